"""UBC PhotoTour patches (Winder and Brown, 2007), in the layout of its zip files.

Each sequence is a folder of sheets `patches0000.bmp`, ... of 16x16 patches of 64x64 pixels;
`info.txt`, whose lines begin with the number of the 3D point that a patch shows; and lists of pairs
`m50_100000_100000_0.txt`, or with other numbers of matching and other pairs.
"""

from pathlib import Path

import cv2
import numpy as np

from ..descriptors import PATCH_SIZE
from ..utils.cli import InputError

PATCHES_PER_SIDE, PATCH_PIXELS = 16, 64
PREFERRED_PAIRS = "m50_100000_100000_0.txt"  # preferred to other lists


def read_points(folder: Path) -> np.ndarray:
    """Read the number of the point that each patch shows, (N,) int64.

    Raises:
        InputError: if the folder is not a sequence.
    """
    info = folder / "info.txt"
    if not info.is_file():
        raise InputError(
            f"{folder} is not a PhotoTour sequence: it has no info.txt "
            "(http://matthewalunbrown.com/patchdata/patchdata.html)."
        )
    points = []
    for number, line in enumerate(info.read_text(errors="replace").splitlines(), 1):
        try:
            points.append(int(line.split()[0]))
        except (ValueError, IndexError):
            raise InputError(f"{info}, line {number}: no number of a point.") from None
    if len(set(points)) == len(points):
        raise InputError(f"{info}: no two patches show the same point.")
    missing = -(-len(points) // PATCHES_PER_SIDE**2) - len(sheets(folder))
    if missing > 0:
        raise InputError(f"{info} names {len(points)} patches, {missing} sheets are missing.")
    return np.array(points)


def sheets(folder: Path) -> list[Path]:
    """Return the sheets of patches, in order."""
    return sorted(folder.glob("patches[0-9][0-9][0-9][0-9].bmp"))


def read_sheet(path: Path) -> np.ndarray:
    """Read the patches (256, 32, 32) float32 in [0, 1] of a sheet, row by row.

    Raises:
        InputError: if it is not a sheet.
    """
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None or image.shape != (PATCHES_PER_SIDE * PATCH_PIXELS,) * 2:
        raise InputError(f"{path} is not a sheet of 16x16 patches of 64x64 pixels.")
    patches = (
        image.reshape(PATCHES_PER_SIDE, PATCH_PIXELS, PATCHES_PER_SIDE, PATCH_PIXELS)
        .swapaxes(1, 2)
        .reshape(-1, PATCH_PIXELS, PATCH_PIXELS)
    )
    size = (PATCH_SIZE, PATCH_SIZE)
    small = [cv2.resize(patch, size, interpolation=cv2.INTER_AREA) for patch in patches]
    return np.stack(small).astype(np.float32) / 255


def read_pairs(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read the pairs of patches (P, 2) int64 for verification, and whether they match (P,) bool.

    Raises:
        InputError: if the list is missing or broken.
    """
    path = folder / PREFERRED_PAIRS
    if not path.is_file():
        path = max(folder.glob("m50_*_*_0.txt"), default=path)
    if not path.is_file():
        raise InputError(f"There is no list of pairs {path}.")
    rows = []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), 1):
        try:
            values = np.array(line.split(), np.int64)
            rows.append((values[0], values[3], values[1] == values[4]))
        except (ValueError, IndexError, OverflowError):
            raise InputError(f"{path}, line {number}: not a pair of patches and points.") from None
    pairs = np.array(rows, np.int64).reshape(-1, 3)
    matches = pairs[:, 2] == 1
    if matches.all() or not matches.any():
        raise InputError(f"{path} needs both matching pairs and others.")
    return pairs[:, :2], matches
