"""Add photos to a map, or remove some; the others keep their features and poses.

A change is prepared in a folder of its own. `map.json`, which names the folder of the COLMAP model,
is written after all that it needs: a map whose change was interrupted is whole, and the same call
resumes the change.
"""

import json
import os
import uuid
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pycolmap

from .. import (
    aggregate_features,
    extract_features,
    localize_sfm,
    logger,
    match_features,
    pairs_from_retrieval,
)
from ..confs import matchers as matchers_confs
from ..localization import intrinsics
from ..localization.confidence import DEFAULT_GATE
from ..localization.records import camera_of, pose_of
from ..mapping import copies, extension
from ..mapping.extension import Placed
from ..runtime import provenance
from ..runtime.group_writer import failures, merge
from ..runtime.outputs import CONF, RunFolder
from ..triangulation import read_matches
from ..utils import cli, colmap
from ..utils.cli import InputError
from ..utils.files import announce, delete
from ..utils.h5 import list_h5_names
from ..utils.images import list_images
from ..utils.match_files import check_names
from ..utils.parsers import parse_pairs
from ..utils.paths import strings_as_paths
from . import contradictions, precision
from .map import FINGERPRINTS, FINISHED, PLACE, RETRIEVAL, SFM, Map
from .mirroring import mirror_images

GROWING = "growing"  # the folder of a change that is being prepared
IMAGES = "images/"  # begins the names of photos in the fingerprints of a map
NUM_LOC = 20  # images of the map that a new photo is matched with


@strings_as_paths
def add(
    built: Map,
    image_dir: Path,
    model: Path | None = None,
    num_loc: int = NUM_LOC,
    refine_map: bool = False,
) -> Map:
    """Add photos to a map: localize them, extend the points that they see, and triangulate others.

    Photos that are in the map already are skipped. Photos that cannot be read, or localized in the
    map, are left out with a warning. Those that only overlap other new ones are localized after
    these.

    Args:
        built: the map.
        image_dir: folder of the photos.
        model: COLMAP model with their poses in the frame of the map, which are kept; default: they
            are localized, with intrinsics from `localization.intrinsics.infer`.
        num_loc: the number of most similar images that each photo is matched with.
        refine_map: adjust the poses of the other photos, too.

    Returns:
        The map with the new photos.

    Raises:
        InputError: if no photo can be added, another photo in the map has the name of a new one, or
            something is missing or wrong. The map is then as it was.
    """
    _check_whole(built)
    reference = None if model is None else colmap.read_model(model)
    names = list_images(image_dir)
    if reference is not None:
        posed = {reference.images[i].name for i in reference.reg_image_ids()}
        names = [name for name in names if name in posed]
        if not names:
            raise InputError(f"{model} has a pose of no photo in {image_dir}.")
    with _opened(built) as folder, folder.stage("add_images"):
        built = Map(built.folder)  # another run may have changed it before it was locked
        addition = _Addition(built, colmap.read_model(built.sfm), image_dir, num_loc, refine_map)
        new = addition.begin(names, posed=reference is not None)
        if not new:
            addition.report()
            _drop_left(folder, built)
            return built
        new = addition.describe(new)
        if reference is not None and new:
            addition.place(reference, new)
        elif new:
            addition.localize(new)
        addition.report()
        addition.commit()
        _drop_left(folder, Map(built.folder))
    return Map(built.folder)


@strings_as_paths
def remove(built: Map, names: Iterable[str]) -> Map:
    """Remove photos from a map, with their features and the points that fewer than two others see.

    Args:
        built: the map.
        names: the photos; those that could not be reconstructed only lose their features.

    Returns:
        The map without them.

    Raises:
        InputError: if a photo is not in the map, or not enough are left.
    """
    _check_whole(built)
    removed = set(names)
    with _opened(built) as folder, folder.stage("remove_images"):
        built = Map(built.folder)
        sfm = colmap.read_model(built.sfm)
        inside = {image.name for image in sfm.images.values()}
        # also of a removal that was interrupted after map.json was written
        if unknown := removed - inside - {*list_h5_names(built.features)}:
            raise InputError(f"The map {built.folder} has no photo {cli.some(sorted(unknown))}.")
        _check_rigs(sfm, removed)
        if removed & inside:
            extension.remove(sfm, removed)
            if not sfm.num_points3D():
                raise InputError(f"No point of the map {built.folder} would be left.")
            _commit(built, sfm, -len(removed), removed=removed)
        for path in (built.features, built.descriptors):
            merge(path, [path], removed)
        known = provenance.read(built.folder / FINGERPRINTS)
        kept = {key: value for key, value in known.items() if _name(key) not in removed}
        provenance.write(built.folder / FINGERPRINTS, kept)
        _drop_left(folder, Map(built.folder))
    return Map(built.folder)


def _check_whole(built: Map) -> None:
    """Refuse an unpacked compact map: it lacks most keypoints."""
    if not (built.folder / FINGERPRINTS).is_file():
        raise InputError(
            f"The map {built.folder} is an unpacked compact one, to which no photo can be added: "
            "change the map that it was made from, and compact that again."
        )


def _check_rigs(sfm: pycolmap.Reconstruction, names: Collection[str]) -> None:
    """Refuse to remove photos without those that a rig took together with them."""
    images = sfm.images.values()
    frames = {image.frame_id for image in images if image.name in names}
    others = {image.name for image in images if image.frame_id in frames} - {*names}
    if others:
        raise InputError(
            f"A rig of cameras took {cli.some(sorted(others))} together with photos to remove: "
            "remove them, too."
        )


def _is_readable(path: Path) -> bool:
    return path.is_file() and os.access(path, os.R_OK)


def _opened(built: Map) -> RunFolder:
    """Lock the folder of a map."""
    conf = provenance.read(built.folder / CONF)
    return RunFolder(built.folder, conf, overwrite=False, kept=(PLACE, FINGERPRINTS))


def _name(key: str) -> str | None:
    """Return the name of a photo in the fingerprints of a map, None for other files."""
    return key.removeprefix(IMAGES) if key.startswith(IMAGES) else None


def _digests(fingerprints: Mapping[str, list]) -> dict[str, str]:
    """Return the digests of the photos in fingerprints, by name."""
    named = {_name(key): value[2] for key, value in fingerprints.items()}
    return {name: digest for name, digest in named.items() if name is not None}


@dataclass
class _Addition:
    """New photos that are being added to a map.

    Args:
        built: the map.
        sfm: its model, to which images are added.
        image_dir: see `add`, like `num_loc` and `refine_map`.
        num_loc: see `image_dir`.
        refine_map: see `image_dir`.

    Attributes:
        added: names of the photos that are in the model now.
        left_out: names of the photos that are not added, by reason.
    """

    built: Map
    sfm: pycolmap.Reconstruction
    image_dir: Path
    num_loc: int
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
        files = {f"{IMAGES}{name}": self.image_dir / name for name in names}
        broken = [key for key, path in files.items() if not _is_readable(path)]
        self._leave_out("not readable", [key.removeprefix(IMAGES) for key in broken])
        files = {key: path for key, path in files.items() if key not in broken}
        known = provenance.read(self.built.folder / FINGERPRINTS)
        self.fingerprints = provenance.fingerprints(files, {})
        digests, before = _digests(self.fingerprints), _digests(known)
        new = self._new(digests, {name: before.get(name) for name in self.inside})
        check_names([*self.inside, *new])
        images = {name: digests[name] for name in new}
        conf = {"map": self.built.id, "images": images, "num_loc": self.num_loc, "posed": posed}
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
            descriptors = aggregate_features.main(
                RETRIEVAL, features, vocabulary=self.built.vocabulary, image_list=readable
            )
            # photos that the map could not reconstruct have old features in its files
            merge(self.features, [self.built.features, features], names)
            merge(self.descriptors, [self.built.descriptors, descriptors], names)
        return readable

    def place(self, reference: pycolmap.Reconstruction, names: list[str]) -> None:
        """Add photos with the poses of a model."""
        images = {image.name: image for image in reference.images.values()}
        placed = {
            name: Placed(
                *(images[name].cam_from_world(), reference.cameras[images[name].camera_id]),
                known=True,
                fixed=True,
            )
            for name in names
        }
        self._extend(placed, [self._pairs(names, [*self.inside, *names], "posed")])

    def localize(self, names: list[str]) -> None:
        """Localize photos in the map and add them; then those that are left, in the new map."""
        known = self.built.cameras
        inferred = intrinsics.infer_all(self.image_dir, names, known)
        self._leave_out("not readable", [name for name in names if name not in inferred])
        left, number = list(inferred), 0
        while left:
            number += 1
            pairs = self._pairs(left, sorted([*self.inside, *self.added]), f"round{number}")
            queries: list[tuple[str, pycolmap.Camera | None]] = [
                (name, inferred[name][0]) for name in left
            ]
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
                    exact = inferred[name][1] == "map"
                    placed[name] = Placed(pose, camera_of(record), exact, fixed=False)
            left = [name for name in left if name not in placed]
            if not placed:
                break
            found = sorted(placed)
            among = self._pairs(found, found, f"new{number}") if len(found) > 1 else None
            self._extend(placed, [pairs, *([among] if among else [])])
        self._leave_out("not localized in the map", left)

    def _pairs(self, names: list[str], others: list[str], what: str) -> Path:
        """Pair photos with the most similar ones of others."""
        pairs = self.folder / f"pairs-{what}.txt"
        return pairs_from_retrieval.main(
            self.descriptors, pairs, self.num_loc, query_list=names, db_list=others
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
        wrong = contradictions.judge(self.sfm, self.matches, left)
        self._drop("contradicting the map", wrong)
        self.added += [name for name in left if name not in wrong]

    def _drop(self, reason: str, names: list[str]) -> None:
        """Take photos out of the model again."""
        extension.remove(self.sfm, names)
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

    def commit(self) -> None:
        """Make the map have the new photos."""
        built, left_out = self.built, {name for part in self.left_out.values() for name in part}
        merge(built.features, [self.features], left_out)
        merge(built.descriptors, [self.descriptors], left_out)
        known = provenance.read(built.folder / FINGERPRINTS)
        new = {f"{IMAGES}{name}": self.fingerprints[f"{IMAGES}{name}"] for name in self.added}
        provenance.write(built.folder / FINGERPRINTS, known | new)
        cameras = intrinsics.of_map(self.sfm, self.image_dir, self.added)
        _commit(built, self.sfm, len(new.keys() - known.keys()), self.added, cameras=cameras)
        logger.info("%d photos were added to the map %s.", len(self.added), built.folder)


def _commit(
    built: Map,
    sfm: pycolmap.Reconstruction,
    more: int,
    added: Collection[str] = (),
    removed: Collection[str] = (),
    cameras: intrinsics.MapCameras | None = None,
) -> None:
    """Write a changed model and the map.json that names it.

    Args:
        built: the map.
        sfm: its changed model.
        more: the number of photos that it is made from grows by this.
        added: names of its new photos.
        removed: names of the photos that it lost.
        cameras: what the new photos tell about intrinsics.
    """
    content = json.loads((built.folder / FINISHED).read_text())
    number = 2
    while built.sfm.name == f"{SFM}-{number}":
        number += 1
    folder = built.folder / f"{SFM}-{number}"
    announce(folder)
    delete(folder)
    folder.mkdir()
    sfm.write_binary(folder)
    sfm = colmap.read_model(folder)  # without images that were removed
    contradicting = sorted(({*built.contradicting} - {*removed}) | {*copies.find(sfm)})
    uncertain = precision.find(sfm) if content.get("model") is None else built.uncertain
    precision.warn({name: share for name, share in uncertain.items() if name in added})
    content |= {
        "id": uuid.uuid4().hex,
        "sfm": folder.name,
        "images": content.get("images", built.num_images) + more,
        "images_with_pose": sfm.num_reg_images(),
        "images_added": sorted(({*content.get("images_added", ())} | {*added}) - {*removed}),
        "images_contradicting_others": contradicting,
        "images_of_uncertain_position": uncertain,
        "points3D": sfm.num_points3D(),
    }
    if cameras is not None:
        content |= intrinsics.to_dict(intrinsics.merged(built.cameras, cameras))
    provenance.write(built.folder / FINISHED, content)


def _drop_left(folder: RunFolder, built: Map) -> None:
    """Delete what finished changes leave: their folder, and models that were replaced."""
    models = {name for name in folder.written if name == SFM or name.startswith(f"{SFM}-")}
    folder.delete({GROWING, *models} - {built.sfm.name})
