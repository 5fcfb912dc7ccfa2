"""Training data: descriptors of the observations of a map's points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from safetensors.numpy import load_file, save_file

from .. import (
    extract_features,
    extractors,
    logger,
    match_features,
    pairs_from_covisibility,
    triangulation,
)
from ..confs import features as features_confs
from ..descriptors import DESCRIPTORS
from ..maps.map import Map, is_map
from ..runtime import provenance
from ..runtime.group_writer import resume_or_replace
from ..runtime.outputs import Lock
from ..utils import colmap
from ..utils.cli import InputError, choose
from ..utils.colmap import point3D_ids
from ..utils.feature_files import get_colmap_keypoints, get_descriptors
from ..utils.files import replacing
from ..utils.h5 import get_dataset, open_h5
from ..utils.images import turned
from ..utils.options import Option
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from . import describers
from .completion import Completion

NUM_COVIS = 20
MATCHED = "sift"  # finds the tracks of all descriptors of patches
MAP_OPTION = Option(
    note="folder of images and folder of their COLMAP model, or a map of pipelines.localize; may "
    "be repeated",
    repeated=True,
    metavar="IMAGES:MODEL|MAP",
)
DOG_SETTINGS = "hloc"  # which the shipped projections were trained with


@dataclass
class Tracks:
    """Descriptors of the observations of 3D points.

    Args:
        descriptors: (M, 2, V, D) float16 of unit norm: M observations, as seen and mirrored, in
            V photometric variants, the first of which is the photo itself.
        track: (M,) int64, the observed point, sorted, from 0 on.
        image: (M,) int64, the image, numbered by name; a patch of PhotoTour is one of its own.
        xy: (M, 2) float32, place in the image, in pixels.
        matched: (M,) bool, whether descriptors matched it; the others were found by geometry.
    """

    descriptors: np.ndarray
    track: np.ndarray
    image: np.ndarray
    xy: np.ndarray
    matched: np.ndarray

    @property
    def num_tracks(self) -> int:
        """The number of points, counted up to the last that is observed."""
        return int(self.track[-1]) + 1

    def only(self, kept: np.ndarray) -> "Tracks":
        """Select observations by indices or a mask. Points keep their numbers."""
        return Tracks(**{key: value[kept] for key, value in vars(self).items()})


def parse_maps(values: Sequence[str], option: str = "--map") -> dict[str, tuple[Path, Path]]:
    """Parse `images:model`, or folders of maps of `pipelines.localize`.

    A map is named after the parent of its images folder, or of the folder of the built map.

    Args:
        values: of the option.
        option: for messages.

    Returns:
        From name to the folders of images and of the COLMAP model.

    Raises:
        InputError: when a folder does not exist, or two maps have the same name.
    """
    folders: dict[str, tuple[Path, Path]] = {}
    for value in values:
        if is_map(Path(value)):
            built = Map(Path(value))
            images, model, folder = built.images, built.sfm, built.folder
        else:
            before, separator, after = value.rpartition(":")
            if not separator:
                raise InputError(f"{option} {value}: neither a map nor of the form images:model.")
            images, model, folder = Path(before), Path(after), Path(before)
        for part in (images, model):
            if not part.is_dir():
                raise InputError(f"{option} {value}: there is no folder {part}.")
        name = folder.resolve().parent.name
        if name in folders:
            raise InputError(f"{option} {value}: another map is called {name}, too.")
        folders[name] = images, model
    return folders


@strings_as_paths
def main(
    images: Path,
    model: Path,
    output: Path,
    descriptor: str = "sift",
    seed: int = 0,
    conf: dict | None = None,
) -> Path:
    """Triangulate the tracks of a map with known poses and describe their observations.

    Args:
        images: folder of the images.
        model: COLMAP model with their poses.
        output: folder for all files, which are used again unless they are stale. If another run is
            at work in it, this one waits.
        descriptor: the base descriptor; with `conf`, a name for its descriptors.
        seed: of the photometric variants.
        conf: configuration of a feature whose keypoints and descriptors are used instead.

    Returns:
        The file for `load`.

    Raises:
        InputError: for an unknown descriptor, or when the map cannot be read or gives no tracks.
    """
    if conf is None:
        choose("descriptor", descriptor, features_confs.BASES)
    with Lock(output, wait=True):
        return _described(images, model, output, descriptor, seed, conf)


def _described(
    images: Path, model: Path, output: Path, descriptor: str, seed: int, conf: dict | None
) -> Path:
    """Do what `main` does, in a folder that no other run writes to."""
    _check_source(images, model, output / "source.json")
    patches = conf is None and descriptor in DESCRIPTORS
    found_by = MATCHED if patches else descriptor
    if conf is None:
        conf = features_confs.with_settings(features_confs.get(found_by)[1], DOG_SETTINGS)
    names = sorted(image.name for image in colmap.read_model(model).images.values())
    sfm = output / f"sfm_{found_by}"
    features, reconstruction = _triangulate(images, model, names, conf, sfm)

    tracks = output / f"tracks_{descriptor}.safetensors"
    made_from = provenance_of(descriptor, seed, [sfm / "points3D.bin", features])
    if is_current(tracks, made_from):
        return tracks
    complete, matched, keypoints = _observations(reconstruction, features, names)
    describe = (
        describers.PatchDescriber(descriptor)
        if patches
        else describers.FeatureDescriber(conf["model"])
    )
    with resume_or_replace(parts_of(tracks), made_from) as writer, open_h5(features) as file:
        todo = [(number, name) for number, name in enumerate(names) if name not in writer]
        done = len(names) - len(todo)
        for number, name in progress(todo, "Describing tracks", "image", len(names), done):
            observed = complete(name)
            kept = np.flatnonzero(observed >= 0)
            if not len(kept):
                continue
            image, frame = extractors.load_image(images / name, conf["preprocessing"])
            ratio = np.array(image.shape[:1:-1]) / frame.shown
            scaled = keypoints[name][kept]  # in pixels of the resized image
            shown = turned(scaled[:, :2], frame.size, frame.turns)
            scaled[:, :2] = (shown + 0.5) * ratio - 0.5
            scaled[:, 2:3] *= ratio.mean()
            known = get_descriptors(file, name)[kept]
            generator = np.random.default_rng([seed, number])
            arrays = {
                "descriptors": describe(image, scaled, known, generator),
                "points": observed[kept],
                "image": np.full(len(kept), number),
                "xy": keypoints[name][kept, :2],
                "matched": matched[name][kept] >= 0,
            }
            writer.add(name, arrays)
        described = [name for name in names if name in writer]
    if not described:
        raise InputError(f"The map {model} gives no tracks.")
    return save(tracks, made_from, described)


def _check_source(images: Path, model: Path, path: Path) -> None:
    """Write which map a folder is for; raise an InputError if it is for another one."""
    source = {"images": str(images.resolve()), "model": str(model.resolve())}
    if is_map(model.parent):  # it may have been rebuilt from other photos
        source["map"] = Map(model.parent).id
    if path.exists() and not provenance.is_current(path, source):
        raise InputError(
            f"{path.parent} holds the tracks of another map, or of an earlier one. Delete it, or "
            "choose another folder: --cache."
        )
    provenance.write(path, source)


def _triangulate(
    images: Path, model: Path, names: list[str], conf: dict, sfm: Path
) -> tuple[Path, pycolmap.Reconstruction]:
    """Return the feature file of a map and its points, triangulated with known poses."""
    output = sfm.parent
    pairs = output / f"pairs-db-covis{NUM_COVIS}.txt"
    pairs_from_covisibility.main(model, pairs, NUM_COVIS)
    features = extract_features.main(conf, images, output, image_list=names)
    # no ratio test: the poses tell right from wrong, and ambiguous matches are worth learning
    matcher = match_features.confs["NN-mutual"]
    matches = match_features.main(matcher, pairs, features.stem, output)
    return features, triangulation.main(sfm, model, images, pairs, features, matches)


def _observations(
    reconstruction: pycolmap.Reconstruction, features: Path, names: list[str]
) -> tuple[Callable[[str], np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Find which points the keypoints of the images observe.

    Returns:
        A function that completes the tracks: from image name to the id of the point of each
        keypoint (N,), -1 where none; from image name to the same ids as matched; and from image
        name to the keypoints (N, 4): x, y, scale (pixels), orientation (degrees). Without scales
        and orientations they are (N, 2), and nothing is completed.
    """
    images = {image.name: image for image in reconstruction.images.values()}
    matched = {name: point3D_ids(images[name]) for name in names}
    keypoints, in_colmap = {}, {}
    with open_h5(features) as file:
        oriented = {"scales", "oris"} <= file[names[0]].keys()
        columns = ("keypoints", "scales", "oris") if oriented else ("keypoints",)
        for name in names:
            arrays = [get_dataset(file, name, key)[()] for key in columns]
            keypoints[name] = np.column_stack(arrays).astype(np.float32)
            places = get_colmap_keypoints(file, name)[0]
            in_colmap[name] = np.column_stack([places, keypoints[name][:, 2:]])
    if not oriented:
        return matched.__getitem__, matched, keypoints
    return Completion(reconstruction, in_colmap, matched), matched, keypoints


def provenance_of(descriptor: str, seed: int, inputs: list[Path]) -> dict:
    """Return the provenance of a file for `load`."""
    options = {"variants": describers.VARIANTS, "seed": seed, "descriptor": descriptor, "format": 2}
    return provenance.of_inputs(options, inputs)


def is_current(path: Path, made_from: dict) -> bool:
    """Return whether a file for `load` exists and is not stale."""
    return path.exists() and provenance.is_current(path.with_suffix(".json"), made_from)


def parts_of(path: Path) -> Path:
    """Return the h5 file of the observations described so far, for a file for `load`."""
    return path.with_suffix(".parts.h5")


def save(path: Path, made_from: dict, names: list[str]) -> Path:
    """Write the file for `load` and its provenance from `parts_of`, and delete these.

    Args:
        path: of the file.
        made_from: its provenance.
        names: groups of the parts, in order, with the arrays of `Tracks`, but in place of `track`
            the ids of the observed `points`, (M,), in any order.

    Returns:
        The path.
    """
    with open_h5(parts_of(path)) as file:
        descriptors, points, image, xy, matched = (
            np.concatenate([get_dataset(file, name, key)[()] for name in names])
            for key in ("descriptors", "points", "image", "xy", "matched")
        )
    _, track = np.unique(points, return_inverse=True)
    order = np.argsort(track, kind="stable")
    tracks = Tracks(descriptors, track, image, xy, matched).only(order)
    with replacing(path) as temporary:
        # which would write arrays in column order wrongly
        save_file(
            {key: np.ascontiguousarray(part) for key, part in vars(tracks).items()}, temporary
        )
    provenance.write(path.with_suffix(".json"), made_from)
    logger.info("%d observations of %d points: %s", len(track), tracks.num_tracks, path)
    parts_of(path).unlink()
    return path


def load(path: Path) -> Tracks:
    """Read the file that `save` wrote."""
    return Tracks(**load_file(path))
