"""Command line of `hloc_reduce.compact`."""

from ..utils import cli, options
from . import __doc__, main


def _main() -> None:
    options.call(main, __doc__, "--map outputs/place/map --output place.hlm --max_mb 0.5")


if __name__ == "__main__":
    cli.run(_main)
