"""Build a map from photos, with or without a model of their poses."""

import uuid
from dataclasses import replace
from pathlib import Path
from typing import Any

import pycolmap

from .. import extract_features, logger, match_features
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..detectors.dog import KEYPOINT_SETTINGS
from ..extract_features import keep_present, without
from ..localization import intrinsics, views
from ..localization import rigs as rig_files
from ..mapping import registration
from ..mapping.checks import Inputs, judging, run, sizes
from ..mapping.findings import Finding, check_accepted, names_in, staying
from ..retrieval import load as load_retrieval
from ..runtime import provenance
from ..runtime.outputs import CONF, RunFolder
from ..utils import colmap
from ..utils import masks as masks_of
from ..utils.cli import InputError
from ..utils.codes import STORAGES
from ..utils.files import replacing
from ..utils.images import list_images, stored_size
from ..utils.match_files import check_distinct, list_pairs
from ..utils.paths import strings_as_paths
from . import georeference, pairing
from .attempts import Attempt, Photos, drop_others, of_model, of_photos_alone
from .map import FINGERPRINTS, FINISHED, PLACE, Map, keep_projection, write


@strings_as_paths
def main(
    map_dir: Path,
    image_dir: Path,
    model: Path | None = None,
    feature: str = features_confs.RECOMMENDED,
    projection: Path | None = None,
    matcher: str | None = None,
    num_covis: int = 20,
    overwrite: bool = False,
    storage: str = STORAGES[0],
    keypoints: str = KEYPOINT_SETTINGS[0],
    accept_partial: bool = False,
    camera_mode: pycolmap.CameraMode = pycolmap.CameraMode.AUTO,
    retrieval: str = retrieval_confs.VLAD,
    exif_gps: bool = True,
    masks: Path | None = None,
    pairs: str | None = None,
    rigs: Path | None = None,
    camera_model: str = "SIMPLE_RADIAL",
    camera_params: str | None = None,
) -> Map:
    """Build a map, or open the one that was made from the same.

    Args:
        map_dir: the folder of the map.
        image_dir: folder of the images.
        model: COLMAP model with their poses; None to reconstruct them, in metres if GPS tells
            these, or in an arbitrary frame and scale.
        feature: name of a feature, or its YAML file.
        projection: projection file to use with the base descriptor of `feature`.
        matcher: a key of `confs.matchers`; default: the feature's.
        num_covis: each image is paired with this number of the most covisible ones in the model.
            Images that share no point of the model with others are paired with all others, or of
            more than `pairing.MAX_EXHAUSTIVE` with the most similar ones.
        overwrite: rebuild the map.
        storage: how descriptors are stored, one of `utils.codes.STORAGES`.
        keypoints: settings of the DoG detector, one of `detectors.dog.KEYPOINT_SETTINGS`.
        accept_partial: do without images that are missing, unreadable or of another size than their
            cameras in the model; without a model, build a map even if fewer than half of the images
            are in it, or its focal lengths, positions or matches show that it may be wrong.
        camera_mode: which images share a camera, without a model.
        retrieval: a key of `confs.retrieval`.
        exif_gps: without a model, align a new map with the GPS positions in the EXIF data of its
            photos, see `georeference.by_exif`.
        masks: of the images, see `extract_features.main`.
        pairs: which images are matched with each other, without a model: all ("exhaustive"), each
            with the `num_covis` most similar ones ("retrieval"), or each with those around it by
            name and similar ones ("sequential", see `pairs_from_sequence`). But for "exhaustive",
            pairs are added where these leave images unconnected. Default: "exhaustive" for up to
            `pairing.MAX_EXHAUSTIVE` images, else "retrieval".
        rigs: COLMAP's `rig_config.json` of cameras that are fixed to each other, without a model:
            their photos share one camera each, and the map is in the units of the file.
        camera_model: COLMAP's model of the cameras, without a model.
        camera_params: about its parameters, separated by commas, see `colmap.lens_options`.

    Returns:
        The map.

    Raises:
        InputError: if the folder has a map that was made from something else, something is missing
            or wrong, such as masks, photos do not have the size of their cameras in the model
            (`checks.sizes`), or a check refuses the reconstruction; what is finished is kept, for a
            run with `accept_partial`.
    """
    feature, conf = features_confs.get(feature, projection, storage, keypoints)
    matcher = matcher or features_confs.matcher_of(conf)
    described_by = retrieval_confs.get(retrieval)
    lens = colmap.lens_options(camera_model, camera_params)
    reference, normalized = (None, False) if model is None else colmap.read_normalized(model)
    if reference is not None and not reference.images:
        raise InputError(f"The model {model} has no images.")
    names = _list(image_dir, reference, accept_partial)
    check_distinct(names)
    if rigs is not None:
        rig_files.frames(rigs, names)  # raises for a wrong one
    # points without tracks, such as those of scanners, tell nothing of the photos
    has_points = reference is not None and any(i.num_points3D for i in reference.images.values())
    masked = masks_of.digests(masks_of.find(masks, image_dir, names))
    if pairs is None or model is not None:
        pairs = pairing.default(len(names))
    if overwrite or not (map_dir / CONF).exists():
        extract_features.check_model(conf)
        match_features.check_model(matchers_confs.confs[matcher], extract_features.provenance(conf))
        load_retrieval(described_by["model"])
    usable = names
    if reference is not None and (overwrite or not (map_dir / FINISHED).exists()):
        usable = _of_fitting_size(image_dir, names, reference, accept_partial)
    images = {name: image_dir / name for name in names}
    parts = {path.name: path for path in (colmap.model_files(model) if model else [])}
    groups = {"images": images, "model": parts} | (
        {"rigs": {"rig_config.json": rigs}} if rigs else {}
    )
    fingerprints, found = digests(map_dir, groups)
    made_from = {
        "feature": extract_features.provenance(conf),
        "matcher": matchers_confs.confs[matcher]["model"],
        "num_covis": num_covis,
        **found,
    }
    if model is None or (pairs == "exhaustive" and not has_points):
        made_from |= pairing.provenance(pairs)
    made_from |= {"normalized": True} if normalized else {}
    made_from |= {"masks": masked} if masked else {}
    made_from |= lens
    made_from |= retrieval_confs.provenance(retrieval)
    made_from |= matchers_confs.provenance(made_from["matcher"], made_from["feature"])
    inputs = image_dir, model, projection, masks, rigs
    with claim(map_dir, made_from, overwrite, *inputs) as folder:
        if not (map_dir / FINISHED).exists():
            begin(map_dir, fingerprints)
            logger.info("Building the map %s of %d images.", map_dir, len(usable))
            photos = Photos(
                folder,
                image_dir,
                usable,
                matcher=matcher,
                num_covis=num_covis,
                pairs=pairs,
                accept_partial=accept_partial,
                camera_mode=camera_mode,
                retrieval=retrieval,
                masks=masks,
                rigs=rigs,
                lens=lens,
            )
            conf = keep_projection(_at_one_size(conf, image_dir, usable), map_dir)
            if model is not None and reference is not None:
                attempt = of_model(photos, conf, model, reference)
                return _finish(attempt, [], True, feature, keypoints, model=str(model.resolve()))
            attempt, findings = of_photos_alone(photos, conf)
            content: dict[str, object] = {"camera_mode": camera_mode.name.lower()}
            content |= {"rigs": True} if rigs else {}
            # the map is in the units of its rigs
            aligned = exif_gps and not (rigs and rig_files.have_baseline(rigs))
            return _finish(attempt, findings, False, feature, keypoints, aligned, **content)
        built = Map(map_dir)
        if built.camera_mode not in (None, camera_mode.name.lower()):
            raise InputError(
                f"The map {map_dir} was made with --camera_mode {built.camera_mode}: give it "
                "again, choose other --outputs, or --overwrite."
            )
        drop_others(folder, built)  # a killed run may have left some
        built.warn()
        return built


def _at_one_size(conf: dict, image_dir: Path, names: list[str]) -> dict:
    """Return the configuration of a feature that shows photos at about one size, if it needs that.

    Args:
        conf: its configuration.
        image_dir: the folder of the photos.
        names: the photos of the map.
    """
    from .. import extractors

    if extractors.is_rotation_invariant(conf["model"]):
        return conf
    sizes = [size for name in names if (size := stored_size(image_dir / name))]
    return {**conf, "preprocessing": views.at_one_size(conf["preprocessing"], sizes)}


def _finish(
    attempt: Attempt,
    found: list[Finding],
    are_poses_given: bool,
    feature: str,
    keypoints: str,
    exif_gps: bool = False,
    **content: Any,
) -> Map:
    """Judge a model and write the map, unless it is refused.

    Args:
        attempt: the model.
        found: what was found of its photos, and of those that are left out.
        are_poses_given: its poses were not reconstructed.
        feature: name of the feature.
        keypoints: the settings of DoG that were asked for.
        exif_gps: align it with the GPS positions of its photos.
        content: what else map.json says.
    """
    photos, sfm = attempt.photos, attempt.sfm
    cameras = intrinsics.of_map(
        sfm, photos.image_dir, attempt.names - names_in(found, "intrinsics")
    )
    if any(one.kind == "intrinsics" for one in found):
        cameras = cameras._replace(known={}, typical={})  # they may be wrong
    inputs = Inputs(
        sfm,
        matches=attempt.matches,
        image_dir=photos.image_dir,
        matched=list_pairs(attempt.matches, photos.names),
    )
    if not are_poses_given:
        dropped = names_in(one for one in found if one.verdict == "drop")
        known = registration.read(attempt.sfm_dir, dropped)
        verified = colmap.read_verified(attempt.sfm_dir / "database.db")
        inputs = replace(inputs, verified=verified, registration=known, typical=cameras.typical)
        found = [*found, *known.dropped]
    with photos.folder.stage("judge"):
        found = [*staying(run(inputs, judging(not are_poses_given))), *found]
    check_accepted(found, photos.accept_partial)
    sfm_dir = attempt.sfm_dir
    if exif_gps and (aligned := georeference.by_exif(sfm, photos.image_dir)):
        sfm_dir = georeference.write_moved(photos.folder.path, sfm_dir.name, sfm)
        content |= aligned
    written = write(
        photos.folder.path,
        attempt.conf,
        sfm,
        cameras,
        feature=feature,
        matcher=photos.matcher,
        retrieval=photos.retrieval,
        image_dir=str(photos.image_dir.resolve()),
        keypoints=keypoints,
        sfm=sfm_dir.name,
        images=len({*photos.names, *names_in(found, "another_size")}),
        findings=[one.to_json() for one in found],
        seconds=photos.folder.seconds(),
        **content,
    )
    built = Map(photos.folder.path)
    built.warn()
    drop_others(photos.folder, built)
    provenance.write(built.folder / FINISHED, written | {"bytes": photos.folder.bytes()})
    return built


def claim(map_dir: Path, made_from: dict, overwrite: bool, *inputs: Path | None) -> RunFolder:
    """Lock the folder of a map, whose unfinished map of something else is replaced.

    Args:
        map_dir: the folder.
        made_from: what the map is made from.
        overwrite: rebuild the map.
        inputs: files and folders that the map is made from, if given.
    """
    before = provenance.read(map_dir / CONF)
    if before and before != made_from and not (map_dir / FINISHED).exists():
        logger.info("Rebuilding the unfinished map %s.", map_dir)
        overwrite = True
    given = [path for path in inputs if path is not None]
    return RunFolder(map_dir, made_from, overwrite, given, kept=(PLACE, FINGERPRINTS))


def begin(map_dir: Path, fingerprints: dict[str, list]) -> None:
    """Write what a map has before it is built: the id of its place, and fingerprints."""
    if not (map_dir / PLACE).exists():
        with replacing(map_dir / PLACE) as temporary:
            temporary.write_text(uuid.uuid4().hex)
    provenance.write(map_dir / FINGERPRINTS, fingerprints)


def _list(
    image_dir: Path, reference: pycolmap.Reconstruction | None, accept_partial: bool
) -> list[str]:
    """List the images of a map: those of the model, or without it all images in a folder."""
    if reference is None:
        names = keep_present(image_dir, list_images(image_dir), accept_partial)
        registration.check_number(image_dir, len(names))
        return names
    names = sorted(image.name for image in reference.images.values())
    return list_images(image_dir, keep_present(image_dir, names, accept_partial))


def _of_fitting_size(
    image_dir: Path, names: list[str], reference: pycolmap.Reconstruction, accept_partial: bool
) -> list[str]:
    """Return the images of a map whose sizes fit their cameras; unreadable ones are kept."""
    found = {name: stored_size(image_dir / name) for name in names}
    _, unfit = sizes.compare(reference, {name: one for name, one in found.items() if one})
    return without([*unfit], names, accept_partial, sizes.complaint(unfit))


def digests(
    map_dir: Path, groups: dict[str, dict[str, Path]]
) -> tuple[dict, dict[str, dict[str, str]]]:
    """Return the fingerprints of groups of files by name, and the digests of each group."""
    files = {f"{key}/{name}": file for key, part in groups.items() for name, file in part.items()}
    fingerprints = provenance.fingerprints(files, provenance.read(map_dir / FINGERPRINTS))
    return fingerprints, {
        key: {name: fingerprints[f"{key}/{name}"][2] for name in part}
        for key, part in groups.items()
    }
