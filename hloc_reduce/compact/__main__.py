"""Command line of `hloc_reduce.compact`."""

import sys
from pathlib import Path
from typing import Annotated

from ..utils import cli
from ..utils.cli import InputError
from ..utils.options import Option, Parser, taken
from . import __doc__, check, main


def _check_option(check: Annotated[Path, Option(metavar="FILE.hlm")] | None = None) -> None:
    """Declare --check.

    Args:
        check: only tell whether this file is current, with `map` or `sfm`: exit code 0, or 1.
    """


def _main() -> None:
    parser = Parser(__doc__, "--map outputs/place/map --output place.hlm --max_mb 0.5")
    parser.add(main, output=None)
    parser.add(_check_option)
    given = parser.read()
    if (file := given["check"]) is not None:
        stale = check(file, given["map"], given["sfm"])
        print(stale or f"{file} is current.")
        sys.exit(stale is not None)
    if given["output"] is None:
        raise InputError("Give --output, the file to write, or --check.")
    main(**taken(main, given))


if __name__ == "__main__":
    cli.run(_main)
