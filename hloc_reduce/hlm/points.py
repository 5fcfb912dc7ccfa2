"""The points of a map as a compact file keeps them: a descriptor each, coordinates in few bits."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap

from ..utils.cli import InputError
from ..utils.colmap import point3D_ids
from ..utils.feature_files import dimension, get_descriptors
from ..utils.h5 import open_h5
from ..utils.progress import progress

COORDINATE_ERROR_SHARE = 0.1  # of the mean reprojection error
NEAR_DEPTH_QUANTILE = 0.02  # of the depths, at which it holds
MAX_BITS = 32
MAX_DIGITS = 15  # of a coordinate, behind the point
TOLERANCE, MAX_ROUNDS = 1e-4, 100  # of the places of points, which only have to be about right
PADDING = 8  # bytes behind packed coordinates, as eight are read at once
POINTS_PER_CHUNK = 2**16  # that are packed at once, a multiple of 8


@dataclass(frozen=True)
class Points:
    """Points of a map.

    Args:
        xyz: (P, 3) float64.
        descriptors: (P, D) float32 of unit norm, the mean of those of a point's keypoints.
        names: the images.
        visible: of each image the points that it shows (M,), ascending.
        keypoints: of each image the indices of their keypoints (M,).
        norms: (P,) float32, lengths of the sums of the descriptors of a point's keypoints.
    """

    xyz: np.ndarray
    descriptors: np.ndarray
    names: Sequence[str]
    visible: list[np.ndarray]
    keypoints: list[np.ndarray]
    norms: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)

    def only(self, chosen: np.ndarray) -> "Points":
        """Return chosen points (K,), renumbered in this order."""
        if np.array_equal(chosen, np.arange(len(self))):
            return self
        number = np.full(len(self), -1, np.int32)
        number[chosen] = np.arange(len(chosen))
        visible, keypoints = [], []
        for points, its_keypoints in zip(self.visible, self.keypoints, strict=True):
            kept = number[points] >= 0
            order = np.argsort(number[points][kept])
            visible.append(number[points][kept][order])
            keypoints.append(its_keypoints[kept][order])
        each = self.xyz[chosen], self.descriptors[chosen]
        return Points(*each, self.names, visible, keypoints, self.norms[chosen])


class Sorted:
    """Points in an order in which those that an image shows are near each other.

    Args:
        points: of a map.
    """

    def __init__(self, points: Points):
        self._points = points
        first = np.full((3, len(points)), len(points.names), np.int32)
        for i in reversed(range(len(points.names))):
            shown = points.visible[i]
            first[1:, shown] = first[:-1, shown]
            first[0, shown] = i
        # of points that are at one place, those of the first images first
        self._rows = np.lexsort([*first[::-1], along(points)]).astype(np.int32)
        self._number = np.empty_like(self._rows)
        self._number[self._rows] = np.arange(len(points), dtype=np.int32)

    def __len__(self) -> int:
        return len(self._rows)

    def xyz(self, part: slice) -> np.ndarray:
        """Return the coordinates (K, 3) float64 of some points."""
        return self._points.xyz[self._rows[part]]

    def descriptors(self, part: slice) -> np.ndarray:
        """Return the descriptors (K, D) float32 of some points."""
        return self._points.descriptors[self._rows[part]]

    def visible(self, image: int) -> np.ndarray:
        """Return the points (M,) that an image shows, ascending."""
        return np.sort(self._number[self._points.visible[image]])


def along(points: Points) -> np.ndarray:
    """Return places (P,) of points on a line, on which those of the same images are close together.

    A point is at the mean of the images that show it and an image, but for the scale, at the mean
    of its points: reciprocal averaging (Hill, Applied Statistics 1974). So the lists of visible
    points have half the bytes that they have in the order of the images.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

    point = np.concatenate(points.visible)
    ends = np.cumsum([0, *map(len, points.visible)])
    shape = len(points.names), len(points)
    shows = csr_array((np.ones(len(point)), point, ends), shape=shape)
    of_image, of_point = shows.sum(axis=1), np.maximum(shows.sum(axis=0), 1)
    if len(of_image) < 3:
        return np.zeros(len(points))
    scale = 1 / np.sqrt(np.maximum(of_image, 1))
    same = np.sqrt(of_image / max(of_image.sum(), 1))  # all images at one place, which is left out

    def averaged(images: np.ndarray) -> np.ndarray:
        images = images.ravel() - same * (same @ images.ravel())
        images = scale * (shows @ ((scale * images) @ shows / of_point))
        return images - same * (same @ images)

    matrix = LinearOperator(2 * shape[:1], averaged, dtype=np.float64)
    begin = np.linspace(-1, 1, len(of_image))
    try:
        places = eigsh(matrix, 1, which="LA", v0=begin, tol=TOLERANCE, maxiter=MAX_ROUNDS)[1][:, 0]
    except ArpackError:  # no convergence, or images that all show the same
        return np.zeros(len(points))
    return (scale * places * np.sign(places @ begin)) @ shows / of_point


def collect(
    sfm: pycolmap.Reconstruction, features: Path, names: Sequence[str] | None = None
) -> Points:
    """Collect the points of a map.

    Args:
        sfm: the map.
        features: feature file of its images.
        names: the images that show them, sorted; default: all.

    Raises:
        InputError: when an image has other features, or the map has no points.
    """
    ids = np.sort(np.fromiter(sfm.points3D, np.int64))
    images = {image.name: image for image in sfm.images.values()}
    names = sorted(images) if names is None else names
    visible, shown, sums = [], [], np.zeros((len(ids), dimension(features)), np.float32)
    for name in progress(names, "Collecting points", "image"):
        image = images[name]
        observed = point3D_ids(image)
        keypoints = np.flatnonzero(observed >= 0)
        rows, first = np.unique(np.searchsorted(ids, observed[keypoints]), return_index=True)
        keypoints = keypoints[first]
        with open_h5(features) as file:
            described = get_descriptors(file, name)
        if len(described) != image.num_points2D() or described.shape[1] != sums.shape[1]:
            raise InputError(
                f"{features} has {len(described)} descriptors of {described.shape[1]} numbers for "
                f"{name}: {image.num_points2D()} of {sums.shape[1]} are expected."
            )
        sums[rows] += described[keypoints]
        visible.append(rows.astype(np.int32))
        shown.append(keypoints.astype(np.int32))
    if not len(ids):
        raise InputError("The map has no points.")
    norms = np.linalg.norm(sums, axis=1)
    sums /= np.maximum(norms, 1e-12)[:, None]
    xyz = np.empty((len(ids), 3))
    for row, i in enumerate(ids.tolist()):
        xyz[row] = sfm.points3D[i].xyz
    points = Points(xyz, sums, names, visible, shown, norms)
    return points.only(np.flatnonzero(norms > 0))


def precision(points: Points, sfm: pycolmap.Reconstruction) -> float:
    """Return the step of coordinates whose error is hardly seen in the images.

    At nearly all points it projects to less than `COORDINATE_ERROR_SHARE` of the mean reprojection
    error.
    """
    pixels = max(sfm.compute_mean_reprojection_error(), 0.1) * COORDINATE_ERROR_SHARE
    images = {image.name: image for image in sfm.images.values()}
    depths = [np.zeros(0)]
    for name, rows in zip(points.names, points.visible, strict=True):
        image = images[name]
        local = image.cam_from_world() * points.xyz[rows]
        focal_length = sfm.cameras[image.camera_id].mean_focal_length()
        depths.append(local[:, 2] / focal_length)  # of a pixel
    found = np.concatenate(depths)
    found = found[found > 0]
    per_pixel = float(np.quantile(found, NEAR_DEPTH_QUANTILE)) if found.size else 1.0
    return 2 * pixels * per_pixel / np.sqrt(3)  # the error is up to half a step in each axis


class Grid(NamedTuple):
    """Whole numbers for coordinates: one is `least` + `step` x number.

    Args:
        least: (3,) float64.
        step: the same for all three.
        bits: of each of the three.
    """

    least: np.ndarray
    step: float
    bits: list[int]

    @classmethod
    def of(cls, least: np.ndarray, largest: np.ndarray, step: float) -> "Grid":
        """Return the grid of coordinates.

        Args:
            least: the least ones (3,).
            largest: the largest ones (3,).
            step: about that of the grid; larger if the extent needs more than `MAX_BITS` bits.
        """
        step = float(f"{max(step, float((largest - least).max()) / 2 ** (MAX_BITS - 1)):.3g}")
        if (digits := 1 - int(np.floor(np.log10(step)))) < MAX_DIGITS:  # short in the file
            least = np.array([np.floor(one * 10.0**digits) / 10.0**digits for one in least])
        bits = [int(number).bit_length() for number in np.rint((largest - least) / step)]
        return cls(least, step, [max(1, number) for number in bits])

    def pack(self, xyz: np.ndarray) -> np.ndarray:
        """Pack coordinates (K, 3): (N,) uint8, in whole bytes if K is a multiple of 8."""
        columns = np.rint((xyz - self.least) / self.step).astype(np.uint64).T[..., None]
        flags = [
            (column >> np.arange(number, dtype=np.uint64) & 1).astype(bool)
            for column, number in zip(columns, self.bits, strict=True)
        ]
        return np.packbits(np.hstack(flags), bitorder="little")

    def nbytes(self, number: int) -> int:
        """Return how many bytes `pack` needs for a number of points."""
        return -(-number * sum(self.bits) // 8)


class Coordinates:
    """Coordinates of points in a few bits each, unpacked when they are needed.

    Args:
        packed: (N,) uint8 from `Grid.pack`, and `PADDING` more bytes.
        number: of points.
        grid: that they are on.

    Raises:
        ValueError: when they contradict each other, or are not finite.
    """

    def __init__(self, packed: np.ndarray, number: int, grid: Grid):
        least, step, bits = grid
        fits = least.shape == (3,) == np.shape(bits) and all(0 < n <= MAX_BITS for n in bits)
        if not (fits and number > 0 and len(packed) == grid.nbytes(number) + PADDING):
            raise ValueError(f"{len(packed)} bytes of {number} points of {bits} bits")
        if not np.isfinite(least + step * 2.0**MAX_BITS).all():
            raise ValueError("coordinates that are not finite")
        # the eight bytes from each one on
        shape, strides = (len(packed) - PADDING + 1,), (1,)
        self._words = np.ndarray(shape, "<u8", np.ascontiguousarray(packed), strides=strides)
        self._number, self._least, self._step = number, least, step
        self._size, self._begin = sum(bits), np.cumsum([0, *bits[:2]])
        self._masks = np.array([2**n - 1 for n in bits], np.uint64)

    def __len__(self) -> int:
        return self._number

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        """Return the coordinates (K, 3) float64 of points (K,)."""
        start = rows[:, None] * self._size + self._begin
        whole = self._words[start >> 3] >> (start & 7).astype(np.uint64) & self._masks
        return self._least + self._step * whole

    def all(self) -> np.ndarray:
        """Return the coordinates (P, 3) float64 of all points."""
        return np.concatenate([self[np.arange(part.start, part.stop)] for part in parts(len(self))])


def parts(number: int) -> list[slice]:
    """Split a number of points into those that are packed at once."""
    starts = range(0, number, POINTS_PER_CHUNK)
    return [slice(start, min(start + POINTS_PER_CHUNK, number)) for start in starts]
