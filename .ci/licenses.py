"""List the licences of what an installed package needs, from the metadata of what is installed.

python .ci/licenses.py [PACKAGE[EXTRA,...]]
"""

import sys
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def license_of(found: Distribution) -> str:
    """Return the licence in one line: an SPDX expression where the package has one."""
    classifiers = [
        line.rpartition(" :: ")[2]
        for line in found.metadata.get_all("Classifier") or []
        if line.startswith("License :: ") and line != "License :: OSI Approved"
    ]
    text = found.metadata.get("License") or ""
    short = text if text and len(text.splitlines()) == 1 and len(text) < 50 else ""
    return found.metadata.get("License-Expression") or short or ", ".join(classifiers) or "unknown"


def needed(package: str) -> dict[str, Distribution]:
    """Return the installed packages that a package needs, by name, those that these need, too."""
    found: dict[str, Distribution] = {}
    todo = [Requirement(package)]
    while todo:
        wanted = todo.pop()
        try:
            one = distribution(wanted.name)
        except PackageNotFoundError:
            continue
        name = canonicalize_name(wanted.name)
        if name in found and not wanted.extras:
            continue
        found[name] = one
        for line in one.requires or []:
            requirement = Requirement(line)
            extras = ["", *wanted.extras]
            if not requirement.marker or any(
                requirement.marker.evaluate({"extra": extra}) for extra in extras
            ):
                todo.append(requirement)
    return found


if __name__ == "__main__":
    for name, one in sorted(needed(*sys.argv[1:] or ["hloc-reduce"]).items()):
        print(f"{name} {one.version}: {license_of(one)}")
