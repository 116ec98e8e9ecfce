"""A log identified: what the declared model of a servo lacks, from the sample that lies beside.

  python examples/identify_log.py

`examples/servo` is a pendulum on a servo, made by `benchmarks/make_blind_sets.py` (the command is
in examples/README.md); answers.json says what is hidden in it.
"""

import json
import pathlib

from nerf2real import sysid

SAMPLE = pathlib.Path(__file__).parent / "servo"


def main() -> None:
  """Identifies, and prints what was found beside the truth."""
  found = sysid.identify(
    SAMPLE / "model.xml",
    sorted(SAMPLE.glob("train_*.mcap")),
    held=sorted(SAMPLE.glob("held_*.mcap")),
    out=pathlib.Path("out/servo"),
  )
  (answer,) = json.loads((SAMPLE / "answers.json").read_text()).values()
  print(f"verdict: {found['verdict']}")
  print("found:", ", ".join(f"{e['kind']} at {e['joint']}" for e in found["effects"]) or "nothing")
  print("truth:", ", ".join(f"{e['kind']} at {e['joint']}" for e in answer["effects"]))
  held = found["error"]["held"]
  print(f"held-out error {1000 * held['before']:.1f} -> {1000 * held['after']:.1f} mrad")
  print("report: out/servo/report.html")


if __name__ == "__main__":
  main()
