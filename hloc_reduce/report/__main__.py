"""Write an HTML page about one run of a pipeline, or several side by side."""

from pathlib import Path

from ..utils import cli
from . import NUM_QUERIES, main


def _main() -> None:
    parser = cli.Parser(__doc__, "outputs/herz-jesus/sift* -o report.html")
    parser.add_argument(
        "folders",
        type=Path,
        nargs="+",
        metavar="OUTPUTS",
        help="outputs folders of runs, or folders with finished runs at most two levels below, "
        "such as the outputs folder of a batch",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("report.html"), help="the HTML file"
    )
    parser.add_argument("--queries", nargs="+", help="queries whose matches are shown")
    parser.add_argument(
        "--num_queries",
        type=int,
        default=NUM_QUERIES,
        help="number of queries shown without --queries, spread evenly from worst to best",
    )
    parser.add_argument(
        "--pictures_dir", type=Path, help="also write plots and pictures of matches to this folder"
    )
    args = parser.parse_args()
    cli.check_positive(args, "num_queries")
    main(**vars(args))


if __name__ == "__main__":
    cli.run(_main)
