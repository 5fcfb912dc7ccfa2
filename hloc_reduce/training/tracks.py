"""Training data: base descriptors of the observations of a map's points, labelled by point."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from safetensors.numpy import load_file, save_file
from scipy.spatial import cKDTree

from .. import (
    extract_features,
    extractors,
    logger,
    match_features,
    pairs_from_covisibility,
    triangulation,
)
from ..confs import features as features_confs
from ..descriptors import BASES, COLMAP, DESCRIPTORS, DIM
from ..descriptors.model import Descriptor
from ..extractors.dog import extract_patches
from ..maps.map import Map, is_map
from ..runtime import provenance
from ..runtime.group_writer import resume_or_replace
from ..utils import colmap
from ..utils.cli import InputError, choose
from ..utils.colmap import point3D_ids
from ..utils.feature_files import get_colmap_keypoints, get_descriptors
from ..utils.files import replacing
from ..utils.h5 import get_dataset, open_h5
from ..utils.paths import strings_as_paths
from ..utils.progress import progress
from .completion import Completion
from .loop import device

NUM_COVIS = 20
MATCHED = "sift"  # which descriptor finds the tracks, whatever they are described with
KEYPOINTS = "hloc"  # settings of DoG, which the projections that ship were trained with
# The photo as it is and three photometric variants, each as seen and mirrored.
VARIANTS = 4
MAX_SHIFT = 1.5  # pixels between a keypoint and the same one of a variant
NEIGHBORS = 4  # keypoints looked at there


@dataclass
class Tracks:
    """Descriptors of the observations of 3D points.

    Args:
        descriptors: (M, 2, V, D) float16 of unit norm: M observations, as seen and mirrored, in
            V photometric variants, the first of which is the photo itself.
        track: (M,) int64, which of the map's points an observation sees, sorted, from 0 on.
        image: (M,) int64, in which image, numbered by name; a patch of PhotoTour is one of its own.
        xy: (M, 2) float32, where in it, in pixels.
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
        """Leave out observations; `kept` indexes or masks them. Points keep their numbers."""
        return Tracks(**{key: value[kept] for key, value in vars(self).items()})


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
        output: folder for all files; what it holds already is used.
        descriptor: the base descriptor; one that takes no patches has keypoints of its own.
        seed: of the photometric variants.
        conf: of the feature whose keypoints and descriptors are used, in place of those of `sift`
            described by `descriptor`, which is then but what its files are called after.

    Returns:
        The file of `load`.

    Raises:
        InputError: for an unknown descriptor, or when the map cannot be read or gives no tracks.
    """
    if conf is None:
        choose("descriptor", descriptor, BASES)
    source = {"images": str(images.resolve()), "model": str(model.resolve())}
    if is_map(model.parent):  # which may have been built anew, of other photos
        source["map"] = Map(model.parent).id
    if (output / "source.json").exists() and not provenance.is_current(
        output / "source.json", source
    ):
        raise InputError(f"{output} holds the tracks of another map. Choose another folder.")
    provenance.write(output / "source.json", source)
    if conf is None and descriptor not in DESCRIPTORS:
        conf = features_confs.get(descriptor, keypoints=KEYPOINTS)[1]
    found_by, patches = (descriptor, False) if conf else (MATCHED, True)
    conf = conf or features_confs.get(MATCHED, keypoints=KEYPOINTS)[1]
    pairs = pairs_from_covisibility.main(
        model, output / f"pairs-db-covis{NUM_COVIS}.txt", NUM_COVIS
    )
    names = sorted(image.name for image in colmap.read_model(model).images.values())
    features = extract_features.main(conf, images, output, image_list=names)
    # no ratio test: the poses tell right from wrong, and what is ambiguous is worth learning
    matcher = match_features.confs["NN-mutual"]
    matches = match_features.main(matcher, pairs, features.stem, output)
    sfm = output / f"sfm_{found_by}"
    reconstruction = triangulation.main(sfm, model, images, pairs, features, matches)

    tracks = output / f"tracks_{descriptor}.safetensors"
    made_from = stamp(descriptor, seed, [sfm / "points3D.bin", features])
    if tracks.exists() and provenance.is_current(tracks.with_suffix(".json"), made_from):
        return tracks
    complete, matched, keypoints = _observations(reconstruction, features, names)
    describe = PatchDescriber(descriptor) if patches else FeatureDescriber(conf["model"])
    parts = parts_of(tracks)
    with resume_or_replace(parts, made_from) as writer, open_h5(features) as file:
        todo = [(number, name) for number, name in enumerate(names) if name not in writer]
        done = len(names) - len(todo)
        for number, name in progress(todo, "Describing tracks", "image", len(names), done):
            observed = complete(name)
            kept = np.flatnonzero(observed >= 0)
            if not len(kept):
                continue
            generator = np.random.default_rng([seed, number])
            image, size = extractors.load_image(images / name, conf["preprocessing"])
            ratio = np.array(image.shape[:1:-1]) / size
            scaled = keypoints[name][kept]  # in pixels of the resized image
            scaled[:, :2] = (scaled[:, :2] + 0.5) * ratio - 0.5
            scaled[:, 2:3] *= ratio.mean()
            known = get_descriptors(file, name)[kept]
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
    return save_parts(tracks, made_from, described)


def _observations(
    reconstruction: pycolmap.Reconstruction, features: Path, names: list[str]
) -> tuple[Callable[[str], np.ndarray], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Find which points the keypoints of the images observe.

    Returns:
        What completes the tracks: from image name to the id of the point of each keypoint (N,), -1
        where none; the same as matched; and from image name to the keypoints (N, 4): x, y, scale
        (pixels), orientation (degrees), or (N, 2) where they have no more, whose tracks cannot be
        completed.
    """
    images = {image.name: image for image in reconstruction.images.values()}
    matched = {name: point3D_ids(images[name]) for name in names}
    with open_h5(features) as file:
        oriented = {"scales", "oris"} <= file[names[0]].keys()
        columns = ("keypoints", "scales", "oris") if oriented else ("keypoints",)
        keypoints = {
            name: np.column_stack([get_dataset(file, name, key)[()] for key in columns])
            for name in names
        }
        keypoints = {name: array.astype(np.float32) for name, array in keypoints.items()}
        places = {name: get_colmap_keypoints(file, name)[0] for name in names}
    if not oriented:
        return matched.__getitem__, matched, keypoints
    shaped = {name: np.column_stack([places[name], keypoints[name][:, 2:]]) for name in names}
    return Completion(reconstruction, shaped, matched), matched, keypoints


def stamp(descriptor: str, seed: int, inputs: list[Path]) -> dict:
    """Describe what a file of `load` is made from."""
    options = {"variants": VARIANTS, "seed": seed, "descriptor": descriptor, "format": 2}
    return provenance.stamp(options, inputs)


def save(
    path: Path,
    made_from: dict,
    descriptors: np.ndarray,
    points: np.ndarray,
    image: np.ndarray,
    xy: np.ndarray,
    matched: np.ndarray,
) -> Path:
    """Write the file of `load` and its stamp.

    Args:
        path: of the file.
        made_from: its stamp.
        descriptors: as in `Tracks`, in any order.
        points: (M,) which points the observations see, by any numbers.
        image: as in `Tracks`.
        xy: as in `Tracks`.
        matched: as in `Tracks`.

    Returns:
        The path.
    """
    _, track = np.unique(points, return_inverse=True)
    order = np.argsort(track, kind="stable")
    tracks = Tracks(descriptors, track, image, xy, matched).only(order)
    with replacing(path) as temporary:
        save_file(vars(tracks), temporary)
    provenance.write(path.with_suffix(".json"), made_from)
    logger.info("%d observations of %d points: %s", len(track), tracks.num_tracks, path)
    return path


def parts_of(path: Path) -> Path:
    """Return the h5 file of the observations described so far, while the file of `load` is made."""
    return path.with_suffix(".parts.h5")


def save_parts(path: Path, made_from: dict, names: list[str]) -> Path:
    """Write the file of `load` from the groups of `parts_of`, which is then deleted.

    Args:
        path: of the file.
        made_from: its stamp.
        names: the groups, in order; each has the arrays that `save` takes.

    Returns:
        The path.
    """
    keys = ("descriptors", "points", "image", "xy", "matched")
    with open_h5(parts_of(path)) as file:
        arrays = {
            key: np.concatenate([get_dataset(file, name, key)[()] for name in names])
            for key in keys
        }
    save(path, made_from, **arrays)
    parts_of(path).unlink()
    return path


def load(path: Path) -> Tracks:
    """Read the file that `save` wrote."""
    return Tracks(**load_file(path))


class PatchDescriber:
    """Describes keypoints by the patches around them, in a photo and in variants of it."""

    def __init__(self, descriptor: str):
        self.describe = Descriptor(descriptor).to(device())

    @torch.no_grad()
    def __call__(
        self,
        image: torch.Tensor,
        keypoints: np.ndarray,
        known: np.ndarray,
        generator: np.random.Generator,
    ) -> np.ndarray:
        """Describe the keypoints of a photo.

        Args:
            image: (1, 1, H, W) float32 in [0, 1].
            keypoints: (N, 4) x, y, scale (pixels), orientation (degrees).
            known: the descriptors that the keypoints were found with, not used.
            generator: draws the variants.

        Returns:
            (N, 2, VARIANTS, D) float16: as seen and mirrored.
        """
        described = np.empty((len(keypoints), 2, VARIANTS, DIM), np.float16)
        photo = image[0, 0].numpy()
        for variant in range(VARIANTS):
            view = photometric_variant(photo, generator) if variant else photo
            patches = extract_patches(torch.from_numpy(view)[None, None], keypoints)
            described[:, :, variant] = describe_mirrored(patches, self.describe)
        return described


class FeatureDescriber:
    """Describes keypoints by an extractor, which finds them anew in each variant of a photo."""

    def __init__(self, model: dict):
        self.extract = extractors.load(model).eval().to(device())
        self.mirror = MIRRORS.get(self.extract.descriptor, np.copy)

    @torch.no_grad()
    def __call__(
        self,
        image: torch.Tensor,
        keypoints: np.ndarray,
        known: np.ndarray,
        generator: np.random.Generator,
    ) -> np.ndarray:
        """Describe the keypoints of a photo (1, C, H, W) as `PatchDescriber` does.

        What is not found anew within MAX_SHIFT pixels keeps its `known` descriptor (N, D). Without
        patches nothing but COLMAP's SIFT is mirrored: both views are as seen.
        """
        described = np.repeat(known[:, None, None].astype(np.float16), VARIANTS, axis=2)
        photo = image[0].numpy().transpose(1, 2, 0)
        for variant in range(1, VARIANTS):
            view = np.atleast_3d(photometric_variant(photo, generator)).transpose(2, 0, 1)
            features = self.extract({"image": torch.from_numpy(view.copy())[None].to(device())})
            found = features["keypoints"][0].cpu().numpy()
            if not len(found):
                continue
            descriptors = features["descriptors"][0].T.cpu().numpy()
            # of several at one place, such as of other orientations, the one most alike
            distance, near = cKDTree(found).query(
                keypoints[:, :2], k=range(1, NEIGHBORS + 1), distance_upper_bound=MAX_SHIFT
            )
            candidates = descriptors[np.minimum(near, len(found) - 1)]
            likeness = np.einsum("nkd,nd->nk", candidates, known.astype(np.float32))
            best = np.where(np.isfinite(distance), likeness, -np.inf).argmax(axis=1)
            again = np.isfinite(distance[:, 0])
            described[again, 0, variant] = candidates[again, best[again]]
        return np.concatenate([described, self.mirror(described)], axis=1)


def mirror_colmap_sift(descriptors: np.ndarray) -> np.ndarray:
    """Return COLMAP's SIFT (..., 128) of keypoints mirrored as by `describe_mirrored`."""
    bins = descriptors.reshape(*descriptors.shape[:-1], 4, 4, 8)  # rows, columns, orientations
    mirrored = np.roll(bins[..., ::-1, :, ::-1], 1, axis=-1)  # orientation 0 stays
    return mirrored.reshape(descriptors.shape)


MIRRORS = {COLMAP: mirror_colmap_sift}


def describe_mirrored(patches: torch.Tensor, describe: Descriptor) -> np.ndarray:
    """Describe patches (N, 1, 32, 32) as seen and mirrored, (N, 2, 128) float32.

    Mirrored is across the axis of the orientation: a mirrored world, oriented alike.
    """
    views = (patches.to(device()), patches.flip(2).to(device()))
    return np.stack([describe(view).cpu().numpy() for view in views], axis=1)


def photometric_variant(image: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Draw how a camera would see the same under another light: darker, blurred, noisy, 8 bit.

    Args:
        image: (H, W) or (H, W, C) float32 in [0, 1].
        generator: draws gamma 0.5-2, gain 0.08-1.2, blur up to 1.5 px and noise up to 2 %.

    Returns:
        As the image, without the last axis if C is 1.
    """
    gamma = 2 ** generator.uniform(-1, 1)
    gain = np.exp(generator.uniform(np.log(0.08), np.log(1.2)))
    view = gain * image**gamma
    blur = generator.uniform(-1.5, 1.5)
    if blur > 0.3:
        view = cv2.GaussianBlur(view, (0, 0), blur)
    noise = generator.uniform(0, 0.02) * np.sqrt(gain)  # less light, less shot noise
    view = view + noise * generator.standard_normal(view.shape, np.float32)
    return (np.round(view.clip(0, 1) * 255) / 255).astype(np.float32)
