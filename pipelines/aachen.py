"""Localize the queries of Aachen Day-Night v1.1, or of any place in its layout.

Extracts features, triangulates a map with the poses of the reference model, retrieves map images
for each query and estimates its pose; a run that was stopped goes on where it was.
"""

import argparse
from pathlib import Path

from confs import features as features_confs
from confs import matchers as matchers_confs
from hloc_reduce import (
    aggregate_features,
    cli,
    demo,
    extract_features,
    extractors,
    localize_sfm,
    logger,
    match_features,
    pairs_from_covisibility,
    pairs_from_retrieval,
    results,
    triangulation,
)
from hloc_reduce.cli import InputError
from hloc_reduce.datasets import Aachen, thresholds
from hloc_reduce.io import list_h5_names
from hloc_reduce.parsers import parse_retrieval
from hloc_reduce.versions import versions

# suffix of a retrieval file -> what makes pairs of it; any other is a text file of pairs
PAIRS_FROM = {".h5": pairs_from_retrieval.main, ".hdf5": pairs_from_retrieval.main}


def main(
    dataset: Path,
    outputs: Path,
    feature: str = "sift_sv64",
    matcher: str = "NN-ratio",
    retrieval: str = "vlad",
    num_covis: int = 20,
    num_loc: int = 50,
    ground_truth: Path | None = None,
    overwrite: bool = False,
    projection: Path | None = None,
) -> dict:
    """Run all stages and return the summary, as in summary.json."""
    feature, feature_conf = features_confs.get(feature, projection)
    matcher_conf = matchers_confs.confs[matcher]
    place = Aachen(dataset)
    map_names, lists = place.map_names(), place.query_lists()
    query_names = [name for queries in lists.values() for name, _ in queries]
    place.check_images([*map_names, *query_names])
    truth = place.true_poses(query_names, ground_truth)
    if retrieval != "vlad" and Path(retrieval).suffix in PAIRS_FROM:
        list_h5_names(Path(retrieval))  # a broken file is refused before any work is done
    elif retrieval != "vlad":
        retrieved = parse_retrieval(Path(retrieval))
        if not any(set(map_names) & set(retrieved.get(name, ())) for name in query_names):
            raise InputError(f"{retrieval} has no pair of a query and a map image.")

    if overwrite or not (outputs / "conf.json").exists():
        extractors.load(feature_conf["model"])  # is wrong before anything is deleted, if it is
    folder = results.RunFolder(
        outputs,
        {
            "dataset": str(dataset.resolve()),
            "feature": extract_features.provenance(feature_conf, as_half=True),
            "matcher": matcher_conf["model"],
            "retrieval": retrieval,
            "num_covis": num_covis,
            "num_loc": num_loc,
        },
        overwrite,
    )
    sfm = outputs / f"sfm_{feature}+{matcher}"
    sfm_pairs = outputs / f"pairs-db-covis{num_covis}.txt"
    loc_pairs = outputs / f"pairs-query-{Path(retrieval).stem}{num_loc}.txt"
    poses = outputs / f"Aachen-v1.1_hloc_{feature}+{matcher}_{Path(retrieval).stem}{num_loc}.txt"

    with folder.stage("extract_features"):
        names = [*map_names, *query_names]
        features = extract_features.main(feature_conf, place.images, outputs, image_list=names)
    with folder.stage("pairs_from_covisibility"):
        pairs_from_covisibility.main(place.reference_model, sfm_pairs, num_covis)
    with folder.stage("match_map"):
        sfm_matches = match_features.main(matcher_conf, sfm_pairs, features.stem, outputs)
    with folder.stage("triangulation"):
        reconstruction = triangulation.main(
            sfm, place.reference_model, place.images, sfm_pairs, features, sfm_matches
        )
    with folder.stage("retrieval"):
        if retrieval == "vlad":
            conf = aggregate_features.confs["vlad"]
            retrieved = aggregate_features.main(conf, features, map_names)
        else:
            retrieved = Path(retrieval)
        select = PAIRS_FROM.get(retrieved.suffix, pairs_from_retrieval.select)
        select(retrieved, loc_pairs, num_loc, query_list=query_names, db_list=map_names)
    with folder.stage("match_queries"):
        loc_matches = match_features.main(matcher_conf, loc_pairs, features.stem, outputs)
    with folder.stage("localization"):
        records = localize_sfm.main(sfm, place.queries, loc_pairs, features, loc_matches, poses)

    rows = results.query_table(lists, records, truth)
    results.write_csv(rows, outputs / "queries.csv")
    summary = {
        "feature": feature,
        "matcher": matcher,
        "retrieval": retrieval,
        "dataset": str(dataset),
        "num_covis": num_covis,
        "num_loc": num_loc,
        "map_images": len(map_names),
        "map_points3D": reconstruction.num_points3D(),
        "queries": len(rows),
        "queries_localized": sum(row["status"] == "localized" for row in rows),
        "lists": {
            name: results.summarize_list(
                [row for row in rows if row["list"] == name],
                thresholds(name),
            )
            for name in lists
        },
        "bytes_per_keypoint": results.bytes_per_keypoint(features, names),
        "seconds": folder.seconds(),
        "versions": versions(),
        "poses": poses.name,
    }
    results.write_summary(summary, outputs / "summary.json")
    return summary


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m pipelines.aachen --feature sift_sv64 --demo",
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
        "--outputs",
        type=Path,
        help="folder for all results, of one configuration (default: outputs/<dataset>/<feature>)",
    )
    parser.add_argument(
        "--feature",
        default="sift_sv64",
        help="local feature, see --list_features, or a YAML file with its configuration",
    )
    parser.add_argument(
        "--projection",
        type=Path,
        help="file of a projection to use with the base descriptor of --feature",
    )
    parser.add_argument(
        "--matcher", default="NN-ratio", help=f"one of {', '.join(matchers_confs.confs)}"
    )
    parser.add_argument(
        "--retrieval",
        default="vlad",
        metavar="vlad|FILE",
        help="vlad, or hloc's text file of pairs or h5 file of global descriptors",
    )
    parser.add_argument("--num_covis", type=int, default=20, help="pairs of each map image")
    parser.add_argument("--num_loc", type=int, default=50, help="map images of each query")
    parser.add_argument(
        "--ground_truth",
        type=Path,
        help="true poses of the queries (default: <dataset>/queries/ground_truth_poses.txt)",
    )
    parser.add_argument("--overwrite", action="store_true", help="compute anew what is there")
    parser.add_argument("--list_features", action="store_true", help="list the features and exit")
    args = parser.parse_args()
    if args.list_features:
        print("\n".join(features_confs.confs))
        return
    feature, _ = features_confs.get(args.feature, args.projection)
    cli.choose("matcher", args.matcher, matchers_confs.confs)
    if args.retrieval != "vlad" and not Path(args.retrieval).is_file():
        raise InputError(f"--retrieval {args.retrieval}: neither vlad nor a file that is there.")
    for option in ("num_covis", "num_loc"):
        if getattr(args, option) < 1:
            raise InputError(f"--{option} {getattr(args, option)}: at least 1.")
    default = "datasets/demo_town" if args.demo else "datasets/aachen_v1.1"
    dataset = args.dataset or Path(default)
    outputs = args.outputs or Path("outputs") / dataset.name / feature
    if args.demo:
        demo.main(dataset)
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
    )
    logger.info(
        "Localized %d of %d queries in %.0f s; %d bytes a descriptor. Results are in %s.",
        summary["queries_localized"],
        summary["queries"],
        sum(summary["seconds"].values()),
        summary["bytes_per_keypoint"]["descriptor"],
        outputs,
    )
    if any("recall_percent" in result for result in summary["lists"].values()):
        print(results.recall_table(feature, summary["lists"]))
    else:
        print(
            "The true poses are not known here. For recall, submit "
            f"{outputs / summary['poses']} to https://www.visuallocalization.net."
        )


if __name__ == "__main__":
    cli.run(_main)
