"""The points of a map as a compact file keeps them: a descriptor each, coordinates in few bits."""

from dataclasses import dataclass
from pathlib import Path

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
    names: list[str]
    visible: list[np.ndarray]
    keypoints: list[np.ndarray]
    norms: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)

    def only(self, chosen: np.ndarray) -> "Points":
        """Return chosen points (K,), renumbered in this order."""
        number = np.full(len(self), -1)
        number[chosen] = np.arange(len(chosen))
        visible, keypoints = [], []
        for points, its_keypoints in zip(self.visible, self.keypoints, strict=True):
            kept = number[points] >= 0
            order = np.argsort(number[points][kept])
            visible.append(number[points][kept][order])
            keypoints.append(its_keypoints[kept][order])
        each = self.xyz[chosen], self.descriptors[chosen]
        return Points(*each, self.names, visible, keypoints, self.norms[chosen])

    def sorted(self) -> "Points":
        """Return the points in the order of the images that show them, the first ones first."""
        first = np.full((3, len(self)), len(self.names))
        for i in reversed(range(len(self.names))):
            points = self.visible[i]
            first[1:, points] = first[:-1, points]
            first[0, points] = i
        return self.only(np.lexsort(first[::-1]))


def collect(sfm: pycolmap.Reconstruction, features: Path) -> Points:
    """Collect the points of a map.

    Args:
        sfm: the map.
        features: feature file of its images.

    Raises:
        InputError: when an image has other features, or the map has no points.
    """
    ids = np.array(sorted(sfm.point3D_ids()), np.int64)
    images = {image.name: image for image in sfm.images.values()}
    names = sorted(images)
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
        visible.append(rows)
        shown.append(keypoints)
    if not len(ids):
        raise InputError("The map has no points.")
    norms = np.linalg.norm(sums, axis=1)
    xyz = np.array([sfm.points3D[i].xyz for i in ids])
    descriptors = sums / np.maximum(norms, 1e-12)[:, None]
    points = Points(xyz, descriptors, names, visible, shown, norms)
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


def quantize(xyz: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray, float, list[int]]:
    """Pack coordinates into as few bits as a step needs.

    Args:
        xyz: (P, 3).
        step: of the coordinates; larger if the extent needs more than `MAX_BITS` bits.

    Returns:
        Bytes (N,) uint8; the least coordinates (3,); the step; and the bits of each coordinate.
    """
    least = xyz.min(axis=0)
    extent = float((xyz - least).max())
    step = max(step, extent / (2**MAX_BITS - 1), np.finfo(np.float64).tiny)
    whole = np.rint((xyz - least) / step).astype(np.uint64)
    bits = [max(1, int(largest).bit_length()) for largest in whole.max(axis=0)]
    packed = []
    for start in range(0, len(whole), POINTS_PER_CHUNK):
        columns = whole[start : start + POINTS_PER_CHUNK].T[..., None]
        flags = [
            column >> np.arange(number, dtype=np.uint64) & 1
            for column, number in zip(columns, bits, strict=True)
        ]
        packed.append(np.packbits(np.hstack(flags).astype(bool), bitorder="little"))
    return np.concatenate(packed), least, step, bits


class Coordinates:
    """Coordinates of points in a few bits each, unpacked when they are needed.

    Args:
        packed: bytes (N,) uint8 from `quantize`, and the other values from there.
        number: of points.

    Raises:
        ValueError: when they contradict each other, or are not finite.
    """

    def __init__(
        self, packed: np.ndarray, number: int, least: np.ndarray, step: float, bits: list[int]
    ):
        fits = least.shape == (3,) == np.shape(bits) and all(0 < n <= MAX_BITS for n in bits)
        if not (fits and number > 0 and len(packed) == -(-number * sum(bits) // 8)):
            raise ValueError(f"{len(packed)} bytes of {number} points of {bits} bits")
        if not np.isfinite(least + step * 2.0**MAX_BITS).all():
            raise ValueError("coordinates that are not finite")
        self._packed = np.append(packed, np.zeros(8, np.uint8))  # eight bytes are read at once
        self._number, self._least, self._step = number, least, step
        self._size, self._begin = sum(bits), np.cumsum([0, *bits[:2]])
        self._masks = np.array([2**n - 1 for n in bits], np.uint64)

    def __len__(self) -> int:
        return self._number

    def __getitem__(self, rows: np.ndarray) -> np.ndarray:
        """Return the coordinates (K, 3) float64 of points (K,)."""
        start = rows[:, None] * self._size + self._begin
        words = self._packed[(start >> 3)[..., None] + np.arange(8)].view("<u8")[..., 0]
        whole = words >> (start & 7).astype(np.uint64) & self._masks
        return self._least + self._step * whole

    def all(self) -> np.ndarray:
        """Return the coordinates (P, 3) float64 of all points."""
        parts = np.split(np.arange(len(self)), range(POINTS_PER_CHUNK, len(self), POINTS_PER_CHUNK))
        return np.concatenate([self[part] for part in parts])


def pack_visible(visible: list[np.ndarray], number: int) -> tuple[np.ndarray, str]:
    """Pack the points that each image shows in as few bytes as one of two ways needs.

    Args:
        visible: of each image the indices of its points, ascending.
        number: of points.

    Returns:
        Bytes (N,) uint8, and "bitmaps", one bit a point, rounded up to bytes, for each image; or
        "deltas", the differences between the indices of an image, from -1 on, in base 128 with the
        low digits first and the high bit set in all bytes of a difference but the last.
    """
    deltas = np.concatenate([np.diff(points, prepend=-1) for points in visible])
    digits = [deltas >> 7 * i for i in range(5)]
    lengths = np.ones(len(deltas), np.int64) + np.sum([part > 0 for part in digits[1:]], axis=0)
    if len(visible) * -(-number // 8) <= lengths.sum():
        flags = np.zeros((len(visible), number), np.uint8)
        for row, points in zip(flags, visible, strict=True):
            row[points] = 1
        return np.packbits(flags, axis=1, bitorder="little").reshape(-1), "bitmaps"
    starts = np.cumsum(lengths) - lengths
    packed = np.zeros(lengths.sum(), np.uint8)
    for i, part in enumerate(digits):
        has = lengths > i
        more = (lengths[has] > i + 1).astype(np.uint8) << 7
        packed[starts[has] + i] = (part[has] & 127).astype(np.uint8) | more
    return packed, "deltas"


class Visible:
    """The points that each image shows, unpacked when they are needed.

    Args:
        packed: bytes (N,) uint8 from `pack_visible`.
        kind: "bitmaps" or "deltas".
        counts: (I,) int64, of each image the number of its points.
        number: of points.

    Raises:
        ValueError: when they contradict each other.
    """

    def __init__(self, packed: np.ndarray, kind: str, counts: np.ndarray, number: int):
        if kind not in ("bitmaps", "deltas"):
            raise ValueError(f"visible points as {kind!r}")
        self.counts, self._number = counts, number
        self._packed, self._as_bitmaps = packed, kind == "bitmaps"
        self._ends = (self._ends_of_bitmaps if self._as_bitmaps else self._ends_of_deltas)()

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, image: int) -> np.ndarray:
        """Return the points (M,) int64 that an image shows, ascending."""
        part = self._packed[self._ends[image] : self._ends[image + 1]]
        if self._as_bitmaps:
            return np.flatnonzero(np.unpackbits(part, count=self._number, bitorder="little"))
        return np.cumsum(_deltas(part)) - 1

    def _ends_of_bitmaps(self) -> np.ndarray:
        """Return where the bytes of each image end (I + 1,), from 0 on, after checking all."""
        width = -(-self._number // 8)
        ends = width * np.arange(len(self) + 1)
        if len(self._packed) != ends[-1]:
            raise ValueError(f"{len(self._packed)} bytes of {len(self)} bitmaps of {width} bytes")
        rows = self._packed.reshape(len(self), width)
        shown = [np.unpackbits(row, count=self._number, bitorder="little").sum() for row in rows]
        if not np.array_equal(shown, self.counts):
            raise ValueError("bitmaps of other numbers of points")
        return ends

    def _ends_of_deltas(self) -> np.ndarray:
        """Return what `_ends_of_bitmaps` does."""
        total, last = int(self.counts.sum()), np.flatnonzero(self._packed < 128)
        if len(last) != total or (total and last[-1] != len(self._packed) - 1):
            raise ValueError(f"{len(last)} differences, not {total}")
        numbers = np.concatenate([[0], np.cumsum(self.counts)])
        ends = np.concatenate([[0], last + 1])[numbers]
        for images in np.array_split(
            np.arange(len(self)), min(len(self), 1 + total // POINTS_PER_CHUNK)
        ):
            deltas = _deltas(self._packed[ends[images[0]] : ends[images[-1] + 1]])
            starts = (numbers - numbers[images[0]])[images[self.counts[images] > 0]]
            if len(deltas) and (
                deltas.min() < 1 or np.add.reduceat(deltas, starts).max() > self._number
            ):
                raise ValueError("visible points that do not exist")
        return ends


def _deltas(packed: np.ndarray) -> np.ndarray:
    """Return the differences (M,) int64 in bytes of `pack_visible`."""
    last = np.flatnonzero(packed < 128)
    starts = np.concatenate([[0], last[:-1] + 1]) if len(last) else last
    lengths = last - starts + 1
    if lengths.max(initial=0) > 5:
        raise ValueError("a difference of more than 5 bytes")
    deltas = packed[starts].astype(np.int64) & 127
    for i in range(1, lengths.max(initial=0)):
        has = np.flatnonzero(lengths > i)
        deltas[has] |= (packed[starts[has] + i].astype(np.int64) & 127) << 7 * i
    return deltas
