"""Tables of the report's page."""

import pytest

from nerf2real.sysid.report import page


def _derating(back_emf):
  figure = {"value": 4.0, "low": 3.0, "high": 5.0, "unit": "K/(s N^2 m^2)"}
  choice = {"value": back_emf, "low": None, "high": None, "unit": "1"}
  parameters = {"heating": figure, "back_emf": choice}
  return {"kind": "thermal_derating", "joint": "knee", "parameters": parameters, "evidence": {}}


@pytest.mark.parametrize(("back_emf", "said"), [(1.0, 1), (0.0, 0)])
def test_a_choice_between_models_is_said_in_words_and_is_no_row(back_emf, said):
  rows, bounds = page._parameters([_derating(back_emf)])
  assert [row[2] for row in rows] == ["heating"] and len(bounds) == 1
  sentences = page._choices([_derating(back_emf)])
  assert len(sentences) == said
  assert all(text.endswith("motor's back-EMF, which takes from the current.") for text in sentences)
