"""Describe new photos of a map, localize them in it and place them in its model."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

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
from ..extract_features import MASK
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
from ..utils import cli, colmap, masks
from ..utils.cli import InputError
from ..utils.feature_files import get_image_size
from ..utils.files import announce, delete, is_readable
from ..utils.h5 import get_text, open_h5
from ..utils.match_files import check_distinct
from ..utils.parsers import parse_pairs
from .by_others import NUM_LOC
from .map import FINGERPRINTS, Map
from .mirror_images import mirror_images

GROWING = "growing"  # the folder of an addition, in that of the map
PHOTO_KEYS = "images/"  # begins the names of photos in the fingerprints of a map
NOT_READABLE = "not readable"  # a reason why a photo is left out


def photo_of(key: str) -> str | None:
    """Return the name of a photo in the fingerprints of a map, None for other files."""
    return key.removeprefix(PHOTO_KEYS) if key.startswith(PHOTO_KEYS) else None


def _digests(fingerprints: Mapping[str, list]) -> dict[str, str]:
    """Return the digests of the photos in fingerprints, by name."""
    named = {photo_of(key): value[2] for key, value in fingerprints.items()}
    return {name: digest for name, digest in named.items() if name is not None}


@dataclass(frozen=True)
class Addition:
    """Photos to add to a map, and the files that this makes.

    Args:
        built: the map.
        image_dir: folder of the photos.
        refine_map: adjust the poses of the other photos, too.
        masks: of the new photos, see `extract_features.main`.
    """

    built: Map
    image_dir: Path
    refine_map: bool
    masks: Path | None = None

    @property
    def folder(self) -> Path:
        """The folder of all files of the addition."""
        return self.built.folder / GROWING

    @property
    def features(self) -> Path:
        """The features of the photos of the map and of the new ones."""
        return self.folder / self.built.features.name

    @property
    def descriptors(self) -> Path:
        """The global descriptors of the photos of the map and of the new ones."""
        return self.folder / self.built.descriptors.name

    @property
    def matches(self) -> Path:
        """The matches of the new photos."""
        return self.folder / "matches.h5"


class New(NamedTuple):
    """Photos that a map does not have.

    Args:
        names: the photos.
        fingerprints: of these and of photos that are in the map, as the map keeps them.
        left_out: why other photos are not added, by name.
    """

    names: list[str]
    fingerprints: dict[str, list]
    left_out: dict[str, str]


class Extended(NamedTuple):
    """A model with new photos.

    Args:
        sfm: the model.
        added: the new photos in it.
        left_out: why other photos are not in it, by name.
    """

    sfm: pycolmap.Reconstruction
    added: list[str]
    left_out: dict[str, str]


def begin(
    addition: Addition, sfm: pycolmap.Reconstruction, names: Iterable[str], posed: bool
) -> New:
    """Find the photos that are new; begin anew unless their addition was interrupted.

    Args:
        addition: the addition.
        sfm: the model of the map.
        names: the photos.
        posed: their poses are given.
    """
    built, image_dir = addition.built, addition.image_dir
    broken = {name: NOT_READABLE for name in names if not is_readable(image_dir / name)}
    files = {f"{PHOTO_KEYS}{name}": image_dir / name for name in names if name not in broken}
    fingerprints = provenance.fingerprints(files, {})
    digests, inside = _digests(fingerprints), _names(sfm)
    before = _digests(provenance.read(built.folder / FINGERPRINTS))
    new, copies = _compare(image_dir, digests, {name: before.get(name) for name in inside})
    check_distinct([*inside, *new])
    images = {name: digests[name] for name in new}
    conf = {"map": built.id, "images": images, "num_loc": NUM_LOC, "posed": posed}
    masked = masks.digests(masks.find(addition.masks, image_dir, digests))
    _check_masks(built, image_dir, {name: masked[name] for name in inside if name in masked})
    if of_new := {name: masked[name] for name in new if name in masked}:
        conf["masks"] = of_new
    if provenance.read(addition.folder / CONF) != conf:
        announce(addition.folder)
        delete(addition.folder)
        provenance.write(addition.folder / CONF, conf)
    return New(new, fingerprints, broken | copies)


def _check_masks(built: Map, image_dir: Path, masked: Mapping[str, str]) -> None:
    """Raise an InputError if photos of a map have other masks there than the digests given."""
    with open_h5(built.features) as file:
        other = [name for name, digest in masked.items() if get_text(file[name], MASK) != digest]
    if other:
        raise InputError(
            f"{cli.some(other)} are in the map already, with other masks or without: leave them or "
            f"their masks out of {image_dir}, or first remove them from the map, --remove_images."
        )


def _names(sfm: pycolmap.Reconstruction) -> list[str]:
    """Return the names of the photos in a model, sorted."""
    return sorted(sfm.images[i].name for i in sfm.reg_image_ids())


def _compare(
    image_dir: Path, digests: Mapping[str, str], inside: Mapping[str, str | None]
) -> tuple[list[str], dict[str, str]]:
    """Find the photos that are not in the map.

    Args:
        image_dir: folder of the photos.
        digests: of the content of photos, by name.
        inside: the same of those in the map; None in a map of a database, which had no photos.

    Returns:
        The new photos, and why copies of others are left out, by name.

    Raises:
        InputError: if other photos in the map have their names.
    """
    new, copies, taken, same = [], {}, [], 0
    first = {digest: name for name, digest in inside.items() if digest is not None}
    for name, digest in digests.items():
        if name in inside:
            same += inside[name] in (None, digest)
            if inside[name] not in (None, digest):
                taken.append(name)
        elif digest in first:
            copies[name] = f"copies of {first[digest]}"
        else:
            first[digest] = name
            new.append(name)
    if taken:
        raise InputError(
            f"The map has other photos that are called {cli.some(taken)}: rename those in "
            f"{image_dir}, or first remove those in the map, --remove_images."
        )
    if same:
        logger.info("%d of %d photos are in the map already.", same, len(digests))
    return new, copies


def place(
    addition: Addition,
    sfm: pycolmap.Reconstruction,
    names: list[str],
    reference: pycolmap.Reconstruction | None,
) -> Extended:
    """Describe photos and add them to the model of a map.

    Args:
        addition: the addition.
        sfm: the model of the map, changed in place.
        names: the photos.
        reference: a model with their poses, whose cameras are scaled to resized photos; None: they
            are localized in the map.
    """
    if not names:
        return Extended(sfm, [], {})
    readable, broken = _describe(addition, names)
    if not readable:
        return Extended(sfm, [], broken)
    if reference is None:
        extended = _place_localized(addition, sfm, readable)
    else:
        extended = _place_posed(addition, sfm, readable, reference)
    return extended._replace(left_out=broken | extended.left_out)


def _describe(addition: Addition, names: list[str]) -> tuple[list[str], dict[str, str]]:
    """Extract local and global descriptors of photos.

    Returns:
        The photos that could be read, and why others are left out, by name.
    """
    built = addition.built
    features = extract_features.main(
        built.conf,
        addition.image_dir,
        addition.folder / "new",
        image_list=names,
        strict=False,
        masks=addition.masks,
    )
    failed = failures(features)
    broken = {name: NOT_READABLE for name in names if name in failed}
    readable = [name for name in names if name not in broken]
    if readable:
        descriptors = built.aggregate(features, readable, addition.image_dir)
        # photos that the map could not reconstruct have old features in its files
        merge(addition.features, [built.features, features], names)
        merge(addition.descriptors, [built.descriptors, descriptors], names)
    return readable, broken


def _place_posed(
    addition: Addition,
    sfm: pycolmap.Reconstruction,
    names: list[str],
    reference: pycolmap.Reconstruction,
) -> Extended:
    """Add photos with the poses of a model."""
    with open_h5(addition.features) as file:
        resized, unfit = sizes.compare(
            reference, {name: get_image_size(file, name) for name in names}
        )
    sizes.scale_cameras(reference, resized)
    left_out = {name: "of another size than their cameras in the model" for name in unfit}
    images = {image.name: image for image in reference.images.values()}
    placed = {}
    for image in (images[name] for name in names if name not in unfit):
        pose = image.cam_from_world()
        placed[image.name] = Placed(pose, image.camera, known=True, fixed=True)
    if not placed:
        return Extended(sfm, [], left_out)
    pairs = _pairs(addition, [*placed], [*_names(sfm), *placed], "posed")
    extended = _extend(addition, sfm, placed, [pairs])
    return extended._replace(left_out=left_out | extended.left_out)


def _place_localized(
    addition: Addition, sfm: pycolmap.Reconstruction, names: list[str]
) -> Extended:
    """Localize photos in the map and add them; then those that are left, in the new map."""
    built, image_dir, known = addition.built, addition.image_dir, addition.built.cameras
    inferred = intrinsics.infer_all(image_dir, names, known)
    left_out = {name: NOT_READABLE for name in names if name not in inferred}
    added: list[str] = []
    left, number = list(inferred), 0
    while left:
        number += 1
        pairs = _pairs(addition, left, _names(sfm), f"round{number}")
        records = localize_sfm.main(
            sfm,
            [(name, inferred[name][0]) for name in left],
            pairs,
            addition.features,
            _match(addition, pairs),
            addition.folder / f"poses-round{number}.txt",
            refinements={name: intrinsics.refinement(*inferred[name], known) for name in left},
            full_names=True,
            mirror_images=mirror_images(
                built.conf,
                image_dir,
                pairs,
                addition.folder / "mirrored.h5",
                partial(_match_mirrored, addition),
                masks=addition.masks,
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
        others = _pairs(addition, found, sorted([*_names(sfm), *found]), f"new{number}")
        extended = _extend(addition, sfm, placed, [pairs, others])
        sfm, added = extended.sfm, added + extended.added
        left_out |= extended.left_out
    left_out |= {name: "not localized in the map" for name in left}
    return Extended(sfm, added, left_out)


def _pairs(addition: Addition, names: list[str], others: list[str], what: str) -> Path:
    """Pair photos with the most similar ones of others."""
    pairs = addition.folder / f"pairs-{what}.txt"
    return pairs_from_retrieval.main(
        addition.descriptors, pairs, NUM_LOC, query_list=names, db_list=others
    )


def _match(addition: Addition, pairs: Path) -> Path:
    """Match pairs."""
    conf = matchers_confs.confs[addition.built.matcher]
    return match_features.main(conf, pairs, addition.features, matches=addition.matches)


def _match_mirrored(addition: Addition, pairs: Path, mirrored: Path) -> Path:
    """Match pairs whose first images have the features of their mirror images, in `mirrored`."""
    return match_features.main(
        matchers_confs.confs[addition.built.matcher],
        pairs,
        mirrored,
        matches=addition.folder / f"matches-{pairs.stem}.h5",
        features_ref=addition.features,
    )


def _extend(
    addition: Addition,
    sfm: pycolmap.Reconstruction,
    placed: Mapping[str, Placed],
    pairs: Iterable[Path],
) -> Extended:
    """Add images to a model, but those that share too little with it or contradict it.

    Args:
        addition: the addition.
        sfm: the model, changed in place.
        placed: the images.
        pairs: text files of pairs of these, and of these and those of the model.
    """
    images = {*_names(sfm), *placed}
    keypoints: dict[str, np.ndarray] = {}
    uncertainty: dict[str, float] = {}
    matches: dict[extension.Pair, np.ndarray] = {}
    for listed in pairs:
        _match(addition, listed)
        names = sorted({name for pair in parse_pairs(listed) for name in pair})
        positions, errors, found = read_matches(
            names, listed, addition.features, addition.matches, None
        )
        keypoints |= {name: positions[name] for name in names if name in images}
        uncertainty |= errors
        matches |= {pair: rows for pair, rows in found.items() if images.issuperset(pair)}
    extension.extend(sfm, placed, keypoints, uncertainty, matches, addition.refine_map)
    shared = extension.count_shared(sfm, placed)
    few = [name for name in placed if shared[name] < DEFAULT_GATE.min_inliers]
    sfm = colmap.remove_images(sfm, few)
    left = [name for name in placed if name not in few]
    wrong = contradictions.judge(Inputs(sfm, matches=addition.matches), left)
    return Extended(
        colmap.remove_images(sfm, wrong),
        [name for name in left if name not in wrong],
        {name: "sharing too few points with the map" for name in few}
        | {name: "contradicting the map" for name in wrong},
    )
