"""Evaluate poses, or features of patches on HPatches and PhotoTour."""

import argparse
from collections.abc import Callable, Iterable
from itertools import chain
from pathlib import Path

import torch

from .. import logger, projections
from ..confs import features as features_confs
from ..datasets import INLOC_THRESHOLDS, thresholds
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import write_csv
from . import hpatches, patch_verification, plots, poses
from .hpatches import data
from .summaries import recall_table

MAX_FAILURES = 20  # of each kind are listed


def evaluate_poses(args: argparse.Namespace) -> None:
    """Compare estimated with true poses."""
    given = args.thresholds or ["aachen"]
    limits = parse_thresholds(given)
    label = args.estimates.name.removesuffix("_logs.jsonl").removesuffix(".txt")
    outputs = args.outputs or Path("outputs/evaluation") / label
    cli.check_folder(outputs)
    rows = compare(args.estimates, args.ground_truth)
    lists: dict[str, list[dict]] = {}
    for row in rows:
        row["list"] = "all" if limits else list_of(row["query"])
        lists.setdefault(row["list"], []).append(row)
    summaries = {
        name: poses.summarize_errors(listed, limits or thresholds(name))
        for name, listed in lists.items()
    }
    write_errors(chain(*lists.values()), outputs / "errors.csv")
    curves = {name: poses.counted_errors(listed) for name, listed in lists.items()}
    write_curves(curves, outputs / "curves.csv")
    if plots.available(outputs / "curves.svg"):
        panels = plots.error_curves({name: {label: errors} for name, errors in curves.items()})
        plots.save(plots.figure(list(panels.values()), 2), outputs / "curves.svg")
    print(f"{label}:\n{recall_table('', summaries)}")
    print_medians(summaries)
    print_failures(rows)
    logger.info("Errors and their curves are in %s.", outputs)


def parse_thresholds(given: list[str]) -> list[tuple[float, float]] | None:
    """Return pairs of metres and degrees; None for Aachen's, which depend on the query."""
    if given == ["aachen"]:
        return None
    if given == ["inloc"]:
        return list(INLOC_THRESHOLDS)
    limits = []
    for text in given:
        try:
            metres, degrees = map(float, text.split(","))
            if not (metres > 0 and degrees > 0):
                raise ValueError
        except ValueError:
            raise InputError(
                f"--thresholds {text}: aachen, inloc or pairs such as 0.25,2 0.5,5 (m,deg)."
            ) from None
        limits.append((metres, degrees))
    return limits


def compare(estimates_file: Path, truth_files: list[Path]) -> list[dict]:
    """Return a row for each query with a true pose: `query`, `status` and `poses.ERRORS`.

    Raises:
        InputError: for a broken file, or when no estimate is of a query.
    """
    truth = poses.read_truth(truth_files)
    estimates, fallbacks = poses.read_estimates(estimates_file)
    found = poses.find_estimates(estimates, truth)
    if not found:
        raise InputError(f"{estimates_file} has no pose of a query of the true poses.")
    if others := estimates.keys() - set(found.values()):
        logger.warning(
            "%d estimates are of other queries: %s.", len(others), cli.some(sorted(others))
        )
    rows = []
    for name, true in truth.items():
        pose = estimates[found[name]] if name in found else None
        errors = dict(zip(poses.ERRORS, poses.pose_error(pose, true), strict=True))
        status = poses.status(pose, found.get(name) not in fallbacks)
        rows.append({"query": name, "status": status, **errors})
    return rows


def list_of(query: str) -> str:
    """Return the list of a query of Aachen by its folders."""
    return "night" if any(part.startswith("night") for part in query.split("/")[:-1]) else "day"


def write_errors(rows: Iterable[dict], path: Path) -> None:
    """Write the status and the errors of all queries; the errors of a failure are empty."""
    empty = dict.fromkeys(poses.ERRORS)
    written = [row | empty if row["status"] == "failed" else row for row in rows]
    write_csv(written, path, ("query", "list", "status", *poses.ERRORS))


def write_curves(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Write the cumulative curves: the percentage of each list's queries within each error."""
    rows = [
        {"list": name, "error": unit, "value": value, "percent": percent}
        for name, errors in curves.items()
        for unit, values in zip(("m", "deg"), zip(*errors, strict=True), strict=True)
        for value, percent in zip(*poses.cumulative(values), strict=True)
    ]
    write_csv(rows, path, ("list", "error", "value", "percent"))


def print_medians(summaries: dict[str, dict]) -> None:
    """Print the median errors of each list."""
    for name, summary in summaries.items():
        medians = [summary[f"median_{key}"] for key in poses.ERRORS]
        known = "{:.3f} m, {:.3f} deg".format(*medians) if None not in medians else None
        print(
            f"{name}: {summary['with_ground_truth']} queries, median errors "
            f"{known or 'none: half have no pose'}"
        )


def print_failures(rows: list[dict]) -> None:
    """Print the first queries that were not localized."""
    for status, kind in (("failed", "without a pose"), ("fallback", "with a fallback pose")):
        if names := [row["query"] for row in rows if row["status"] == status]:
            more = ["..."] if len(names) > MAX_FAILURES else []
            print(f"Failures {kind}: {len(names)}", *names[:MAX_FAILURES], *more, sep="\n")


def evaluate_hpatches(args: argparse.Namespace) -> None:
    """Evaluate features on HPatches."""
    cli.check_folder(args.outputs)
    rows = hpatches.main(
        args.root,
        args.feature,
        args.outputs,
        args.split,
        args.task_lists,
        args.task or hpatches.TASKS,
    )
    print(hpatches.table(rows))
    scores = args.outputs / f"{args.split}_scores.csv"
    picture = args.outputs / f"{args.split}.svg"
    if plots.available(picture):
        plots.save(plots.hpatches_bars(rows), picture)
    logger.info("The scores are in %s, their means in %s.csv.", scores, args.outputs / args.split)


def evaluate_phototour(args: argparse.Namespace) -> None:
    """Evaluate features on PhotoTour."""
    cli.check_folder(args.outputs)
    if Path(args.name).name != args.name:
        raise InputError(f"--name {args.name}: name a folder in --root, without any /.")
    by_base: dict[str, dict[str, torch.nn.Module]] = {}
    for feature in args.feature:
        base, projection = features_confs.of_patches(feature)
        project = torch.nn.Identity() if projection is None else projections.load(projection)
        by_base.setdefault(base, {})[features_confs.get(feature)[0]] = project
    found: dict[str, float] = {}
    for base, projects in by_base.items():
        folder, outputs = args.root / args.name, args.outputs / args.name
        found |= patch_verification.main(folder, outputs, base, projects)
    rows = [{"feature": name, "fpr95_percent": 100 * value} for name, value in found.items()]
    write_csv(rows, args.outputs / f"{args.name}.csv")
    for name, value in found.items():
        print(f"FPR95 of {name} on {args.name}: {100 * value:.2f} %")


def _main() -> None:
    parser = cli.Parser(__doc__)
    commands = parser.add_subparsers(required=True, metavar="poses|hpatches|phototour")
    for add in (_add_poses, _add_hpatches, _add_phototour):
        add(commands.add_parser)
    args = parser.parse_args()
    args.evaluate(args)


def _add_poses(add: Callable[..., cli.Parser]) -> None:
    command = add(
        "poses",
        help="compare estimated with true poses",
        description="Compare estimated with true poses, both camera from world: recall, median "
        "errors, cumulative curves. A query without an estimate is a failure. Estimates name "
        "queries in full, or by file name as in a submission.",
        example="--estimates poses.txt --ground_truth ground_truth_poses.txt",
    )
    command.add_argument(
        "--estimates",
        type=Path,
        required=True,
        help="text file of poses, or the *_logs.jsonl of a pipeline, whose fallback poses count as "
        "failures in recall and curves",
    )
    command.add_argument(
        "--ground_truth",
        type=Path,
        required=True,
        action="append",
        help="text file of true poses; may be repeated",
    )
    command.add_argument(
        "--thresholds",
        nargs="+",
        metavar="aachen|inloc|M,DEG",
        help="aachen (wider for queries in a folder night...), inloc, or pairs of metres and "
        "degrees (default: aachen)",
    )
    command.add_argument(
        "--outputs",
        type=Path,
        help="folder for errors and curves (default: outputs/evaluation/<estimates>)",
    )
    command.set_defaults(evaluate=evaluate_poses)


def _add_hpatches(add: Callable[..., cli.Parser]) -> None:
    command = add(
        "hpatches",
        help="evaluate features on HPatches",
        description="Evaluate features of patches in the tasks of HPatches: matching, verification "
        "and retrieval, mean average precision in percent next to the paper's.",
        example="--root hpatches-release "
        "--task_lists hpatches-benchmark/tasks --feature sift sift_sv64",
    )
    _add_features(command)
    command.add_argument("--split", default="a", help=f"one of {', '.join(data.SPLITS)}")
    command.add_argument(
        "--task_lists",
        type=Path,
        help="folder of splits.json and of the lists of pairs, queries and distractors; missing "
        "lists are drawn by the benchmark's rule (default: <root>/tasks)",
    )
    command.add_argument(
        "--task", nargs="+", help=f"some of {', '.join(hpatches.TASKS)} (default: all)"
    )
    command.add_argument(
        "--outputs", type=Path, default=Path("outputs/hpatches"), help="folder for the results"
    )
    command.set_defaults(evaluate=evaluate_hpatches)


def _add_phototour(add: Callable[..., cli.Parser]) -> None:
    command = add(
        "phototour",
        help="evaluate features on PhotoTour",
        description="Verify the pairs m50_100000_100000_0.txt of a PhotoTour sequence: false "
        "positive rate at 95 % recall.",
        example="--root phototour --name notredame --feature sift sift_sv64",
    )
    _add_features(command)
    command.add_argument("--name", required=True, help="folder of a sequence in --root")
    command.add_argument(
        "--outputs", type=Path, default=Path("outputs/phototour"), help="folder for the results"
    )
    command.set_defaults(evaluate=evaluate_phototour)


def _add_features(command: cli.Parser) -> None:
    command.add_argument("--root", type=Path, required=True, help="folder of the sequences")
    command.add_argument(
        "--feature",
        nargs="+",
        required=True,
        help="features of patches, see pipelines.aachen --list_features, or YAML files of them",
    )


if __name__ == "__main__":
    cli.run(_main)
