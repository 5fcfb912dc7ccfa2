"""Write compact maps. docs/map-format.md describes the file."""

import json
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, BinaryIO, Protocol

import numpy as np
import pycolmap

from .. import projections
from ..confs import features as features_confs
from ..confs import retrieval as retrieval_confs
from ..localization import intrinsics
from ..localization.frame import UNKNOWN, Frame
from ..retrieval.vlad import VOCABULARY, read_vocabulary
from ..utils.cli import InputError
from ..utils.codes import CODED, FLOATS, STORAGES, encode, pack, quantize
from ..utils.files import file_sha256
from . import names, signs, tensors, visible
from .images import Images, pack_cameras
from .points import PADDING, Grid, parts
from .reader import MAX_GLOBAL, VERSION, check_model
from .tensors import Blocks

SPOOLED = 2**26  # bytes of visible points that are kept in memory
# what logs call arrays
PARTS = {"images": "poses", "cameras": "poses", "coarse": "retrieval", "vocabulary": "retrieval"}


@dataclass(frozen=True)
class Source:
    """What a compact map is made from, apart from its points.

    Args:
        model: the COLMAP model that the points are from.
        feature: name of the feature.
        conf: its configuration, whose storage is that of the points' descriptors.
        matcher: a key of `confs.matchers`.
        global_descriptors: h5 file of the images' global descriptors.
        vocabulary: of these; None if they have none.
        cameras: what the map tells about the intrinsics of other photos.
        doubts: why the map may be wrong, see `Map.doubts`.
        retrieval: of the global descriptors, a key of `confs.retrieval`.
        frame: of the map.
        made_from: id of the map, or a fingerprint of the model.
    """

    model: pycolmap.Reconstruction
    feature: str
    conf: dict
    matcher: str
    global_descriptors: Path
    vocabulary: Path | None
    cameras: intrinsics.MapCameras
    doubts: list[str] = field(default_factory=list)
    retrieval: str = retrieval_confs.VLAD
    frame: Frame = UNKNOWN
    made_from: str | None = None


class Content(Protocol):
    """The points of a compact map, in the order in which the file has them."""

    def __len__(self) -> int:
        """Return their number."""

    def xyz(self, part: slice) -> np.ndarray:
        """Return the coordinates (K, 3) float64 of some points."""

    def descriptors(self, part: slice) -> np.ndarray:
        """Return the descriptors (K, D) float32 of some points."""

    def visible(self, image: int) -> np.ndarray:
        """Return the points (M,) that an image shows, ascending."""


def write(
    file: BinaryIO,
    points: Content,
    images: Images,
    source: Source,
    global_signs: np.ndarray,
    global_dim: int,
    step: float,
) -> dict[str, int]:
    """Write a compact map, the same for the same arguments, block by block.

    Args:
        file: where to.
        points: that it has.
        images: that show them.
        source: what else it is made from; not its model.
        global_signs: (I, B) uint8, see `signs.pack`, of the images.
        global_dim: dimension of the global descriptors.
        step: about that of the coordinates.

    Returns:
        The number of bytes of each part.
    """
    check_model(source.conf["model"], source.feature)
    metadata: dict[str, Any] = {
        "version": VERSION,
        "feature": source.feature,
        "conf": {key: source.conf[key] for key in ("model", "preprocessing")},
        "matcher": source.matcher,
        "points": len(points),
    }
    told = intrinsics.to_dict(source.cameras) | {"doubts": source.doubts}
    told |= {"frame": source.frame.to_json() if source.frame != UNKNOWN else None}
    told |= {"made_from": source.made_from, "shipped": {}}
    metadata |= told
    arrays: dict[str, np.ndarray | Blocks] = {}
    with tempfile.SpooledTemporaryFile(SPOOLED) as spool:
        ends = _spool_visible(spool, points, len(images.names))
        grid = _grid(points, step)
        metadata |= {"least": grid.least.tolist(), "step": grid.step, "bits": grid.bits}
        arrays["images"], metadata["center_step"] = images.pack(grid.least, ends)
        _add_retrieval(arrays, metadata, source, global_signs, global_dim)
        arrays["descriptors"] = _descriptors(arrays, metadata, points, source.conf)
        arrays["cameras"] = pack_cameras(images.cameras)
        arrays["names"] = names.pack(images.names)
        _add_projection(arrays, metadata, source.conf["model"])
        blocks = (grid.pack(points.xyz(part)) for part in parts(len(points)))
        arrays["coordinates"] = _blocks(np.uint8, grid.nbytes(len(points)), blocks, PADDING)
        arrays["visible"] = _blocks(np.uint8, int(ends[-1]), _read(spool))
        if "levels" in arrays and "projection" in metadata["shipped"]:
            del arrays["levels"]  # they ship with it
        kept = {key: value for key, value in metadata.items() if value not in (None, {}, [])}
        ordered = sorted(arrays, key=lambda name: (-arrays[name].dtype.itemsize, name))
        text = json.dumps(kept, sort_keys=True, separators=(",", ":"))
        header = tensors.write(file, {"map": text}, {name: arrays[name] for name in ordered})
    sizes = dict.fromkeys(PARTS.values(), 0)
    for name in ordered:
        part = PARTS.get(name, name)
        sizes[part] = sizes.get(part, 0) + arrays[name].nbytes
    return sizes | {"header": header}


def _blocks(kind: type, number: int, blocks: Iterator[np.ndarray], padding: int = 0) -> Blocks:
    """Return numbers that are written block by block, with zeros behind them."""

    def padded() -> Iterator[np.ndarray]:
        yield from blocks
        yield np.zeros(padding, kind)

    return Blocks(np.dtype(kind), (number + padding,), padded())


def _spool_visible(spool: IO[bytes], points: Content, number: int) -> np.ndarray:
    """Write which points each image shows; return where its bytes end (I,)."""
    ends, end = np.zeros(number, np.int64), 0
    for image in range(number):
        end += spool.write(visible.pack(points.visible(image)))
        ends[image] = end
    if end >= 2**32:
        raise InputError("The map is too large for one file: split it.")
    return ends


def _read(spool: IO[bytes]) -> Iterator[np.ndarray]:
    """Yield the bytes of a file."""
    spool.seek(0)
    while block := spool.read(SPOOLED):
        yield np.frombuffer(block, np.uint8)


def _grid(points: Content, step: float) -> Grid:
    """Return the grid of the coordinates."""
    limits = [[part.min(axis=0), part.max(axis=0)] for part in map(points.xyz, parts(len(points)))]
    least, largest = np.array(limits).transpose(1, 0, 2)
    return Grid.of(least.min(axis=0), largest.max(axis=0), step)


def _descriptors(arrays: dict, metadata: dict, points: Content, conf: dict) -> Blocks:
    """Return the descriptors as they are stored, and add what they need."""
    storage = conf.get("storage", STORAGES[0])
    metadata["storage"] = storage
    levels = features_confs.levels(conf)
    store: Callable[[np.ndarray], np.ndarray]
    if levels is not None:
        arrays["levels"] = levels.astype(np.float16)
        store = lambda rows: pack(encode(rows.T, levels), CODED[storage]).T  # noqa: E731
    elif storage in FLOATS:
        store = lambda rows: rows.astype(storage)  # noqa: E731
    else:
        found = [(part.min(), part.max()) for part in map(points.descriptors, parts(len(points)))]
        limits = min(least for least, _ in found), max(largest for _, largest in found)
        _, *metadata["scale"] = quantize(np.zeros((0, 1), np.float32), limits)
        store = lambda rows: quantize(rows, limits)[0]  # noqa: E731
    first = store(points.descriptors(slice(0, 1)))
    blocks = (store(points.descriptors(part)) for part in parts(len(points)))
    return Blocks(first.dtype, (len(points), first.shape[1]), blocks)


def _add_retrieval(
    arrays: dict,
    metadata: dict,
    source: Source,
    global_signs: np.ndarray,
    global_dim: int,
) -> None:
    """Add the signs of global descriptors and their vocabulary, if any, or name one that ships."""
    if global_dim > MAX_GLOBAL:
        raise InputError(f"Global descriptors of {global_dim} numbers, of at most {MAX_GLOBAL}.")
    arrays["retrieval"] = global_signs
    if len(global_signs) > signs.FEW:
        arrays["coarse"] = signs.columns(global_signs[:, : signs.COARSE])
    if source.retrieval != retrieval_confs.VLAD:
        metadata |= {"retrieval": source.retrieval, "global_dim": global_dim}
    if source.vocabulary is None:
        return
    words, shipped = read_vocabulary(source.vocabulary), file_sha256(VOCABULARY)
    if file_sha256(source.vocabulary) == shipped:
        metadata["shipped"]["vocabulary"] = shipped
    else:
        arrays["vocabulary"] = words.astype(np.float16)


def _add_projection(arrays: dict, metadata: dict, model: dict) -> None:
    """Name the projection, if any, and add it unless it is one that ships."""
    projection = model.get("projection")
    if not projection:
        return
    file, prefix = projections.find(projection), projections.split_prefix(projection)[1]
    checksum = file_sha256(file)
    if file.stem in projections.names() and projections.checksum(file.stem) == checksum:
        metadata["shipped"]["projection"] = checksum
    else:
        metadata["projection_suffix"] = file.suffix
        arrays["projection"] = np.frombuffer(file.read_bytes(), np.uint8)
    name = file.stem + (prefix and f"@{prefix}")
    metadata["conf"]["model"] = {**model, "projection": name}
