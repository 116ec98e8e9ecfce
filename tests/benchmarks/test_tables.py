"""The READMEs' figures equal their records, and the check of that can fail."""

import pytest

from benchmarks import tables
from benchmarks.ledger import prose
from benchmarks.ledger import records as ledger
from benchmarks.ledger.records import Rate, Record

RECORDS = {
  record.id: record
  for record in (
    Record(
      id="x.speed",
      what="speed",
      values={"t_ms": 2.345, "share": Rate(10, 11), "long_s": 12345.0},
      unit={"t_ms": "ms", "long_s": "s"},
      found="{t_ms:.1f} ms",
      asked="3 ms",
      command="python x",
      commit="unknown",
      stated_in="abc1234",
      machine="m",
      date="2026-01-01",
      evidence=("README.md",),
    ),
  )
}
BLOCKS = {
  "root": "The most important ones.\n",
  "speed": "| a | b | c |\n{row x.speed}\n| d | {x.speed/share.count} / {x.speed/share:.0f} |\n",
}
FOLDERS = {"x": "speeds"}
GOOD = """# A

<!-- figures: speed -->
<!-- /figures -->

It takes 2.3 ms. <!-- record: x.speed -->
"""


@pytest.fixture
def root(tmp_path):
  (tmp_path / "README.md").write_text(GOOD)
  for path, text in tables.differences(tmp_path, RECORDS, BLOCKS, FOLDERS).items():
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(text)
  return tmp_path


def _check(root, allowed=None):
  return tables.check(
    root, RECORDS, BLOCKS, FOLDERS, allowed or {"benchmarks/ledger/tables.md": {}}
  )


def test_this_checkout_s_readmes_agree_with_their_records():
  """If this fails: python benchmarks/tables.py --write, and read what it says."""
  found = tables.check(
    ledger.ROOT, ledger.read(), tables.templates(), ledger.folders(), prose.read_allowed()
  )
  assert not found, "\n".join(found)


def test_blocks_and_page_are_generated(root):
  text = (root / "README.md").read_text()
  assert "| speed | 2.3 ms | 3 ms |\n| d | 10 / 91 |\n<!-- /figures -->" in text
  assert "[speeds](speeds.md): x" in (root / "docs/figures/README.md").read_text()
  page = (root / "docs/figures/speeds.md").read_text()
  assert "| speed | 2.3 ms [59 to 100 %] | 3 ms |" in page and "(abc1234); *old*" in page
  assert _check(root) == []


def test_a_page_without_records_is_found(root):
  (root / "docs/figures/old.md").write_text("# Figures: old\n")
  assert _check(root) == [
    "docs/figures/old.md: no folder of records has this name; remove the page"
  ]


def test_a_figure_changed_by_hand_is_found(root):
  text = (root / "README.md").read_text()
  (root / "README.md").write_text(text.replace("| speed | 2.3 ms", "| speed | 1.9 ms"))
  assert _check(root) == [
    "README.md: differs from its records; run python benchmarks/tables.py --write"
  ]


@pytest.mark.parametrize(
  ("sentence", "problem"),
  [
    ("It takes 2.4 ms. <!-- record: x.speed -->", '"2.4 ms" differs from x.speed'),
    ("It takes 2.36 ms. <!-- record: x.speed -->", '"2.36 ms" differs from x.speed'),
    ("It takes 2.3 s. <!-- record: x.speed -->", '"2.3 s" differs from x.speed'),
    ("It takes 2.3 ms.", '"2.3 ms" has no record'),
    ("9 of 11 walk. <!-- record: x.speed -->", '"9 of 11" differs from x.speed'),
    ("- a list: 31.5 dB", '"31.5 dB" has no record'),
    ("| a | 5 / 7 % |", '"7 %" has no record'),
    ("It takes 2.3 ms. <!-- record: x.other -->", "names no record"),
  ],
)
def test_a_figure_without_its_record_is_found(root, sentence, problem):
  with (root / "README.md").open("a") as stream:
    stream.write(f"\n{sentence}\n")
  assert any(problem in line for line in _check(root)), _check(root)


@pytest.mark.parametrize(
  "sentence",
  [
    "10 of 11 walk: 91 %, in 12,345 s. <!-- record: x.speed -->",
    "It runs at 40 Hz on pictures of 30x40.",
    "`sleep 3 s` and [a page](pages/5 m) are no figures.\n\n```\n7 ms\n```",
    "Version 3.11 or newer, 20 joints, table 5.",
  ],
)
def test_what_is_recorded_or_allowed_or_no_figure_passes(root, sentence):
  with (root / "README.md").open("a") as stream:
    stream.write(f"\n{sentence}\n")
  assert _check(root, {"*": {"40 Hz": "rate of control"}}) == []


def test_a_figure_typed_into_a_template_is_found(root):
  blocks = BLOCKS | {"speed": BLOCKS["speed"] + "| e | 77 ms |\n"}
  found = tables.check(root, RECORDS, blocks, FOLDERS, {})
  assert any('benchmarks/ledger/tables.md: "77 ms" has no record' in line for line in found)


@pytest.mark.parametrize(
  ("template", "message"),
  [("{row x.none}", "x.none"), ("{x.none/t_ms}", "x.none"), ("{x.speed/none}", "no value 'none'")],
)
def test_a_template_that_names_nothing_is_an_error(template, message):
  with pytest.raises(ValueError, match=message):
    tables.render(template, RECORDS)


def test_a_block_without_template_and_a_template_without_block(root):
  (root / "README.md").write_text("<!-- figures: other -->\n<!-- /figures -->\n")
  with pytest.raises(ValueError, match="other"):
    _check(root)
  (root / "README.md").write_text("# A\n")
  assert "tables.md: no README has the block speed" in _check(root)


def test_evidence_must_be_there(root):
  (root / "README.md").rename(root / "x.md")
  assert "record x.speed: its evidence README.md is not there" in _check(root)
