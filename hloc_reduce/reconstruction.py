"""Reconstruct a map from matches of images without known poses or intrinsics."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import pycolmap

from . import logger
from .localization import rigs as rig_files
from .mapping import checks, findings, registration
from .mapping.checks.overlays import drop_overlays
from .mapping.database import verified_by
from .mapping.mapper import MODEL_CHOICE, Mapper, attempts_for
from .runtime import provenance
from .triangulation import read_matches, replacing_map
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.files import file_sha256
from .utils.h5 import list_h5_names
from .utils.images import list_images
from .utils.options import HIDDEN, Option
from .utils.paths import strings_as_paths

# COLMAP would drop parts of fewer than 10 images
MAPPER_OPTIONS = {"random_seed": 0, "num_threads": 1, "min_model_size": 3}


@strings_as_paths
def main(
    sfm_dir: Path,
    image_dir: Path,
    pairs: Path,
    features: Path,
    matches: Path,
    camera_mode: colmap.CameraMode = pycolmap.CameraMode.AUTO,
    verbose: bool = False,
    skip_geometric_verification: bool = False,
    min_match_score: float | None = None,
    image_list: Path | str | Iterable[str] | None = None,
    image_options: dict | None = None,
    mapper_options: dict | None = None,
    overwrite: bool = False,
    accept_partial: bool = False,
    once: Annotated[bool, HIDDEN] = False,
    checked: bool = True,
    rigs: Annotated[Path, Option(metavar="rig_config.json")] | None = None,
) -> pycolmap.Reconstruction:
    """Reconstruct poses, intrinsics and points with COLMAP's incremental mapper.

    Takes the arguments of hloc's `reconstruction.main`. The frame and the scale of the model are
    arbitrary. Images with an implausible focal length or distortion, or a focal length far from
    their EXIF data, are dropped from the model.
    If images are missing (of more than 100 images, more than a fifth), further attempts follow, and
    the model with the most images is kept: an attempt with lower thresholds and, for up to 30
    images, some with other initial pairs, as many at once as there are cores; none of these begins
    after they have taken `mapper.MAPPER_PATIENCE` seconds, which is said. With `camera_mode`
    AUTO, if at most two thirds of the images are in the model, or focal lengths differ by more than
    a factor of 1.2, and one camera may have taken all of them, the mapper runs with one shared
    camera. Its model is kept if it has at least 1.5 times as many images, or 1.5 times as many
    points where focal lengths differ. It also runs and is kept if focal lengths differ by more than
    a factor of 1.05, although all images fit with one camera, and 0.9 times as many points are
    found.

    Args:
        sfm_dir: folder of the new COLMAP model; a model made from the same inputs is read instead.
        image_dir: folder of the images, whose EXIF data give the initial intrinsics.
        pairs: text file of image pairs.
        features: feature file.
        matches: match file.
        camera_mode: which photos share a camera.
        verbose: show COLMAP's log.
        skip_geometric_verification: use all matches, unverified.
        min_match_score: use only matches with a higher score.
        image_list: text file of names, one per line (in Python, also the names); default: the
            images of `features`.
        image_options: of pycolmap's ImageReaderOptions.
        mapper_options: of pycolmap's IncrementalPipelineOptions; if given, there is one attempt.
        overwrite: replace an existing model.
        accept_partial: accept a map that has fewer than half of the photos, or focal lengths that
            differ too much.
        once: make one attempt only.
        checked: report missing images and focal lengths that differ, see `mapping.checks`.
        rigs: COLMAP's file of cameras that are fixed to each other. Their poses in the rig, and
            intrinsics if the file has any, are exact, and the model is in its units.

    Returns:
        The model with the most images. It has the keypoints of the feature file, in the same order.

    Raises:
        InputError: when an input is missing, or the model is refused; it is kept for a run with
            `accept_partial`.
        NoModelError: when nothing can be reconstructed, as of fewer than three images.
    """
    options = {**MAPPER_OPTIONS, **(mapper_options or {})}
    colmap.mapper_options(options)  # raises for a wrong one
    for path in (pairs, features, matches):
        if not path.is_file():
            raise InputError(f"There is no file {path}.")
    names = list_images(image_dir, list_h5_names(features) if image_list is None else image_list)
    registration.check_number(image_dir, len(names))
    attempts = [{}] if mapper_options else attempts_for(len(names))
    chosen = {
        "camera_mode": camera_mode.name,
        "image_options": image_options or {},
        "images": names,
        "skip_geometric_verification": skip_geometric_verification,
        "min_match_score": min_match_score,
        "overlays": "dropped",
        "attempts": attempts[:1] if once else attempts,
        **MODEL_CHOICE,
        "once": once,
    }
    if rigs is not None:
        rig_files.frames(rigs, names)  # raises for a wrong one
        chosen |= {"rigs": file_sha256(rigs), "scale": "by rigs"}
    made_from = provenance.of_inputs({**options, **chosen}, [pairs, features, matches])
    is_whole = bool(provenance.read(sfm_dir / registration.REGISTRATION))
    is_current = provenance.is_current(sfm_dir / provenance.MADE_FROM, made_from)
    if not overwrite and is_whole and is_current:
        logger.info("The map %s is up to date.", sfm_dir)
        sfm = colmap.read_model(sfm_dir)
    else:
        with replacing_map(sfm_dir, made_from) as building:
            keypoints, _, found = read_matches(names, pairs, features, matches, min_match_score)
            found = drop_overlays(keypoints, found)
            Mapper(
                building,
                image_dir,
                names,
                image_options or {},
                keypoints,
                found,
                verify=not skip_geometric_verification,
                known=verified_by(matches),
                attempts=[{**options, **changed} for changed in attempts],
                once=once,
                verbose=verbose,
                rigs=rigs,
            ).reconstruct(camera_mode)
        sfm = colmap.read_model(sfm_dir)
        logger.info("The map %s:\n%s", sfm_dir, sfm.summary())
    if checked:
        known = registration.read(sfm_dir)
        judged = checks.run(checks.Inputs(sfm, registration=known), ["partial", "focal_lengths"])
        judged += known.dropped
        findings.check_accepted(judged, accept_partial)
        findings.warn(judged)
    return sfm


def _main() -> None:
    example = (
        "--sfm_dir outputs/sfm --image_dir photos --pairs pairs.txt "
        "--features outputs/feats-dog-colmap_sift_sv64.h5 --matches outputs/matches.h5"
    )
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
