"""Time of a policy step on one core: `python benchmarks/policy.py [--policy runs/x/policy/best]`.

Without --policy, a policy of the paper's shape with random parameters is exported and loaded, once
for 30x40 and once for 60x80 pictures. Targets: p99 below 10 ms at 30x40, 25 ms at 60x80. Writes
benchmarks/results/policy.json. Steps take turns, so that sizes see the same machine; under other
load the column of processor time is the one to read.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import json
import platform
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from nerf2real.agents.dmpo.export import ExportedPolicy, load_policy
from nerf2real.core.serialization import to_plain

TARGETS = {(30, 40): 10.0, (60, 80): 25.0}  # ms
# As the suite gives them: 5 steps of 20 joints, 20 previous controls, 3 gyroscope, 3
# accelerometer and 3 gravity numbers, and a goal of 2.
PROPRIOCEPTION = 5 * (20 + 20 + 3 + 3 + 3) + 2
ACTIONS = 20


def random_policy(size: tuple[int, int], folder: Path) -> ExportedPolicy:
  """Exports a policy of the paper's shape with random parameters, and loads it."""
  import jax

  from nerf2real.agents.dmpo import config, networks
  from nerf2real.agents.dmpo.export import export_policy
  from nerf2real.agents.dmpo.learning import flatten_params
  from nerf2real.agents.dmpo.specs import Layout

  settings = config.preset("paper")
  layout = Layout("camera", (*size, 3), ("s",), (PROPRIOCEPTION,), (), (), ACTIONS)
  shapes = jax.eval_shape(
    lambda: networks.init_policy(jax.random.PRNGKey(0), settings.network, layout)
  )
  rng = np.random.default_rng(0)
  params = jax.tree.map(lambda x: 0.05 * rng.normal(size=x.shape).astype(np.float32), shapes)
  export_policy(
    folder,
    flatten_params({"policy": params}),
    layout=layout,
    environment="benchmark",
    settings=to_plain(settings),
    info={},
  )
  return load_policy(folder)


def measure(exported: list[ExportedPolicy], steps: int) -> list[dict[str, float]]:
  """Runs the policies in turns; times in ms."""
  rng = np.random.default_rng(0)
  runs: list[list[Any]] = []
  for loaded in exported:
    shape = loaded.layout.image_shape
    image = None if shape is None else rng.integers(0, 256, shape, dtype=np.uint8)
    state = rng.standard_normal(loaded.layout.state_size, np.float32)
    runs.append([loaded.policy, image, state, loaded.policy.initial_state()])
  wall, processor = np.zeros((len(runs), steps)), np.zeros((len(runs), steps))
  for step in range(-20, steps):  # the first 20 warm up
    for index, run in enumerate(runs):
      policy, image, state, memory = run
      begin, begin_cpu = time.perf_counter(), time.process_time()
      run[3] = policy.step(image, state, memory).state
      if step >= 0:
        wall[index, step] = 1e3 * (time.perf_counter() - begin)
        processor[index, step] = 1e3 * (time.process_time() - begin_cpu)
  return [
    {
      "median_ms": float(np.median(w)),
      "p99_ms": float(np.percentile(w, 99)),
      "max_ms": float(w.max()),
      "median_cpu_ms": float(np.median(c)),
    }
    for w, c in zip(wall, processor, strict=True)
  ]


def main() -> None:
  parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawTextHelpFormatter
  )
  parser.add_argument("--policy", type=Path, help="folder of an exported policy")
  parser.add_argument("--steps", type=int, default=1000)
  parser.add_argument("--out", type=Path, default=Path("benchmarks/results/policy.json"))
  arguments = parser.parse_args()
  with tempfile.TemporaryDirectory() as folder:
    if arguments.policy:
      exported = [load_policy(arguments.policy)]
    else:
      exported = [random_policy(size, Path(folder) / str(size[0])) for size in TARGETS]
    results = measure(exported, arguments.steps)
  rows = []
  for policy, result in zip(exported, results, strict=True):
    shape = policy.layout.image_shape
    name = "state only" if shape is None else f"{shape[0]}x{shape[1]}"
    target = TARGETS.get(shape[:2]) if shape else None
    rows.append({"picture": name, "target_p99_ms": target, **result})
    print(
      f"{name:>10}: median {result['median_ms']:.2f} ms (processor {result['median_cpu_ms']:.2f}), "
      f"p99 {result['p99_ms']:.2f} ms, longest {result['max_ms']:.2f} ms, target {target} ms"
    )
  arguments.out.parent.mkdir(parents=True, exist_ok=True)
  record = {
    "command": "python benchmarks/policy.py",
    "machine": platform.machine(),
    "processor": _processor(),
    "steps": arguments.steps,
    "load": os.getloadavg()[0],
    "rows": rows,
  }
  arguments.out.write_text(json.dumps(record, indent=1) + "\n")


def _processor() -> str:
  path = Path("/proc/cpuinfo")
  lines = path.read_text().splitlines() if path.exists() else []
  return next((n.partition(":")[2].strip() for n in lines if n.startswith("model name")), "")


if __name__ == "__main__":
  main()
