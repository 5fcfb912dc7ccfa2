"""Compare maps of photos without poses with given poses, and with maps of stock pycolmap.

Builds a map from all photos of each place, or from subsets that are consecutive by name, and one by
stock pycolmap: its own SIFT, exhaustive matching and incremental mapper, with default options. A
similarity aligns the positions of a map with the given ones. Adds rows to results/photos_alone.csv;
position errors are in percent of the largest distance between two given positions.
"""

import shutil
import time
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from benchmarks import rows
from hloc_reduce import logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError

NAME = "photos_alone"
STOCK = "pycolmap"
REWEIGHTINGS = 10  # of the alignment


def choose_photos(names: list[str], size: int, number: int) -> list[list[str]]:
    """Return subsets of consecutive names, spread evenly over the list; all if size is 0."""
    if not size or len(names) <= size:
        return [names]
    starts = np.unique(np.linspace(0, len(names) - size, number + 2)[1:-1].astype(int))
    return [names[start : start + size] for start in starts]


def link(images: Path, names: list[str], folder: Path) -> Path:
    """Link photos from a new folder."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in names:
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to((images / name).resolve())
    return folder


def stock(images: Path, folder: Path) -> pycolmap.Reconstruction:
    """Reconstruct by stock pycolmap in one thread; return the model with the most images."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    database = folder / "database.db"
    with pycolmap.Database.open(database):
        pass
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1)
    matching = pycolmap.FeatureMatchingOptions(num_threads=1)
    verification = pycolmap.TwoViewGeometryOptions(ransac={"random_seed": 0})
    cpu = pycolmap.Device.cpu
    pycolmap.extract_features(database, images, extraction_options=extraction, device=cpu)
    pycolmap.match_exhaustive(
        database, matching_options=matching, verification_options=verification, device=cpu
    )
    options = colmap.mapper_options({"random_seed": 0, "num_threads": 1})
    models = pycolmap.incremental_mapping(database, images, folder, options=options)
    if not models:
        raise InputError(f"Stock pycolmap could not reconstruct the photos of {images}.")
    return max(models.values(), key=lambda model: model.num_reg_images())


Similarity = tuple[float, np.ndarray, np.ndarray]  # scale, rotation (3, 3) and shift (3,)


def align(model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction) -> Similarity:
    """Align a model with another that has its images: positions map by s R x + t.

    One of least absolute errors: a wrong pose does not spoil the others.

    Raises:
        InputError: if they share fewer than three images.
    """
    true = {image.name: image.projection_center() for image in reference.images.values()}
    known = [image for image in model.images.values() if image.has_pose and image.name in true]
    if len(known) < 3:
        raise InputError(f"Models that share {len(known)} images cannot be aligned.")
    source = np.array([image.projection_center() for image in known])
    target = np.array([true[image.name] for image in known])
    weights = np.ones(len(source))
    for _ in range(REWEIGHTINGS):
        scale, rotation, shift = fit_similarity(source, target, weights)
        errors = np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1)
        weights = 1 / np.maximum(errors, max(np.median(errors), 1e-9) / 10)
    return scale, rotation, shift


def difference(
    pose: pycolmap.Rigid3d, true: pycolmap.Rigid3d, similarity: Similarity
) -> tuple[float, float]:
    """Return how far a pose is from the true one after a similarity: in its units, and degrees."""
    scale, rotation, shift = similarity
    position = scale * rotation @ pose.inverse().translation + shift
    turn = true.rotation.matrix().T @ pose.rotation.matrix() @ rotation.T
    angle = np.rad2deg(Rotation.from_matrix(turn).magnitude())
    return float(np.linalg.norm(position - true.inverse().translation)), float(angle)


def pose_errors(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction
) -> tuple[np.ndarray, np.ndarray]:
    """Align a model with another by a similarity and compare the poses of its images.

    Args:
        model: the model to align.
        reference: has the images of the model, and perhaps more.

    Returns:
        Position errors (N,), in percent of the extent of the reference, and rotation errors (N,),
        in degrees.
    """
    similarity = align(model, reference)
    true = {image.name: image.cam_from_world() for image in reference.images.values()}
    extent = pdist([pose.inverse().translation for pose in true.values()]).max()
    found = [
        difference(image.cam_from_world(), true[image.name], similarity)
        for image in sorted(model.images.values(), key=lambda image: image.name)
    ]
    distances, angles = np.array(found).T
    return 100 * distances / extent, angles


def fit_similarity(
    source: np.ndarray, target: np.ndarray, weights: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit target = scale * rotation @ source + shift by weighted least squares (Umeyama)."""
    weights = (weights / weights.sum())[:, None]
    centre, true_centre = (weights * source).sum(0), (weights * target).sum(0)
    source, target = source - centre, target - true_centre
    u, s, vt = np.linalg.svd((weights * target).T @ source)
    flip = np.diag([1, 1, np.linalg.det(u @ vt)])
    scale = (s * np.diag(flip)).sum() / (weights * source**2).sum()
    rotation = u @ flip @ vt
    return scale, rotation, true_centre - scale * rotation @ centre


def measured(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction
) -> dict[str, object]:
    """Return the measures of a model."""
    positions, rotations = pose_errors(model, reference)
    return {
        "points": model.num_points3D(),
        "registered": model.num_reg_images(),
        "reprojection_px": model.compute_mean_reprojection_error(),
        "median_percent": float(np.median(positions)),
        "largest_percent": float(positions.max()),
        "largest_deg": float(rotations.max()),
    }


def _main() -> None:
    parser = cli.Parser(__doc__, "--map scenes/fox/images:scenes/fox/sparse --subset 10")
    add = parser.add_argument
    add("--map", action="append", required=True, metavar="IMAGES:MODEL", help="may be repeated")
    add("--outputs", type=Path, default=Path("outputs/photos_alone"), help="folder of the maps")
    add("--feature", default=features_confs.RECOMMENDED, help="name or YAML file")
    add("--subset", type=int, default=0, help="photos per subset; 0: all")
    add("--subsets", type=int, default=1, help="subsets of each place")
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    for place, (images, model) in parse_maps(args.map).items():
        reference = colmap.read_model(model)
        names = sorted(image.name for image in reference.images.values())
        for number, chosen in enumerate(choose_photos(names, args.subset, args.subsets), 1):
            part = f"{len(chosen)} photos, {number}" if args.subset else "all"
            folder = args.outputs / f"{place}-{part.replace(', ', '-').replace(' ', '-')}"
            for feature in (args.feature, STOCK):
                cells = {"place": place, "list": part, "feature": feature}
                if rows.select(known, **cells):
                    continue
                photos, start = link(images, chosen, folder / "photos"), time.perf_counter()
                try:
                    if feature == STOCK:
                        built = stock(photos, folder / STOCK)
                    else:
                        options = {"feature": feature, "accept_partial": True}
                        built = colmap.read_model(maps.main(folder / "map", photos, **options).sfm)
                    cells |= measured(built, reference)
                except InputError as error:
                    logger.error("%s", error)
                    cells |= {"registered": 0}
                seconds = time.perf_counter() - start
                rows.add(NAME, [cells | {"photos": len(chosen)} | rows.how(seconds)])


if __name__ == "__main__":
    cli.run(_main)
