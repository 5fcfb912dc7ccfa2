"""Write compact maps. docs/map-format.md describes the file."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from .. import projections
from ..confs import features as features_confs
from ..confs import retrieval as retrieval_confs
from ..localization import intrinsics
from ..localization.frame import UNKNOWN, Frame
from ..retrieval.vlad import VOCABULARY, read_vocabulary
from ..utils.cli import InputError
from ..utils.codes import QUANTIZED, STORAGES, store
from ..utils.files import file_sha256
from . import points as points_of_map
from . import signs
from .points import Points
from .reader import MAX_GLOBAL, VERSION, VERSION_RETRIEVAL, check_model, rotation_of


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


def encode(
    points: Points, source: Source, global_descriptors: np.ndarray
) -> tuple[bytes, dict[str, int]]:
    """Return the content of a compact map, the same for the same arguments.

    Args:
        points: that it has.
        source: what it is made from.
        global_descriptors: (I, G) of the images of the points.

    Returns:
        The content, and the number of bytes of each part.
    """
    from safetensors.numpy import save

    check_model(source.conf["model"], source.feature)
    points = points.sorted()
    tensors: dict[str, np.ndarray] = {}
    metadata: dict[str, Any] = {
        "version": VERSION,
        "feature": source.feature,
        "conf": {key: source.conf[key] for key in ("model", "preprocessing")},
        "matcher": source.matcher,
        "known": {name: intrinsics.to_list(one) for name, one in source.cameras.known.items()},
        "sizes": sorted(source.cameras.sizes),
        "models": sorted(source.cameras.models),
        "focal_lengths": source.cameras.focal_lengths,
        "typical": intrinsics.to_rows(source.cameras.typical),
        "orientations": sorted(source.cameras.orientations),
        "doubts": source.doubts,
    }
    metadata |= {"frame": source.frame.to_json()} if source.frame != UNKNOWN else {}
    _add_images(tensors, metadata, points, source.model)
    _add_points(tensors, metadata, points, source.model)
    _add_descriptors(tensors, metadata, points, source.conf)
    _add_projection(tensors, metadata, source.conf["model"])
    _add_retrieval(tensors, metadata, source, global_descriptors)
    # safetensors writes the memory of an array, whatever its order
    tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
    content = save(tensors, {"map": json.dumps(metadata, sort_keys=True)})
    parts = {name: tensor.nbytes for name, tensor in tensors.items()}
    return content, parts | {"header": len(content) - sum(parts.values())}


def _add_images(
    tensors: dict, metadata: dict, points: Points, model: pycolmap.Reconstruction
) -> None:
    images = {image.name: image for image in model.images.values()}
    shown = [images[name] for name in points.names]
    ids = sorted({image.camera_id for image in shown})
    quaternions = [image.cam_from_world().rotation.quat for image in shown]
    rotations = np.array(quaternions, np.float32)
    # far from the origin, rounded rotations would move the centres, so these stay as they are
    centers = [image.projection_center() for image in shown]
    matrices = [rotation_of(quaternion).matrix() for quaternion in rotations]
    tensors["names"] = np.frombuffer("\n".join(points.names).encode(), np.uint8)
    tensors["rotations"] = rotations
    tensors["translations"] = -np.einsum("nij,nj->ni", matrices, centers)
    numbers = [ids.index(image.camera_id) for image in shown]
    tensors["camera_of_image"] = np.array(numbers, np.uint32)
    metadata["cameras"] = [intrinsics.to_list(model.cameras[i]) for i in ids]


def _add_points(
    tensors: dict, metadata: dict, points: Points, model: pycolmap.Reconstruction
) -> None:
    precision = points_of_map.precision(points, model)
    packed, least, step, bits = points_of_map.quantize(points.xyz, precision)
    visible, kind = points_of_map.pack_visible(points.visible, len(points))
    tensors["coordinates"], tensors["visible"] = packed, visible
    tensors["num_visible"] = np.array([len(part) for part in points.visible], np.uint32)
    metadata |= {"points": len(points), "least": least.tolist(), "step": step}
    metadata |= {"bits": bits, "visible": kind}


def _add_descriptors(tensors: dict, metadata: dict, points: Points, conf: dict) -> None:
    storage = conf.get("storage", STORAGES[0])
    levels = features_confs.levels(conf)
    stored, attrs = store({"descriptors": points.descriptors.T}, storage, levels)
    key = QUANTIZED.get(storage, "descriptors")
    tensors["descriptors"] = stored[key]
    if levels is not None:
        tensors["levels"] = attrs[key]["levels"]
    scale = [] if levels is not None else [float(value) for value in attrs.get(key, {}).values()]
    metadata |= {"storage": storage, "scale": scale}


def _add_retrieval(
    tensors: dict, metadata: dict, source: Source, global_descriptors: np.ndarray
) -> None:
    """Add global descriptors and their vocabulary, if any, or name the one that ships."""
    number = global_descriptors.shape[1]
    if number > MAX_GLOBAL:
        raise InputError(f"Global descriptors of {number} numbers, of at most {MAX_GLOBAL}.")
    tensors["retrieval"], metadata["signs"] = signs.pack(global_descriptors)
    if source.retrieval != retrieval_confs.VLAD:
        metadata["version"] = VERSION_RETRIEVAL
        metadata |= {"retrieval": source.retrieval, "global_dim": number}
    if source.vocabulary is None:
        return
    words, shipped = read_vocabulary(source.vocabulary), file_sha256(VOCABULARY)
    if file_sha256(source.vocabulary) == shipped:
        metadata["vocabulary_sha256"] = shipped
    else:
        tensors["vocabulary"] = words.astype(np.float16)


def _add_projection(tensors: dict, metadata: dict, model: dict) -> None:
    """Name the projection, if any, and add it unless it is one that ships."""
    projection = model.get("projection")
    if not projection:
        return
    file, prefix = projections.find(projection), projections.split_prefix(projection)[1]
    metadata["projection_sha256"] = file_sha256(file)
    metadata["projection_suffix"] = file.suffix
    shipped = file.stem in projections.names() and projections.checksum(file.stem)
    if shipped != metadata["projection_sha256"]:
        tensors["projection"] = np.frombuffer(file.read_bytes(), np.uint8)
    name = file.stem + (prefix and f"@{prefix}")
    metadata["conf"]["model"] = {**model, "projection": name}
