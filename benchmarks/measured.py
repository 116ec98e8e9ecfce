"""What the analyser finds in measured data: `python benchmarks/measured.py`.

Runs `sysid.identify` on the real logs in ../shared/data/measured (Dynamixel XL330 at three gains,
and the EMPS positioning benchmark) and keeps the figures in benchmarks/results/measured.json.
There are no answers: what was named, how sure it is and what it lowers is told in measured.md.
"""

import dataclasses
import json
import pathlib
import sys
from typing import Any

import tyro

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1]))
from nerf2real import sysid

ROOT = pathlib.Path(__file__).resolve().parents[1]


@dataclasses.dataclass(frozen=True)
class Settings:
  """What to run."""

  data: pathlib.Path = ROOT / "../shared/data/measured"
  """Folder of sets."""
  out: pathlib.Path = ROOT / "out/measured"
  """Folder of reports."""
  results: pathlib.Path = ROOT / "benchmarks/results"
  """Folder of the figures."""


def main(settings: Settings) -> None:
  """Analyses every set and keeps the figures."""
  rows: dict[str, Any] = {}
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
    rows[folder.name] |= {name: details[name] for name in ("calibration", "clocks")}
    held = content["error"]["held"]
    print(
      f"{folder.name}: {content['verdict']}"
      f" {[e['kind'] for e in content['effects']]}, held-out {1e3 * held['before']:.3f} ->"
      f" {1e3 * held['after']:.3f} mrad (mm), {content['seconds']} s"
    )
  (settings.results / "measured.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
  main(tyro.cli(Settings, description=__doc__))
