"""Localize queries in a COLMAP model: 2D-3D matches through retrieved images, PnP + RANSAC."""

import argparse
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path

import pycolmap

from .localization import stage
from .localization.confidence import DEFAULT_GATE, Gate, add_gate_options
from .localization.query import merged
from .localization.records import to_stamp
from .localization.references import SfmMap
from .runtime import provenance
from .runtime.executors import SERIAL, Executor
from .utils import cli, colmap
from .utils.cli import InputError
from .utils.parsers import parse_query_lists, parse_retrieval
from .utils.paths import strings_as_paths

RANSAC_THRESH = 12.0  # pixels, as in hloc


@strings_as_paths
def main(
    reference_sfm: Path | pycolmap.Reconstruction,
    queries: Path | list[tuple[str, pycolmap.Camera | None]],
    retrieval: Path,
    features: Path,
    matches: Path,
    results: Path,
    ransac_thresh: float = RANSAC_THRESH,
    covisibility_clustering: bool = False,
    prepend_camera_name: bool = False,
    config: dict | None = None,
    overwrite: bool = False,
    refinements: Mapping[str, dict] | None = None,
    full_names: bool = False,
    executor: Executor = SERIAL,
    gate: Gate = DEFAULT_GATE,
) -> dict[str, dict]:
    """Localize all queries of the lists that match a glob.

    Takes what hloc's `localize_sfm.main` takes.

    Args:
        reference_sfm: the map, made from the same features.
        queries: query list with intrinsics, or a glob of several; or names and intrinsics, None
            where these are not known.
        retrieval: pairs of queries and map images, best first.
        features: feature file of the queries.
        matches: match file of the pairs.
        results: text file of poses, one line for every query.
        ransac_thresh: RANSAC inlier threshold in pixels.
        covisibility_clustering: solve each cluster of retrieved images that see common points by
            itself and keep the pose of the highest confidence.
        prepend_camera_name: write `folder/basename` instead of `basename`.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement".
        overwrite: localize anew what is there.
        refinements: for queries whose intrinsics are inexact more options, as in `config`.
        full_names: write whole names instead of `basename`.
        executor: does the work; for a map in memory it is this process.
        gate: what a pose must have for the query to be called localized.

    Returns:
        A record for each query, as `localization.main`. A query without a trusted pose is not
        localized, and its pose is that of `db`, its best retrieved map image.

        The same is kept in `<results>_logs.jsonl`, from which a later run goes on.

    Raises:
        InputError: when an input is missing or broken, or the map is empty.
    """
    if ransac_thresh <= 0:
        raise InputError(f"ransac_thresh is {ransac_thresh}: it must be above 0.")
    retrieved = parse_retrieval(retrieval)
    in_memory = isinstance(reference_sfm, pycolmap.Reconstruction)
    config = {**(config or {})}
    config.setdefault("estimation", {"ransac": {"max_error": ransac_thresh}})

    inputs, options = [retrieval, features, matches], {"config": config}
    if isinstance(queries, Path):
        inputs += sorted(queries.parent.glob(queries.name))
        queries = [query for part in parse_query_lists(queries).values() for query in part]
    else:
        options["queries"] = to_stamp(queries)
    if in_memory:
        load = partial(SfmMap, reference_sfm, covisibility_clustering)
    else:
        if not reference_sfm.is_dir():
            raise InputError(f"There is no COLMAP model folder {reference_sfm}.")
        inputs.append(reference_sfm / "points3D.bin")
        load = partial(
            _load, reference_sfm, covisibility_clustering, reference_sfm.stat().st_mtime_ns
        )
    refinements = refinements or {}
    if refinements:
        options["refinements"] = refinements
    if covisibility_clustering:
        options["covisibility_clustering"] = True
    try:
        return stage.main(
            load,
            queries,
            retrieved,
            features,
            matches,
            results,
            partial(_config, config, refinements),
            provenance.stamp(options, [path for path in inputs if path.exists()]),
            overwrite or in_memory,
            name_parts=None if full_names else 2 if prepend_camera_name else 1,
            executor=SERIAL if in_memory else executor,
            gate=gate,
        )
    finally:
        _load.cache_clear()  # a map may be large


@lru_cache(maxsize=1)  # a process localizes many chunks of queries
def _load(path: Path, covisibility_clustering: bool, written: int) -> "SfmMap":
    """Read the map that was written at a time."""
    return SfmMap(colmap.read_model(path), covisibility_clustering)


def _config(config: dict, refinements: Mapping[str, dict], name: str, _: pycolmap.Camera) -> dict:
    return merged(config, refinements.get(name, {}))


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.localize_sfm --reference_sfm outputs/sfm "
        "--queries queries.txt --retrieval pairs.txt --matches outputs/matches.h5 "
        "--features outputs/feats-dog-colmap_sift_sv64.h5 --results outputs/poses.txt",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--reference_sfm", type=Path, required=True, help="folder of the map")
    parser.add_argument(
        "--queries", type=Path, required=True, help="query list with intrinsics, or a glob"
    )
    parser.add_argument("--retrieval", type=Path, required=True, help="pairs of queries and map")
    parser.add_argument("--features", type=Path, required=True, help="feature file")
    parser.add_argument("--matches", type=Path, required=True, help="match file")
    parser.add_argument("--results", type=Path, required=True, help="text file of poses")
    parser.add_argument(
        "--ransac_thresh",
        type=float,
        default=RANSAC_THRESH,
        help="RANSAC inlier threshold in pixels",
    )
    parser.add_argument(
        "--covisibility_clustering",
        action="store_true",
        help="solve each cluster of retrieved images that see common points by itself",
    )
    parser.add_argument(
        "--prepend_camera_name", action="store_true", help="write folder/basename of each query"
    )
    add_gate_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="localize anew what is there")
    args = vars(parser.parse_args())
    gate = Gate(args.pop("min_confidence"), args.pop("min_inliers"))
    main(**args, gate=gate)


if __name__ == "__main__":
    cli.run(_main)
