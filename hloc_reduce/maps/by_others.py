"""Localize photos by the other photos of a map, as they are and mirrored."""

import copy
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from .. import aggregate_features, match_features, pairs_from_retrieval
from ..confs.matchers import confs as matchers_confs
from ..localization import intrinsics, stage
from ..localization.gate import DEFAULT_GATE
from ..localization.inputs import Settings
from ..localization.mirrored import mirror
from ..localization.query import merged, ransac_options
from ..localization.references import SfmMap
from ..localize_sfm import RANSAC_THRESH
from ..runtime.executors import SERIAL
from ..utils import colmap
from ..utils.parsers import parse_retrieval, write_pairs
from . import mirror_images

NUM_LOC = 20  # most similar images that a new photo is matched with


@dataclass(frozen=True)
class ByOthers:
    """Localizes photos of a map by its other photos; a `checks.Localize`.

    Args:
        sfm: the map.
        conf: configuration of its features.
        matcher: a key of `confs.matchers`.
        image_dir: folder of the photos.
        features: feature file of the photos.
        descriptors: h5 file of their global descriptors.
        folder: for the features and the matches of mirror images.
        retrieval: configuration of the global descriptors.
        masks: of the photos, see `extract_features.main`.
    """

    sfm: pycolmap.Reconstruction
    conf: dict
    matcher: str
    image_dir: Path
    features: Path
    descriptors: Path
    folder: Path
    retrieval: dict
    masks: Path | None = None

    def __call__(
        self, names: Collection[str], by: Collection[str], mirrored: bool
    ) -> dict[str, dict]:
        """Return the records of photos, see `localization.stage`; none without a point to see."""
        known = intrinsics.of_map(self.sfm, self.image_dir, by)
        inferred = intrinsics.infer_all(self.image_dir, sorted(names), known)
        unused = {image.name for image in self.sfm.images.values()} - {*by}
        others = colmap.remove_images(copy.deepcopy(self.sfm), unused)
        if not inferred or not others.num_points3D():
            return {}
        reference = SfmMap(others)
        features, descriptors, what = self.features, self.descriptors, "photos"
        if mirrored:
            features, descriptors = self._describe_mirror_images([*inferred])
            what = "mirrored"
        pairs = self.folder / f"pairs-{what}.txt"
        pairs_from_retrieval.main(
            descriptors,
            pairs,
            NUM_LOC + 1,
            query_list=[*inferred],
            db_list=sorted(by),
            db_descriptors=self.descriptors,
        )
        retrieved = {  # a mirror image must not be localized by the photo itself
            name: [other for other in others if other != name][:NUM_LOC]
            for name, others in parse_retrieval(pairs).items()
        }
        write_pairs([(name, other) for name in retrieved for other in retrieved[name]], pairs)
        matches = match_features.main(
            matchers_confs[self.matcher],
            pairs,
            features,
            matches=self.folder / f"matches-{what}.h5",
            features_ref=self.features,
        )
        options = {
            name: merged(
                ransac_options(RANSAC_THRESH, camera), intrinsics.refinement(camera, source, known)
            )
            for name, (camera, source) in inferred.items()
        }
        tasks: list[tuple[str, pycolmap.Camera | None, list[str]]] = [
            (name, mirror(camera) if mirrored else camera, retrieved.get(name, []))
            for name, (camera, _) in inferred.items()
        ]
        return dict(
            stage.localize_all(
                Settings(
                    load_reference=lambda: reference,
                    config=lambda name, _: options[name],
                    skip_matches=0,
                    gate=DEFAULT_GATE,
                    executor=SERIAL,
                ),
                features=features,
                matches=matches,
                tasks=tasks,
                thorough=False,
                said="Looking for mirrored photos",
            )
        )

    def _describe_mirror_images(self, names: list[str]) -> tuple[Path, Path]:
        """Return the files of the features and of the global descriptors of mirror images."""
        features = self.folder / self.features.name
        mirror_images.extract(self.conf, self.image_dir, names, features, masks=self.masks)
        return features, aggregate_features.main(
            mirror_images.of_mirror_images(self.retrieval),
            features,
            vocabulary=aggregate_features.vocabulary_of(self.descriptors),
            image_dir=self.image_dir,
        )
