"""The stages that describe, pair, match and place the photos of a map; with several attempts."""

import shutil
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import pycolmap

from .. import (
    aggregate_features,
    extract_features,
    logger,
    match_features,
    pairs_from_verification,
    reconstruction,
    triangulation,
)
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..extract_features import keep_readable
from ..localization.rigs import know_all
from ..mapping import findings, mapper, plausibility, registration
from ..mapping.checks import Inputs, another_size, intrinsics, mirrored
from ..mapping.database import VERIFIED
from ..mapping.findings import Finding, names_in
from ..runtime.outputs import RunFolder
from ..utils import cli, colmap
from ..utils.parsers import parse_pairs, write_pairs
from . import pairing
from .by_others import ByOthers
from .map import SFM, Map, models

# suffixes of the models of later attempts
MORE_KEYPOINTS = "-keypoints_colmap"  # also of its features
FURTHER = "-further"  # with the same keypoints as the first one
UNMIRRORED = "-unmirrored"  # without the mirrored photos of another attempt
ONLY_ALIKE = "-alike"  # without photos whose intrinsics are unlike those of the others
OWN_CAMERAS = "-per_image"  # with a camera for each photo
MIRROR_IMAGES = "mirrored"  # folder of what is known of mirror images


@dataclass(frozen=True)
class Photos:
    """The photos of a map, and how they are matched.

    Args:
        folder: of the map.
        image_dir: folder of the photos.
        names: the photos.
        matcher: a key of `confs.matchers`.
        num_covis: each photo is paired with this number of others.
        pairs: how photos without covisible ones are paired, a key of `pairing.PAIRS`.
        accept_partial: do without photos that cannot be read.
        camera_mode: which photos share a camera, if their poses are reconstructed.
        retrieval: a key of `confs.retrieval`.
        masks: of the photos, see `extract_features.main`.
        rigs: COLMAP's `rig_config.json` of cameras that are fixed to each other.
        lens: of pycolmap's ImageReaderOptions, see `colmap.lens_options`.
        left_out: photos that are described and matched, but not reconstructed.
    """

    folder: RunFolder
    image_dir: Path
    names: list[str]
    matcher: str
    num_covis: int
    pairs: str
    accept_partial: bool
    camera_mode: pycolmap.CameraMode
    retrieval: str
    masks: Path | None = None
    rigs: Path | None = None
    lens: dict[str, str] = field(default_factory=dict)
    left_out: frozenset[str] = frozenset()

    @property
    def kept(self) -> list[str]:
        """The photos that are not left out."""
        return [name for name in self.names if name not in self.left_out]


class Described(NamedTuple):
    """Photos that could be read, with the files of their features and global descriptors."""

    photos: Photos
    features: Path
    descriptors: Path


class Attempt(NamedTuple):
    """A model of the photos of a map.

    Args:
        photos: those that could be read.
        conf: configuration of their features.
        matches: their match file.
        sfm_dir: the folder of the model.
        sfm: the model.
    """

    photos: Photos
    conf: dict
    matches: Path
    sfm_dir: Path
    sfm: pycolmap.Reconstruction

    @property
    def names(self) -> set[str]:
        """The photos in the model."""
        return {self.sfm.images[i].name for i in self.sfm.reg_image_ids()}


def of_model(
    photos: Photos, conf: dict, model: Path, reference: pycolmap.Reconstruction
) -> Attempt:
    """Triangulate a map with the poses of a model."""
    photos, features, descriptors = _describe(photos, conf)
    folder = photos.folder
    if len(photos.names) < len(reference.images):
        model = colmap.write_part(model, set(photos.names), folder.path / "sfm_reference")
        reference = colmap.read_model(model)
    with folder.stage("pairs"):
        pairs = pairing.of_model(
            folder.path,
            reference,
            photos.names,
            descriptors,
            photos.pairs,
            photos.num_covis,
        )
    matches = _match(photos, pairs, features)
    with folder.stage("triangulation"):
        sfm = triangulation.main(
            folder.path / SFM, model, photos.image_dir, pairs, features, matches
        )
    shutil.rmtree(folder.path / "sfm_reference", ignore_errors=True)
    return Attempt(photos, conf, matches, folder.path / SFM, sfm)


def of_photos_alone(photos: Photos, conf: dict) -> tuple[Attempt, list[Finding]]:
    """Reconstruct poses and points, without photos that do not fit the others.

    Returns:
        The model, and what was found of photos that are left out, or that do not fit.
    """
    found = another_size.of_photos(photos.image_dir, photos.names)
    names = names_in(found)
    photos = replace(photos, names=[name for name in photos.names if name not in names])
    try:
        best = _most_registered(photos, conf)
        if of_mirrored := _find_mirrored(best):
            found += of_mirrored
            names = names_in(of_mirrored)
            logger.info("Trying again without mirrored photos: %s.", cli.some(sorted(names)))
            photos = replace(best.photos, left_out=frozenset(names))
            best = _reconstruct(photos, best.conf, f"{best.sfm_dir.name}{UNMIRRORED}")
            _log(best.sfm.num_reg_images(), photos)
    except registration.NoModelError:
        findings.warn(found)
        raise
    best, of_intrinsics = _fitting(best)
    return best, found + of_intrinsics


def _most_registered(photos: Photos, conf: dict) -> Attempt:
    """Return the model with the most photos: also with more keypoints, if some are missing."""
    adaptive = features_confs.keypoints_of(conf["model"]) == "adaptive"
    several = adaptive and len(photos.names) <= mapper.VERY_FEW
    tried: list[Attempt] = []
    errors: list[registration.NoModelError] = []

    def attempt(folder: str, conf: dict, once: bool = False) -> None:
        try:
            tried.append(_reconstruct(photos, conf, folder, once))
        except registration.NoModelError as error:
            errors.append(error)
        tried.sort(key=lambda one: plausibility.size(one.sfm), reverse=True)
        _log(tried[0].sfm.num_reg_images() if tried else 0, photos)

    attempt(SFM, conf, once=several)
    if several and not (tried and len(tried[0].names) == len(tried[0].photos.kept)):
        logger.info("Trying again with more keypoints.")
        model = features_confs.with_keypoints(conf["model"], "colmap")
        attempt(
            f"{SFM}{MORE_KEYPOINTS}",
            {**conf, "output": f"{conf['output']}{MORE_KEYPOINTS}", "model": model},
        )
        if not tried or tried[0].conf is conf:
            attempt(f"{SFM}{FURTHER}", conf)
    if not tried:
        raise errors[-1]
    return tried[0]


def _log(registered: int, photos: Photos) -> None:
    logger.info("%d of %d photos are in the map.", registered, len(photos.kept))


def _find_mirrored(best: Attempt) -> list[Finding]:
    """Find mirrored photos, with a pose or without."""
    photos, features, descriptors = _describe(best.photos, best.conf)
    by_others = ByOthers(
        best.sfm,
        conf=best.conf,
        matcher=photos.matcher,
        image_dir=photos.image_dir,
        features=features,
        descriptors=descriptors,
        folder=photos.folder.path / MIRROR_IMAGES,
        retrieval=retrieval_confs.get(photos.retrieval),
        masks=photos.masks,
    )
    known = registration.read(best.sfm_dir)
    with photos.folder.stage("mirror_images"):
        return mirrored.find(Inputs(best.sfm, registration=known, localize=by_others))


def _fitting(best: Attempt) -> tuple[Attempt, list[Finding]]:
    """Reconstruct again if the photos do not fit.

    First with a camera for each photo, if they share some; then without the fewer than half whose
    intrinsics are unlike those of the others. A new model is used if it has all other photos, which
    fit. The cameras of rigs stay; nothing is done if a file gives the intrinsics of all photos.

    Returns:
        The model, and what was found of photos that are left out, or that do not fit.
    """
    photos = best.photos
    if photos.rigs is not None and know_all(photos.rigs, best.names):
        return best, []
    fit = _fit(best)
    if fit.gain <= intrinsics.GAIN_OF_FREE:
        return best, []
    if photos.rigs is not None:
        return best, [intrinsics.finding(fit)]
    cameras = {best.sfm.images[i].camera_id for i in best.sfm.reg_image_ids()}
    is_auto = photos.camera_mode == pycolmap.CameraMode.AUTO
    if len(cameras) < best.sfm.num_reg_images() and is_auto:
        logger.info("Trying again with a camera for each photo.")
        mode = pycolmap.CameraMode.PER_IMAGE
        if found := _fitting_attempt(photos, best, OWN_CAMERAS, mode):
            return found, []
    if 0 < 2 * len(fit.altered) < best.sfm.num_reg_images():
        logger.info("Trying again without %s.", cli.some(fit.altered))
        rest = replace(photos, left_out=photos.left_out.union(fit.altered))
        if found := _fitting_attempt(rest, best, ONLY_ALIKE, photos.camera_mode):
            return found, [another_size.finding(fit.altered)]
    return best, [intrinsics.finding(fit)]


def _fitting_attempt(
    photos: Photos, before: Attempt, suffix: str, camera_mode: pycolmap.CameraMode
) -> Attempt | None:
    """Reconstruct photos again; None if not all of them are in the model, or they do not fit."""
    with suppress(registration.NoModelError):
        found = _reconstruct(photos, before.conf, f"{SFM}{suffix}", camera_mode=camera_mode)
        fit = _fit(found)
        fits = fit is not intrinsics.NOT_TRIED and fit.gain <= intrinsics.GAIN_OF_FREE
        if fits and len(found.names) >= len(before.names - photos.left_out):
            return found
    return None


def _fit(attempt: Attempt) -> intrinsics.Fit:
    with attempt.photos.folder.stage("judge_intrinsics"):
        return intrinsics.measure(attempt.sfm)


def _reconstruct(
    photos: Photos,
    conf: dict,
    name: str,
    once: bool = False,
    camera_mode: pycolmap.CameraMode | None = None,
) -> Attempt:
    """Reconstruct the poses of photos.

    Args:
        photos: the photos.
        conf: configuration of their features.
        name: of the folder of the model.
        once: make one attempt only.
        camera_mode: which photos share a camera in the model; default: that of `photos`.
    """
    photos, features, descriptors = _describe(photos, conf)
    folder = photos.folder
    with folder.stage("pairs"):
        pairs = pairing.of_photos(
            folder.path, photos.names, descriptors, photos.pairs, photos.num_covis
        )
    first = pairs.stem
    matches = _match(photos, pairs, features)
    wanted = pairing.PAIRS[photos.pairs]
    for number in range(1, wanted.rounds + 1):
        before, pairs = pairs, folder.path / f"{first}-{number}.txt"
        with folder.stage("verification"):
            pairs_from_verification.main(
                pairs,
                photos.image_dir,
                before,
                features,
                matches,
                descriptors,
                num_matched=photos.num_covis,
                num_covis=photos.num_covis if wanted.widens and number == 1 else 0,
                camera_mode=photos.camera_mode,
                image_list=photos.names,
                rigs=photos.rigs,
                image_options=photos.lens,
            )
        _match(photos, pairs, features, matches)
        if _pairs(pairs) == _pairs(before):  # so the next round would find none, too
            break
    kept = photos.kept
    if len(kept) < len(photos.names):
        listed = [pair for pair in parse_pairs(pairs) if {*pair} <= {*kept}]
        pairs = folder.path / f"{pairs.stem}{name.removeprefix(SFM)}-kept.txt"
        write_pairs(listed, pairs)
    with folder.stage("reconstruction"):
        sfm = reconstruction.main(
            folder.path / name,
            photos.image_dir,
            pairs,
            features,
            matches,
            camera_mode=camera_mode or photos.camera_mode,
            image_list=kept,
            once=once,
            checked=False,
            rigs=photos.rigs,
            image_options=photos.lens,
        )
    return Attempt(photos, conf, matches, folder.path / name, sfm)


def _pairs(path: Path) -> set[frozenset[str]]:
    """Return the pairs of a file in any order."""
    return {frozenset(pair) for pair in parse_pairs(path)}


def _describe(photos: Photos, conf: dict) -> Described:
    """Extract features and global descriptors."""
    with photos.folder.stage("extract_features"):
        features = extract_features.main(
            conf,
            photos.image_dir,
            photos.folder.path,
            image_list=photos.names,
            strict=not photos.accept_partial,
            masks=photos.masks,
        )
        names = keep_readable(features, photos.names, photos.accept_partial)
    with photos.folder.stage("retrieval"):
        described_by = retrieval_confs.get(photos.retrieval)
        descriptors = aggregate_features.main(
            described_by, features, names, image_dir=photos.image_dir
        )
    return Described(replace(photos, names=names), features, descriptors)


def _match(photos: Photos, pairs: Path, features: Path, matches: Path | None = None) -> Path:
    """Match pairs, into a file of these or into `matches`."""
    conf = matchers_confs.confs[photos.matcher]
    name = f"{features.stem}_{conf['output']}_{pairs.stem}.h5"
    matches = matches or photos.folder.path / name
    with photos.folder.stage("match_map"):
        match_features.main(conf, pairs, features, matches=matches)
    return matches


def drop_others(folder: RunFolder, built: Map) -> None:
    """Delete the files of other attempts to build a map."""
    kept = built.features.stem
    plain = kept.removesuffix(MORE_KEYPOINTS)
    for name in {plain, f"{plain}{MORE_KEYPOINTS}"} - {kept}:
        described = aggregate_features.output_of(
            retrieval_confs.get(built.retrieval), built.features.with_stem(name)
        )
        begins = f"{name}.h5", f"{name}_matches", f"{described.stem}."
        folder.delete(other for other in folder.written if other.startswith(begins))
    folder.delete(name for name in {*folder.written} if name.endswith(VERIFIED))
    folder.delete({MIRROR_IMAGES, *models(folder.written)} - {built.sfm.name})
