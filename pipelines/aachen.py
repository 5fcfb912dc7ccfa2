"""Localize the queries of Aachen Day-Night v1.1, or of any place in its layout.

Extracts features, triangulates a map with the poses of the reference model, retrieves map images
for each query and estimates its pose; a run that was stopped goes on where it was.
"""

import argparse
from pathlib import Path

from hloc_reduce import demo, extract_features, localize_sfm, pairs_from_covisibility, triangulation
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.datasets import thresholds, true_poses
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.detectors.dog import KEYPOINTS
from hloc_reduce.localization.confidence import DEFAULT_GATE, Gate
from hloc_reduce.runtime import trace
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.feature_files import STORAGES
from hloc_reduce.utils.paths import strings_as_paths

from . import common

NUMBERS = {"num_covis": 20, "num_loc": 50}
Place = Aachen


@strings_as_paths
def main(
    dataset: Path,
    outputs: Path,
    feature: str = features_confs.RECOMMENDED,
    matcher: str = "NN-ratio",
    retrieval: str = "vlad",
    num_covis: int = NUMBERS["num_covis"],
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
    of them to use instead of extracting them.
    """
    feature, feature_conf = features_confs.get(feature, projection, storage, keypoints)
    matcher_conf = matchers_confs.confs[matcher]
    place = Aachen(dataset)
    map_names = place.map_names()
    lists = {name: [query for query, _ in part] for name, part in place.query_lists().items()}
    query_names = [name for part in lists.values() for name in part]
    place.check([] if accept_partial else map_names)
    number = len(map_names)
    map_names = extract_features.keep_present(place.images, map_names, accept_partial)
    if features is None:
        common.check_queries(place.images, query_names, strict)
    truth_file = ground_truth or place.ground_truth
    truth = true_poses(query_names, truth_file, bool(ground_truth))
    retrieved = common.retrieval_name(retrieval, num_loc)
    loc_pairs = outputs / f"pairs-query-{retrieved}.txt"
    common.check_retrieval(retrieval, loc_pairs, num_loc, query_names, map_names)

    numbers = {"num_covis": num_covis, "num_loc": num_loc}
    with common.run_folder(
        outputs, dataset, feature_conf, matcher_conf, retrieval, numbers, overwrite, features
    ) as folder:
        sfm = outputs / f"sfm_{feature}+{matcher}"
        sfm_pairs = outputs / f"pairs-db-covis{num_covis}.txt"
        poses = outputs / f"Aachen-v1.1_hloc_{feature}+{matcher}_{retrieved}.txt"

        with folder.stage("extract_features"):
            names = [*map_names, *query_names]
            features = features or extract_features.main(
                *(feature_conf, place.images, outputs),
                image_list=names,
                executor=executor,
                strict=strict,
            )
            map_names = extract_features.keep_readable(features, map_names, accept_partial)
            queries = common.readable(features, query_names)
        reference = place.reference_model
        if len(map_names) < number:
            reference = colmap.write_part(reference, set(map_names), outputs / "sfm_reference")
        with folder.stage("pairs_from_covisibility"):
            pairs_from_covisibility.main(reference, sfm_pairs, num_covis)
        with folder.stage("match_map"):
            sfm_matches = common.match(matcher_conf, sfm_pairs, features, outputs, executor)
        with folder.stage("triangulation"):
            reconstruction = triangulation.main(
                sfm, reference, place.images, sfm_pairs, features, sfm_matches
            )
        with folder.stage("retrieval"):
            common.retrieve(retrieval, features, loc_pairs, num_loc, queries, map_names)
        with folder.stage("match_queries"):
            loc_matches = common.match(matcher_conf, loc_pairs, features, outputs, executor)
        with folder.stage("localization"):
            records = localize_sfm.main(
                sfm,
                place.queries,
                loc_pairs,
                features,
                loc_matches,
                poses,
                executor=executor,
                gate=gate,
            )

        summary = {
            "feature": feature,
            "matcher": matcher,
            "retrieval": retrieval,
            "dataset": str(dataset),
            **numbers,
            "map_images": len(map_names),
            "map_points3D": reconstruction.num_points3D(),
        }
        limits = {name: thresholds(name) for name in lists}
        files = {
            "query_images": place.images,
            "map_images": place.images,
            "map_features": features,
            "map": sfm,
            "pairs": loc_pairs,
            "matches": loc_matches,
            "ground_truth": truth_file if truth else None,
        }
        return common.finish(folder, summary, lists, records, truth, limits, features, poses, files)


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m pipelines.aachen --feature colmap_sift_sv64 --demo",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument(
        "--dataset", type=Path, help="folder of the data set (default: datasets/aachen_v1.1)"
    )
    parser.add_argument(
        "--demo",
        action="store_true",
        help="render a small town in the data set's layout and localize there "
        "(default --dataset: datasets/demo_town)",
    )
    parser.add_argument(
        "--num_covis",
        type=int,
        default=NUMBERS["num_covis"],
        help="other images that each map image is matched with",
    )
    common.add_dataset_options(
        parser,
        outputs="outputs/<dataset>/<feature>",
        truth="<dataset>/queries/ground_truth_poses.txt",
        num_loc=NUMBERS["num_loc"],
    )
    args = parser.parse_args()
    common.check_options(args)
    # raise for wrong options before the demo is rendered
    feature, _ = features_confs.get(args.feature, args.projection, args.storage, args.keypoints)
    gate = Gate(args.min_confidence, args.min_inliers)
    default = "datasets/demo_town" if args.demo else "datasets/aachen_v1.1"
    dataset = args.dataset or Path(default)
    outputs = args.outputs or Path("outputs") / dataset.name / feature
    if args.demo:
        demo.main(dataset)
    with trace.recording(outputs / "trace.json" if args.profile else None):
        summary = main(
            dataset,
            outputs,
            args.feature,
            args.matcher,
            args.retrieval,
            args.num_covis,
            args.num_loc,
            args.ground_truth,
            args.overwrite,
            args.projection,
            args.storage,
            args.keypoints,
            strict=args.strict,
            accept_partial=args.accept_partial,
            gate=gate,
        )
    submit = "For recall, submit {} to https://www.visuallocalization.net."
    common.print_result(summary, outputs, submit)


if __name__ == "__main__":
    cli.run(_main)
