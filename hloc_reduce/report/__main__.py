"""Write an HTML page about one run of a pipeline, or several side by side."""

from pathlib import Path

from ..utils import cli, options
from . import main


def _main() -> None:
    example = "outputs/herz-jesus/sift* -o report.html"
    options.call(main, __doc__, example, output=Path("report.html"))


if __name__ == "__main__":
    cli.run(_main)
