"""Names of frames that are time stamps, such as 0012.345.jpg."""

import re
from collections.abc import Iterable
from decimal import Decimal
from pathlib import PurePosixPath

_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?")


def name_of(seconds: float) -> str:
    """Return the name of the frame at a time: sorted by name, frames are in order for 2.7 hours."""
    return f"{seconds:08.3f}.jpg"


def time_stamps(names: Iterable[str]) -> dict[str, Decimal] | None:
    """Return the time stamps that names are, exact in all digits.

    Args:
        names: of images; they may be in folders.

    Returns:
        The time stamps by name, or None if a name is not a number, or two are the same time.
    """
    stems = {name: PurePosixPath(name).stem for name in names}
    if not all(map(_NUMBER.fullmatch, stems.values())):
        return None
    found = {name: Decimal(stem) for name, stem in stems.items()}
    return found if len({*found.values()}) == len(found) else None


def in_order(names: Iterable[str]) -> list[str]:
    """Sort images of each folder by their time stamps, or by name if a name is not a number."""
    names = sorted(names)
    paths = {name: PurePosixPath(name) for name in names}
    if not all(_NUMBER.fullmatch(path.stem) for path in paths.values()):
        return names
    return sorted(names, key=lambda name: (paths[name].parts[:-1], Decimal(paths[name].stem)))
