"""Draws the imports between packages and folders into docs/architecture.md.

  python docs/draw_imports.py            # rewrites the drawn parts
  python docs/draw_imports.py --check    # lists what is out of date or against the rules

The rules: imports run one way through the layers, packages of one layer do not import each other,
and no two folders of a package import each other, directly or on the way round.
"""

import argparse
import ast
import collections
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
LAYERS = (
  ("launch", "benchmarks"),
  ("evaluation",),
  ("agents", "real", "sysid"),
  ("suite",),
  ("scenes",),
  ("core",),
)
PACKAGES = tuple(package for layer in LAYERS for package in layer)
_PREFIX = "nerf2real."

Edge = tuple[str, str]  # importing module, imported module


def modules(root: Path = ROOT) -> dict[str, Path]:
  """Returns every module of the packages by its dotted name without `nerf2real.`."""
  found = {}
  for package in PACKAGES:
    for path in sorted((root / package).rglob("*.py")):
      parts = path.relative_to(root).with_suffix("").parts
      found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
  return found


def imports(root: Path = ROOT) -> set[Edge]:
  """Returns all imports among the packages' modules, those inside functions included."""
  known = modules(root)

  def resolve(name: str) -> str:
    name = name.removeprefix(_PREFIX)
    while name and name not in known:
      name = name.rpartition(".")[0]
    return name

  edges = set()
  for module, path in known.items():
    for name in _imported_names(ast.parse(path.read_text())):
      target = resolve(name)
      if target and target != module:
        edges.add((module, target))
  return edges


def _imported_names(tree: ast.AST) -> Iterator[str]:
  for node in ast.walk(tree):
    if isinstance(node, ast.ImportFrom) and node.module:
      yield from (f"{node.module}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Import):
      yield from (alias.name for alias in node.names)


def package_of(module: str) -> str:
  """Returns the package of a module: `scenes` of `scenes.poses.pairs`."""
  return module.partition(".")[0]


def folder_of(module: str) -> str:
  """Returns the folder (or file) below the package: `scenes.poses` of `scenes.poses.pairs`."""
  return ".".join(module.split(".")[:2])


def count(edges: Iterable[Edge], group) -> collections.Counter[Edge]:
  """Counts imports between groups of modules; those inside a group are left out."""
  pairs = ((group(a), group(b)) for a, b in edges)
  return collections.Counter((a, b) for a, b in pairs if a != b)


def wrong_way(edges: Iterable[Edge]) -> list[Edge]:
  """Returns the imports that do not go to a lower layer or stay in their package."""
  level = {package: i for i, layer in enumerate(LAYERS) for package in layer}
  found = []
  for importing, imported in edges:
    a, b = package_of(importing), package_of(imported)
    if a != b and level[a] >= level[b]:
      found.append((importing, imported))
  return sorted(found)


def circles(edges: Iterable[Edge]) -> list[tuple[str, ...]]:
  """Returns groups of a package's folders that import each other, also on the way round."""
  arrows = collections.defaultdict(set)
  for a, b in count(edges, folder_of):
    if package_of(a) == package_of(b) and b != package_of(b) and a != package_of(a):
      arrows[a].add(b)

  def reachable(start: str) -> set[str]:
    seen: set[str] = set()
    stack = [start]
    while stack:
      fresh = arrows[stack.pop()] - seen
      seen |= fresh
      stack.extend(fresh)
    return seen

  reach = {folder: reachable(folder) for folder in list(arrows)}
  groups = {
    tuple(sorted({folder} | {b for b in reach[folder] if folder in reach.get(b, set())}))
    for folder in reach
    if folder in reach[folder]
  }
  return sorted(groups)


def drawing(edges: Iterable[Edge]) -> str:
  """Returns the imports of packages as a Mermaid flowchart; numbers count importing files."""
  lines = ["```mermaid", "flowchart TD"]
  for i, layer in enumerate(LAYERS):
    lines += [f"  subgraph layer{i} [ ]", "    direction LR", *(f"    {p}" for p in layer), "  end"]
  pairs = {(a, b): 0 for a, b in count(edges, package_of)}
  for pair in pairs:
    files = {
      importing
      for importing, imported in edges
      if (package_of(importing), package_of(imported)) == pair
    }
    lines.append(f"  {pair[0]} -->|{len(files)}| {pair[1]}")
  head = lines[: len(lines) - len(pairs)]
  return "\n".join([*head, *sorted(lines[len(head) :]), "```"])


def folder_table(edges: Iterable[Edge], package: str) -> str:
  """Returns a table of a package's folders: their content, files, and what they import of it."""
  known = modules()
  between = count(edges, folder_of)
  names = sorted({folder_of(module) for module in known if package_of(module) == package})
  rows = ["| where | what | files | uses |", "| --- | --- | --- | --- |"]
  for name in names:
    if name == package:
      continue
    files = sum(folder_of(module) == name for module in known)
    uses = sorted(b.split(".")[1] for a, b in between if a == name and b.startswith(package + "."))
    is_folder = (ROOT / Path(*name.split("."))).is_dir()
    where = name.split(".")[1] + ("/" if is_folder else ".py")
    rows.append(f"| `{where}` | {_first_sentence(known[name])} | {files} | {', '.join(uses)} |")
  return "\n".join(rows)


def _first_sentence(path: Path) -> str:
  text = ast.get_docstring(ast.parse(path.read_text())) or ""
  return text.split("\n\n")[0].replace("\n", " ").rstrip(".")


def page(text: str) -> str:
  """Returns the page with its drawn parts made anew; they stand between HTML comments."""
  edges = imports()
  parts = {"imports": drawing(edges)} | {p: folder_table(edges, p) for p in PACKAGES}
  for name, content in parts.items():
    marked = re.compile(rf"(<!-- {name}: drawn -->).*?(<!-- end -->)", re.DOTALL)
    if marked.search(text):
      text = marked.sub(lambda match, content=content: f"{match[1]}\n{content}\n{match[2]}", text)
  return text


def main() -> int:
  """Rewrites the page, or checks it."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("--check", action="store_true", help="change nothing; exit 1 if out of date")
  check = parser.parse_args().check
  edges = imports()
  faults = [f"{a} imports {b}: against the layers" for a, b in wrong_way(edges)]
  faults += [f"folders import each other: {', '.join(group)}" for group in circles(edges)]
  text = PAGE.read_text()
  if check and page(text) != text:
    faults.append(f"{PAGE.name} is out of date: run python docs/draw_imports.py")
  elif not check:
    PAGE.write_text(page(text))
  print(*faults, sep="\n", end="\n" if faults else "")
  return int(bool(faults))


if __name__ == "__main__":
  sys.exit(main())
