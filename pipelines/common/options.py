"""The options that the pipelines share."""

from collections.abc import Callable
from pathlib import Path

from hloc_reduce import logger
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.evaluation.summaries import recall_table
from hloc_reduce.localization.confidence import Gate, add_gate_options
from hloc_reduce.runtime import trace
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

from . import compact_map

SUBMIT = "For recall, submit {} to https://www.visuallocalization.net."


def add_dataset_options(parser: cli.Parser, datasets: str, truth: str, num_loc: int) -> None:
    """Add the options of the pipelines of data sets.

    Args:
        parser: the parser.
        datasets: the default of --dataset, for its help.
        truth: the default of --ground_truth, for its help.
        num_loc: the default of --num_loc.
    """
    parser.add_argument("--dataset", type=Path, help=f"data set folder (default: {datasets})")
    parser.add_argument(
        "--outputs",
        type=Path,
        help="folder for the results of one configuration (default: outputs/<dataset>/<feature>)",
    )
    add_feature_options(parser)
    add_retrieval_option(parser)
    add_localization_options(parser, truth, num_loc)


def add_retrieval_option(parser: cli.Parser) -> None:
    """Add --retrieval."""
    parser.add_argument(
        "--retrieval",
        default="vlad",
        metavar="vlad|FILE",
        help="vlad, or hloc's text file of pairs or h5 file of global descriptors",
    )


def add_feature_options(parser: cli.Parser) -> None:
    """Add the options of features and their matching."""
    parser.add_argument(
        "--feature",
        default=features_confs.RECOMMENDED,
        help="local feature, see --list_features, or a YAML file with its configuration",
    )
    parser.add_argument(
        "--projection",
        type=Path,
        help="projection file to use with the base descriptor of --feature",
    )
    of = "the descriptors of map images (those of queries stay floats)"
    features_confs.add_storage_option(parser, of)
    features_confs.add_keypoints_option(parser)
    parser.add_argument(
        "--matcher",
        help=f"one of {', '.join(matchers_confs.confs)} (default: the feature's, see "
        "--list_features)",
    )
    parser.add_argument("--list_features", action="store_true", help="list the features and exit")


def add_localization_options(parser: cli.Parser, truth: str, num_loc: int) -> None:
    """Add the options of localization; `truth` is the default of --ground_truth, for its help."""
    parser.add_argument(
        "--num_loc", type=int, default=num_loc, help="retrieved map images per query"
    )
    parser.add_argument(
        "--ground_truth", type=Path, help=f"true poses of the queries (default: {truth})"
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="fail at an unreadable query photo instead of recording it as not localized",
    )
    parser.add_argument(
        "--accept_partial",
        action="store_true",
        help="build the map without photos that are missing, unreadable or, in a map of photos "
        "alone, not reconstructed; and use a map whose focal lengths, positions or matches show "
        "that it may be wrong",
    )
    add_gate_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="recompute existing results")
    parser.add_argument(
        "--profile", action="store_true", help="write trace.json for https://ui.perfetto.dev"
    )


def parse(parser: cli.Parser) -> dict:
    """Parse and check the options of a pipeline.

    Returns:
        The options by name, with the `gate` of --min_confidence and --min_inliers.

    Raises:
        InputError: for a wrong option.
        SystemExit: after --list_features.
    """
    args = parser.parse_args()
    options = vars(args)
    if options.pop("list_features"):
        print(features_confs.table())
        print(f"\nDefault: {features_confs.RECOMMENDED}. Which to choose: docs/features.md")
        raise SystemExit(0)
    if options["matcher"] is not None:
        cli.choose("matcher", options["matcher"], matchers_confs.confs)
    retrieval = options.get("retrieval", "vlad")
    if retrieval != "vlad" and not Path(retrieval).is_file():
        raise InputError(f"--retrieval {retrieval}: neither vlad nor an existing file.")
    cli.check_positive(args, *(name for name in options if name.startswith("num_")))
    options["gate"] = Gate(options.pop("min_confidence"), options.pop("min_inliers"))
    return options


def run_on_dataset(main: Callable[..., dict], dataset: Path, options: dict) -> None:
    """Run the pipeline of a data set with the options of its command line; print the result."""
    names = ("feature", "projection", "storage", "keypoints")
    feature, _ = features_confs.get(*(options[name] for name in names))
    outputs = options.pop("outputs") or Path("outputs") / dataset.name / feature
    with trace.recording(outputs / "trace.json" if options.pop("profile") else None):
        summary = main(dataset, outputs, **options)
    results = compact_map.folder(outputs, options.get("compact", False), options.get("max_mb"))
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
    elif not summary["queries_localized"]:
        print(f"No query is localized. {outputs / 'queries.csv'} gives the reasons.")
    else:
        print(f"The true poses are not known here. {unknown.format(outputs / summary['poses'])}")
