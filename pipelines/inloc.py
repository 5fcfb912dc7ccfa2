"""Localize the queries of InLoc, or of any RGB-D place in its layout.

Extracts features, retrieves cutouts for each query, lifts their keypoints to 3D by the scans and
estimates the pose of the query. An interrupted run resumes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hloc_reduce import localize_inloc
from hloc_reduce.confs import features as features_confs
from hloc_reduce.datasets import INLOC_THRESHOLDS
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.utils import cli
from hloc_reduce.utils.options import Parser, taken
from hloc_reduce.utils.paths import strings_as_paths

from .common import command
from .common.dataset import SHARED_POINTS, DatasetRun
from .common.options import DatasetOptions, Positive


@dataclass(frozen=True, kw_only=True)
class Options(DatasetOptions):
    """The options of the pipeline.

    Args:
        ground_truth: true poses of the queries; default: <dataset>/ground_truth_poses.txt.
        num_loc: retrieved cutouts per query.
        features: feature file to use instead of extracting features. The 3D points of its
            keypoints are kept in points3D.h5 beside it, which all feature files there share and
            which `overwrite` does not delete.
    """

    num_loc: Positive = 40


@strings_as_paths
def main(
    dataset: Path, outputs: Path, feature: str = features_confs.RECOMMENDED, **options: Any
) -> dict:
    """Run all stages and return the summary, as in summary.json.

    Args:
        dataset: data set folder.
        outputs: folder for the results.
        feature: name of a feature, or its YAML file.
        options: further `Options`.
    """
    given, place = Options(feature=feature, **options), InLoc(dataset)
    points = given.features.with_name(SHARED_POINTS) if given.features else None
    with DatasetRun(place, outputs, given) as run:
        # by all cutouts, so that unreadable ones change no list
        lists = place.buildings(run.query_names, run.truth, run.map_names)
        features = run.extract_features()
        points = points or localize_inloc.points_file(features)
        pairs = run.retrieve()
        matches = run.match("match_queries", pairs, features)
        poses = outputs / f"InLoc_hloc_{run.label}.txt"
        with run.stage("localization"):
            records = localize_inloc.main(
                dataset,
                pairs,
                features,
                matches,
                poses,
                queries=place.queries(features),
                ransac_thresh=place.ransac_thresh,
                executor=given.executor,
                points=points,
                gate=given.gate,
                again=run.again(pairs, features),
                rigs=run.rigs,
            )
        source = "list" if place.query_list.is_file() else "iphone7"
        limits = dict.fromkeys(lists, INLOC_THRESHOLDS)
        intrinsics = {source: len(run.query_names)}
        return run.finish_dataset(
            lists, limits, records, poses, matches, points, intrinsics=intrinsics
        )


@dataclass(frozen=True, kw_only=True)
class Command(command.DatasetCommand):
    """The command line of the pipeline."""

    dataset: Path = Path("datasets/inloc")


def _main() -> None:
    parser = Parser(__doc__, "--feature colmap_sift_sv64 --retrieval pairs-query-netvlad40.txt")
    parser.add(Command)
    parser.add(Options)
    values = command.read(parser)
    called, given = Command(**taken(Command, values)), Options(**taken(Options, values))
    command.run_on_dataset(main, called.dataset, called, given)


if __name__ == "__main__":
    cli.run(_main)
