"""Add photos to a map, or remove some; the others keep their features and poses.

A change is prepared in a folder of its own. `map.json`, which names the folder of the COLMAP model,
is written after all that it needs: a map whose change was interrupted is whole, and the same call
resumes the change.
"""

import json
import uuid
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import pycolmap

from .. import logger
from ..localization import intrinsics
from ..mapping.adjustment import MAX_ADJUSTED_IMAGES
from ..mapping.checks import CHECKS, Inputs, focal_lengths, judging, partial, run
from ..mapping.findings import Finding, names_in, staying, warn, without
from ..mapping.plausibility import focal_length_spread
from ..runtime import provenance
from ..runtime.group_writer import merge
from ..runtime.outputs import RunFolder
from ..utils import cli, colmap
from ..utils.cli import InputError
from ..utils.h5 import list_h5_names
from ..utils.images import list_images
from ..utils.paths import strings_as_paths
from . import older, placing
from .map import FINGERPRINTS, FINISHED, Map, models, opened, write_model
from .placing import GROWING, PHOTO_KEYS, Addition, Extended, photo_of


@strings_as_paths
def add(
    built: Map,
    image_dir: Path,
    model: Path | None = None,
    refine_map: bool = False,
    masks: Path | None = None,
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
        refine_map: adjust the poses of the other photos, too.
        masks: of the photos, see `extract_features.main`; photos that are in the map already keep
            theirs.

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
    with opened(built) as folder, folder.stage("add_images"):
        built = Map(built.folder)  # another run may have changed it before it was locked
        addition = Addition(built, image_dir, refine_map, masks)
        sfm = colmap.read_model(built.sfm)
        new = placing.begin(addition, sfm, names, posed=reference is not None)
        extended = placing.place(addition, sfm, new.names, reference)
        left_out = new.left_out | extended.left_out
        _report(built, extended.added, left_out)
        if extended.added:
            _commit_addition(addition, extended, left_out, new.fingerprints)
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
    with opened(built) as folder, folder.stage("remove_images"):
        built = Map(built.folder)
        sfm = colmap.read_model(built.sfm)
        inside = {image.name for image in sfm.images.values()}
        # also of a removal that was interrupted after map.json was written
        if unknown := removed - inside - {*list_h5_names(built.features)}:
            raise InputError(f"The map {built.folder} has no photo {cli.some(sorted(unknown))}.")
        if removed & inside:
            sfm = colmap.remove_images(sfm, removed)
            if not sfm.num_points3D():
                raise InputError(f"No point of the map {built.folder} would be left.")
        if removed & (inside | names_in(built.findings)):
            _commit(built, sfm, -len(removed), removed=removed)
        for path in (built.features, built.descriptors):
            merge(path, [path], removed)
        known = provenance.read(built.folder / FINGERPRINTS)
        kept = {key: value for key, value in known.items() if photo_of(key) not in removed}
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


def _report(built: Map, added: Collection[str], left_out: Mapping[str, str]) -> None:
    """Say which photos are not added, and why; raise an InputError if that is all."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in left_out.items():
        by_reason.setdefault(reason, []).append(name)
    found = "; ".join(f"{reason}: {cli.some(names)}" for reason, names in by_reason.items())
    if found and not added:
        raise InputError(f"No photo was added to {built.folder}: {found}.")
    if found:
        logger.warning("Not added: %s.", found)


def _commit_addition(
    addition: Addition,
    extended: Extended,
    left_out: Collection[str],
    fingerprints: Mapping[str, list],
) -> None:
    """Make the map have the new photos."""
    built, added = addition.built, extended.added
    merge(built.features, [addition.features], left_out)
    merge(built.descriptors, [addition.descriptors], left_out)
    known = provenance.read(built.folder / FINGERPRINTS)
    new = {key: fingerprints[key] for key in (f"{PHOTO_KEYS}{name}" for name in added)}
    provenance.write(built.folder / FINGERPRINTS, known | new)
    alike = {*added} - names_in(built.findings, "another_size")
    cameras = intrinsics.of_map(extended.sfm, addition.image_dir, alike)
    more = len(new.keys() - known.keys())
    _commit(built, extended.sfm, more, added, cameras=cameras)
    logger.info("Photos added to the map %s: %d.", built.folder, len(added))


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
    content = {key: value for key, value in content.items() if key not in older.FIELDS}
    folder = write_model(built.folder, built.sfm.name, sfm)
    sfm = colmap.read_model(folder)  # without images that were removed
    images = content.get("images", built.num_images) + more
    findings = _judge_again(built, sfm, images, {*added, *removed}, content.get("model") is None)
    warn(one for one in findings if _is_new(one, built.findings))
    content |= {
        "id": uuid.uuid4().hex,
        "sfm": folder.name,
        "images": images,
        "images_with_pose": sfm.num_reg_images(),
        "images_added": sorted(({*content.get("images_added", ())} | {*added}) - {*removed}),
        "findings": [one.to_json() for one in findings],
        "points3D": sfm.num_points3D(),
    }
    told = built.cameras if cameras is None else intrinsics.merged(built.cameras, cameras)
    if any(one.kind == "intrinsics" for one in findings):
        told = told._replace(known={}, typical={})  # they may be wrong
    else:
        cameras_now = (image.camera for image in sfm.images.values())
        told = told._replace(typical=intrinsics.of_cameras(cameras_now).typical)
    told = intrinsics.with_lenses(told, (image.camera for image in sfm.images.values()))
    content |= intrinsics.to_dict(told)
    provenance.write(built.folder / FINISHED, content)


def _judge_again(
    built: Map,
    sfm: pycolmap.Reconstruction,
    images: int,
    changed: Collection[str],
    are_poses_estimated: bool,
) -> list[Finding]:
    """Return what may be wrong with a changed map.

    What its model tells is found again. What matches and photos told stays, but for photos that
    were added or removed.

    Args:
        built: the map before.
        sfm: its changed model.
        images: the number of photos that it is made from.
        changed: names of the photos that were added or removed.
        are_poses_estimated: from photos alone.
    """
    again = {kind for kind in judging(are_poses_estimated) if not CHECKS[kind].needs}
    if are_poses_estimated and sfm.num_reg_images() <= MAX_ADJUSTED_IMAGES:
        again.add("intrinsics")
    before = {one.kind: one for one in built.findings}
    kept = without(built.findings, changed)
    missing = names_in(kept, "partial")
    found = partial.of_numbers(sfm.num_reg_images(), images, sorted(missing))
    if "focal_lengths" in before:
        found += focal_lengths.of_spread(focal_length_spread([sfm]), sfm.num_reg_images())
    inputs = Inputs(sfm, matched=built.matched())
    found += staying(run(inputs, [kind for kind in CHECKS if kind in again]))
    replaced = {"partial", "focal_lengths", *again}
    return found + [one for one in kept if one.kind not in replaced]


def _is_new(finding: Finding, before: Collection[Finding]) -> bool:
    """Tell whether findings before say nothing like it, or not of all of its photos."""
    alike = [one for one in before if one.kind == finding.kind]
    return not alike or not names_in(alike).issuperset(finding.names)


def _drop_left(folder: RunFolder, built: Map) -> None:
    """Delete what finished changes leave: their folder, and models that were replaced."""
    folder.delete({GROWING, *models(folder.written)} - {built.sfm.name})
