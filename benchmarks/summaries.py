"""Print a Markdown table of finished runs of any pipeline.

What is no outputs folder of a finished run, such as a report beside the folders, is named and left
out.
"""

import json
from pathlib import Path

from hloc_reduce import logger
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

HEADER = (
    "| feature | bytes | list | localized | recall [%] | median error | mean inliers | points | s |"
)


def rows(summary: dict) -> list[str]:
    """Format a row for each query list of a summary."""
    lines = []
    for name, result in summary["lists"].items():
        recall = " / ".join(f"{value:.1f}" for value in result.get("recall_percent", []))
        error = (
            f"{100 * result['median_position_error_m']:.2f} cm, "
            f"{result['median_rotation_error_deg']:.3f}°"
            if result.get("median_position_error_m") is not None
            else ""
        )
        cells = (
            summary["feature"],
            summary["bytes_per_keypoint"]["descriptor"],
            name.split("_")[0],
            f"{result['localized']} of {result['queries']}",
            recall,
            error,
            f"{result['mean_inliers']:.0f}",
            f"{summary['map_points3D']:,}" if "map_points3D" in summary else "",
            f"{sum(summary['seconds'].values()):.0f}",
        )
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return lines


def _main() -> None:
    parser = cli.Parser(__doc__, "outputs/demo_town/*")
    parser.add_argument("outputs", type=Path, nargs="+", help="outputs folders of runs")
    args = parser.parse_args()
    lines = [HEADER, "| --- | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: |"]
    finished = [folder for folder in args.outputs if (folder / "summary.json").is_file()]
    others = ", ".join(str(path) for path in args.outputs if path not in finished)
    if not finished:
        raise InputError(f"There is no summary.json in {others}: has the run finished?")
    if others:
        logger.warning("Left out, no finished runs: %s.", others)
    for folder in finished:
        lines += rows(json.loads((folder / "summary.json").read_text()))
    print("\n".join(lines))


if __name__ == "__main__":
    cli.run(_main)
