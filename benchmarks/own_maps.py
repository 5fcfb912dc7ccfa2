"""Localize photos in maps of other photos of a place, by nearest neighbours and by LightGlue.

Nothing is known of the photos but their EXIF data. A third of them is left out of a map of photos
alone, and localized in it; of a folder of few web photos, each third in turn. The map is aligned
by a similarity with given poses or, if there are none, with a map of all photos by the recommended
feature: it is no better than others, so that only large errors count. Adds rows to
results/own_maps.csv: how many photos the maps have, the errors of localized ones in percent of the
largest distance between two photos, and seconds of a map and of a query, on as many cores as
OMP_NUM_THREADS says.
"""

import shutil
import time
from collections.abc import Iterable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pycolmap
import yaml
from scipy.spatial.distance import pdist

from benchmarks import rows
from benchmarks.lightglue import limited
from benchmarks.photos_alone import align, difference, link
from hloc_reduce import Localizer, logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.progress import progress

NAME = "own_maps"
FOLDS = 3
FAR = 10.0, 10.0  # percent and degrees: an error that no map explains


def folds(names: list[str], number: int) -> Iterator[tuple[list[str], list[str]]]:
    """Yield the photos of each of some maps, and those that are left out."""
    for i in range(number):
        yield [name for k, name in enumerate(names) if k % FOLDS != i], names[i::FOLDS]


def localized(
    photos: Path,
    parts: Iterable[tuple[list[str], list[str]]],
    folder: Path,
    options: dict,
    reference: pycolmap.Reconstruction,
) -> dict[str, object]:
    """Build maps of photos, localize others in them, and return the measures of all together."""
    true = {image.name: image.cam_from_world() for image in reference.images.values()}
    extent = pdist([pose.inverse().translation for pose in true.values()]).max()
    counts = dict.fromkeys(("photos", "points", "registered", "queries", "localized"), 0)
    map_s, query_s, inliers, errors = [], [], [], []
    for i, (mapped, left_out) in enumerate(parts):
        counts["photos"] += len(mapped)
        counts["queries"] += len(left_out)
        fold, start = folder / str(i), time.perf_counter()
        shutil.rmtree(fold, ignore_errors=True)
        try:
            linked = link(photos, mapped, fold / "photos")
            built = maps.main(fold / "map", linked, accept_partial=True, **options)
        except InputError as error:
            logger.error("%s", error)
            continue
        map_s.append(time.perf_counter() - start)
        model = colmap.read_model(built.sfm)
        counts["registered"] += model.num_reg_images()
        counts["points"] += model.num_points3D()
        try:
            similarity, compared = align(model, reference), set(true)
        except InputError as error:
            logger.error("%s", error)
            compared = set()
        localizer = Localizer(built.folder)
        for name in progress(left_out, "Localizing", "photo"):
            start = time.perf_counter()
            pose, info = localizer.localize(photos / name)
            query_s.append(time.perf_counter() - start)
            if pose is None:
                continue
            counts["localized"] += 1
            inliers.append(info["num_inliers"])
            if name in compared:
                distance, degrees = difference(pose, true[name], similarity)
                errors.append((100 * distance / extent, degrees))
        shutil.rmtree(fold / "photos")
    percent, degrees = np.array(errors).T if errors else np.empty((2, 0))
    return counts | {
        "compared": len(errors),
        "far": int(((percent > FAR[0]) | (degrees > FAR[1])).sum()),
        "median_percent": float(np.median(percent)) if errors else None,
        "median_deg": float(np.median(degrees)) if errors else None,
        "inliers": sum(inliers) / counts["queries"],
        "map_s": float(np.mean(map_s)) if map_s else None,
        "query_s": float(np.median(query_s)) if query_s else None,
    }


def feature_file(feature: str, number: int, folder: Path) -> Path:
    """Write the configuration of a feature with a number of keypoints."""
    conf = features_confs.get(feature)[1]
    model = limited(conf["model"], number)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{feature}.yaml"
    path.write_text(yaml.safe_dump({"model": model, "preprocessing": conf["preprocessing"]}))
    return path


def references(photos: Iterable[Path], places: Iterable[str], outputs: Path) -> Iterator[tuple]:
    """Yield the name, the folder of photos, the poses and the number of folds of places."""
    for folder in photos:
        built = maps.main(outputs / folder.name / "reference", folder, accept_partial=True)
        yield folder.name, folder, colmap.read_model(built.sfm), FOLDS
    for name, (images, model) in parse_maps(list(places)).items():
        yield name, images, colmap.read_model(model), 1


def _main() -> None:
    parser = cli.Parser(__doc__, "--map scenes/fox/images:scenes/fox/sparse --feature mini32:uint2")
    add = parser.add_argument
    add("--photos", nargs="+", type=Path, default=[], help="folders of web photos")
    add("--map", action="append", default=[], metavar="IMAGES:MODEL", help="photos and their poses")
    add("--feature", nargs="+", default=["mini32:uint2"], help="features, with the map's storage")
    add("--keypoints", nargs="+", type=int, default=[0], help="most of a photo; 0: the feature's")
    add(
        "--matcher",
        nargs="+",
        default=["NN", "lightglue"],
        choices=("NN", "lightglue"),
        help="of maps and queries: NN, the feature's own; lightglue",
    )
    add("--outputs", type=Path, default=Path("outputs/own_maps"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    for place, photos, reference, number in references(args.photos, args.map, args.outputs):
        names = list_images(photos)
        for given, matcher, keypoints in product(args.feature, args.matcher, args.keypoints):
            feature, _, storage = given.partition(":")
            storage = storage or "float16"
            fast = features_confs.matcher_of(features_confs.get(feature)[1])
            matcher = fast if matcher == "NN" else matcher
            cells = {"place": place, "feature": feature, "storage": storage, "matcher": matcher}
            cells |= {"variant": f"{keypoints} keypoints" if keypoints else ""}
            if rows.select(known, **cells):
                continue
            folder = args.outputs / place / f"{feature}-{storage}-{matcher}-{keypoints}"
            options = {"storage": storage, "matcher": matcher, "feature": feature}
            if keypoints:
                options["feature"] = str(feature_file(feature, keypoints, folder))
            measures = localized(photos, folds(names, number), folder, options, reference)
            rows.add(NAME, [cells | measures | rows.how()])


if __name__ == "__main__":
    cli.run(_main)
