"""What the command lines of the pipelines share beyond the options of a run."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hloc_reduce import logger
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import listing
from hloc_reduce.evaluation.summaries import recall_table
from hloc_reduce.runtime import trace
from hloc_reduce.utils.options import Parser

from . import compact_map
from .options import DatasetOptions
from .retrieval import check_name

SUBMIT = "For recall, submit {} to https://www.visuallocalization.net."


@dataclass(frozen=True, kw_only=True)
class Command:
    """What command lines have beyond the options of a run.

    Args:
        list_features: list the features and exit.
        profile: write trace.json for https://ui.perfetto.dev.
    """

    list_features: bool = False
    profile: bool = False


@dataclass(frozen=True, kw_only=True)
class DatasetCommand(Command):
    """The command line of a pipeline of data sets.

    Args:
        dataset: data set folder.
        outputs: folder for the results of one configuration; default:
            outputs/<dataset>/<feature>.
    """

    dataset: Path | None = None
    outputs: Path | None = None


def read(parser: Parser) -> dict[str, Any]:
    """Parse and check the options of a pipeline and return them by name.

    Raises:
        InputError: for a wrong option.
        SystemExit: after --list_features.
    """
    values = parser.read()
    if values["list_features"]:
        print(listing.table())
        print(f"\nDefault: {features_confs.RECOMMENDED}. Which to choose: docs/features.md")
        raise SystemExit(0)
    if values.get("retrieval") is not None:
        check_name(values["retrieval"])
    return values


def run_on_dataset(
    main: Callable[..., dict], dataset: Path, command: DatasetCommand, options: DatasetOptions
) -> None:
    """Run the pipeline of a data set as its command line says; print the result."""
    outputs = command.outputs or Path("outputs") / dataset.name / options.configured_feature()[0]
    with trace.recording(outputs / "trace.json" if command.profile else None):
        summary = main(dataset, outputs, **vars(options))
    given = vars(options)
    results = compact_map.folder(outputs, given.get("compact", False), given.get("max_mb"))
    print_result(summary, results, SUBMIT)


def print_result(summary: dict, outputs: Path, unknown: str) -> None:
    """Print recall or, where no true poses are known, the message `unknown`."""
    unreadable = summary["queries_unreadable"]
    logger.info(
        "Localized %d of %d queries%s in %.0f s; %d bytes a descriptor%s. Results are in %s.",
        summary["queries_localized"],
        summary["queries"],
        f" ({unreadable} unreadable)" * bool(unreadable),
        sum(summary["seconds"].values()),
        summary["bytes_per_keypoint"]["descriptor"],
        f", {summary['map_bytes']:,} bytes of map" if "map_bytes" in summary else "",
        outputs,
    )
    if any("recall_percent" in result for result in summary["lists"].values()):
        print(recall_table(summary["feature"], summary["lists"]))
        for name, result in summary["lists"].items():
            if (metres := result.get("median_position_error_m")) is not None:
                degrees = result["median_rotation_error_deg"]
                print(f"{name}: median errors {metres:.3f} m, {degrees:.3f} deg")
    elif not summary["queries_localized"]:
        print(f"No query is localized. {outputs / 'queries.csv'} gives the reasons.")
    else:
        print(f"The true poses are not known here. {unknown.format(outputs / summary['poses'])}")
