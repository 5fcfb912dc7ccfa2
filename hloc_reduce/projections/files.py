"""The files of projections: those that ship, those of the paper's authors, and those of users."""

import re
from pathlib import Path

from ..descriptors import DESCRIPTORS
from ..utils.cli import InputError
from ..utils.files import file_sha256
from . import released

WEIGHTS = Path(__file__).parent / "weights"
# how to make one that does not ship
COMMAND = (
    "python -m hloc_reduce.training --descriptor {descriptor} --scheme {scheme}{dim} "
    "--map IMAGES:MODEL --output weights"
)
# sift_nested@24: the first 24 numbers of sift_nested; an @ in the path of a file is its own
PREFIX = re.compile(r"(.+)@([^@/\\.]+)")


def names() -> list[str]:
    """List the projections that ship."""
    return sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


def find(projection: str | Path) -> Path:
    """Return the file of a projection, given by the name of one that ships or by its path.

    `@` and a prefix may follow.

    Those of hardnet that the paper's authors released are downloaded once.

    Raises:
        InputError: when it is not there, does not ship or cannot be had.
    """
    name, prefix = split_prefix(projection)
    path = Path(name)
    if path.suffix:
        if not path.is_file():
            raise InputError(f"There is no projection file {path}.")
        return path
    path = WEIGHTS / f"{name}.safetensors"
    if path.is_file():
        return path
    if name in released.FILES:
        return released.fetch(name)
    parts = re.fullmatch(r"([a-z]+)_([a-z]+)(\d*)", name)
    if not parts or parts[1] not in DESCRIPTORS:
        raise InputError(f"There is no projection {name}. Those that ship: {', '.join(names())}.")
    descriptor, scheme, dim = parts.groups()
    command = COMMAND.format(
        descriptor=descriptor, scheme=scheme, dim=f" --dim {dim}" if dim else ""
    )
    raise InputError(
        f"The projection {name} does not ship. Train it by '{command}' and give the pipeline "
        f"'--projection weights/{name}.safetensors{prefix and '@' + prefix}'."
    )


def split_prefix(projection: str | Path) -> tuple[str, str]:
    """Split `name@24` into the name and the prefix, "" where there is none."""
    match = PREFIX.fullmatch(str(projection))
    return match.groups() if match else (str(projection), "")


def checksum(projection: str | Path) -> str:
    """Return the sha256 of a projection's file, to tell which one made a feature file."""
    return file_sha256(find(projection))
