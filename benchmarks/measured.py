"""What the analyser finds in measured data: `python benchmarks/measured.py`.

Runs `sysid.identify` on the real logs in ../shared/data/measured (Dynamixel XL330 at three gains,
and the EMPS positioning benchmark) and keeps the figures in benchmarks/results/measured.json.
There are no answers: what was named, how sure it is and what it lowers stands in measured.md.
"""

import dataclasses
import json
import pathlib
from typing import Any

from benchmarks import harness
from benchmarks.ledger.records import ROOT
from nerf2real import sysid

_SIDES = ("before", "after", "single", "median", "least", "most")


@dataclasses.dataclass(frozen=True)
class Settings:
  """What to run."""

  data: pathlib.Path = ROOT / "../shared/data/measured"
  """Folder of sets."""
  out: pathlib.Path = ROOT / "out/measured"
  """Folder of reports."""
  results: pathlib.Path = ROOT / "benchmarks/results"
  """Folder of the figures."""
  write: bool = False
  """Keep the errors as records in benchmarks/results/records/."""


def main(settings: Settings) -> None:
  """Analyses every set and keeps the figures."""
  rows: dict[str, Any] = {}
  figures: dict[str, dict[str, harness.Value]] = {}
  for folder in sorted(p for p in settings.data.iterdir() if (p / "model.xml").is_file()):
    content = sysid.identify(
      folder / "model.xml",
      sorted(folder.glob("train*.mcap")),
      held=sorted(folder.glob("held*.mcap")),
      out=settings.out / folder.name,
    )
    kept = ("verdict", "effects", "alternatives", "residual_at", "error", "seconds")
    details = json.loads((settings.out / folder.name / "details.json").read_text())
    rows[folder.name] = {name: content[name] for name in kept}
    rows[folder.name] |= {name: details[name] for name in ("calibration", "clocks", "servo")}
    error = content["error"]
    figures[folder.name] = {
      "verdict": content["verdict"],
      **{
        f"{name}_{side}": 1e3 * error[name][side]
        for name in ("train", "held")
        if name in error
        for side in _SIDES
        if side in error[name]
      },
      "models": error["held"].get("models", 1),
      **_gain(content["effects"]),
      "seconds": content["seconds"],
    }
    print(folder.name, figures[folder.name], flush=True)
  (settings.results / "measured.json").write_text(json.dumps(rows, indent=1) + "\n")
  words = "Errors in mrad (positioning: mm)."
  harness.finish("measured", figures, harness.Options(write=settings.write), words=words)


def _gain(effects: list[dict[str, Any]]) -> dict[str, harness.Value]:
  """Returns a servo's gain and its interval, where one is claimed."""
  found = [row["parameters"]["gain"] for row in effects if row["kind"] == "motor_gain"]
  return {f"gain_{end}": found[0][end] for end in ("value", "low", "high")} if found else {}


if __name__ == "__main__":
  harness.run(main, Settings, __doc__)
