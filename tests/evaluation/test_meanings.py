"""Reports say unit, meaning and good values of their figures."""

from nerf2real.core.pages.blocks import Figure, Figures
from nerf2real.evaluation.episodes import OUTCOMES
from nerf2real.evaluation.report import meanings as of_evaluation
from nerf2real.sysid.report import meanings as of_identification


def test_every_outcome_but_success_counts_trials_and_is_best_at_none():
  figures = {figure.name: figure for figure in of_evaluation.FIGURES}
  for outcome in OUTCOMES[1:]:
    assert (figures[outcome].unit, figures[outcome].good) == ("trials", "0")
  assert figures["success"].good == "higher"


def test_figures_have_a_meaning_and_quantities_a_good_value():
  for figure in (*of_evaluation.FIGURES, *of_identification.FIGURES):
    assert figure.meaning and figure.value is None
  named = [figure.name for figure in of_identification.FIGURES if not figure.good]
  assert named == ["noise of the readings"]  # a property of the sensor


def test_meanings_alone_have_no_column_of_values():
  with_values = Figures([Figure("speed", 0.2, "m/s", "along the path", "higher")]).table
  without = Figures([Figure("speed", None, "m/s", "along the path", "higher")]).table
  assert "value" in with_values.header and "value" not in without.header
  assert len(without.rows[0]) == len(without.header)
