"""The documentation: links lead somewhere, and commands and files that it names exist."""

import io
import re
import subprocess
import sys
from collections import Counter
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pycolmap
import pytest

from hloc_reduce.hlm.images import MODELS

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("results/*.md")])
OTHERS = "https://", "http://", "mailto:"

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```|^    .*?$", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    found, seen = set(), Counter()
    for heading in re.findall(r"^#+ (.*)$", without_code(page.read_text()), re.MULTILINE):
        title = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", title).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found


@every_page
def test_links_lead_somewhere(page):
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", without_code(page.read_text())):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if link.startswith(OTHERS):
            continue
        if not target.exists() or anchor and anchor not in anchors(target):
            broken.append(link)
    assert not broken


@every_page
def test_commands_exist(page):
    text = page.read_text()
    modules = set(re.findall(r"python -m ((?:hloc_reduce|pipelines|benchmarks)[\w.]*\w)", text))
    assert not [module for module in modules if find_spec(module) is None]
    files = set(re.findall(r"\b((?:benchmarks|confs|tests)/[\w/]+\.\w+)", text))
    assert not [file for file in files if not (ROOT / file).exists()]


@cache
def options(module: str, *subcommand: str) -> set[str]:
    """Return the options of a command."""
    if hasattr(import_module(module), "__path__"):
        module += ".__main__"
    argv, stdout = sys.argv, sys.stdout
    sys.argv, sys.stdout = [module, *subcommand, "--help"], io.StringIO()
    try:
        with pytest.raises(SystemExit):
            import_module(module)._main()
        return set(re.findall(r"--\w+", sys.stdout.getvalue()))
    finally:
        sys.argv, sys.stdout = argv, stdout


@every_page
def test_options_of_commands_exist(page):
    text, unknown = page.read_text().replace("\\\n", " "), []
    for module, arguments in re.findall(
        r"python -m ((?:hloc_reduce|pipelines)[\w.]+)([^\n`|]*)", text
    ):
        if module != "hloc_reduce.hloc":  # those are of modules of hloc
            subcommand = re.findall(r"^ ([a-z]+) --", arguments)
            known = options(module, *subcommand)
            given = re.findall(r" (--\w+)", arguments)
            unknown += [(module, option) for option in given if option not in known]
    assert not unknown


@pytest.mark.check
@pytest.mark.skipif(
    None in map(find_spec, ("sphinx", "myst_parser", "furo")), reason="needs the docs extra"
)
def test_the_site_is_built_without_a_warning(tmp_path):
    """And has all pages."""
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet"]
    options = ["-c", ROOT / "docs", "-d", tmp_path / "cache", ROOT, tmp_path / "site"]
    done = subprocess.run([*command, *options], capture_output=True, text=True)
    assert not done.returncode, done.stderr
    for page in PAGES:
        name = page.relative_to(ROOT).with_suffix(".html")
        assert (tmp_path / "site" / name).exists(), name
    reference = (tmp_path / "site/docs/api.html").read_text()
    assert 'id="hloc_reduce.maps.localizer.Localizer.localize"' in reference
    assert 'id="hloc_reduce.extract_features.main"' in reference


def test_camera_models_of_the_format():
    text = (ROOT / "docs/map-format.md").read_text()
    listed = re.findall(r"`([A-Z_]+)`\s\((\d+)\)", text)
    for number, name in MODELS.items():
        parameters = len(pycolmap.Camera(model=name).params_info.split(","))
        assert name == "EQUIRECTANGULAR" or listed[number] == (name, str(parameters))


@pytest.mark.parametrize("name", ["CONTRIBUTING.md", "docs/architecture.md", "docs/map-format.md"])
def test_files_of_the_code_exist(name):
    paths = set(re.findall(r"`([\w/]+/[\w.]*)`", (ROOT / name).read_text()))
    places = ROOT / "hloc_reduce", ROOT
    assert not [path for path in paths if not any((place / path).exists() for place in places)]
