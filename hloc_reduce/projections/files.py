"""The files of projections: shipped, released by the paper's authors, and trained by users."""

import json
import re
from pathlib import Path

import numpy as np

from ..descriptors import DESCRIPTORS
from ..utils.cli import InputError
from ..utils.codes import check_levels
from ..utils.files import file_sha256
from . import released

WEIGHTS = Path(__file__).parent / "weights"
# trains a projection that does not ship
COMMAND = (
    "python -m hloc_reduce.training --descriptor {descriptor} --scheme {scheme}{dim} "
    "--map IMAGES:MODEL --output weights"
)
NAME = re.compile(r"(\w+)_([a-z]+)(\d*)")  # descriptor, scheme, dimension
# sift_nested@24: the first 24 numbers of sift_nested; an @ in a folder or a suffix is no prefix
PREFIX = re.compile(r"(.+)@([^@/\\.]+)")


def names() -> list[str]:
    """List the shipped projections."""
    return sorted(path.stem for path in WEIGHTS.glob("*.safetensors"))


def find(projection: str | Path) -> Path:
    """Return the file of a projection, given by its name or path, with or without a prefix.

    The projections of hardnet that the paper's authors released are downloaded once.

    Raises:
        InputError: when it is missing, does not ship or cannot be downloaded.
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
    if name in released.WEIGHT_FILES:
        return released.fetch(name)
    parts, shipped = NAME.fullmatch(name), filter(None, map(NAME.fullmatch, names()))
    if not parts or parts[1] not in {*DESCRIPTORS, *(other[1] for other in shipped)}:
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
    """Split `name@24`, the first 24 dimensions, into the name and "24"; "" without a number."""
    match = PREFIX.fullmatch(str(projection))
    return (match[1], match[2]) if match else (str(projection), "")


def level_key(storage: str, prefix: str | int = "") -> str:
    """Return the name of the tensor with the levels of a storage, for a prefix if any."""
    return f"levels.{storage}" + (f"@{prefix}" if prefix else "")


def levels(projection: str | Path, storage: str) -> np.ndarray:
    """Return the levels (D, 2**bits) float32 of a projection for a storage in `codes.CODED`.

    Raises:
        InputError: when it has none, or they are broken.
    """
    from safetensors import SafetensorError, safe_open

    path, (name, prefix) = find(projection), split_prefix(projection)
    key = level_key(storage, prefix)
    try:
        with safe_open(path, "np") as file:
            found = check_levels(file.get_tensor(key), storage)
            layers = json.loads((file.metadata() or {}).get("layers", "null"))
    except SafetensorError:
        said = f"The projection {Path(name).stem}{prefix and '@' + prefix} has no levels"
        if path.suffix != ".safetensors":
            said += ", and a .pth file can have none: use --storage uint8."
            raise InputError(said) from None
        # with other levels, a shipped file would make all files that were made with it stale
        is_shipped = path.parent == WEIGHTS
        add = f"copy {path} and add levels to the copy" if is_shipped else "add levels"
        raise InputError(
            f"{said} for {storage}: use --storage uint8, or {add} with 'python -m hloc_reduce."
            f"training.levels --projection {'COPY' if is_shipped else path} --map IMAGES:MODEL'."
        ) from None
    except ValueError as error:
        raise InputError(f"{path} has {error}.") from None
    dim = prefix or (layers[-1] if isinstance(layers, list) and layers else "unknown")
    if str(len(found)) != str(dim):
        raise InputError(
            f"{path} has levels for {len(found)} numbers, but its descriptors have {dim}."
        )
    return found


def checksum(projection: str | Path) -> str:
    """Return the sha256 of a projection's file, the provenance of feature files."""
    return file_sha256(find(projection))
