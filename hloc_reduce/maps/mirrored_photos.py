"""Find the mirrored photos in a map of photos alone."""

import copy
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from .. import aggregate_features, logger, match_features, pairs_from_retrieval
from ..confs.matchers import confs as matchers_confs
from ..confs.retrieval import confs as retrieval_confs
from ..localization import intrinsics, stage
from ..localization.confidence import DEFAULT_GATE
from ..localization.mirrored import mirror
from ..localization.query import merged, ransac_options
from ..localization.references import SfmMap
from ..localize_sfm import RANSAC_THRESH
from ..runtime.executors import SERIAL
from ..utils import cli, colmap
from ..utils.colmap import point3D_ids, visibility
from ..utils.parsers import parse_retrieval, write_pairs
from . import mirroring

# photos show the same part of a place if they share as many points, of the median number that a
# photo of the map has
SHARED = 0.5
SIMILAR = 20  # photos by which one is localized
FEWEST = 3  # photos that may tell whether others are mirrored
CERTAIN = 0.9, 250.0  # least agreement and confidence of the mirror image of a mirrored photo


def find(
    sfm: pycolmap.Reconstruction,
    names: Collection[str],
    conf: dict,
    matcher: str,
    image_dir: Path,
    features: Path,
    descriptors: Path,
    folder: Path,
) -> list[str]:
    """Find the mirrored photos among those of a map, with a pose or without.

    Mirrored photos match others only where the place is symmetric, so a mapper places them anywhere
    or not at all. They share few points with the others, though many among themselves. So photos
    that share few points with most others, and those without a pose, are localized by the others,
    as they are and mirrored. If the mirror image fits beyond doubt, with a higher confidence, they
    were mirrored before, or all others were. If there are any, all other photos are tried, too.
    This takes up to as long as the extraction of the photos that are tried, and their matching.

    Args:
        sfm: the map.
        names: its photos.
        conf: configuration of its features.
        matcher: a key of `confs.matchers`.
        image_dir: folder of the photos.
        features: feature file of the photos.
        descriptors: h5 file of their global descriptors.
        folder: for the features and the matches of mirror images.

    Returns:
        Their names, sorted.
    """
    judge = _Judge(sfm, conf, matcher, image_dir, features, descriptors, folder)
    sound = _largest_group(sfm)
    found = judge.find({*names} - sound, sound)
    if found:
        placed = {sfm.images[i].name for i in sfm.reg_image_ids()}
        found |= judge.find({*names} - found, placed - found)
    return sorted(found)


def warn(names: list[str]) -> None:
    """Warn of mirrored photos, if there are any."""
    if names:
        logger.warning(
            "Mirrored photos are not in the map: %s. Their mirror images fit to the other photos. "
            "Either these were mirrored, or all others: use photos as the camera took them.",
            cli.some(names),
        )


def _largest_group(sfm: pycolmap.Reconstruction) -> set[str]:
    """Return the names of the largest group of photos that share many points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    images = [sfm.images[i] for i in sfm.reg_image_ids()]
    shows = visibility(map(point3D_ids, images)).sign()
    shared = (shows @ shows.T).tocoo()
    many = shared.data >= SHARED * np.median(shared.diagonal())
    pairs = shared.row[many], shared.col[many]
    _, group = connected_components(coo_array((shared.data[many], pairs), shared.shape))
    largest = np.bincount(group).argmax()
    return {image.name for image, its in zip(images, group, strict=True) if its == largest}


@dataclass
class _Judge:
    """Tells mirrored photos by the other photos of a map; arguments as in `find`."""

    sfm: pycolmap.Reconstruction
    conf: dict
    matcher: str
    image_dir: Path
    features: Path
    descriptors: Path
    folder: Path

    def find(self, names: set[str], by: set[str]) -> set[str]:
        """Return the mirrored ones of some photos, each of which is localized by some others."""
        if len(by) < FEWEST:
            return set()
        known = intrinsics.of_map(self.sfm, self.image_dir, by)
        inferred = intrinsics.infer_all(self.image_dir, sorted(names), known)
        unused = {image.name for image in self.sfm.images.values()} - by
        others = colmap.remove_images(copy.deepcopy(self.sfm), unused)
        if not inferred or not others.num_points3D():
            return set()
        reference = SfmMap(others)
        mirrored = mirroring.extract(
            self.conf, self.image_dir, [*inferred], self.folder / self.features.name
        )
        descriptors = aggregate_features.main(
            retrieval_confs["vlad"],
            mirrored,
            vocabulary=aggregate_features.vocabulary_of(self.descriptors),
        )
        options = {
            name: merged(
                ransac_options(RANSAC_THRESH, camera), intrinsics.refinement(camera, source, known)
            )
            for name, (camera, source) in inferred.items()
        }
        cameras = {name: camera for name, (camera, _) in inferred.items()}
        of_mirrored = {name: mirror(camera) for name, camera in cameras.items()}
        files = self.features, self.descriptors
        as_they_are = self._localize(reference, by, "photos", *files, cameras, options)
        files = mirrored, descriptors
        as_mirrored = self._localize(reference, by, "mirrored", *files, of_mirrored, options)
        return {
            name
            for name, record in as_mirrored.items()
            if record["confidence"] > as_they_are[name]["confidence"]
            and record["agreement"] >= CERTAIN[0]
            and record["confidence"] >= CERTAIN[1]
        }

    def _localize(
        self,
        reference: SfmMap,
        by: set[str],
        what: str,
        features: Path,
        descriptors: Path,
        cameras: dict[str, pycolmap.Camera],
        options: dict[str, dict],
    ) -> dict[str, dict]:
        """Return the records of photos that are localized by others, see `localization.stage`."""
        pairs = self.folder / f"pairs-{what}.txt"
        pairs_from_retrieval.main(
            *(descriptors, pairs, SIMILAR + 1),
            query_list=[*cameras],
            db_list=sorted(by),
            db_descriptors=self.descriptors,
        )
        retrieved = {  # a mirror image must not be localized by the photo itself
            name: [other for other in others if other != name][:SIMILAR]
            for name, others in parse_retrieval(pairs).items()
        }
        write_pairs([(name, other) for name in retrieved for other in retrieved[name]], pairs)
        matches = match_features.main(
            *(matchers_confs[self.matcher], pairs, features),
            matches=self.folder / f"matches-{what}.h5",
            features_ref=self.features,
        )
        return dict(
            stage.localize_all(
                *(lambda: reference, lambda name, _: options[name], 0, DEFAULT_GATE, SERIAL),
                *(features, matches),
                [(name, camera, retrieved.get(name, [])) for name, camera in cameras.items()],
                thorough=False,
                said="Looking for mirrored photos",
            )
        )
