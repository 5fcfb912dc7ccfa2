"""Unpack a compact map into the folder of a map, in which pipelines localize as in any other."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from ..aggregate_features import output_of, vocabulary_of
from ..confs import features as features_confs
from ..confs import retrieval as retrieval_confs
from ..hlm.joined import opened
from ..hlm.reader import CompactMap
from ..runtime import provenance
from ..runtime.group_writer import GroupWriter
from ..runtime.outputs import CONF, DELETING, RunFolder
from ..utils import colmap
from ..utils.cli import InputError
from ..utils.files import announce, file_sha256, replacing
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from .map import FINISHED, PLACE, SFM, Map, write

COMPACT = "compact"  # in the configuration of a folder: the sha256 of the file


@strings_as_paths
def main(path: Path | Sequence[Path], map_dir: Path, overwrite: bool = False) -> Map:
    """Unpack a compact map, unless it is unpacked already.

    The keypoints of an image are the projections of the points that it shows.

    Args:
        path: file of `hloc_reduce.compact`, or several of one place.
        map_dir: the folder of the map.
        overwrite: replace another map in it.

    Raises:
        InputError: when the file is broken, or the folder has another map.
    """
    compact, paths = opened(path), [path] if isinstance(path, Path) else [*path]
    compact.check_names()
    before = provenance.read(map_dir / CONF)
    if before and before != DELETING and COMPACT not in before:
        raise InputError(f"{map_dir} is a map of photos, not an unpacked one: use other --outputs.")
    digest = " ".join(map(file_sha256, paths))
    with RunFolder(map_dir, {COMPACT: digest}, overwrite, inputs=paths) as folder:
        if not (map_dir / FINISHED).exists():
            with folder.stage("unpack"):
                _write(compact, map_dir, digest)
    return Map(map_dir)


def _write(compact: CompactMap, folder: Path, digest: str) -> None:
    """Write the files of a map."""
    from safetensors.numpy import save

    conf = compact.write_projection(folder)
    model = pycolmap.Reconstruction()
    features = folder / f"{conf['output']}.h5"
    header = {COMPACT: digest}
    with GroupWriter(features, header, overwrite=True) as writer:
        for i, name in enumerate(progress(compact.names, "Unpacking", "image")):
            keypoints = _add_image(model, compact, i)
            arrays, attrs = compact.stored(name)
            camera = compact.camera(name)
            arrays |= {
                "keypoints": (keypoints - 0.5).astype(np.float32),  # hloc's pixels
                "image_size": np.array([camera.width, camera.height]),
            }
            writer.add(name, arrays, attrs)
    _add_points(model, compact)
    announce(folder / SFM)
    (folder / SFM).mkdir(exist_ok=True)
    model.write(folder / SFM)
    descriptors = output_of(retrieval_confs.get(compact.retrieval), features)
    with GroupWriter(descriptors, header, overwrite=True) as writer:
        for name, row in zip(compact.names, compact.global_descriptors(), strict=True):
            writer.add(name, {"global_descriptor": row})
    if compact.vocabulary is not None:
        with replacing(vocabulary_of(descriptors)) as temporary:
            temporary.write_bytes(save({"vocabulary": compact.vocabulary}))
    with replacing(folder / PLACE) as temporary:
        temporary.write_text(digest)
    write(
        folder,
        conf,
        model,
        compact.cameras,
        id=digest,
        feature=compact.feature,
        matcher=compact.matcher,
        retrieval=compact.retrieval,
        image_dir=str(folder / "images"),  # there are none
        keypoints=features_confs.keypoints_of(conf["model"]) or "adaptive",
        doubts=compact.doubts,
        frame=compact.frame.to_json(),
    )


def _add_image(model: pycolmap.Reconstruction, compact: CompactMap, number: int) -> np.ndarray:
    """Add an image; return the projections of its points (M, 2), COLMAP's pixels."""
    name = compact.names[number]
    camera, pose, projected = compact.camera(name), compact.pose(name), compact.projections(name)
    camera.camera_id = compact.camera_number(name) + 1
    image = pycolmap.Image(
        name=name, keypoints=projected, camera_id=camera.camera_id, image_id=number + 1
    )
    colmap.add_image(model, camera, image, pose)
    return projected


def _add_points(model: pycolmap.Reconstruction, compact: CompactMap) -> None:
    """Add the points with their tracks."""
    visible = [compact.visible(name) for name in compact.names]
    image = np.repeat(np.arange(len(visible)), [len(part) for part in visible])
    keypoint = np.concatenate([np.arange(len(part)) for part in visible])
    point = np.concatenate(visible)
    order = np.argsort(point, kind="stable")
    ends = np.cumsum(np.bincount(point, minlength=len(compact.points)))
    for at, rows in zip(compact.points.all(), np.split(order, ends[:-1]), strict=True):
        track = pycolmap.Track(
            [pycolmap.TrackElement(int(image[row]) + 1, int(keypoint[row])) for row in rows]
        )
        model.add_point3D(at, track)
