"""Localize photos from the web in maps of the others, by nearest neighbours and by LightGlue.

Nothing is known of the photos of a folder but their EXIF data. Three times, a third of them is left
out of a map of photos alone, and localized in it. Each map is aligned by a similarity with one of
all photos by the recommended feature, whose poses stand for the true ones: they are no better than
a map, so that only large errors count. Adds rows to results/web_photos.csv: how many photos the
maps have, and the errors of localized ones in percent of the largest distance between two photos.
"""

import shutil
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.distance import pdist

from benchmarks import rows
from benchmarks.photos_alone import align, difference, link
from hloc_reduce import Localizer, logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.progress import progress

NAME = "web_photos"
FOLDS = 3
FAR = 10.0, 10.0  # percent and degrees: an error that no map explains


def folds(names: list[str]) -> Iterator[tuple[list[str], list[str]]]:
    """Yield the photos of each map, and those that are left out."""
    for i in range(FOLDS):
        yield [name for k, name in enumerate(names) if k % FOLDS != i], names[i::FOLDS]


def localized(
    photos: Path, names: list[str], folder: Path, options: dict, reference: pycolmap.Reconstruction
) -> tuple[int, int, list[int], list[tuple[float, float]]]:
    """Localize the photos that are left out of the maps.

    Returns:
        The photos in all maps, their points; of each localized photo the inliers and, if the
        reference has it, its errors in percent and degrees.
    """
    true = {image.name: image.cam_from_world() for image in reference.images.values()}
    extent = pdist([pose.inverse().translation for pose in true.values()]).max()
    registered, points, inliers, errors = 0, 0, [], []
    for i, (mapped, left_out) in enumerate(folds(names)):
        fold = folder / str(i)
        try:
            linked = link(photos, mapped, fold / "photos")
            built = maps.main(fold / "map", linked, accept_partial=True, **options)
        except InputError as error:
            logger.error("%s", error)
            continue
        model = colmap.read_model(built.sfm)
        registered, points = registered + model.num_reg_images(), points + model.num_points3D()
        try:
            similarity, compared = align(model, reference), set(true)
        except InputError as error:
            logger.error("%s", error)
            compared = set()
        localizer = Localizer(built.folder)
        for name in progress(left_out, "Localizing", "photo"):
            pose, info = localizer.localize(photos / name)
            if pose is None:
                continue
            inliers.append(info["num_inliers"])
            if name in compared:
                distance, degrees = difference(pose, true[name], similarity)
                errors.append((100 * distance / extent, degrees))
        shutil.rmtree(fold / "photos")
    return registered, points, inliers, errors


def _main() -> None:
    parser = cli.Parser(__doc__, "--photos datasets/strangers/naver+mast3r --feature mini32:uint2")
    add = parser.add_argument
    add("--photos", nargs="+", type=Path, required=True, help="folders of photos of one place each")
    add("--feature", nargs="+", default=["mini32:uint2"], help="features, with the map's storage")
    add(
        "--matcher",
        nargs="+",
        default=["NN", "lightglue"],
        choices=("NN", "lightglue"),
        help="of maps and queries: NN, the feature's own; lightglue",
    )
    add("--outputs", type=Path, default=Path("outputs/web_photos"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    for photos in args.photos:
        names, folder = list_images(photos), args.outputs / photos.name
        built = maps.main(folder / "reference", photos, accept_partial=True)
        reference = colmap.read_model(built.sfm)
        for given, name in product(args.feature, args.matcher):
            feature, _, storage = given.partition(":")
            fast = features_confs.matcher_of(features_confs.get(feature)[1])
            options = {"feature": feature, "storage": storage or "float16"}
            options["matcher"] = fast if name == "NN" else name
            cells = {"place": photos.name} | options
            if rows.select(known, **cells):
                continue
            part = folder / "-".join(options.values())
            registered, points, inliers, errors = localized(photos, names, part, options, reference)
            percent, degrees = np.array(errors).T if errors else np.empty((2, 0))
            far = int(((percent > FAR[0]) | (degrees > FAR[1])).sum())
            measures = {
                "photos": len(names) * (FOLDS - 1),
                "points": points,
                "registered": registered,
                "queries": len(names),
                "localized": len(inliers),
                "compared": len(errors),
                "far": far,
                "median_percent": float(np.median(percent)) if errors else None,
                "median_deg": float(np.median(degrees)) if errors else None,
                "inliers": sum(inliers) / len(names),
            }
            rows.add(NAME, [cells | measures | rows.how()])


if __name__ == "__main__":
    cli.run(_main)
