"""New photos that are being added to a map: described, localized in it and placed in its model."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from .. import (
    extract_features,
    localize_sfm,
    logger,
    match_features,
    pairs_from_retrieval,
)
from ..confs import matchers as matchers_confs
from ..localization import intrinsics
from ..localization.gate import DEFAULT_GATE
from ..localization.records import camera_of, pose_of
from ..mapping import extension
from ..mapping.checks import Inputs, contradictions, sizes
from ..mapping.extension import Placed
from ..runtime import provenance
from ..runtime.group_writer import failures, merge
from ..runtime.outputs import CONF
from ..triangulation import read_matches
from ..utils import cli, colmap
from ..utils.cli import InputError
from ..utils.feature_files import get_image_size
from ..utils.files import announce, delete, is_readable
from ..utils.h5 import open_h5
from ..utils.match_files import check_distinct
from ..utils.parsers import parse_pairs
from .by_others import NUM_LOC
from .map import FINGERPRINTS, Map
from .mirror_images import mirror_images

GROWING = "growing"  # the folder of an addition, in that of the map
PHOTO_KEYS = "images/"  # begins the names of photos in the fingerprints of a map


def photo_of(key: str) -> str | None:
    """Return the name of a photo in the fingerprints of a map, None for other files."""
    return key.removeprefix(PHOTO_KEYS) if key.startswith(PHOTO_KEYS) else None


def _digests(fingerprints: Mapping[str, list]) -> dict[str, str]:
    """Return the digests of the photos in fingerprints, by name."""
    named = {photo_of(key): value[2] for key, value in fingerprints.items()}
    return {name: digest for name, digest in named.items() if name is not None}


@dataclass
class Addition:
    """New photos that are being added to a map.

    Args:
        built: the map.
        sfm: its model, to which images are added.
        image_dir: folder of the new photos.
        refine_map: adjust the poses of the other photos, too.

    Attributes:
        added: names of the photos that are in the model now.
        left_out: names of the photos that are not added, by reason.
    """

    built: Map
    sfm: pycolmap.Reconstruction
    image_dir: Path
    refine_map: bool
    added: list[str] = field(default_factory=list)
    left_out: dict[str, list[str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.folder = self.built.folder / GROWING
        self.features = self.folder / self.built.features.name
        self.descriptors = self.folder / self.built.descriptors.name
        self.matches = self.folder / "matches.h5"
        self.inside = sorted(image.name for image in self.sfm.images.values())

    def begin(self, names: list[str], posed: bool) -> list[str]:
        """Return the photos that are new; begin anew unless their addition was interrupted."""
        broken = [name for name in names if not is_readable(self.image_dir / name)]
        self._leave_out("not readable", broken)
        files = {
            f"{PHOTO_KEYS}{name}": self.image_dir / name for name in names if name not in broken
        }
        known = provenance.read(self.built.folder / FINGERPRINTS)
        self.fingerprints = provenance.fingerprints(files, {})
        digests, before = _digests(self.fingerprints), _digests(known)
        new = self._new(digests, {name: before.get(name) for name in self.inside})
        check_distinct([*self.inside, *new])
        images = {name: digests[name] for name in new}
        conf = {"map": self.built.id, "images": images, "num_loc": NUM_LOC, "posed": posed}
        if provenance.read(self.folder / CONF) != conf:
            announce(self.folder)
            delete(self.folder)
            provenance.write(self.folder / CONF, conf)
        return new

    def _new(self, digests: Mapping[str, str], inside: Mapping[str, str | None]) -> list[str]:
        """Return the photos that are not in the map.

        Args:
            digests: of the content of photos, by name.
            inside: the same of those in the map; None in a map of a database, which had no photos.
        """
        new, taken, same = [], [], 0
        first = {digest: name for name, digest in inside.items() if digest is not None}
        for name, digest in digests.items():
            if name in inside:
                same += inside[name] in (None, digest)
                if inside[name] not in (None, digest):
                    taken.append(name)
            elif digest in first:
                self._leave_out(f"copies of {first[digest]}", [name])
            else:
                first[digest] = name
                new.append(name)
        if taken:
            raise InputError(
                f"The map has other photos that are called {cli.some(taken)}: rename those in "
                f"{self.image_dir}, or first remove those in the map, --remove_images."
            )
        if same:
            logger.info("%d of %d photos are in the map already.", same, len(digests))
        return new

    def describe(self, names: list[str]) -> list[str]:
        """Extract local and global descriptors of photos, and return those that could be read."""
        features = extract_features.main(
            *(self.built.conf, self.image_dir, self.folder / "new"),
            image_list=names,
            strict=False,
        )
        broken = failures(features)
        self._leave_out("not readable", [name for name in names if name in broken])
        readable = [name for name in names if name not in broken]
        if readable:
            descriptors = self.built.aggregate(features, readable, self.image_dir)
            # photos that the map could not reconstruct have old features in its files
            merge(self.features, [self.built.features, features], names)
            merge(self.descriptors, [self.built.descriptors, descriptors], names)
        return readable

    def place(self, reference: pycolmap.Reconstruction, names: list[str]) -> None:
        """Add photos with the poses of a model, whose cameras are scaled to resized photos."""
        with open_h5(self.features) as file:
            resized, unfit = sizes.compare(
                reference, {name: get_image_size(file, name) for name in names}
            )
        sizes.scale_cameras(reference, resized)
        self._leave_out("of another size than their cameras in the model", [*unfit])
        images = {image.name: image for image in reference.images.values()}
        placed = {}
        for image in (images[name] for name in names if name not in unfit):
            pose = image.cam_from_world()
            placed[image.name] = Placed(pose, image.camera, known=True, fixed=True)
        if placed:
            self._extend(placed, [self._pairs([*placed], [*self.inside, *placed], "posed")])

    def localize(self, names: list[str]) -> None:
        """Localize photos in the map and add them; then those that are left, in the new map."""
        known = self.built.cameras
        inferred = intrinsics.infer_all(self.image_dir, names, known)
        self._leave_out("not readable", [name for name in names if name not in inferred])
        left, number = list(inferred), 0
        while left:
            number += 1
            pairs = self._pairs(left, sorted([*self.inside, *self.added]), f"round{number}")
            queries = [(name, inferred[name][0]) for name in left]
            records = localize_sfm.main(
                *(self.sfm, queries, pairs, self.features),
                *(self._match(pairs), self.folder / f"poses-round{number}.txt"),
                refinements={name: intrinsics.refinement(*inferred[name], known) for name in left},
                full_names=True,
                mirror_images=mirror_images(
                    *(self.built.conf, self.image_dir, pairs),
                    *(self.folder / "mirrored.h5", self._match),
                ),
            )
            placed = {}
            for name, record in records.items():
                if record["localized"] and (pose := pose_of(record)) is not None:
                    exact = inferred[name][1] in intrinsics.EXACT
                    placed[name] = Placed(pose, camera_of(record), exact, fixed=False)
            left = [name for name in left if name not in placed]
            if not placed:
                break
            found = sorted(placed)
            everything = sorted([*self.inside, *self.added, *found])
            self._extend(placed, [pairs, self._pairs(found, everything, f"new{number}")])
        self._leave_out("not localized in the map", left)

    def _pairs(self, names: list[str], others: list[str], what: str) -> Path:
        """Pair photos with the most similar ones of others."""
        pairs = self.folder / f"pairs-{what}.txt"
        return pairs_from_retrieval.main(
            self.descriptors, pairs, NUM_LOC, query_list=names, db_list=others
        )

    def _match(self, pairs: Path, mirrored: Path | None = None) -> Path:
        """Match pairs; with a file of the features of mirror images, those of the first images."""
        conf = matchers_confs.confs[self.built.matcher]
        if mirrored is None:
            return match_features.main(conf, pairs, self.features, matches=self.matches)
        matches = self.folder / f"matches-{pairs.stem}.h5"
        return match_features.main(
            conf, pairs, mirrored, matches=matches, features_ref=self.features
        )

    def _extend(self, placed: Mapping[str, Placed], pairs: Iterable[Path]) -> None:
        """Add images to the model, but those that share too little with it or contradict it."""
        images = {*self.inside, *self.added, *placed}
        keypoints: dict[str, np.ndarray] = {}
        uncertainty: dict[str, float] = {}
        matches: dict[extension.Pair, np.ndarray] = {}
        for listed in pairs:
            self._match(listed)
            names = sorted({name for pair in parse_pairs(listed) for name in pair})
            positions, errors, found = read_matches(
                *(names, listed, self.features, self.matches), None
            )
            keypoints |= {name: positions[name] for name in names if name in images}
            uncertainty |= errors
            matches |= {pair: rows for pair, rows in found.items() if images.issuperset(pair)}
        extension.extend(self.sfm, placed, keypoints, uncertainty, matches, self.refine_map)
        shared = extension.count_shared(self.sfm, placed)
        self._drop(
            "sharing too few points with the map",
            [name for name in placed if shared[name] < DEFAULT_GATE.min_inliers],
        )
        left = [name for name in placed if shared[name] >= DEFAULT_GATE.min_inliers]
        wrong = contradictions.judge(Inputs(self.sfm, matches=self.matches), left)
        self._drop("contradicting the map", wrong)
        self.added += [name for name in left if name not in wrong]

    def _drop(self, reason: str, names: list[str]) -> None:
        """Take photos out of the model again."""
        self.sfm = colmap.remove_images(self.sfm, names)
        self._leave_out(reason, names)

    def report(self) -> None:
        """Say which photos are not added, and why; raise an InputError if that is all."""
        found = [f"{reason}: {cli.some(names)}" for reason, names in self.left_out.items()]
        if found and not self.added:
            raise InputError(f"No photo was added to {self.built.folder}: {'; '.join(found)}.")
        if found:
            logger.warning("Not added: %s.", "; ".join(found))

    def _leave_out(self, reason: str, names: list[str]) -> None:
        if names:
            self.left_out.setdefault(reason, []).extend(names)
