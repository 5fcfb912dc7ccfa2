"""The settings of the documentation's site, which `make docs` builds with Sphinx.

Its source is the whole repository, so that links between pages, and to files, are those that
work without a site. The first page is README.md.
"""

from pathlib import Path

from sphinx.application import Sphinx

project = "hloc-reduce"
author = "the authors of hloc-reduce"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "README"
include_patterns = ["*.md", "docs/*.md", "docs/api.rst", "results/*.md"]
exclude_patterns = ["build", "datasets", "outputs", "**/.*"]
html_theme = "furo"
html_title = project
html_copy_source = False
myst_heading_anchors = 4
default_role = "literal"  # docstrings are Markdown
autodoc_default_options = {"members": True, "member-order": "bysource"}

CONTENTS = {
    "Use": "tutorial localize maps features hloc operations",
    "Small maps": "map-format robot serve export",
    "Data sets": "aachen inloc evaluation",
    "Results": "results performance lab ../results/README",
    "Training": "training models",
    "Reference": "api glossary architecture ../CONTRIBUTING ../CHANGELOG ../SECURITY",
}
PACKAGE = Path(__file__).parents[1] / "hloc_reduce"
MODULES = [
    "hloc_reduce",
    "hloc_reduce.maps",
    "hloc_reduce.maps.localizer",
    "hloc_reduce.confs.features",
    "hloc_reduce.confs.matchers",
    "hloc_reduce.compact",
    "hloc_reduce.utils.ros",
    *sorted(f"hloc_reduce.{path.stem}" for path in PACKAGE.glob("[!_]*.py")),  # the stages
]


def add_contents(app: Sphinx, page: str, source: list[str]) -> None:
    """Add the list of pages to the first page, and the modules to that of the API."""
    if page == root_doc:
        for caption, pages in CONTENTS.items():
            paths = "\n".join(f"/docs/{name}" for name in pages.split())
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{paths}\n```\n"
    if page == "docs/api":
        for module in MODULES:
            source[0] += f"\n{module}\n{'-' * len(module)}\n\n.. automodule:: {module}\n"


def setup(app: Sphinx) -> None:
    """Have Sphinx call `add_contents`."""
    app.connect("source-read", add_contents)
