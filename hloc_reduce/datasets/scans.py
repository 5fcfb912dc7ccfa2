"""The RGB-D scans of InLoc: their poses, and the 3D points of the pixels of cutouts."""

from pathlib import Path

import numpy as np

from ..utils.cli import InputError

TRANSFORMATION = slice(7, 11)  # lines of the second one of two matrices, "after GICP"


def floor_of(cutout: str) -> str:
    """Return the floor of a cutout from its name.

    Raises:
        InputError: as for `transformation_file`.
    """
    return _parts(cutout)[0]


def transformation_file(root: Path, cutout: str) -> Path:
    """Return the file with the pose of a cutout's scan.

    Raises:
        InputError: if the name does not have the form
            database/cutouts/<floor>/<scan>/<building>_cutout_<scan>_<yaw>_<pitch>.jpg.
    """
    floor, scan, name = _parts(cutout)
    building = name.partition("_cutout_")[0]
    folder = root / "database/alignments" / floor / "transformations"
    return folder / f"{building}_trans_{scan}.txt"


def _parts(cutout: str) -> list[str]:
    parts = cutout.split("/")[-3:]
    if len(parts) < 3 or "_cutout_" not in parts[2]:
        raise InputError(
            f"{cutout} is not the name of a cutout, database/cutouts/<floor>/<scan>/"
            "<building>_cutout_<scan>_<yaw>_<pitch>.jpg."
        )
    return parts


def read_pose(root: Path, cutout: str) -> np.ndarray:
    """Read the pose of a cutout's scan, floor from scan (4, 4) in metres, "after GICP".

    Raises:
        InputError: if its file is missing or has no such matrix.
    """
    return read_transformation(transformation_file(root, cutout))


def read_transformation(path: Path) -> np.ndarray:
    """Read the pose of a scan from its file, as `read_pose` returns it."""
    try:
        lines = path.read_text().splitlines()[TRANSFORMATION]
        matrix = np.array([[float(word) for word in line.split()] for line in lines])
    except OSError as error:
        raise InputError(f"Cannot read the transformation {path}: {error.strerror}.") from None
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{path} has no 4x4 matrix in its lines 8 to 11.")
    return matrix


def read_scan(path: Path) -> np.ndarray:
    """Read the `XYZcut` (H, W, 3) of a cutout's .mat file: metres in the frame of the scan.

    Pixels without depth are NaN.

    Raises:
        InputError: if the file is missing or has no such array.
    """
    from scipy.io import loadmat

    try:
        scan = loadmat(path, variable_names=["XYZcut"])["XYZcut"]
    except KeyError:
        raise InputError(f"{path} has no XYZcut.") from None
    except Exception as error:  # scipy raises whatever a broken file leads it to
        reason = " ".join(str(error).split())
        raise InputError(f"Cannot read the scan {path} ({reason}).") from None
    if scan.ndim != 3 or scan.shape[2] != 3 or not scan.size or scan.dtype.kind != "f":
        raise InputError(f"{path}: XYZcut is {scan.dtype} {scan.shape}, not (H, W, 3) floats.")
    return scan


def interpolate(scan: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Interpolate the points of a scan at keypoints.

    The result is bilinear if all four pixels around a keypoint have depth, else the point of the
    nearest one of them that has.

    Args:
        scan: (H, W, 3), NaN where there is no depth.
        keypoints: (N, 2) x, y in pixels of the scan, centres at integers; clipped to its border.

    Returns:
        (N, 3) float64, NaN where none of the four pixels has depth.
    """
    last = np.array(scan.shape[1::-1]) - 1
    place = np.clip(keypoints, 0, last)
    first = np.minimum(np.floor(place), np.maximum(last - 1, 0)).astype(int)
    around = first[:, None] + [[0, 0], [1, 0], [0, 1], [1, 1]]
    offset = np.abs(place[:, None] - around)
    x, y = np.minimum(around, last).transpose(2, 0, 1)
    points = scan[y, x].astype(np.float64)
    known = np.isfinite(points).all(axis=2)
    linear = ((1 - offset).prod(axis=2)[:, :, None] * points).sum(axis=1)
    nearest = np.where(known, (offset**2).sum(axis=2), np.inf).argmin(axis=1)
    nearest = points[np.arange(len(points)), nearest]
    found = np.where(known.all(axis=1, keepdims=True), linear, nearest)
    return np.where(known.any(axis=1, keepdims=True), found, np.nan)
