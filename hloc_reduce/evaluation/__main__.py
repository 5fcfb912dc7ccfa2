"""Evaluate poses, or features of patches on HPatches and PhotoTour."""

from collections.abc import Callable, Iterable, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated

import torch

from .. import logger, projections
from ..confs import features as features_confs
from ..datasets import INLOC_THRESHOLDS
from ..datasets import thresholds as thresholds_of
from ..utils import cli
from ..utils.cli import InputError
from ..utils.files import write_csv
from ..utils.options import Option, Parser
from . import hpatches, patch_verification, plots, poses
from .hpatches import data
from .summaries import recall_table

MAX_FAILURES = 20  # of each kind are listed


def evaluate_poses(
    estimates: Path,
    ground_truth: Annotated[list[Path], Option(repeated=True)],
    thresholds: Annotated[Sequence[str], Option(metavar="aachen|inloc|M,DEG")] | None = None,
    outputs: Path | None = None,
) -> None:
    """Compare estimated with true poses.

    Both are camera from world. Gives recall, median errors and cumulative curves. A query without
    an estimate is a failure. Estimates name queries in full, or by file name as in a submission.

    Args:
        estimates: text file of poses, or the *_logs.jsonl of a pipeline, whose fallback poses count
            as failures in recall and curves.
        ground_truth: text file of true poses; may be repeated.
        thresholds: aachen (wider for queries in a folder night...), inloc, or pairs of metres and
            degrees; default: aachen.
        outputs: folder for errors and curves; default: outputs/evaluation/<estimates>.
    """
    limits = parse_thresholds(thresholds or ["aachen"])
    label = estimates.name.removesuffix("_logs.jsonl").removesuffix(".txt")
    outputs = outputs or Path("outputs/evaluation") / label
    cli.check_folder(outputs)
    rows = compare(estimates, ground_truth)
    lists: dict[str, list[dict]] = {}
    for row in rows:
        row["list"] = "all" if limits else list_of(row["query"])
        lists.setdefault(row["list"], []).append(row)
    summaries = {
        name: poses.summarize_errors(listed, limits or thresholds_of(name))
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


def parse_thresholds(given: Sequence[str]) -> list[tuple[float, float]] | None:
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


def evaluate_hpatches(
    root: Path,
    feature: list[str],
    split: Annotated[str, Option("split", data.SPLITS)] = "a",
    task_lists: Path | None = None,
    task: Annotated[Sequence[str], Option("task", hpatches.TASKS)] | None = None,
    outputs: Path = Path("outputs/hpatches"),
) -> None:
    """Evaluate features on HPatches.

    The features are of patches. The tasks of HPatches are matching, verification and retrieval; the
    mean average precision is shown in percent next to the paper's.

    Args:
        root: folder of the sequences.
        feature: features of patches, see pipelines.aachen --list_features, or YAML files of them.
        split: split of the sequences.
        task_lists: folder of splits.json and of the lists of pairs, queries and distractors;
            missing lists are drawn by the benchmark's rule; default: <root>/tasks.
        task: tasks; default: all.
        outputs: folder for the results.
    """
    cli.check_folder(outputs)
    rows = hpatches.main(root, feature, outputs, split, task_lists, task or hpatches.TASKS)
    print(hpatches.table(rows))
    scores, picture = outputs / f"{split}_scores.csv", outputs / f"{split}.svg"
    if plots.available(picture):
        plots.save(plots.hpatches_bars(rows), picture)
    logger.info("The scores are in %s, their means in %s.csv.", scores, outputs / split)


def evaluate_phototour(
    root: Path, feature: list[str], name: str, outputs: Path = Path("outputs/phototour")
) -> None:
    """Evaluate features on PhotoTour.

    Verifies the pairs m50_100000_100000_0.txt of a PhotoTour sequence: false positive rate at 95 %
    recall.

    Args:
        root: folder of the sequences.
        feature: features of patches, see pipelines.aachen --list_features, or YAML files of them.
        name: folder of a sequence in `root`.
        outputs: folder for the results.
    """
    cli.check_folder(outputs)
    if Path(name).name != name:
        raise InputError(f"--name {name}: name a folder in --root, without any /.")
    by_base: dict[str, dict[str, torch.nn.Module]] = {}
    for one in feature:
        base, projection = features_confs.of_patches(one)
        project = torch.nn.Identity() if projection is None else projections.load(projection)
        by_base.setdefault(base, {})[features_confs.get(one)[0]] = project
    found: dict[str, float] = {}
    for base, projects in by_base.items():
        found |= patch_verification.main(root / name, outputs / name, base, projects)
    rows = [{"feature": one, "fpr95_percent": 100 * value} for one, value in found.items()]
    write_csv(rows, outputs / f"{name}.csv")
    for one, value in found.items():
        print(f"FPR95 of {one} on {name}: {100 * value:.2f} %")


COMMANDS: dict[str, tuple[Callable, str]] = {
    "poses": (evaluate_poses, "--estimates poses.txt --ground_truth ground_truth_poses.txt"),
    "hpatches": (
        evaluate_hpatches,
        "--root hpatches-release --task_lists hpatches-benchmark/tasks --feature sift sift_sv64",
    ),
    "phototour": (
        evaluate_phototour,
        "--root phototour --name notredame --feature sift sift_sv64",
    ),
}


def _main() -> None:
    parser = Parser(__doc__)
    commands = parser.add_subparsers(required=True, metavar="|".join(COMMANDS))
    for name, (evaluate, example) in COMMANDS.items():
        about, _, _ = (evaluate.__doc__ or "").partition("Args:\n")
        command = commands.add_parser(
            name, help=about.partition(".")[0], description=about, example=example
        )
        command.add(evaluate)
        command.set_defaults(evaluate=evaluate)
    values = parser.read()
    values.pop("evaluate")(**values)


if __name__ == "__main__":
    cli.run(_main)
