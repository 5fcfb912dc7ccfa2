"""Localize photos in a map of your own.

Builds the map once, from photos and a COLMAP model of them, from photos alone, or from a COLMAP
model and its database; later runs localize other photos in it. Without --query_images only the map
is built. A new map has the feature colmap_sift_sv64 and its matcher unless you choose others.
--add_images adds photos to a map.
"""

from collections import Counter
from pathlib import Path
from typing import Any

from hloc_reduce import compact, extract_features, localize_sfm, logger, maps
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import DAY_THRESHOLDS, true_poses
from hloc_reduce.detectors.dog import KEYPOINTS
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate
from hloc_reduce.maps.map import Map
from hloc_reduce.runtime import trace
from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.paths import strings_as_paths

from .common import changes, options
from .common.queries import LISTED, Photos, Queries, identity, results_folder
from .common.retrieval import retrieve_in_map
from .common.run import Run, readable

MADE_FROM = "made_from.json"  # the map and the photos of the queries
OF_MAP = "feature", "projection", "matcher", "storage", "keypoints", "camera_mode"  # options


@strings_as_paths
def open_map(
    outputs: Path,
    map_images: Path | None = None,
    model_or_map: Path | None = None,
    feature: str | None = None,
    projection: Path | None = None,
    matcher: str | None = None,
    num_covis: int = 20,
    overwrite: bool = False,
    storage: str | None = None,
    keypoints: str | None = None,
    accept_partial: bool = False,
    camera_mode: str | None = None,
    database: Path | None = None,
) -> Map:
    """Build a map, or open one that was built before.

    None stands for the default of a new map, and for whatever an old map was built with.

    Args:
        outputs: a new map goes into its folder `map`.
        map_images: folder of the map's photos; None to open an old map.
        model_or_map: COLMAP model of the photos, or an old map, or a file of
            `hloc_reduce.compact`, which is unpacked into the folder `map`.
        feature: name of a feature, or its YAML file; default: colmap_sift_sv64.
        projection: projection file to use with the base descriptor of `feature`.
        matcher: default: the feature's.
        num_covis: other images that each map image is matched with.
        overwrite: rebuild the map.
        storage: how descriptors are stored; default: float16.
        keypoints: settings of the DoG detector; default: adaptive.
        accept_partial: build the map without photos that are missing, unreadable or not
            reconstructed, and even if its focal lengths, positions or matches show that it may be
            wrong.
        camera_mode: which photos share a camera, as in COLMAP; default: auto.
        database: COLMAP database that the model was made from: its keypoints and descriptors make
            the map. Photos, if given, only tell more about the cameras.

    Raises:
        InputError: when an old map was built with other options, or something is missing or wrong.
    """
    if camera_mode is not None and (map_images is None or model_or_map is not None):
        raise InputError("--camera_mode is for maps of photos alone: leave it or --map out.")
    mode = colmap.camera_mode(camera_mode or "auto")
    is_built = model_or_map and (maps.is_map(model_or_map) or maps.is_compact(model_or_map))
    if is_built and (database or map_images):
        option = "--database" if database else "--map_images"
        raise InputError(
            f"--map {model_or_map} is a map that was built: leave out {option} to localize in it, "
            "or give the COLMAP model that it was built from."
        )
    new: dict[str, Any] = {
        "feature": feature or features_confs.RECOMMENDED,
        "projection": projection,
        "matcher": matcher,
        "overwrite": overwrite,
        "storage": storage or STORAGES[0],
        "keypoints": keypoints or KEYPOINTS[0],
    }
    folder = outputs / "map"
    if database is not None:
        if model_or_map is None:
            raise InputError(
                f"Give --map, the COLMAP model that was made from --database {database}."
            )
        return maps.from_database.main(folder, database, model_or_map, image_dir=map_images, **new)
    if map_images is not None:
        new |= {"num_covis": num_covis, "accept_partial": accept_partial, "camera_mode": mode}
        return maps.main(folder, map_images, model_or_map, **new)
    if model_or_map is None:
        raise InputError("Give --map_images, the folder of the photos to build a map of.")
    built = _open(model_or_map, folder, overwrite)
    if feature or projection:
        built.check_feature(feature or features_confs.RECOMMENDED, projection)
    given = {"storage": storage, "keypoints": keypoints, "matcher": matcher}
    for option, value in given.items():
        if value not in (None, getattr(built, option)):
            raise InputError(
                f"The map {model_or_map} was built with --{option} {getattr(built, option)}."
            )
    return built


def _open(model_or_map: Path, folder: Path, overwrite: bool) -> Map:
    """Open a map that was built before; unpack a compact one into a folder."""
    models = [*model_or_map.glob("cameras.*"), *model_or_map.glob("*/cameras.*")]
    if models and not maps.is_map(model_or_map):
        raise InputError(
            f"{model_or_map} is a COLMAP model: give its photos, --map_images, or its --database."
        )
    if maps.is_compact(model_or_map):
        return maps.unpack(model_or_map, folder, overwrite)
    return Map(model_or_map)


@strings_as_paths
def main(
    built: Map,
    query_images: Path,
    outputs: Path,
    queries: Path | None = None,
    num_loc: int = 50,
    ground_truth: Path | None = None,
    overwrite: bool = False,
    strict: bool = False,
    gate: Gate = DEFAULT_GATE,
) -> dict:
    """Localize queries in a map and return the summary, as in summary.json.

    Args:
        built: the map.
        query_images: folder of the photos.
        outputs: folder for the results.
        queries: query list with intrinsics, or a glob of several; default: all photos of the
            folder, with inferred intrinsics.
        num_loc: retrieved map images per query.
        ground_truth: true poses of the queries.
        overwrite: recompute existing results.
        strict: stop at an unreadable query photo instead of recording it as not localized.
        gate: what a pose must have for the query to be called localized.

    Raises:
        InputError: when something is missing or wrong.
    """
    wanted = Queries.find(query_images, queries, built, strict)
    names = wanted.names
    map_names = built.names()
    built.check_features(map_names)  # a broken map is found before photos are read
    truth = true_poses(names, ground_truth, True) if ground_truth else {}

    photos = Photos(outputs / MADE_FROM, built, query_images, names)
    conf = {"map": built.place, **identity(outputs, query_images, queries), "num_loc": num_loc}
    inputs = [query_images, *([queries] if queries else [])]
    remedy = (
        "Choose other --outputs, or replace the results, but not the map: "
        f"--map {built.folder} --overwrite."
    )
    folder = RunFolder(outputs, conf, overwrite, inputs, bool(photos.changed), remedy=remedy)
    with Run(folder, built.feature, built.matcher) as run:
        photos.write()
        listed = queries or wanted.write(outputs / LISTED)
        wanted.log()
        with run.stage("extract_features"):
            features = extract_features.main(
                *(built.conf, query_images, outputs),
                image_list=names,
                strict=strict,
                queries=names,
            )
        photos.forget(failures(features))
        loc_pairs = outputs / f"pairs-query-vlad{num_loc}.txt"
        with run.stage("retrieval"):
            queries_read = readable(features, names)
            retrieve_in_map(built, features, loc_pairs, num_loc, queries_read, map_names)
        matches = run.match("match_queries", loc_pairs, features, built.features)
        poses = outputs / f"poses_hloc_{built.feature}+{built.matcher}_vlad{num_loc}.txt"
        with run.stage("localization"):
            records = localize_sfm.main(
                *(built.sfm, listed, loc_pairs, features, matches, poses),
                refinements=wanted.refinements,
                full_names=True,
                gate=gate,
                mirror_images=run.mirror_images(
                    built.conf, query_images, loc_pairs, features, built.features
                ),
            )
        limits = dict.fromkeys(wanted.lists, DAY_THRESHOLDS)
        summary = {
            "retrieval": "vlad",
            "num_loc": num_loc,
            "intrinsics": Counter(wanted.sources.values()),
            "map": str(built.folder),
            "map_images": built.num_images,
            "map_points3D": built.num_points3D,
            "map_doubts": built.doubts,
        }
        files = {
            "query_images": query_images,
            "pairs": loc_pairs,
            "matches": matches,
            "ground_truth": ground_truth,
            "map_images": built.images,
            "map_features": built.features,
            "map": built.sfm,
        }
        return run.finish(summary, wanted.lists, records, truth, limits, features, poses, files)


def _parser() -> cli.Parser:
    """Return the parser of the command line."""
    parser = cli.Parser(
        __doc__, "--map sparse --map_images photos --query_images new --outputs outputs/place"
    )
    parser.add_argument(
        "--map",
        type=Path,
        metavar="MODEL|MAP",
        help="COLMAP model of --map_images or --database, or a folder with one model in it; or a "
        "map of an earlier run: its folder or .hlm file",
    )
    parser.add_argument(
        "--map_images", type=Path, help="photos of the map; without --map they are reconstructed"
    )
    parser.add_argument(
        "--database",
        type=Path,
        help="COLMAP database that --map was made from: its keypoints and descriptors make the "
        "map, without photos",
    )
    parser.add_argument(
        "--compact", type=Path, metavar="FILE.hlm", help="write the map into one small file, too"
    )
    parser.add_argument("--query_images", type=Path, help="folder of the photos to localize")
    parser.add_argument(
        "--queries",
        type=Path,
        help="query list with intrinsics, or a glob of several (default: all photos of "
        "--query_images, with intrinsics from EXIF data or guessed)",
    )
    parser.add_argument(
        "--outputs",
        type=Path,
        help="results folder: the map goes to OUTPUTS/map, poses to OUTPUTS/queries-<name of "
        "--queries or --query_images>",
    )
    parser.add_argument(
        "--num_covis", type=int, default=20, help="other images that each map image is matched with"
    )
    changes.add_options(parser)
    colmap.add_camera_mode(parser)
    options.add_feature_options(parser)
    options.add_localization_options(parser, "none", 50)
    # None: what an old map was built with
    parser.set_defaults(feature=None, storage=None, keypoints=None, camera_mode=None)
    return parser


def _check(given: dict, is_changed: bool) -> None:
    """Raise an InputError for options that contradict each other.

    Args:
        given: the options.
        is_changed: whether photos are added to a map or removed from it.
    """
    for name, names in (("storage", STORAGES), ("keypoints", KEYPOINTS)):
        if given[name] is not None:
            cli.choose(name, given[name], names)
    if given["outputs"] is None and (given["query_images"] is not None or not is_changed):
        raise InputError("Give --outputs, a folder.")
    if given["queries"] is not None and given["query_images"] is None:
        raise InputError("--queries is a list of photos: give their folder, --query_images, too.")
    if given["compact"] is not None:
        compact.check_output(given["compact"])
        if given["map"] is not None and maps.is_compact(given["map"]):
            raise InputError(f"--map {given['map']} is a compact map: leave out --compact.")


def _main() -> None:
    given = options.parse(_parser())
    change = {name: given.pop(name) for name in changes.NAMES}
    _check(given, any(change.values()))
    profiled = given.pop("profile") and given["outputs"] is not None
    trace_file = given["outputs"] / "trace.json" if profiled else None
    with trace.recording(trace_file):
        if any(change.values()):
            folder = given["map"]
            changes.check(given, **change)
            built = open_map(folder, model_or_map=folder, **{name: given[name] for name in OF_MAP})
            if given["outputs"] is None:  # the map is not opened again
                built.warn()
            changes.main(folder, **change)
        if given["outputs"] is not None:
            _run(given)
        elif given["compact"] is not None:
            compact.main(given["compact"], given["map"])


def _run(given: dict) -> None:
    """Build or open the map, and localize the queries in it."""
    outputs, query_images, queries = (given.pop(k) for k in ("outputs", "query_images", "queries"))
    of_queries = {name: given.pop(name) for name in ("num_loc", "ground_truth", "strict", "gate")}
    small = given.pop("compact")
    built = open_map(outputs, model_or_map=given.pop("map"), **given)
    if given["map_images"] is None and given["database"] is None:  # others warn as they are built
        built.warn()
    if small is not None:
        compact.main(small, built.folder)
    if query_images is None:
        print(f"The map {built.folder} is ready. Localize photos in it with --query_images.")
        return
    results = results_folder(outputs, query_images, queries)
    summary = main(
        built, query_images, results, queries, overwrite=given["overwrite"], **of_queries
    )
    if built.doubts:
        logger.warning(
            "The map may be wrong, and poses in it may be off by a tenth of the distance or more: "
            "it has %s.",
            " and ".join(built.doubts),
        )
    options.print_result(summary, results, "The poses, camera from world, are in {}.")


if __name__ == "__main__":
    cli.run(_main)
