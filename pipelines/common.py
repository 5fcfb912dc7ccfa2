"""What the pipelines share: options, retrieval, and what a run leaves behind."""

import argparse
import hashlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import pycolmap

from hloc_reduce import (
    aggregate_features,
    extract_features,
    logger,
    match_features,
    pairs_from_retrieval,
)
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.evaluation.summaries import (
    bytes_per_keypoint,
    query_table,
    recall_table,
    summarize_list,
    write_summary,
)
from hloc_reduce.localization.confidence import add_gate_options
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.runtime.outputs import RunFolder
from hloc_reduce.runtime.versions import versions
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.files import delete, write_csv
from hloc_reduce.utils.h5 import get_text, list_h5_names, open_h5
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.parsers import parse_pairs, parse_retrieval, write_pairs

# suffix of a retrieval file -> what makes pairs of it; any other is a text file of pairs
PAIRS_FROM = {".h5": pairs_from_retrieval.main, ".hdf5": pairs_from_retrieval.main}


def add_dataset_options(
    parser: argparse.ArgumentParser, outputs: str, truth: str, num_loc: int
) -> None:
    """Add the options of the pipelines of data sets.

    Args:
        parser: to add to.
        outputs: the default of --outputs, in words.
        truth: the default of --ground_truth, in words.
        num_loc: the default of --num_loc.
    """
    parser.add_argument(
        "--outputs",
        type=Path,
        help=f"folder for all results, of one configuration (default: {outputs})",
    )
    add_feature_options(parser)
    parser.add_argument(
        "--retrieval",
        default="vlad",
        metavar="vlad|FILE",
        help="vlad, or hloc's text file of pairs or h5 file of global descriptors",
    )
    add_localization_options(parser, truth, num_loc)


def add_feature_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of features and their matching."""
    parser.add_argument(
        "--feature",
        default=features_confs.RECOMMENDED,
        help="local feature, see --list_features, or a YAML file with its configuration",
    )
    parser.add_argument(
        "--projection",
        type=Path,
        help="file of a projection to use with the base descriptor of --feature",
    )
    features_confs.add_storage_option(parser)
    features_confs.add_keypoints_option(parser)
    parser.add_argument(
        "--matcher", default="NN-ratio", help=f"one of {', '.join(matchers_confs.confs)}"
    )
    parser.add_argument("--list_features", action="store_true", help="list the features and exit")


def add_localization_options(parser: argparse.ArgumentParser, truth: str, num_loc: int) -> None:
    """Add the options of localization; `truth` is the default of --ground_truth, in words."""
    parser.add_argument("--num_loc", type=int, default=num_loc, help="map images of each query")
    parser.add_argument(
        "--ground_truth", type=Path, help=f"true poses of the queries (default: {truth})"
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="fail at a query photo that cannot be read, instead of recording it as not localized",
    )
    parser.add_argument(
        "--accept_partial",
        action="store_true",
        help="do without map photos that are missing, cannot be read or, in a map of photos alone, "
        "could not be reconstructed",
    )
    add_gate_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="compute anew what is there")
    parser.add_argument(
        "--profile",
        action="store_true",
        help="write trace.json, of what ran when, for https://ui.perfetto.dev",
    )


def check_options(args: argparse.Namespace) -> None:
    """Check options of any pipeline.

    Raises:
        InputError: for a wrong one.
        SystemExit: after the features are listed.
    """
    if args.list_features:
        print(features_confs.table())
        raise SystemExit(0)
    if args.matcher is not None:
        cli.choose("matcher", args.matcher, matchers_confs.confs)
    retrieval = vars(args).get("retrieval", "vlad")
    if retrieval != "vlad" and not Path(retrieval).is_file():
        raise InputError(f"--retrieval {retrieval}: neither vlad nor a file that is there.")
    cli.check_positive(args, *(option for option in vars(args) if option.startswith("num_")))


def retrieval_name(retrieval: str, num_loc: int) -> str:
    """Return what files are called after: `netvlad40` of `pairs-query-netvlad50.txt` and 40."""
    name = Path(retrieval).stem.removeprefix("pairs-query-")
    return f"{name.rstrip('0123456789')}{num_loc}"


def check_retrieval(
    retrieval: str, output: Path, num_loc: int, query_names: list[str], map_names: list[str]
) -> list[str]:
    """Refuse a broken file, or one of other images, or `output`, before any work is done.

    Returns:
        The map images that may be retrieved: those of a list of pairs, or else all.
    """
    if retrieval == "vlad":
        return map_names
    if Path(retrieval).resolve() == output.resolve():
        raise InputError(f"--retrieval {retrieval} would be overwritten: move it elsewhere.")
    if Path(retrieval).suffix in PAIRS_FROM:
        list_h5_names(Path(retrieval))
        return map_names
    pairs, names = parse_retrieval(Path(retrieval)), set(map_names)
    found = [[other for other in pairs.get(name, ()) if other in names] for name in query_names]
    if not any(found):
        raise InputError(f"{retrieval} has no pair of a query and a map image.")
    return sorted({other for others in found for other in others[:num_loc]})


def check_queries(image_dir: Path, names: list[str], strict: bool) -> None:
    """Refuse queries none of which is there, or if `strict` one that is not.

    Raises:
        InputError: as said.
    """
    if strict or not any((image_dir / name).is_file() for name in names):
        list_images(image_dir, names)


def readable(features: Path, names: list[str]) -> list[str]:
    """Return the queries whose photos could be read, as their feature file tells."""
    failed = failures(features)
    return [name for name in names if name not in failed]


def run_folder(
    outputs: Path,
    dataset: Path,
    feature_conf: dict,
    matcher_conf: dict,
    retrieval: str,
    numbers: dict[str, int],
    overwrite: bool,
    features: Path | None = None,
) -> RunFolder:
    """Open the output folder of a data set's pipeline, or refuse it, before any work is done.

    It is begun anew if the given features were.

    Args:
        outputs: the folder.
        dataset: of the data set.
        feature_conf: configuration of the feature.
        matcher_conf: of the matcher.
        retrieval: --retrieval.
        numbers: --num_...
        overwrite: begin anew.
        features: a feature file, where they are not extracted in the folder.
    """
    conf = {
        "dataset": str(dataset.resolve()),
        "feature": extract_features.provenance(feature_conf),
        "matcher": matcher_conf["model"],
        "retrieval": retrieval,
        **numbers,
    }
    if retrieval != "vlad" and outputs.resolve().parent in Path(retrieval).resolve().parents:
        conf["retrieval"] = _placed(Path(retrieval), outputs)  # which may be moved with it
    if features is not None:
        with open_h5(features) as file:
            conf["features"] = get_text(file, "id", str(features))
        before = provenance.read(outputs / "conf.json")
        made_anew = before.get("features") not in (None, conf["features"])
        overwrite |= made_anew and {**before, "features": conf["features"]} == conf
    elif overwrite or not (outputs / "conf.json").exists():
        extract_features.check_model(feature_conf)
    return RunFolder(
        outputs, conf, overwrite, inputs=[] if retrieval == "vlad" else [Path(retrieval)]
    )


def match(
    conf: dict, pairs: Path, features: Path, outputs: Path, executor: Executor = SERIAL
) -> Path:
    """Match pairs, if there are any, into a file of the outputs folder, named as hloc's."""
    matches = outputs / f"{features.stem}_{conf['output']}_{pairs.stem}.h5"
    if next(parse_pairs(pairs), None) is None:  # no query could be read
        return matches
    return match_features.main(conf, pairs, features, matches=matches, executor=executor)


def retrieve(
    retrieval: str,
    features: Path | None,
    output: Path,
    num_loc: int,
    query_names: list[str],
    map_names: list[str],
) -> Path:
    """Write the pairs of queries and map images, from a file or by VLAD of `features`."""
    if not query_names:
        write_pairs([], output)
        return output
    descriptors = _aggregate(features, map_names) if retrieval == "vlad" else Path(retrieval)
    select = PAIRS_FROM.get(descriptors.suffix, pairs_from_retrieval.select)
    return select(descriptors, output, num_loc, query_list=query_names, db_list=map_names)


def _aggregate(features: Path, map_names: list[str]) -> Path:
    """Compute global descriptors, anew where their vocabulary was learned from other map images."""
    conf = aggregate_features.confs["vlad"]
    name = f"{conf['output']}_{features.stem}"
    stamp = features.with_name(f"{name}.made_from.json")
    learned_from = {"images": hashlib.sha256("\n".join(map_names).encode()).hexdigest()}
    if provenance.read(stamp) not in ({}, learned_from):
        for made in aggregate_features.files_of(features):
            delete(made)
    provenance.write(stamp, learned_from)
    return aggregate_features.main(conf, features, map_names)


def finish(
    folder: RunFolder,
    summary: dict,
    lists: Mapping[str, Iterable[str]],
    records: Mapping[str, dict],
    truth: Mapping[str, pycolmap.Rigid3d],
    thresholds: Mapping[str, tuple[tuple[float, float], ...]],
    features: Path,
    poses: Path,
    files: Mapping[str, Path | None],
) -> dict:
    """Write queries.csv and summary.json.

    Args:
        folder: of the run.
        summary: its configuration and counts, which the summary begins with.
        lists: the queries of each list.
        records: of each query, as from `localization.main`.
        truth: true poses, camera from world, of some queries or none.
        thresholds: of each list, metres and degrees.
        features: the feature file.
        poses: the file of poses.
        files: what else the run read and wrote, for whoever shows it: `query_images` and
            `map_images`, folders; `pairs` and `matches` of the queries; `map_features`; `map`, a
            COLMAP model or the h5 file of `localize_inloc.lift_keypoints`; and `ground_truth`.

    Returns:
        The summary.
    """
    rows = query_table(lists, records, truth)
    failed = {name: reason for name, reason in failures(features).items() if name in records}
    if failed:
        logger.warning(
            "%d of %d queries could not be read and are not localized: %s. The same command tries "
            "them again.",
            *(len(failed), len(rows), extract_features.with_reasons(failed)),
        )
    write_csv(rows, folder.path / "queries.csv")
    summary = {
        **summary,
        "queries": len(rows),
        "queries_localized": sum(row["status"] == "localized" for row in rows),
        "queries_unreadable": len(failed),
        "lists": {
            name: summarize_list([row for row in rows if row["list"] == name], thresholds[name])
            for name in lists
        },
        "bytes_per_keypoint": bytes_per_keypoint(features),
        "seconds": folder.seconds(),
        "bytes": folder.bytes(),
        "versions": versions(),
        "poses": poses.name,
        "files": {
            key: None if path is None else _placed(path, folder.path)
            for key, path in {"features": features, **files}.items()
        },
    }
    write_summary(summary, folder.path / "summary.json")
    return summary


def _placed(path: Path, outputs: Path) -> str:
    """Return the place of a file: relative where it is in or beside the outputs folder."""
    path, outputs = path.resolve(), outputs.resolve()
    return os.path.relpath(path, outputs) if path.is_relative_to(outputs.parent) else str(path)


def print_result(summary: dict, outputs: Path, unknown: str) -> None:
    """Print recall, or where no true pose is known the message `unknown`."""
    logger.info(
        "Localized %d of %d queries in %.0f s; %d bytes a descriptor. Results are in %s.",
        summary["queries_localized"],
        summary["queries"],
        sum(summary["seconds"].values()),
        summary["bytes_per_keypoint"]["descriptor"],
        outputs,
    )
    if any("recall_percent" in result for result in summary["lists"].values()):
        print(recall_table(summary["feature"], summary["lists"]))
    else:
        print(f"The true poses are not known here. {unknown.format(outputs / summary['poses'])}")
