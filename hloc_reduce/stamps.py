"""Tell whether a derived file is still up to date, as make does, by what it was made from."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from tqdm import tqdm

from .io import replacing


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
    try:
        return json.loads(path.read_text()) == json.loads(json.dumps(expected))
    except (OSError, ValueError):
        return False


def write(path: Path, made_from: dict) -> None:
    """Write a stamp file."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(made_from, indent=1))


def fingerprints(files: Mapping[str, Path], known: Path) -> dict[str, list]:
    """Compute the size, the time and the sha256 of files.

    Args:
        files: from name to path.
        known: file of earlier ones. What has the size and time that it had there is not read.

    Returns:
        From name to [size, time, digest].
    """
    try:
        before = json.loads(known.read_text())
    except (OSError, ValueError):
        before = {}
    statuses = {name: path.stat() for name, path in files.items()}
    now = {name: [status.st_size, status.st_mtime_ns] for name, status in statuses.items()}
    changed = [name for name in now if before.get(name, [])[:2] != now[name]]
    for name in tqdm(changed, desc="Reading files", unit="file"):
        now[name].append(sha256(files[name]))
    return {name: value if len(value) == 3 else before[name] for name, value in now.items()}


def sha256(path: Path) -> str:
    """Return the sha256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
