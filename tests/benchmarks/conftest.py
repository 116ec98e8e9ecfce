"""The benchmark scripts import each other as they do when they are run: from their own folder."""

import pathlib
import sys

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "benchmarks"))
