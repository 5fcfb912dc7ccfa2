"""The wheel has everything that the commands need outside the repository."""

import os
import platform
import shutil
import subprocess
import sys
import zipfile

import pytest
from package_copy import FOLDERS, ROOT, copy_package

from hloc_reduce import projections
from hloc_reduce.networks import MINI

pytestmark = pytest.mark.check


def has_compiler() -> bool:
    compiler = os.environ.get("CXX", "c++")
    if not shutil.which(compiler):
        return False
    return subprocess.run([compiler, "--version"], capture_output=True).returncode == 0


def test_wheel_is_complete(tmp_path):
    source = copy_package(tmp_path / "source")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", tmp_path]
    subprocess.run([*command, source], check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
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
        assert any(name.startswith("hloc_reduce/utils/_best_two.") for name in names)
    assert "hloc_reduce/retrieval/vlad_sift_sv64.safetensors" in names
    assert {f"hloc_reduce/report/page.{kind}" for kind in ("html", "css", "js")} <= names
    assert "hloc_reduce/evaluation/published/localization_recall.csv" in names
