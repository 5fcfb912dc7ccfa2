"""Compact maps of versions 1 to 3, converted to the present one when they are opened."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from ..localization import intrinsics
from ..utils.parsers import check_names
from . import names, visible
from .images import Images, pack_cameras
from .points import PADDING

VERSIONS = 1, 2, 3
RENAMED = {"known": "cameras", "models": "camera_models"}
SHIPPED = "projection", "vocabulary"


def convert(
    metadata: dict[str, Any], arrays: Mapping[str, np.ndarray], path: Path
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the metadata and the arrays of a compact map as the present version has them.

    Args:
        metadata: of one of `VERSIONS`.
        arrays: of its file.
        path: of the file, for messages.

    Raises:
        KeyError, TypeError or ValueError: when it is broken.
    """
    found, number = dict(arrays), int(metadata["points"])
    images = _images(metadata, arrays, path)
    packed = [visible.pack(points) for points in _visible(metadata["visible"], arrays, number)]
    least = np.array(metadata["least"], np.float64)
    found["images"], step = images.pack(least, np.cumsum([len(part) for part in packed]))
    found["visible"] = np.frombuffer(b"".join(packed), np.uint8)
    found["names"] = names.pack(images.names)
    found["cameras"] = pack_cameras(images.cameras)
    found["coordinates"] = np.append(found["coordinates"], np.zeros(PADDING, np.uint8))
    found["descriptors"] = np.ascontiguousarray(found["descriptors"].T)
    content = {RENAMED.get(key, key): value for key, value in metadata.items() if key != "cameras"}
    told = intrinsics.from_dict(content)
    told = intrinsics.with_lenses(told, [images.cameras[i] for i in images.camera])
    sums = {part: metadata.get(f"{part}_sha256") for part in SHIPPED}
    content |= intrinsics.to_dict(told) | {
        "bits": 3 * [metadata["bits"]] if metadata["version"] == 1 else metadata["bits"],
        "center_step": step,
        "shipped": {part: checksum for part, checksum in sums.items() if checksum},
    }
    return content, found


def _images(metadata: Mapping, arrays: Mapping[str, np.ndarray], path: Path) -> Images:
    """Return the images; those in the names of others' folders are refused."""
    listed = check_names(arrays["names"].tobytes().decode().split("\n"), path)
    rotations = arrays["rotations"].astype(np.float64).reshape(len(listed), 4)
    translations = arrays["translations"].astype(np.float64).reshape(len(listed), 3)
    norms = np.linalg.norm(rotations, axis=1, keepdims=True)
    if not (np.isfinite(norms).all() and np.isfinite(translations).all() and norms.min() > 0):
        raise ValueError("numbers that are not finite")
    poses = [
        pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation)
        for rotation, translation in zip(rotations / norms, translations, strict=True)
    ]
    cameras = [intrinsics.from_list(values) for values in metadata["cameras"]]
    used = arrays["camera_of_image"].astype(np.int64)
    if used.shape != (len(listed),) or used.max() >= len(cameras):
        raise ValueError("cameras that do not exist")
    centers = np.array([pose.inverse().translation for pose in poses])
    return Images(listed, rotations, centers, cameras, used)


def _visible(kind: str, arrays: Mapping[str, np.ndarray], number: int) -> Iterator[np.ndarray]:
    """Yield the points (M,) that each image shows.

    Args:
        kind: "bitmaps" or "deltas".
        arrays: of the file.
        number: of points.
    """
    packed, counts = arrays["visible"], arrays["num_visible"].astype(np.int64)
    if kind == "bitmaps":
        for row, count in zip(packed.reshape(len(counts), -(-number // 8)), counts, strict=True):
            points = np.flatnonzero(np.unpackbits(row, count=number, bitorder="little"))
            if len(points) != count:
                raise ValueError("bitmaps of other numbers of points")
            yield points
        return
    last = np.flatnonzero(packed < 128)
    if kind != "deltas" or len(last) != counts.sum() or (len(last) and last[-1] + 1 < len(packed)):
        raise ValueError(f"{len(last)} visible points as {kind!r}, not {counts.sum()}")
    ends = np.concatenate([[0], last + 1])[np.concatenate([[0], np.cumsum(counts)])]
    for begin, end in zip(ends[:-1], ends[1:], strict=True):
        differences = visible.numbers(packed[begin:end])
        points = np.cumsum(differences) - 1
        if len(points) and (differences.min() < 1 or points[-1] >= number):
            raise ValueError("visible points that do not exist")
        yield points
