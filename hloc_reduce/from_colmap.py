"""Write the keypoints and descriptors of a COLMAP database into a feature file, without the photos.

COLMAP's SIFT descriptors become those of a feature of colmap_sift. Keypoints keep their order, so
that COLMAP's matches and models stay valid with the file.
"""

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap

from . import logger
from .confs import features as features_confs
from .descriptors import COLMAP_SIFT
from .descriptors.normalization import NORMALIZATIONS, Normalization
from .detectors.dog import KEYPOINT_UNCERTAINTY_PIXELS
from .reduce import Described, Reduction, sampled, told_by
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.codes import STORAGES, Storage
from .utils.colmap import SIFT, StoredDatabase
from .utils.files import file_sha256
from .utils.parsers import check_names
from .utils.paths import strings_as_paths

LARGEST = 3200  # pixels: COLMAP detects in smaller versions of larger photos, by default
COMPARED_KEYPOINTS = 50  # of each image, whose positions are compared with those of a model
SAME_POSITION_PIXELS = 0.05  # positions that differ by less are equal


@strings_as_paths
def main(
    database: Path,
    output: Path,
    feature: str = features_confs.RECOMMENDED,
    model: Path | pycolmap.Reconstruction | None = None,
    projection: Path | None = None,
    storage: Storage = STORAGES[0],
    normalization: Normalization | None = None,
    overwrite: bool = False,
) -> Path:
    """Write a feature file of the images of a COLMAP database.

    Args:
        database: COLMAP database of any version; it is only read.
        output: the new feature file. Images that it has already are skipped.
        feature: colmap_sift or a projection of it, see pipelines.aachen --list_features, or a YAML
            file.
        model: COLMAP model made from the database: only its images are written, and their keypoints
            are compared; default: all images that have descriptors.
        projection: file of another projection of its base.
        storage: storage of descriptors.
        normalization: normalization of SIFT descriptors; default: detected.
        overwrite: write all images again.

    Returns:
        `output`.

    Raises:
        InputError: when the database is missing, broken or locked, has no descriptors or those of
            another base, or is not the one that the model was made from.
    """
    if isinstance(model, Path):
        model = colmap.read_model(model)
    reduction = Reduction(feature, projection, storage)
    if output.resolve() == database.resolve():
        raise InputError(f"{output} is the database: choose another --output.")
    with colmap.open_stored(database) as opened:
        names = check(opened, reduction, model)
        made_from = {path.name: file_sha256(path) for path in opened.files()}
        write(opened, output, reduction, names, made_from, normalization, overwrite)
    logger.info("%d images with %s, %s: %s", len(names), reduction.name, storage, output)
    return output


def check(
    database: StoredDatabase, reduction: Reduction, model: pycolmap.Reconstruction | None
) -> list[str]:
    """Check that a database has descriptors for a feature, and is that of a model.

    Args:
        database: COLMAP database.
        reduction: to the feature.
        model: the model, if there is one.

    Returns:
        The images to write: those of the model that have poses, or all that have descriptors.

    Raises:
        InputError: see `main`.
    """
    keypoints, described = map(database.numbers, ("keypoints", "descriptors"))
    if not described:
        raise InputError(
            f"{database.path} has no descriptors: give the database that COLMAP extracted the "
            "features into."
        )
    _check_type(database, reduction)
    if model is None:
        names = check_names(sorted(described), database.path)
    else:
        names = sorted(model.images[i].name for i in model.reg_image_ids())
        check_model(database, model)
    if not names:
        raise InputError("The model has no image with a pose.")
    lacking = [name for name in names if described.get(name, 0) != keypoints.get(name, 0)]
    if lacking:
        raise InputError(
            f"{database.path} lacks the descriptors of {len(lacking)} of {len(names)} images, or "
            f"has others than keypoints: {cli.some(lacking, 3)}. Extract the features again."
        )
    return names


def write(
    database: StoredDatabase,
    output: Path,
    reduction: Reduction,
    names: list[str],
    made_from: dict,
    normalization: str | None = None,
    overwrite: bool = False,
) -> None:
    """Write images of a database, as `check` returns them, into a feature file.

    Args:
        database: COLMAP database.
        output: the feature file.
        reduction: to the feature.
        names: the images.
        made_from: what determines the content of the database.
        normalization: of the SIFT descriptors; default: detected.
        overwrite: write all images again.
    """
    normalization = normalization or _normalization(database, names)
    cli.choose("normalization", normalization, NORMALIZATIONS)
    made_from = {"database": made_from, "normalization": normalization, **reduction.provenance}
    read = partial(_read, database, reduction)
    reduction.write(output, made_from, overwrite, names, read, normalization)


def _check_type(database: StoredDatabase, reduction: Reduction) -> None:
    """Raise an InputError if the descriptors of a database are not those of a feature's base."""
    found = database.descriptor_type()
    if found != SIFT:
        raise InputError(
            f"{database.path} has descriptors of {found}; only those of SIFT are read. Build the "
            "map from the photos instead."
        )
    if not reduction.of_colmap:
        raise InputError(
            f"{database.path} has descriptors of COLMAP's SIFT, not those of {reduction.name}: "
            f"choose a feature of {COLMAP_SIFT}, such as {features_confs.RECOMMENDED}."
        )


def check_model(database: StoredDatabase, model: pycolmap.Reconstruction) -> None:
    """Raise an InputError if a model was made from another database."""
    keypoints = database.numbers("keypoints")

    def of_another(names: list[str], reason: str) -> InputError:
        return InputError(
            f"{database.path} is of another model: {reason} of {len(images)} images differ, such "
            f"as those of {cli.some(names, 3)}. Give the database that the model was made from."
        )

    images = [model.images[i] for i in model.reg_image_ids()]
    if missing := sorted(image.name for image in images if image.name not in database.images):
        raise InputError(
            f"{database.path} is of another model: it lacks {len(missing)} of {len(images)} "
            f"images: {cli.some(missing, 3)}."
        )
    others = [i.name for i in images if keypoints.get(i.name, 0) != i.num_points2D()]
    if others:
        raise of_another(sorted(others), f"the numbers of keypoints of {len(others)}")
    moved = [i.name for i in images if not _agree(i, database.keypoints(i.name))]
    if moved:
        raise of_another(sorted(moved), f"the positions of keypoints of {len(moved)}")


def _agree(image: pycolmap.Image, keypoints: np.ndarray) -> bool:
    """Return whether keypoints of a database are where an image of a model has them."""
    rows = np.unique(np.linspace(0, len(keypoints) - 1, COMPARED_KEYPOINTS).astype(int))
    if not len(keypoints):
        return True
    points2D = image.points2D
    expected = np.array([points2D[i].xy for i in rows.tolist()])
    return bool(np.abs(expected - keypoints[rows, :2]).max() < SAME_POSITION_PIXELS)


def _normalization(database: StoredDatabase, names: list[str]) -> str:
    """Tell how the descriptors of a database are normalized, by those of some images."""
    found = np.concatenate([_unit(database.descriptors(name)) for name in sampled(names)])
    return told_by(found, str(database.path))


def _unit(descriptors: np.ndarray) -> np.ndarray:
    """Return descriptors (N, D) float32 of unit norm."""
    found = descriptors.astype(np.float32)
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)


def _read(database: StoredDatabase, reduction: Reduction, names: list[str]) -> Iterator[Described]:
    """Read the features of images."""
    for name in names:
        keypoints, descriptors = database.keypoints(name), database.descriptors(name)
        reduction.check(descriptors.shape[1], f"{database.path}: the descriptors of {name}")
        size = np.array(database.image_size(name))
        # hloc's pixels
        arrays = {"keypoints": keypoints[:, :2] - np.float32(0.5), "image_size": size}
        if (shapes := colmap.shapes(keypoints)) is not None:
            scales, oris = (part.astype(np.float16) for part in shapes)
            arrays |= {"scales": scales, "oris": oris, "scores": scales}  # as the extractor `dog`
        noise = KEYPOINT_UNCERTAINTY_PIXELS * max(1.0, size.max() / LARGEST)
        yield name, descriptors.astype(np.float32), (arrays, {"keypoints": {"uncertainty": noise}})


def _main() -> None:
    example = "--database database.db --model sparse/0 --output outputs/feats-colmap.h5"
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
