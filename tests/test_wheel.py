"""What is published: complete, and it works where nothing else is installed."""

import os
import platform
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest
from package_copy import FOLDERS, ROOT, copy_package

from hloc_reduce import __version__, projections
from hloc_reduce.networks import MINI

pytestmark = pytest.mark.check

# tests that need nothing of the repository but themselves
WITHOUT_SOURCE = "tests/models", "tests/hlm"
# the environment without what makes the source tree importable
CLEAN = {
    name: value
    for name, value in os.environ.items()
    if name != "PYTHONPATH" and not name.startswith("PYTEST_")
}


def has_compiler() -> bool:
    compiler = os.environ.get("CXX", "c++")
    if not shutil.which(compiler):
        return False
    return subprocess.run([compiler, "--version"], capture_output=True).returncode == 0


def build(source: Path, target: Path, *options: str, **environment: str) -> None:
    """Build with what is installed; without options a source distribution, and a wheel of that."""
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", target, *options]
    subprocess.run([*command, source], check=True, capture_output=True, env=CLEAN | environment)


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with the source distribution, and the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("built")
    build(copy_package(folder / "source"), folder / "dist")
    return folder / "dist"


def wheel_of(folder: Path) -> Path:
    (wheel,) = folder.glob("*.whl")
    return wheel


def test_wheel_is_complete(built):
    wheel = wheel_of(built)
    sizes = {entry.filename: entry.file_size for entry in zipfile.ZipFile(wheel).infolist()}
    names = sizes.keys()
    modules = {
        path.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*.py")
    }
    assert modules <= names
    weights = {
        f"hloc_reduce/projections/weights/{name}.safetensors" for name in projections.names()
    }
    assert weights and weights <= names
    for network in MINI:
        assert sizes[f"hloc_reduce/networks/weights/{network}.safetensors"] < 1e6
    if has_compiler() and platform.system() == "Linux":
        assert "hloc_reduce/utils/_best_two.abi3.so" in names
        assert wheel.name.startswith(f"hloc_reduce-{__version__}-cp311-abi3-linux_")
    assert "hloc_reduce/retrieval/vlad_sift_sv64.safetensors" in names
    assert {f"hloc_reduce/report/page.{kind}" for kind in ("html", "css", "js")} <= names
    assert "hloc_reduce/evaluation/published/localization_recall.csv" in names
    licenses = f"hloc_reduce-{__version__}.dist-info/licenses"
    assert {f"{licenses}/LICENSE", f"{licenses}/NOTICE"} <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/"))]
    assert wheel.stat().st_size < 30e6  # PyPI takes 100 MB


def test_pure_wheel(built, tmp_path):
    with tarfile.open(built / f"hloc_reduce-{__version__}.tar.gz") as archive:
        archive.extractall(tmp_path, filter="data")
    source = tmp_path / f"hloc_reduce-{__version__}"
    build(source, tmp_path, "--wheel", HLOC_REDUCE_PURE="1")
    wheel = wheel_of(tmp_path)
    assert wheel.name == f"hloc_reduce-{__version__}-py3-none-any.whl"
    compiled = {"hloc_reduce/utils/_best_two.abi3.so"}
    names, others = (set(zipfile.ZipFile(path).namelist()) for path in (wheel, wheel_of(built)))
    assert names - others == set() and others - names <= compiled


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """The Python of a new environment with the wheel, and with pytest, with tested versions."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv/bin/python"

    def pip(*arguments: object, check: bool = True) -> subprocess.CompletedProcess:
        command = [python, "-m", "pip", *map(str, arguments)]
        return subprocess.run(command, check=check, capture_output=True, text=True, env=CLEAN)

    # torch by itself first, as in the Makefile
    constraints = ROOT / "constraints.txt"
    (torch,) = (line for line in constraints.read_text().splitlines() if line.startswith("torch=="))
    if pip("download", "--no-deps", "--dest", folder, "threadpoolctl", check=False).returncode:
        pytest.skip("there is no package index to install from")
    for packages in ([torch], [wheel_of(built)], ["pytest", "hypothesis"]):
        done = pip("install", "--no-compile", "--constraint", constraints, *packages, check=False)
        assert not done.returncode, done.stderr
    done = pip("check", check=False)
    assert not done.returncode, done.stdout
    return python


def test_an_installed_wheel_localizes(installed, aachen_layout, tmp_path):
    """As the first command of README.md, in photos that are smaller than the demo town's."""
    options = ["--feature", "colmap_sift_sv64", "--dataset", aachen_layout, "--outputs", "outputs"]
    command = [installed, "-m", "pipelines.aachen", *options]
    done = subprocess.run(command, cwd=tmp_path, env=CLEAN, capture_output=True, text=True)
    assert "Localized 2 of 3 queries" in done.stderr, done.stderr
    code = (
        "import hloc_reduce; from hloc_reduce.utils import best_two;"
        "print(hloc_reduce.__file__, *best_two.instructions(), sep='\\n')"
    )
    found = subprocess.run(
        [installed, "-c", code], check=True, cwd=tmp_path, env=CLEAN, capture_output=True, text=True
    )
    place, *instructions = found.stdout.splitlines()
    assert place.startswith(str(installed.parents[1]))
    assert bool(instructions) == (has_compiler() and platform.system() == "Linux")


def test_tests_pass_with_an_installed_wheel(installed, tmp_path):
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "tests", tmp_path / "tests", ignore=ignored)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    options = ["-q", "-m", "not long and not check", "-o", "pythonpath=", "-o", "addopts="]
    command = [installed, "-m", "pytest", "-p", "no:cacheprovider", *options, *WITHOUT_SOURCE]
    done = subprocess.run(command, cwd=tmp_path, env=CLEAN, capture_output=True, text=True)
    assert not done.returncode, done.stdout[-3000:]
