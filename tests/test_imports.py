"""Which module imports which, and that a command that has nothing to do imports little."""

import json
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
checker = runpy.run_path(str(ROOT / "benchmarks/imports.py"))
HEAVY = {"torch", "kornia", "scipy", "sklearn", "matplotlib", "safetensors.torch", "ray"}


def test_imports_point_down():
    graph = checker["imports"](checker["modules"]())
    assert len(graph) > 100
    assert checker["upward"](graph) == []
    assert checker["cycle"](graph) == []


def test_imports_that_point_up_or_in_a_circle_are_found(tmp_path):
    for name, text in {
        "hloc_reduce/utils/low.py": "def f():\n    from ..maps import build",
        "hloc_reduce/maps/__init__.py": "",
        "hloc_reduce/maps/build.py": "from . import other\nimport pipelines.job",
        "hloc_reduce/maps/other.py": "from .build import main",
        "pipelines/job.py": "from hloc_reduce.utils.low import f",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    graph = checker["imports"](checker["modules"](tmp_path))
    assert checker["upward"](graph) == [
        "hloc_reduce.maps.build -> pipelines.job",
        "hloc_reduce.utils.low -> hloc_reduce.maps.build",
    ]
    assert {"hloc_reduce.maps.build"} < set(checker["cycle"](graph))


COMMANDS = [
    "pipelines.aachen --list_features",
    "pipelines.aachen --feature sfit",
    "pipelines.aachen --no_such_option",
    "pipelines.aachen --dataset no/such/folder",
    "pipelines.localize --outputs o --map no/such/map --query_images no/such/folder",
    "pipelines.batch no/such/jobs.yaml",
    "hloc_reduce.export --feature xfaet --output file.onnx",
    *(
        f"pipelines.{name} --help"
        for name in ("aachen", "inloc", "localize", "shrink", "batch", "compare")
    ),
    *(
        f"hloc_reduce.{name} --help"
        for name in (
            "check",
            "export",
            "extract_features",
            "match_features",
            "localize_sfm",
            "report",
            "storage",
            "reduce",
            "to_colmap",
            "from_colmap",
        )
    ),
]

# Runs commands one after the other, each to its exit, and prints what each imports first.
PROGRAM = """
import contextlib, io, json, runpy, sys
import hloc_reduce

known = {*sys.modules}
first = {"import hloc_reduce": [*known]}
for command in sys.argv[1:]:
    module, *arguments = command.split()
    sys.argv = ["", *arguments]
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit:
        first[command] = [*{*sys.modules} - known]
    known |= {*sys.modules}
print(json.dumps(first))
"""


@pytest.fixture(scope="module")
def imported() -> dict[str, set[str]]:
    """What each command imports that those before it did not; all of them end by an exit."""
    program = [sys.executable, "-c", PROGRAM, *COMMANDS]
    run = subprocess.run(program, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert run.returncode == 0, run.stderr
    return {command: {*names} for command, names in json.loads(run.stdout).items()}


def test_the_package_imports_little(imported):
    names = imported["import hloc_reduce"]
    assert "hloc_reduce" in names and not names & (HEAVY | {"numpy", "cv2", "pycolmap"})


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_that_have_nothing_to_do_import_little(command, imported):
    assert not imported[command] & HEAVY
