"""Evaluate poses, or features of patches on HPatches and PhotoTour."""

import argparse
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

PAPER = ("aachen", "inloc")
SHOWN = 20  # failures of each kind that are named


def evaluate_poses(args: argparse.Namespace) -> None:
    """Compare estimated with true poses."""
    given = args.thresholds or ["aachen"]
    limits = parse_thresholds(given)
    label = args.estimates.name.removesuffix("_logs.jsonl").removesuffix(".txt")
    outputs = args.outputs or Path("outputs/evaluation") / label
    cli.check_folder(outputs)
    truth = poses.read_truth(args.ground_truth)
    estimates, fallbacks = poses.read_estimates(args.estimates)
    found = poses.find_estimates(estimates, truth)
    if not found:
        raise InputError(f"{args.estimates} has no pose of a query of the true poses.")
    if others := estimates.keys() - set(found.values()):
        logger.warning(
            "%d estimates are of no such query: %s.", len(others), cli.some(sorted(others))
        )
    errors = poses.errors_of({name: estimates[key] for name, key in found.items()}, truth)
    status = {
        name: "failed" if key is None else "fallback" if key in fallbacks else "localized"
        for name, key in ((name, found.get(name)) for name in truth)
    }
    counted = {
        name: error if status[name] == "localized" else poses.FAILED
        for name, error in errors.items()
    }
    groups: dict[str, list[str]] = {}
    for name in truth:
        groups.setdefault(group_of(name, given), []).append(name)
    summaries = {
        group: poses.summarize_errors(
            [errors[name] for name in names],
            [counted[name] for name in names],
            limits or thresholds(group),
        )
        for group, names in groups.items()
    }
    write_errors(errors, status, groups, outputs / "errors.csv")
    curves = {group: [counted[name] for name in names] for group, names in groups.items()}
    write_curves(curves, outputs / "curves.csv")
    if plots.available(outputs / "curves.svg"):
        by_list = {group: {label: listed} for group, listed in curves.items()}
        plots.save(
            plots.figure(list(plots.error_curves(by_list).values()), 2), outputs / "curves.svg"
        )
    print(f"{label}:\n{recall_table('', summaries)}")
    for group, summary in summaries.items():
        medians = [summary[f"median_{key}"] for key in ("position_error_m", "rotation_error_deg")]
        known = None not in medians
        print(
            f"{group}: {summary['with_ground_truth']} queries, median errors "
            + ("{:.3f} m, {:.3f} deg".format(*medians) if known else "none: half have no pose")
        )
    for kind, said in (("failed", "without a pose"), ("fallback", "with a fallback pose")):
        names = [name for name in truth if status[name] == kind]
        if names:
            print(f"Failures {said}: {len(names)}")
            print("\n".join(names[:SHOWN]) + ("\n..." if len(names) > SHOWN else ""))
    logger.info("Errors and their curves are in %s.", outputs)


def parse_thresholds(given: list[str]) -> list[tuple[float, float]] | None:
    """Return pairs of metres and degrees; None for those of Aachen, which depend on the query."""
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
                f"--thresholds {text}: {', '.join(PAPER)} or pairs such as 0.25,2 0.5,5 (m,deg)."
            ) from None
        limits.append((metres, degrees))
    return limits


def group_of(name: str, given: list[str]) -> str:
    """Return the group of a query: with Aachen's thresholds those of night are apart."""
    if given != ["aachen"]:
        return "all"
    return "night" if any(part.startswith("night") for part in name.split("/")[:-1]) else "day"


def write_errors(
    errors: dict[str, tuple[float, float]],
    status: dict[str, str],
    groups: dict[str, list[str]],
    path: Path,
) -> None:
    """Write the status and the errors of all queries, empty for those without a pose."""
    rows = []
    for group, names in groups.items():
        for name in names:
            metres, degrees = (None, None) if errors[name] == poses.FAILED else errors[name]
            rows.append(
                {
                    "query": name,
                    "list": group,
                    "status": status[name],
                    "position_error_m": metres,
                    "rotation_error_deg": degrees,
                }
            )
    write_csv(rows, path)


def write_curves(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Write the cumulative curves: how many percent of a list have at most which error."""
    rows = [
        {"list": group, "error": kind, "value": value, "percent": percent}
        for group, errors in curves.items()
        for kind, values in zip(("m", "deg"), zip(*errors, strict=True), strict=True)
        for value, percent in zip(*poses.cumulative(values), strict=True)
    ]
    write_csv(rows, path, ("list", "error", "value", "percent"))


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
        raise InputError(f"--name {args.name} is a folder in --root, without any /.")
    by_base: dict[str, dict[str, torch.nn.Module]] = {}
    for feature in args.feature:
        base, projection = features_confs.of_patches(feature)
        project = torch.nn.Identity() if projection is None else projections.load(projection)
        by_base.setdefault(base, {})[features_confs.get(feature)[0]] = project
    found = {}
    for base, projects in by_base.items():
        found |= patch_verification.main(
            args.root / args.name, args.outputs / args.name, base, projects
        )
    write_csv(
        [{"feature": name, "fpr95_percent": 100 * value} for name, value in found.items()],
        args.outputs / f"{args.name}.csv",
    )
    for name, value in found.items():
        print(f"FPR95 of {name} on {args.name}: {100 * value:.2f} %")


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=cli.HelpFormatter)
    commands = parser.add_subparsers(required=True, metavar="poses|hpatches|phototour")

    command = commands.add_parser(
        "poses",
        help="compare estimated with true poses",
        description="Compare estimated with true poses, both camera from world: recall, median "
        "errors, cumulative curves. A query without an estimate is a failure. The names of "
        "estimates are whole ones, or their last parts, as in a submission.",
        epilog="example: python -m hloc_reduce.evaluation poses --estimates poses.txt "
        "--ground_truth ground_truth_poses.txt",
        formatter_class=cli.HelpFormatter,
    )
    command.add_argument(
        "--estimates",
        type=Path,
        required=True,
        help="text file of poses, or the *_logs.jsonl of a pipeline, of which fallbacks count as "
        "failures in recall and curves",
    )
    command.add_argument(
        "--ground_truth",
        type=Path,
        required=True,
        action="append",
        help="text file of true poses; may be given again",
    )
    command.add_argument(
        "--thresholds",
        nargs="+",
        metavar="aachen|inloc|M,DEG",
        help="the paper's, those of Aachen for queries in a folder night... and for others, or "
        "pairs of metres and degrees (default: aachen)",
    )
    command.add_argument(
        "--outputs",
        type=Path,
        help="folder for errors and curves (default: outputs/evaluation/<estimates>)",
    )
    command.set_defaults(evaluate=evaluate_poses)

    command = commands.add_parser(
        "hpatches",
        help="evaluate features on HPatches",
        description="Evaluate features of patches in the tasks of HPatches: matching, verification "
        "and retrieval, mean average precision in percent next to the paper's.",
        epilog="example: python -m hloc_reduce.evaluation hpatches --root hpatches-release "
        "--task_lists hpatches-benchmark/tasks --feature sift sift_sv64",
        formatter_class=cli.HelpFormatter,
    )
    command.add_argument("--root", type=Path, required=True, help="folder of the sequences")
    _add_feature(command)
    command.add_argument("--split", default="a", help=f"one of {', '.join(data.SPLITS)}")
    command.add_argument(
        "--task_lists",
        type=Path,
        help="folder of splits.json and of the lists of pairs, queries and distractors; lists that "
        "it lacks are drawn by the benchmark's rule (default: <root>/tasks)",
    )
    command.add_argument(
        "--task",
        nargs="+",
        help=f"some of {', '.join(hpatches.TASKS)} (default: all)",
    )
    command.add_argument(
        "--outputs", type=Path, default=Path("outputs/hpatches"), help="folder for the results"
    )
    command.set_defaults(evaluate=evaluate_hpatches)

    command = commands.add_parser(
        "phototour",
        help="evaluate features on PhotoTour",
        description="Verify the pairs m50_100000_100000_0.txt of a PhotoTour sequence: false "
        "positive rate at 95 % recall.",
        epilog="example: python -m hloc_reduce.evaluation phototour --root phototour "
        "--name notredame --feature sift sift_sv64",
        formatter_class=cli.HelpFormatter,
    )
    command.add_argument("--root", type=Path, required=True, help="folder of the sequences")
    command.add_argument("--name", required=True, help="folder of a sequence there")
    _add_feature(command)
    command.add_argument(
        "--outputs",
        type=Path,
        default=Path("outputs/phototour"),
        help="folder for the descriptors of patches",
    )
    command.set_defaults(evaluate=evaluate_phototour)

    args = parser.parse_args()
    args.evaluate(args)


def _add_feature(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--feature",
        nargs="+",
        required=True,
        help="features of patches, see pipelines.aachen --list_features, or YAML files of them",
    )


if __name__ == "__main__":
    cli.run(_main)
