"""Pages of judged runs lie in their generator's folder, named by seed, and the index has them."""

import json
import string

import pytest

from benchmarks import identify


@pytest.mark.parametrize(
  ("plants", "folder"),
  [
    (("pendulum", "arm"), "first"),
    (("arm", "slider"), "second"),
    (("bent",), "third"),
    (("arm",), "second"),  # both have arms: as it was asked for
    (("other",), "second"),
  ],
)
def test_plants_tell_the_folder(plants, folder):
  answers = {f"1_{index}": {"plant": plant} for index, plant in enumerate(plants)}
  assert identify.folder_of(answers, "independent_sets") == folder


def test_every_page_is_where_its_sets_belong_and_in_the_index():
  index = (identify.RESULTS / "README.md").read_text()
  pages = [path for path in identify.RESULTS.rglob("*.md") if path.name != "README.md"]
  assert len(pages) > 30
  placed: list[tuple[str, str]] = []  # a generator's set stands on one page
  for page in pages:
    assert f"({page.relative_to(identify.RESULTS)})" in index, page
    scores = page.with_suffix(".json")
    if scores.is_file():
      content = json.loads(scores.read_text())
      # A letter behind the seed: sets of it that were judged later.
      seed = page.stem.rstrip(string.ascii_lowercase)
      assert {name.split("_")[0] for name in content["sets"]} == {seed}, page
      placed += [(page.parent.name, name) for name in content["sets"]]
      generator = {v: k for k, v in identify.FOLDERS.items()}[page.parent.name]
      assert identify.folder_of(content["answers"], generator) == page.parent.name, page
  assert len(set(placed)) == len(placed) > 100


def test_runs_are_put_together(tmp_path, monkeypatch):
  """Cases add up over pages, every set is listed, each generator has figures of its own."""
  kept_of = {}
  monkeypatch.setattr(
    identify.harness, "finish", lambda name, figures, *_, seed, within: kept_of.update({name: seed})
  )
  pages = ("second/8315", "third/9115")
  kept = [json.loads((identify.RESULTS / f"{page}.json").read_text()) for page in pages]
  healthy = sum(row["score"]["mix"] == "healthy" for page in kept for row in page["scores"])
  identify.main(identify.Settings(pool=pages, results=tmp_path, name="identify_both"))
  text = (tmp_path / "both.md").read_text()
  assert f"| healthy: accused | 0 % (0 to 31 %) | {healthy} |" in text
  assert all(f"| {name} " in text for page in kept for name in page["sets"])
  assert kept_of == {
    "identify_both": "8315, 9115",
    "identify_both_second": "8315",
    "identify_both_third": "9115",
  }
  with pytest.raises(ValueError, match=r"Found no .*third/1\.json"):
    identify.main(identify.Settings(pool=("third/1",), results=tmp_path))
