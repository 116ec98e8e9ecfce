"""Figures of the tables against the paper's own counts and hand-computed ones; what is kept."""

import html
import json

import numpy as np
import pytest

from nerf2real.evaluation import episodes
from nerf2real.evaluation.report import page as report
from nerf2real.evaluation.report import tables
from nerf2real.suite.gaits.floor import EmptyFloor
from tests.evaluation.fakes import episode


def _many(successes, count, **changes):
  return [episode("success" if k < successes else "lost", index=k, **changes) for k in range(count)]


@pytest.mark.parametrize(
  ("successes", "count", "printed"),
  [(37, 54, "69±6%"), (47, 54, "87±5%"), (25, 32, "78±7%"), (6, 14, "43±14%")],
)
def test_errors_are_the_papers(successes, count, printed):
  """Counts and percentages of the paper's real robot (tables I and II)."""
  table = tables.navigation_table(_many(successes, count))
  assert table.rows[0].cells[0] == f"{printed} (n={count})"


def test_navigation_table_has_the_papers_columns_side_by_side():
  found = [
    *_many(3, 4, localisation_error=0.2),
    *[
      episode(index=k, plant="virtual", time=8.0 + k, localisation_error=0.1 * k) for k in range(5)
    ],
  ]
  table = tables.navigation_table(found)
  names = ("Success", "Time taken", "Localization error")
  assert table.header == (
    "Policy resolution",
    *(f"Simulation: {n}" for n in names),
    *(f"Virtual robot: {n}" for n in names),
    *(f"Robot: {n}" for n in names),
  )
  cells = table.rows[0].cells
  assert cells[0] == "75±25% (n=4)" and cells[3] == "100±0% (n=5)"
  assert cells[1].startswith("10.0±0.0 sec") and cells[4].startswith("10.0±")
  assert cells[2].startswith("0.20±0.00 m") and cells[5].startswith("0.20±")
  assert cells[6:] == ("-", "-", "-")
  paper = {row.name: row.cells for row in table.rows[1:]}
  assert paper["60 x 80 (paper)"][0] == "86±2%" and paper["60 x 80 (paper)"][6] == "87±5%"


def test_medians_are_over_successes_and_have_bootstrapped_errors():
  values = np.random.default_rng(0).normal(10, 2, 400)
  found = tables.median(values)
  # Standard error of a normal sample's median: 1.2533 sigma / sqrt(n).
  assert found.value == pytest.approx(np.median(values))
  assert found.error == pytest.approx(1.2533 * 2 / 20, rel=0.25)
  assert tables.time_taken([episode(time=4.0), episode("fall")]).episodes == 1
  assert tables.median([]) is None


def test_ball_table():
  found = [
    *_many(25, 32, group="center", protocol="ball", plant="virtual"),
    *_many(6, 14, group="wall", protocol="ball", plant="virtual"),
  ]
  table = tables.ball_table(found)
  assert table.header[1:5] == (
    "Simulation: Center",
    "Simulation: Wall",
    "Virtual robot: Center",
    "Virtual robot: Wall",
  )
  assert table.rows[0].cells[:4] == ("-", "-", "78±7% (n=32)", "43±14% (n=14)")
  assert table.rows[1].cells == ("99%", "100%", "-", "-", "78±7%", "43±14%")


def test_gain_table_counts_and_says_what_happened():
  found = [
    *_many(4, 5, group="gain 50", protocol="gain"),
    *[episode("collision", index=k, group="gain 10", protocol="gain") for k in range(4)],
    episode("fall", index=4, group="gain 10", protocol="gain"),
  ]
  rows = {row.name.split(",")[0]: row.cells for row in tables.gain_table(found).rows}
  assert list(rows) == ["128", "90", "50", "10", "1"]
  assert rows["50"] == ("4/5", "reached the goal 4/5, got lost 1/5")
  assert rows["10"] == ("0/5", "hit an obstacle 4/5, fell 1/5")
  assert rows["1"] == ("-", "-")


def test_two_policies_of_one_name_are_two_rows():
  found = [episode(policy_id="d1"), episode("lost", policy_id="d2")]
  rows = tables.navigation_table(found).rows
  assert [row.cells[0] for row in rows[:2]] == ["100% (n=1)", "0% (n=1)"]
  assert "d1" in rows[0].name and "d2" in rows[1].name


def test_disturbed_episodes_stay_out_of_the_papers_tables():
  found = [*_many(4, 4), *_many(0, 4, perturbation="person")]
  (table,) = tables.paper_tables(found)
  assert table.rows[0].cells[0] == "100±0% (n=4)"
  outcomes = tables.outcome_table(found)
  assert [row.cells[:2] for row in outcomes.rows] == [("4", "4"), ("4", "0")]
  assert "person" in outcomes.rows[1].name


def test_other_conditions_have_a_table_of_their_own():
  found = [*_many(4, 4), *_many(1, 4, conditions="scene office (1a2b3c4d)")]
  built_in, office = tables.paper_tables(found)
  assert built_in.rows[0].cells[0] == "100±0% (n=4)" and office.rows[0].cells[0] == "25±25% (n=4)"
  assert office.title.endswith("; scene office (1a2b3c4d)")
  assert "scene office" in tables.outcome_table(found).rows[1].name


def test_store_goes_on_where_a_run_was_cut_off(tmp_path):
  store = episodes.Store(tmp_path)
  moment = episodes.Moment(
    time=0.5, position=(1.0, 2.0), logits=[0.0], means=[[1.0, 2.0, 0.1]], stddevs=[[0.1, 0.1, 1.0]]
  )
  first = episode(index=3, moments=[moment], path=[[0.0, 1.0, 2.0, 0.5]])
  store.add(first)
  store.add(episode("fall", index=4))
  with store.path.open("a") as stream:
    stream.write('{"setting": {"policy": "p", "pol')  # the run was killed here
  again = episodes.Store(tmp_path)
  assert again.episodes[0] == first and len(again.episodes) == 2
  again.add(episode(index=5))
  assert [e.index for e in episodes.Store(tmp_path).episodes] == [3, 4, 5]
  assert first.key in again.done()
  assert episode(index=3, plant="virtual").key not in again.done()
  lines = again.path.read_text().splitlines()
  again.path.write_text("\n".join([lines[0], "{", *lines[1:]]) + "\n")
  with pytest.raises(ValueError, match="line 2 is damaged"):
    episodes.Store(tmp_path)
  # A whole line of another version is no rest of a write: it is not removed.
  again.path.write_text(f"{lines[0]}\n" + lines[1].replace('"outcome"', '"ended_as"') + "\n")
  before = again.path.read_text()
  with pytest.raises(ValueError, match="line 2 is damaged.*ended_as"):
    episodes.Store(tmp_path)
  assert again.path.read_text() == before


def test_report_holds_tables_paths_and_every_episode(tmp_path):
  path = [[0.2 * k, 0.1 * k, 0.0, 0.0] for k in range(9)]
  found = [episode(path=path), episode("collision", index=1, path=path, plant="virtual")]
  report.write(tmp_path / "report.html", found, scene=EmptyFloor(), settings={"seed": 3})
  page = (tmp_path / "report.html").read_text()
  for text in ("Table I", "How the episodes ended", "Where the robot went", "collision", "paper"):
    assert text in page
  assert page.count("data:image/jpeg") == 2 and '"seed": 3' in html.unescape(page)
  assert json.loads(json.dumps(found[0].path)) == path


def test_paths_are_drawn_over_the_map_of_their_own_scene(tmp_path):
  path = [[0.2 * k, 0.1 * k, 0.0, 0.0] for k in range(9)]
  office = "scene office (1a2b3c4d)"
  found = [
    episode(path=path),
    episode(path=path, index=1, conditions="drawn actions"),
    episode(path=path, index=2, conditions=office),
    episode(path=path, index=3, conditions=f"{office}, at most 20 s"),
    episode(path=path, index=4, conditions="scene office (5e6f7a8b)"),
  ]
  for condition, maps_drawn in (("", 2), (office, 2)):
    report.write(tmp_path / "report.html", found, scene=EmptyFloor(), condition=condition)
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/jpeg") == maps_drawn
    assert "in the scene of the last command alone" in page


def test_a_trial_that_is_there_twice_is_counted_once(tmp_path):
  """Two processes that wrote into one folder would turn three trials into six."""
  store = episodes.Store(tmp_path)
  for index in range(3):
    store.add(episode(index=index))
  store.path.write_text(2 * store.path.read_text())
  again = episodes.Store(tmp_path)
  assert [e.index for e in again.episodes] == [0, 1, 2] and again.duplicates == 3
  (table,) = tables.paper_tables(again.episodes)
  assert table.rows[0].cells[0] == "100±0% (n=3)"
