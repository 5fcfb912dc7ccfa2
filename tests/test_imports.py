"""Which module imports which, and that a command that has nothing to do imports little."""

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


def loaded(code: str) -> set[str]:
    """Return the modules that a program has loaded when it ends."""
    code = f"import sys\ntry:\n    {code}\nfinally:\n    print(*sys.modules, file=sys.stderr)"
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)
    return set(run.stderr.splitlines()[-1].split())


def test_the_package_imports_little():
    names = loaded("import hloc_reduce")
    assert "hloc_reduce" in names and not names & (HEAVY | {"numpy", "cv2", "pycolmap"})


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


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_that_have_nothing_to_do_import_little(command):
    module, *arguments = command.split()
    argv = f"sys.argv = ['', *{arguments}]; import runpy; "
    names = loaded(f"{argv}runpy.run_module('{module}', run_name='__main__', alter_sys=True)")
    assert "hloc_reduce.utils.cli" in names and not names & HEAVY
