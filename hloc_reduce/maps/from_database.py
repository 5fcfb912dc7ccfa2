"""Build a map from a COLMAP model and the database it was made from: no photo is read."""

from pathlib import Path

import pycolmap

from .. import aggregate_features, extract_features, from_colmap, logger, triangulation
from ..confs import features as features_confs
from ..confs import matchers as matchers_confs
from ..confs import retrieval as retrieval_confs
from ..detectors.dog import KEYPOINT_SETTINGS
from ..localization import intrinsics
from ..mapping.checks import Inputs, judging, run
from ..mapping.findings import staying
from ..reduce import Reduction
from ..retrieval import load as load_retrieval
from ..runtime.outputs import RunFolder
from ..utils import colmap
from ..utils.cli import InputError, no_folder
from ..utils.codes import STORAGES
from ..utils.colmap import StoredDatabase
from ..utils.match_files import check_distinct
from ..utils.paths import strings_as_paths
from .build import begin, claim, digests
from .map import FINISHED, SFM, Map, keep_projection, write


@strings_as_paths
def main(
    map_dir: Path,
    database: Path,
    model: Path,
    feature: str = features_confs.RECOMMENDED,
    projection: Path | None = None,
    matcher: str | None = None,
    overwrite: bool = False,
    storage: str = STORAGES[0],
    keypoints: str = KEYPOINT_SETTINGS[0],
    image_dir: Path | None = None,
    retrieval: str = retrieval_confs.VLAD,
) -> Map:
    """Build a map, or open the one that was made from the same.

    Args:
        map_dir: the folder of the map.
        database: COLMAP database with keypoints and descriptors.
        model: the COLMAP model that was made from it, with points.
        feature: name of a feature, or its YAML file.
        projection: projection file to use with the base descriptor of `feature`.
        matcher: default: the feature's.
        overwrite: rebuild the map.
        storage: how descriptors are stored, one of `utils.codes.STORAGES`.
        keypoints: settings of DoG for queries, as in `confs.features.get`.
        image_dir: folder of the images, whose EXIF data tell more about the cameras, and which the
            report shows; None if there are none.
        retrieval: a key of `confs.retrieval`; those that see the images need `image_dir`.

    Returns:
        The map.

    Raises:
        InputError: if the folder has a map that was made from something else, or something is
            missing or wrong.
    """
    reduction = Reduction(feature, projection, storage)
    name, conf = features_confs.get(feature, projection, storage, keypoints)
    matcher = matcher or features_confs.matcher_of(conf)
    described_by = retrieval_confs.get(retrieval)
    if load_retrieval(described_by["model"]).needs_image and image_dir is None:
        raise InputError(f"--retrieval {retrieval} needs the photos of the map: --map_images.")
    if image_dir is not None and not image_dir.is_dir():
        raise no_folder(image_dir)
    reference = colmap.read_model(model)
    if not reference.num_points3D():
        raise InputError(f"The model {model} has no points: give one that COLMAP reconstructed.")
    with colmap.open_stored(database) as opened:
        names = from_colmap.check(opened, reduction, reference)
        check_distinct(names)
        cameras = _cameras(reference, names, image_dir)
        told = intrinsics.to_dict(cameras)
        groups = {"database": opened.files(), "model": colmap.model_files(model)}
        named = {key: {path.name: path for path in part} for key, part in groups.items()}
        fingerprints, found = digests(map_dir, named)
        made_from = {
            "feature": extract_features.provenance(conf),
            "matcher": matchers_confs.confs[matcher]["model"],
            **found,
            "cameras": {"known": told["cameras"], "models": told["camera_models"]},
            **retrieval_confs.provenance(retrieval),
        }
        with claim(map_dir, made_from, overwrite, database, model, projection, image_dir) as folder:
            if not (map_dir / FINISHED).exists():
                begin(map_dir, fingerprints)
                logger.info("Building the map %s of %d images.", map_dir, len(names))
                conf = keep_projection(conf, map_dir)
                _build(folder, opened, reduction, conf, names, reference, model, found)
                with folder.stage("retrieval"):
                    features = map_dir / f"{conf['output']}.h5"
                    aggregate_features.main(described_by, features, names, image_dir=image_dir)
                with folder.stage("judge_poses"):
                    judged = staying(run(Inputs(reference), judging(are_poses_estimated=False)))
                write(
                    map_dir,
                    conf,
                    reference,
                    cameras,
                    feature=name,
                    matcher=matcher,
                    retrieval=retrieval,
                    image_dir=str((image_dir or map_dir / "images").resolve()),
                    model=str(model.resolve()),
                    database=str(database.resolve()),
                    keypoints=keypoints,
                    images=len(names),
                    images_with_pose=len(names),
                    findings=[one.to_json() for one in judged],
                    seconds=folder.seconds(),
                    bytes=folder.bytes(),
                )
            built = Map(map_dir)
            built.warn()
            return built


def _cameras(
    reference: pycolmap.Reconstruction, names: list[str], image_dir: Path | None
) -> intrinsics.MapCameras:
    """Return what a map, and the EXIF data of its photos, if any, tell about intrinsics."""
    if image_dir is None:
        return intrinsics.of_cameras(image.camera for image in reference.images.values())
    if not any((image_dir / name).is_file() for name in names):
        raise InputError(
            f"{image_dir} has none of the {len(names)} images of the model, such as {names[0]}: "
            "choose another --map_images, or leave it out."
        )
    return intrinsics.of_map(reference, image_dir)


def _build(
    folder: RunFolder,
    database: StoredDatabase,
    reduction: Reduction,
    conf: dict,
    names: list[str],
    reference: pycolmap.Reconstruction,
    model: Path,
    found: dict[str, dict[str, str]],
) -> None:
    """Write the features and the model of a map."""
    with folder.stage("extract_features"):
        features = folder.path / f"{conf['output']}.h5"
        from_colmap.write(database, features, reduction, names, found["database"])
    with (
        folder.stage("triangulation"),
        triangulation.replacing_map(folder.path / SFM, found["model"], model) as written,
    ):
        reference.write_binary(written)
