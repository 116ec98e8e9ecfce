"""Sentences of a report that follow from what was found."""

from types import SimpleNamespace

import pytest

from nerf2real.sysid.outputs.notes import another_session


@pytest.mark.parametrize(
  ("paired", "apart", "said"), [(True, True, 1), (True, False, 0), (False, True, 0)]
)
def test_a_reference_of_another_session_is_said(paired, apart, said):
  """Where the same motions are compared; other ones are judged by their own scatter."""
  subject = SimpleNamespace(paired=paired, another_session=apart)
  notes = another_session(SimpleNamespace(joint="knee", subject=subject))  # type: ignore[arg-type]
  assert len(notes) == said
  assert all("reference of knee" in note and "friction by 15 %" in note for note in notes)
