"""What a release says of itself agrees, and GitHub and PyPI can read it."""

import re
import runpy
import subprocess
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from test_wheel import WITHOUT_SOURCE

from hloc_reduce import __version__

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SCHEMAS = {
    "github-workflows": sorted(ROOT.glob(".github/workflows/*")),
    "github-issue-forms": sorted(ROOT.glob(".github/ISSUE_TEMPLATE/[!c]*")),
    "github-issue-config": [ROOT / ".github/ISSUE_TEMPLATE/config.yml"],
    "citation-file-format": [ROOT / "CITATION.cff"],
}


def test_versions_agree():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == __version__
    versions = re.findall("^## ([^ \n]+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert versions[0] == __version__


@pytest.mark.check
@pytest.mark.skipif(find_spec("check_jsonschema") is None, reason="needs check-jsonschema")
@pytest.mark.parametrize("schema", SCHEMAS)
def test_files_have_the_schemas_of_github(schema):
    assert SCHEMAS[schema]
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}"]
    done = subprocess.run([*command, *SCHEMAS[schema]], capture_output=True, text=True)
    assert not done.returncode, done.stdout


def test_tests_of_an_installed_wheel_import_nothing_of_the_repository():
    paths = [path for folder in WITHOUT_SOURCE for path in (ROOT / folder).rglob("*.py")]
    assert len(paths) > 15
    found = re.compile(r"^\s*(from|import) (benchmarks|examples)", re.MULTILINE)
    assert not [path.name for path in paths if found.search(path.read_text())]


def test_workflows_call_what_exists():
    """Files, and targets of make."""
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for path in SCHEMAS["github-workflows"]:
        text = path.read_text()
        assert all((ROOT / file).exists() for file in re.findall(r"\.ci/\w+(?:\.py)?", text))
        assert set(re.findall(r"make ([\w-]+)", text)) <= set(targets)


def test_pypi_shows_links_to_the_repository():
    absolute = runpy.run_path(str(ROOT / ".ci/absolute_links.py"))["absolute"]
    text = "[a](#b) [c](docs/d.md#e) ![f\ng](docs/h.svg) [i](https://j) [k\nl](NOTICE)"
    found = "[a](#b) [c](R:/blob/X/docs/d.md#e) ![f\ng](R:/raw/X/docs/h.svg) [i](https://j) "
    assert absolute(text, "R:", "X") == found + "[k\nl](R:/blob/X/NOTICE)"
    links = re.findall(r"\]\(([^)]*)\)", absolute((ROOT / "README.md").read_text(), "R:", "X"))
    assert len(links) > 50 and all(link.startswith(("R:", "https:")) for link in links)


def test_licenses_of_dependencies_are_listed():
    listed = dict(re.findall(r"^([\w-]+): (.+)$", (ROOT / "NOTICE").read_text(), re.MULTILINE))
    wanted = {canonicalize_name(Requirement(line).name) for line in PROJECT["dependencies"]}
    assert listed.keys() == wanted
    found = runpy.run_path(str(ROOT / ".ci/licenses.py"))
    for name, one in found["needed"]("hloc-reduce").items():
        license = found["license_of"](one)
        assert license != "unknown", name
        assert "GPL" not in license, f"{name}: {license}"
