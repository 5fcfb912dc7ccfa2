"""Localize photos in a map of one's own.

Builds the map from photos and a COLMAP model of them, or from photos alone, once; later runs
localize other photos in it. Without --query_images only the map is built. A new map is of the
feature colmap_sift_sv64 and the matcher NN-ratio if no others are given.
"""

import argparse
import hashlib
import os
import re
from collections import Counter
from pathlib import Path

import pycolmap

from hloc_reduce import (
    aggregate_features,
    extract_features,
    localize_sfm,
    logger,
    maps,
    match_features,
    pairs_from_retrieval,
    reconstruction,
)
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets import DAY_THRESHOLDS, true_poses
from hloc_reduce.detectors.dog import KEYPOINTS
from hloc_reduce.localization import intrinsics
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate
from hloc_reduce.maps.map import RETRIEVAL, Map
from hloc_reduce.runtime import provenance, trace
from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.feature_files import STORAGES
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.parsers import parse_query_lists, write_pairs
from hloc_reduce.utils.paths import strings_as_paths

from . import common

FEATURE, MATCHER = features_confs.RECOMMENDED, "NN-ratio"
MADE_FROM = "made_from.json"  # the map and the photos of queries
LISTED = "queries_with_intrinsics.txt"  # those of a folder
SOURCES = {
    "map": "those of the map's camera, which took them by EXIF data",
    "EXIF": "from EXIF data and refined with the pose",
    "guess": "guessed and refined with the pose",
    "unknown": "guessed and refined with the pose, but sizes not of map photos: perhaps cropped",
}
NOT_IN_NAMES = r"[^\w.-]+"  # of a glob


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
) -> Map:
    """Build a map in `outputs`, or open one that was built before.

    Args:
        outputs: its folder map is that of a new map.
        map_images: folder of the photos of the map; None to open a map that was built.
        model_or_map: COLMAP model of the photos, or that map.
        feature: default: colmap_sift_sv64 for a new map; any other than that of an old one is
            refused.
        projection: of one's own.
        matcher: likewise, NN-ratio.
        num_covis: pairs of each map image.
        overwrite: build anew.
        storage: of descriptors; likewise, float16.
        keypoints: settings of the DoG detector; likewise, adaptive.
        accept_partial: as of `maps.main`.
        camera_mode: which photos share a camera, as in COLMAP; default: auto.
    """
    if camera_mode is not None:
        mode = colmap.camera_mode(camera_mode)
        if map_images is None or model_or_map is not None:
            raise InputError("--camera_mode is for maps of photos alone: leave it or --map out.")
    else:
        mode = colmap.camera_mode("auto")
    if map_images is None:
        if model_or_map is None:
            raise InputError("Give --map_images, the folder of the photos to build a map of.")
        if any(model_or_map.glob("cameras.*")):
            raise InputError(
                f"{model_or_map} is a COLMAP model: give its photos, --map_images, too."
            )
        built = Map(model_or_map)
        if feature or projection:
            built.check_feature(feature or FEATURE, projection)
        if storage not in (None, built.storage):
            raise InputError(f"The map {model_or_map} is of --storage {built.storage}.")
        if keypoints not in (None, built.keypoints):
            raise InputError(f"The map {model_or_map} is of --keypoints {built.keypoints}.")
        if matcher not in (None, built.matcher):
            raise InputError(f"The map {model_or_map} is of --matcher {built.matcher}.")
        return built
    if model_or_map is not None and maps.is_map(model_or_map):
        raise InputError(
            f"--map {model_or_map} is a map that was built: leave out --map_images to localize in "
            "it, or give the COLMAP model that it was built from."
        )
    return maps.main(
        outputs / "map",
        map_images,
        model_or_map,
        feature or FEATURE,
        projection,
        matcher or MATCHER,
        num_covis,
        overwrite,
        storage or STORAGES[0],
        keypoints or KEYPOINTS[0],
        accept_partial,
        mode,
    )


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
    """Localize queries in a map and return the summary, as in summary.json."""
    matcher_conf = matchers_confs.confs[built.matcher]
    given, cameras = queries, {}
    if given is None:
        names = list_images(query_images)
        lists = {query_images.resolve().name: names}
        cameras = _infer(query_images, names, built.cameras, strict)
        queries = outputs / LISTED
    else:
        parts = parse_query_lists(queries)
        lists = {stem: [name for name, _ in part] for stem, part in parts.items()}
    names = [name for part in lists.values() for name in part]
    common.check_queries(query_images, names, strict)
    map_names = built.names()  # a broken model is to be found before photos are read
    truth = true_poses(names, ground_truth, True) if ground_truth else {}

    made_from = outputs / MADE_FROM
    before = provenance.read(made_from)
    files = {name: query_images / name for name in names}
    files = {
        name: file for name, file in files.items() if file.is_file() and os.access(file, os.R_OK)
    }
    now = {"map": built.id, "queries": provenance.fingerprints(files, before.get("queries", {}))}
    changed = provenance.changed(before.get("queries", {}), now["queries"])
    if before and before.get("map") != now["map"]:
        changed.append(f"the map {built.folder}")
    if changed:
        logger.info("Localizing anew, because of changes: %s.", ", ".join(changed))
    with RunFolder(
        outputs,
        {
            "map": built.place,
            "query_images": str(query_images.resolve()),
            "queries": str(queries.resolve()),
            "num_loc": num_loc,
        },
        overwrite,
        inputs=[query_images, *([given] if given else [])],
        stale=bool(changed),
    ) as folder:
        if not changed:  # photos that are not in this list may be in the next
            now["queries"] = {**before.get("queries", {}), **now["queries"]}
        provenance.write(made_from, now)
        sources = dict.fromkeys(names, "list") if given else {}
        sources |= {name: source for name, (_, source) in cameras.items()}
        if given is None:
            intrinsics.write_queries(cameras, queries)
        for source, said in SOURCES.items():
            if some := [name for name in names if sources.get(name) == source]:
                logger.info("Intrinsics of %d queries are %s: %s", len(some), said, cli.some(some))
        loc_pairs = outputs / f"pairs-query-vlad{num_loc}.txt"
        poses = outputs / f"poses_hloc_{built.feature}+{built.matcher}_vlad{num_loc}.txt"

        with folder.stage("extract_features"):
            features = extract_features.main(
                built.conf, query_images, outputs, image_list=names, strict=strict
            )
            readable = common.readable(features, names)
        # when another one has been read, what is finished of these stays
        failed = failures(features)
        now["queries"] = {name: made for name, made in now["queries"].items() if name not in failed}
        provenance.write(made_from, now)
        with folder.stage("retrieval"):
            descriptors = aggregate_features.main(RETRIEVAL, features, vocabulary=built.vocabulary)
            if readable:
                pairs_from_retrieval.main(
                    descriptors,
                    loc_pairs,
                    num_loc,
                    query_list=readable,
                    db_list=map_names,
                    db_descriptors=built.descriptors,
                )
            else:
                write_pairs([], loc_pairs)
        with folder.stage("match_queries"):
            matches = outputs / f"{features.stem}_{matcher_conf['output']}_{loc_pairs.stem}.h5"
            if readable:
                match_features.main(
                    matcher_conf, loc_pairs, features, matches=matches, features_ref=built.features
                )
        with folder.stage("localization"):
            records = localize_sfm.main(
                built.sfm,
                given or [(name, cameras[name][0] if name in cameras else None) for name in names],
                loc_pairs,
                features,
                matches,
                poses,
                refinements={
                    name: intrinsics.REFINEMENTS[source]
                    for name, source in sources.items()
                    if source != "list"
                },
                full_names=True,
                gate=gate,
            )
        summary = {
            "feature": built.feature,
            "matcher": built.matcher,
            "retrieval": "vlad",
            "map": str(built.folder),
            "num_loc": num_loc,
            "map_images": built.num_images,
            "map_points3D": built.num_points3D,
            "intrinsics": Counter(sources.values()),
        }
        limits = dict.fromkeys(lists, DAY_THRESHOLDS)
        files = {
            "query_images": query_images,
            "map_images": built.images,
            "map_features": built.features,
            "map": built.sfm,
            "pairs": loc_pairs,
            "matches": matches,
            "ground_truth": ground_truth,
        }
        return common.finish(folder, summary, lists, records, truth, limits, features, poses, files)


def _infer(
    query_images: Path, names: list[str], of_map: intrinsics.MapCameras, strict: bool
) -> dict[str, tuple[pycolmap.Camera, str]]:
    """Infer the intrinsics of photos, unless `strict` without those that cannot be read."""
    cameras = {}
    for name in names:
        try:
            cameras[name] = intrinsics.infer(query_images / name, of_map)
        except InputError:
            if strict:
                raise
    return cameras


def results_folder(outputs: Path, query_images: Path, queries: Path | None) -> Path:
    """Return the folder for the results of queries, which is called by their list or folder.

    Where that is of other queries of the same name, a digest of their path follows the name.

    Args:
        outputs: the folder for it.
        query_images: folder of the photos.
        queries: their list, if there is one.
    """
    name = (queries or query_images.resolve()).stem
    name = re.sub(NOT_IN_NAMES, "_", name).strip("._-")
    folder = outputs / f"queries-{name or 'all'}"
    before = provenance.read(folder / "conf.json")
    own = {"query_images": str(query_images.resolve())}
    own["queries"] = str((queries or folder / LISTED).resolve())
    if any(before.get(key, value) != value for key, value in own.items()):
        where = f"{own['query_images']}\n{queries and own['queries']}"
        folder = folder.with_name(f"{folder.name}-{hashlib.sha256(where.encode()).hexdigest()[:8]}")
    return folder


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m pipelines.localize --map sparse --map_images photos "
        "--query_images new --outputs outputs/place",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument(
        "--map",
        type=Path,
        metavar="MODEL|MAP",
        help="COLMAP model of the photos in --map_images, or a map that was built before",
    )
    parser.add_argument(
        "--map_images", type=Path, help="photos of the map; without --map they are reconstructed"
    )
    parser.add_argument("--query_images", type=Path, help="folder of the photos to localize")
    parser.add_argument(
        "--queries",
        type=Path,
        help="query list with intrinsics, or a glob of several (default: all photos of "
        "--query_images, with intrinsics of EXIF data or guessed)",
    )
    parser.add_argument(
        "--outputs",
        type=Path,
        help="folder for the map, in map, and for the results, in queries-<name of --queries or "
        "--query_images>, and some letters where the queries of another folder have that name",
    )
    parser.add_argument(
        "--num_covis", type=int, default=20, help="other images that each map image is matched with"
    )
    reconstruction.add_camera_mode(parser)
    common.add_feature_options(parser)
    common.add_localization_options(parser, "none", 50)
    # None: those of a map that was built
    parser.set_defaults(feature=None, matcher=None, storage=None, keypoints=None, camera_mode=None)
    args = parser.parse_args()
    common.check_options(args)
    if args.storage is not None:
        cli.choose("storage", args.storage, STORAGES)
    if args.keypoints is not None:
        cli.choose("keypoints", args.keypoints, KEYPOINTS)
    if args.outputs is None:
        raise InputError("Give --outputs, a folder.")
    if args.queries is not None and args.query_images is None:
        raise InputError("--queries is a list of photos: give their folder, --query_images, too.")
    with trace.recording(args.outputs / "trace.json" if args.profile else None):
        _run(args)


def _run(args: argparse.Namespace) -> None:
    built = open_map(
        args.outputs,
        args.map_images,
        args.map,
        args.feature,
        args.projection,
        args.matcher,
        args.num_covis,
        args.overwrite,
        args.storage,
        args.keypoints,
        args.accept_partial,
        args.camera_mode,
    )
    if args.query_images is None:
        print(f"The map {built.folder} is there. Localize photos in it with --query_images.")
        return
    outputs = results_folder(args.outputs, args.query_images, args.queries)
    summary = main(
        built,
        args.query_images,
        outputs,
        args.queries,
        args.num_loc,
        args.ground_truth,
        args.overwrite,
        args.strict,
        Gate(args.min_confidence, args.min_inliers),
    )
    common.print_result(summary, outputs, "The poses, camera from world, are in {}.")


if __name__ == "__main__":
    cli.run(_main)
