"""Tell whether a derived file is still up to date, as make does, by what it was made from."""

import json
from pathlib import Path

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
