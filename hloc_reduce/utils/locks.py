"""Locks of files, which some network file systems do not have."""

import fcntl
from collections.abc import Callable
from pathlib import Path


def has_locks(path: Path, lock: Callable[..., object] = fcntl.flock) -> bool:
    """Return whether the file system of a file has locks, be the file locked or not.

    Args:
        path: the file.
        lock: `fcntl.flock`, which HDF5 uses, or `fcntl.lockf`, which SQLite uses.

    Raises:
        OSError: when the file cannot be read.
    """
    with path.open("rb") as file:
        try:
            lock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):  # another program has locked it
            return True
        except OSError:
            return False
    return True
