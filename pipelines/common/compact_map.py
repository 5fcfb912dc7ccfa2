"""Localize the queries of a data set in a compact map, as `pipelines.localize` does."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from hloc_reduce import compact, localize_sfm, logger, maps
from hloc_reduce.aggregate_features import vocabulary_if_any
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.datasets import ModelPlace
from hloc_reduce.hlm.reader import SUFFIX
from hloc_reduce.hlm.writer import Source
from hloc_reduce.localization import intrinsics
from hloc_reduce.maps.map import Map
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError

from .dataset import DatasetRun
from .retrieval import retrieve_in_map
from .run import Run, Thresholds, readable

FILE = f"map{SUFFIX}"


def check(is_compact: bool, max_mb: float | None, retrieval: str, matcher: str | None) -> None:
    """Raise an InputError for options that do not go together."""
    if max_mb is not None and not is_compact:
        raise InputError(f"--max_mb {max_mb:g} is the size of a compact map: give --compact, too.")
    if is_compact and retrieval not in retrieval_confs.confs:
        raise InputError(
            "Images of a compact map are retrieved by what is in it: leave out --retrieval, or "
            f"choose one of {', '.join(retrieval_confs.confs)}."
        )
    if is_compact and matcher and matcher != matchers_confs.NN_LIGHTGLUE:
        compact.check_matcher(matcher)


def folder(outputs: Path, is_compact: bool, max_mb: float | None) -> Path:
    """Return the folder for the results of a run: in the outputs folder for a compact map."""
    if not is_compact:
        return outputs
    return outputs / ("compact" if max_mb is None else f"compact-{max_mb:g}MB")


def main(
    run: DatasetRun,
    place: ModelPlace,
    sfm: Path,
    max_mb: float | None,
    lists: Mapping[str, Iterable[str]],
    limits: Thresholds,
) -> dict:
    """Pack the map of a run into a file, localize the queries in it and return the summary.

    The file and the results are in a folder of the run's outputs folder, whose features they share.
    They are stale if the map or its packing has changed.

    Args:
        run: the run, with features, map and global descriptors.
        place: its data set.
        sfm: its map.
        max_mb: size of the file in 1,000,000 bytes.
        lists: the queries of each list.
        limits: the recall thresholds of each list.

    Raises:
        InputError: when `max_mb` is too small.
    """
    outputs = folder(run.folder.path, True, max_mb)
    made_from = provenance.of_inputs({"packed": compact.PACKED}, [sfm / "points3D.bin"])
    is_old = (outputs / provenance.MADE_FROM).exists()
    if stale := is_old and not provenance.is_current(outputs / provenance.MADE_FROM, made_from):
        logger.info("Results in %s are stale, as the map or its packing has changed.", outputs)
    results = RunFolder(outputs, {"max_mb": max_mb}, overwrite=False, stale=stale)
    steps = compact.matcher_of(run.steps[0]), *run.steps[1:]
    matcher = run.matcher if run.steps[1:] else steps[0]
    with Run(results, run.feature, matcher, steps, run.executor, run.folder) as part:
        provenance.write(outputs / provenance.MADE_FROM, made_from)
        built = _pack(run, part, place, sfm, max_mb)
        features, num_loc = run.features, run.options.num_loc
        retrieved = f"{built.retrieval}{num_loc}"
        pairs = outputs / f"pairs-query-{retrieved}.txt"
        with part.stage("retrieval"):
            queries = readable(features, run.query_names)
            retrieve_in_map(built, features, pairs, num_loc, queries, built.names(), place.images)
        matches = part.match("match_queries", pairs, features, built.features)
        poses = outputs / f"{place.results}_hloc_{run.feature}+{matcher}_{retrieved}.txt"
        with part.stage("localization"):
            records = localize_sfm.main(
                built.sfm,
                place.queries,
                pairs,
                features,
                matches,
                poses,
                full_names=place.full_names,
                executor=run.executor,
                gate=run.options.gate,
                again=part.again(pairs, features, built.features),
                rigs=run.rigs,
                match_rigs=part.match_rigs(pairs, features, built.features),
            )
        files = run.files(built.features, built.sfm, pairs, matches)
        summary = run.summary(
            compact=FILE,
            map_images=built.num_images,
            map_points3D=built.num_points3D,
            map_bytes=(outputs / FILE).stat().st_size,
        )
        return part.finish(summary, lists, records, run.truth, limits, features, poses, files)


def _pack(run: DatasetRun, part: Run, place: ModelPlace, sfm: Path, max_mb: float | None) -> Map:
    """Pack a map into a file, unless that is there, and unpack it, in which stages localize."""
    file = part.folder.path / FILE
    with part.stage("compact"):
        if not file.exists():
            model = colmap.read_model(sfm)
            retrieval = run.options.retrieval
            source = Source(
                model,
                run.feature,
                run.conf,
                run.steps[0],
                run.global_descriptors,
                vocabulary_if_any(retrieval_confs.get(retrieval), run.global_descriptors),
                intrinsics.of_map(model, place.images),
                retrieval=retrieval,
                made_from=colmap.fingerprint(sfm),
            )
            compact.write(file, source, run.features, max_mb=max_mb)
        return maps.unpack(file, part.folder.path / "map")
