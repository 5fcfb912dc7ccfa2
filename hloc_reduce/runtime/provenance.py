"""Tell whether a derived file is still up to date, as make does, by what it was made from."""

import json
from collections.abc import Mapping
from pathlib import Path

from ..utils.files import file_sha256, replacing
from ..utils.progress import progress


def stamp(options: dict, inputs: list[Path]) -> dict:
    """Describe what a file is made from: options, and the size and time of each input file."""
    files = {}
    for path in inputs:
        status = path.stat()
        key = path.name if path.name not in files else str(path)
        files[key] = [status.st_size, status.st_mtime_ns]
    return {"options": options, "inputs": files}


def is_current(path: Path, expected: dict) -> bool:
    """Return whether the stamp file `path` is there and says what is expected."""
    return bool(expected) and read(path) == json.loads(json.dumps(expected))


def read(path: Path) -> dict:
    """Read a stamp file; one that is not there or broken is empty."""
    try:
        return dict(json.loads(path.read_text()))
    except (OSError, ValueError, TypeError):
        return {}


def write(path: Path, made_from: dict) -> None:
    """Write a stamp file."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(made_from, indent=1))


def fingerprints(files: Mapping[str, Path], before: Mapping[str, list]) -> dict[str, list]:
    """Compute the size, the time and the sha256 of files.

    Args:
        files: from name to path.
        before: earlier ones. A file that still has its size and time is not read.

    Returns:
        From name to [size, time, digest].
    """
    statuses = {name: path.stat() for name, path in files.items()}
    now = {name: [status.st_size, status.st_mtime_ns] for name, status in statuses.items()}
    changed = [name for name in now if before.get(name, [])[:2] != now[name]]
    for name in progress(changed, "Reading files", "file"):
        now[name].append(file_sha256(files[name]))
    return {name: value if len(value) == 3 else before[name] for name, value in now.items()}


def changed(before: Mapping[str, list], now: Mapping[str, list]) -> list[str]:
    """Return the names whose fingerprints are in both, but of other contents."""
    return [name for name in now if name in before and before[name][2] != now[name][2]]
