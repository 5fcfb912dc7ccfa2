"""Provenance: what determines the content of a file.

A file is stale when its provenance has changed. There are two mechanisms. Each derived file has a
header with its provenance: the attributes of an h5 file (`group_writer`), the first line of a JSON
lines file, a JSON file in or beside a COLMAP model. Each outputs folder has a configuration,
conf.json (`outputs`). A third, the fingerprints of photos, serves users who copy or touch their
photos: their content counts, not their time.
"""

import json
from collections.abc import Mapping
from pathlib import Path

from ..utils.files import file_sha256, replacing
from ..utils.progress import progress

MADE_FROM = "made_from.json"  # the provenance of files beside it, such as a COLMAP model


def of_inputs(options: dict, inputs: list[Path]) -> dict:
    """Return the provenance of a file: options, and the size and time of each input file."""
    files = {}
    for path in inputs:
        status = path.stat()
        key = path.name if path.name not in files else str(path)
        files[key] = [status.st_size, status.st_mtime_ns]
    return {"options": options, "inputs": files}


def is_current(path: Path, expected: dict) -> bool:
    """Tell whether the JSON file `path` exists and has the expected content."""
    return bool(expected) and read(path) == json.loads(json.dumps(expected))


def read(path: Path) -> dict:
    """Read a JSON file; a missing or broken one is empty."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def write(path: Path, content: dict) -> None:
    """Write a JSON file."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1))


def fingerprints(files: Mapping[str, Path], before: Mapping[str, list]) -> dict[str, list]:
    """Compute the size, time and sha256 of files.

    Args:
        files: paths by name.
        before: earlier fingerprints. A file that still has its size and time is not read.

    Returns:
        [size, time, digest] by name.
    """
    statuses = {name: path.stat() for name, path in files.items()}
    now: dict[str, list] = {name: [s.st_size, s.st_mtime_ns] for name, s in statuses.items()}
    changed = [name for name in now if before.get(name, [])[:2] != now[name]]
    for name in progress(changed, "Reading files", "file"):
        now[name].append(file_sha256(files[name]))
    return {name: value if len(value) == 3 else before[name] for name, value in now.items()}


def changed(before: Mapping[str, list], now: Mapping[str, list]) -> list[str]:
    """Return the names that have fingerprints in both, with different digests."""
    return [name for name in now if name in before and before[name][2] != now[name][2]]
