"""Localize the queries of InLoc, or of any RGB-D place in its layout.

Extracts features, retrieves cutouts for each query, lifts their keypoints to 3D by the scans and
estimates the query's pose; a run that was stopped goes on where it was.
"""

import argparse
from pathlib import Path

from hloc_reduce import extract_features, localize_inloc
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets import INLOC_THRESHOLDS, true_poses
from hloc_reduce.datasets.inloc import InLoc
from hloc_reduce.detectors.dog import KEYPOINTS
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate
from hloc_reduce.runtime import trace
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.utils import cli
from hloc_reduce.utils.feature_files import STORAGES
from hloc_reduce.utils.paths import strings_as_paths

from . import common

NUMBERS = {"num_loc": 40}
Place = InLoc


@strings_as_paths
def main(
    dataset: Path,
    outputs: Path,
    feature: str = features_confs.RECOMMENDED,
    matcher: str = "NN-ratio",
    retrieval: str = "vlad",
    num_loc: int = NUMBERS["num_loc"],
    ground_truth: Path | None = None,
    overwrite: bool = False,
    projection: Path | None = None,
    storage: str = STORAGES[0],
    keypoints: str = KEYPOINTS[0],
    executor: Executor = SERIAL,
    features: Path | None = None,
    strict: bool = False,
    accept_partial: bool = False,
    gate: Gate = DEFAULT_GATE,
) -> dict:
    """Run all stages and return the summary, as in summary.json.

    Takes what the command line takes, and the executor that does the work, and `features`, a file
    of them to use instead of extracting them. What these show is then kept beside it, in
    points3D.h5 of all feature files of that folder, which `overwrite` does not concern.
    """
    feature, feature_conf = features_confs.get(feature, projection, storage, keypoints)
    matcher_conf = matchers_confs.confs[matcher]
    place = InLoc(dataset)
    map_names, query_names = place.map_names(), place.query_names()
    retrieved = common.retrieval_name(retrieval, num_loc)
    loc_pairs = outputs / f"pairs-query-{retrieved}.txt"
    # what is not retrieved needs neither features nor a scan
    used = common.check_retrieval(retrieval, loc_pairs, num_loc, query_names, map_names)
    if features is None:
        common.check_queries(dataset, query_names, strict)
    place.check(used)
    truth_file = ground_truth or place.ground_truth
    truth = true_poses(query_names, truth_file, bool(ground_truth))
    lists = place.buildings(query_names, truth, used)

    numbers = {"num_loc": num_loc}
    with common.run_folder(
        outputs, dataset, feature_conf, matcher_conf, retrieval, numbers, overwrite, features
    ) as folder:
        poses = outputs / f"InLoc_hloc_{feature}+{matcher}_{retrieved}.txt"

        # of all features of a batch
        points = features.with_name("points3D.h5") if features else None
        with folder.stage("extract_features"):
            names = [*used, *query_names]
            features = features or extract_features.main(
                *(feature_conf, dataset, outputs),
                image_list=names,
                executor=executor,
                strict=strict,
            )
            kept = extract_features.keep_readable(features, used, accept_partial)
            if len(kept) < len(used):
                map_names = used = kept
            queries = common.readable(features, query_names)
        with folder.stage("retrieval"):
            common.retrieve(retrieval, features, loc_pairs, num_loc, queries, map_names)
        with folder.stage("match_queries"):
            matches = common.match(matcher_conf, loc_pairs, features, outputs, executor)
        with folder.stage("localization"):
            records = localize_inloc.main(
                dataset,
                loc_pairs,
                features,
                matches,
                poses,
                queries=place.queries(features),
                ransac_thresh=place.ransac_thresh,
                executor=executor,
                points=points,
                gate=gate,
            )

        summary = {
            "feature": feature,
            "matcher": matcher,
            "retrieval": retrieval,
            "dataset": str(dataset),
            **numbers,
            "intrinsics": {"list" if place.query_list.is_file() else "iphone7": len(query_names)},
            "map_images": len(used),
        }
        limits = dict.fromkeys(lists, INLOC_THRESHOLDS)
        files = {
            "query_images": dataset,
            "map_images": dataset,
            "map_features": features,
            "map": points or localize_inloc.points_file(features),
            "pairs": loc_pairs,
            "matches": matches,
            "ground_truth": truth_file if truth else None,
        }
        return common.finish(folder, summary, lists, records, truth, limits, features, poses, files)


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m pipelines.inloc --feature colmap_sift_sv64 "
        "--retrieval pairs-query-netvlad40.txt",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument(
        "--dataset", type=Path, default=Path("datasets/inloc"), help="folder of the data set"
    )
    common.add_dataset_options(
        parser,
        outputs="outputs/<dataset>/<feature>",
        truth="<dataset>/ground_truth_poses.txt",
        num_loc=NUMBERS["num_loc"],
    )
    args = parser.parse_args()
    common.check_options(args)
    feature, _ = features_confs.get(args.feature, args.projection)
    outputs = args.outputs or Path("outputs") / args.dataset.name / feature
    with trace.recording(outputs / "trace.json" if args.profile else None):
        summary = main(
            args.dataset,
            outputs,
            args.feature,
            args.matcher,
            args.retrieval,
            args.num_loc,
            args.ground_truth,
            args.overwrite,
            args.projection,
            args.storage,
            args.keypoints,
            strict=args.strict,
            accept_partial=args.accept_partial,
            gate=Gate(args.min_confidence, args.min_inliers),
        )
    submit = "For recall, submit {} to https://www.visuallocalization.net."
    common.print_result(summary, outputs, submit)


if __name__ == "__main__":
    cli.run(_main)
