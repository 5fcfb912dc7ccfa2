"""Compare maps of photos without poses with given poses, and with maps of stock pycolmap.

Builds a map from all photos of each place, or from subsets that are consecutive by name, and with
--stock also one by stock pycolmap: its own SIFT, exhaustive matching and incremental mapper, with
default options. A similarity aligns the positions of a map with the given ones. Position errors are
in percent of the largest distance between two given positions.
"""

import shutil
import time
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image, ImageOps
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from hloc_reduce import maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.maps import build
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError

COLUMNS = ("registered", "points", "reprojection error", "positions", "rotations", "seconds")
REWEIGHTINGS = 10


def choose_photos(names: list[str], size: int, number: int) -> list[list[str]]:
    """Return subsets of consecutive names, spread evenly over the list; all if size is 0."""
    if not size or len(names) <= size:
        return [names]
    starts = np.unique(np.linspace(0, len(names) - size, number + 2)[1:-1].astype(int))
    return [names[start : start + size] for start in starts]


def collect(images: Path, names: list[str], mirrored: list[str], folder: Path) -> Path:
    """Link the photos of a subset from a new folder, and write mirrored ones into it."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in names:
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in mirrored:
            with Image.open(images / name) as photo:
                ImageOps.mirror(photo).save(target, quality=95, exif=photo.getexif().tobytes())
        else:
            target.symlink_to((images / name).resolve())
    return folder


def spread(names: list[str], number: int) -> list[str]:
    """Choose names that are spread evenly over a list, neither the first nor the last one.

    Raises:
        InputError: if there are not as many.
    """
    if number > max(0, len(names) - 2):
        raise InputError(f"--mirrored {number}: at most {max(0, len(names) - 2)} of {len(names)}.")
    chosen = np.linspace(1, len(names) - 2, number).round().astype(int) if number else []
    return [names[i] for i in chosen]


def ours(images: Path, folder: Path, feature: str, options: dict) -> maps.Map:
    """Build a map of photos without poses."""
    return maps.main(folder, images, feature=feature, accept_partial=True, **options)


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
    true = {image.name: image.cam_from_world() for image in reference.images.values()}
    known = {image.name: image.cam_from_world() for image in model.images.values()}
    names = sorted(known)
    source = np.array([known[name].inverse().translation for name in names])
    target = np.array([true[name].inverse().translation for name in names])
    # least absolute errors: one wrong pose does not spoil the others
    weights = np.ones(len(names))
    for _ in range(REWEIGHTINGS):
        scale, rotation, shift = fit_similarity(source, target, weights)
        errors = np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1)
        weights = 1 / np.maximum(errors, max(np.median(errors), 1e-9) / 10)
    angles = [
        Rotation.from_matrix(
            true[name].rotation.matrix().T @ known[name].rotation.matrix() @ rotation.T
        ).magnitude()
        for name in names
    ]
    return 100 * errors / pdist(target).max(), np.rad2deg(angles)


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


def row(model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction, number: int) -> list:
    """Return the cells of a model, without the seconds."""
    positions, rotations = pose_errors(model, reference)
    return [
        f"{model.num_reg_images()} of {number}",
        model.num_points3D(),
        f"{model.compute_mean_reprojection_error():.2f}",
        f"{np.median(positions):.2f} / {positions.max():.2f} %",
        f"{np.median(rotations):.2f} / {rotations.max():.2f}°",
    ]


def main(
    places: dict[str, tuple[Path, Path]],
    output: Path,
    feature: str = features_confs.RECOMMENDED,
    subset: int = 0,
    subsets: int = 1,
    with_stock: bool = False,
    num_mirrored: int = 0,
    options: dict | None = None,
) -> None:
    """Print a row for each place, subset and method."""
    print(f"| place | method | {' | '.join(COLUMNS)} |")
    print(f"| --- | --- |{' ---: |' * len(COLUMNS)}", flush=True)
    registered: dict[str, int] = {}
    outcomes: dict[str, int] = {}
    for place, (images, model) in places.items():
        reference = colmap.read_model(model)
        names = sorted(image.name for image in reference.images.values())
        for number, chosen in enumerate(choose_photos(names, subset, subsets)):
            title = f"{place} {len(chosen)}" + (f" ({number + 1})" if subsets > 1 else "")
            mirrored = spread(chosen, num_mirrored)
            suffix = f"-mirrored{num_mirrored}" if mirrored else ""
            folder = output / f"{title.replace(' ', '-')}{suffix}"
            photos = collect(images, chosen, mirrored, folder / "photos")
            for method in ("ours", "stock") if with_stock else ("ours",):
                start = time.perf_counter()
                try:
                    if method == "ours":
                        built = ours(photos, folder / "map", feature, options or {})
                        found = colmap.read_model(built.sfm)
                        for name in chosen:
                            outcome = _outcome(built, name, name in mirrored)
                            outcomes[outcome] = outcomes.get(outcome, 0) + 1
                    else:
                        found = stock(photos, folder / "stock")
                    cells = row(found, reference, len(chosen))
                    registered[method] = registered.get(method, 0) + int(cells[0].split()[0])
                except InputError as error:
                    cells = [f"0 of {len(chosen)}", *["-"] * 4]
                    print(f"<!-- {error} -->")
                cells.append(f"{time.perf_counter() - start:.0f}")
                print(f"| {title} | {method} | {' | '.join(map(str, cells))} |", flush=True)
    print()
    for method, total in registered.items():
        print(f"{method}: {total} photos registered in all")
    if num_mirrored:
        print(", ".join(f"{outcome}: {outcomes[outcome]}" for outcome in sorted(outcomes)))


def _outcome(built: maps.Map, name: str, is_mirrored: bool) -> str:
    """Return what became of a photo of a map."""
    named = name in built.mirrored
    place = "named" if named else "in the map" if name in built.names() else "missing"
    return f"{'mirrored' if is_mirrored else 'others'} {place}"


def _main() -> None:
    parser = cli.Parser(
        __doc__, "--map fox/images:fox/sparse --subset 10 --stock --output outputs/photos_alone"
    )
    parser.add_argument(
        "--map", action="append", required=True, metavar="IMAGES:MODEL", help="may be repeated"
    )
    parser.add_argument("--output", type=Path, required=True, help="folder of the maps")
    parser.add_argument("--feature", default=features_confs.RECOMMENDED, help="name or YAML file")
    features_confs.add_keypoints_option(parser)
    parser.add_argument("--subset", type=int, default=0, help="photos per subset; 0: all")
    parser.add_argument("--subsets", type=int, default=1, help="subsets of each place")
    parser.add_argument("--stock", action="store_true", help="also run stock pycolmap")
    parser.add_argument("--mirrored", type=int, default=0, help="mirrored photos in each subset")
    colmap.add_camera_mode(parser)
    parser.add_argument(
        "--num_covis", type=int, default=20, help="pairs of each photo, unless all are matched"
    )
    parser.add_argument(
        "--max_exhaustive",
        type=int,
        default=build.MAX_EXHAUSTIVE,
        help="largest number of photos whose pairs are all matched",
    )
    args = parser.parse_args()
    build.MAX_EXHAUSTIVE = args.max_exhaustive
    main(
        parse_maps(args.map),
        args.output,
        args.feature,
        args.subset,
        args.subsets,
        args.stock,
        args.mirrored,
        {
            "num_covis": args.num_covis,
            "keypoints": args.keypoints,
            "camera_mode": colmap.camera_mode(args.camera_mode),
        },
    )


if __name__ == "__main__":
    cli.run(_main)
