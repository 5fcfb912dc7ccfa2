"""Print which rooms of the code import which, and fail if an import points up or in a cycle.

A room is a package of hloc_reduce, its stages, or another top-level package. A room may import the
rooms before it in `ROOMS`.
"""

import ast
import sys
from collections import Counter
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
STAGES = "stages"  # the modules at the top level of hloc_reduce
# the lowest first
ROOMS = (
    "utils",
    "runtime",
    "detectors",
    "descriptors",
    "networks",
    "projections",
    "extractors",
    "retrieval",
    "matchers",
    "confs",
    "datasets",
    "localization",
    "mapping",
    STAGES,
    "hlm",
    "maps",
    "check",
    "compact",
    "serve",
    "evaluation",
    "report",
    "demo",
    "training",
    "hloc",
    "hloc_reduce",
    "pipelines",
    "confs (shown)",
)


def modules(root: Path = ROOT) -> dict[str, Path]:
    """Return the file of each module by dotted name."""
    files = {}
    for package in ("hloc_reduce", "pipelines", "confs"):
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


def imports(files: dict[str, Path]) -> dict[str, set[str]]:
    """Return the modules that each module imports, at its top or in a function."""
    return {name: set(_imported(name, path, files)) - {name} for name, path in files.items()}


def _imported(name: str, path: Path, files: dict[str, Path]) -> Iterator[str]:
    package = name.split(".") if path.name == "__init__.py" else name.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in files)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            source = ".".join([*above, *([node.module] if node.module else [])])
            for alias in node.names:
                found = f"{source}.{alias.name}" if f"{source}.{alias.name}" in files else source
                # every room may import the logger and the version from hloc_reduce itself
                if found in files and found != "hloc_reduce":
                    yield found


def room(module: str) -> str:
    """Return the room of a module."""
    top, *rest = module.split(".")
    if top == "confs":
        return "confs (shown)"
    if top == "pipelines" or not rest:
        return top
    return rest[0] if rest[0] in ROOMS else STAGES


def upward(graph: dict[str, set[str]]) -> list[str]:
    """Return the imports of modules in higher rooms, as text."""
    return [
        f"{module} -> {other}"
        for module, others in graph.items()
        for other in sorted(others)
        if ROOMS.index(room(other)) > ROOMS.index(room(module))
    ]


def cycle(graph: dict[str, set[str]]) -> list[str]:
    """Return the modules of an import cycle, none if there is no cycle."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def _main() -> None:
    graph = imports(modules())
    edges = Counter((room(m), room(other)) for m, others in graph.items() for other in others)
    for name in reversed(ROOMS):
        used = [f"{other} {edges[name, other]}" for other in ROOMS if edges[name, other]]
        inside = sum(room(module) == name for module in graph)
        print(f"{name} ({inside} modules): {', '.join(used) or 'nothing'}")
    wrong = [f"points up: {edge}" for edge in upward(graph)]
    if found := cycle(graph):
        wrong.append(f"in a cycle: {' <- '.join(found)}")
    print("\n".join(wrong) or "No import points up or is in a cycle.")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    _main()
