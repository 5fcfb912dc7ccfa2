"""Localize queries in a COLMAP model: 2D-3D matches through retrieved images, PnP + RANSAC."""

from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import pycolmap

from .localization import stage
from .localization.gate import DEFAULT_GATE, Gate
from .localization.intrinsics import to_lists
from .localization.mirrored import MirrorImages
from .localization.query import merged, ransac_options
from .localization.references import SfmMap
from .localization.rigs import Frames
from .runtime import provenance
from .runtime.executors import SERIAL, Executor
from .utils import cli, colmap, options
from .utils.options import HIDDEN
from .utils.parsers import parse_retrieval
from .utils.paths import strings_as_paths

RANSAC_THRESH = 12.0  # pixels, as in hloc


@strings_as_paths
def main(
    reference_sfm: Path | pycolmap.Reconstruction,
    queries: Path | Sequence[tuple[str, pycolmap.Camera | None]],
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
    full_names: Annotated[bool, HIDDEN] = False,
    executor: Executor = SERIAL,
    gate: Gate = DEFAULT_GATE,
    mirror_images: MirrorImages | None = None,
    again: Sequence[stage.Try] = (),
    rigs: Annotated[Frames, HIDDEN] = MappingProxyType({}),
    match_rigs: stage.MatchRigs | None = None,
) -> dict[str, dict]:
    """Localize queries in a COLMAP model.

    Takes the arguments of hloc's `localize_sfm.main`.

    Args:
        reference_sfm: folder of the map, made from the same features; in Python, also the map.
        queries: query list with intrinsics, or a glob of several; in Python, also names and
            intrinsics, None if these are not known.
        retrieval: text file of pairs of queries and map images, best first.
        features: feature file of the queries.
        matches: match file of the pairs.
        results: text file of poses, one line for every query.
        ransac_thresh: RANSAC inlier threshold in pixels; larger in proportion in photos whose
            longer side exceeds 1,600 pixels. A threshold in the config is taken as it is.
        covisibility_clustering: localize in each cluster of retrieved images that see common points
            separately, and keep the pose with the highest confidence.
        prepend_camera_name: write folder/basename of each query instead of its basename.
        config: hloc's dict of options of pycolmap, under "estimation" and "refinement".
        overwrite: localize all queries again.
        refinements: more options, as in `config`, for queries with inexact intrinsics.
        full_names: write whole names instead of `basename`.
        executor: runs the localization; with a reconstruction in memory, this process does.
        gate: what a pose must have for the query to be called localized.
        mirror_images: extracts and matches mirror images of queries, see `localization.stage.main`.
        again: how queries that are not localized are matched once more, see
            `localization.stage.main`.
        rigs: queries of which one pose is estimated together, see `localization.stage.main`.
        match_rigs: matches photos of rigs once more, see `localization.stage.main`.

    Returns:
        A record for each query, as `localization.stage.main` returns it and keeps it in
        `<results>_logs.jsonl`, from which a later run resumes. A query that is not localized has
        the pose of its best retrieved map image, `db`.

    Raises:
        InputError: if an input is missing or broken, or the map is empty.
    """
    stage.check_threshold(ransac_thresh)
    config = config or {}
    retrieved = parse_retrieval(retrieval)
    inputs = [retrieval, features, matches]
    estimation = {"ransac": {"max_error": ransac_thresh}}
    options: dict[str, object] = {"config": {"estimation": estimation} | config}
    if isinstance(queries, Path):
        inputs += sorted(queries.parent.glob(queries.name))
        listed: Sequence[tuple[str, pycolmap.Camera | None]] = stage.read_queries(queries)
    else:
        listed = queries
        options["queries"] = to_lists(queries)
    if isinstance(reference_sfm, pycolmap.Reconstruction):
        load = partial(SfmMap, reference_sfm, covisibility_clustering)
        overwrite, executor = True, SERIAL
    else:
        inputs += colmap.model_files(reference_sfm)
        written = reference_sfm.stat().st_mtime_ns
        load = partial(_load, reference_sfm, covisibility_clustering, written)
    if refinements:
        options["refinements"] = refinements
    if covisibility_clustering:
        options["covisibility_clustering"] = True
    try:
        return stage.main(
            load,
            listed,
            retrieved,
            features,
            matches,
            results,
            partial(_config, ransac_thresh, config, refinements or {}),
            provenance.of_inputs(options, [path for path in inputs if path.exists()]),
            overwrite,
            name_parts=None if full_names else 2 if prepend_camera_name else 1,
            executor=executor,
            gate=gate,
            mirror_images=mirror_images,
            again=again,
            rigs=rigs,
            match_rigs=match_rigs,
        )
    finally:
        _load.cache_clear()  # a map may be large


@lru_cache(maxsize=1)  # a process localizes many chunks of queries
def _load(path: Path, covisibility_clustering: bool, written: int) -> SfmMap:
    """Read the map that was written at a time."""
    return SfmMap(colmap.read_model(path), covisibility_clustering)


def _config(
    ransac_thresh: float,
    config: dict,
    refinements: Mapping[str, dict],
    name: str,
    camera: pycolmap.Camera,
) -> dict:
    return merged(ransac_options(ransac_thresh, camera) | config, refinements.get(name, {}))


def _main() -> None:
    example = (
        "--reference_sfm outputs/sfm --queries queries.txt --retrieval pairs.txt "
        "--matches outputs/matches.h5 --features outputs/feats-dog-colmap_sift_sv64.h5 "
        "--results outputs/poses.txt"
    )
    options.call(main, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
