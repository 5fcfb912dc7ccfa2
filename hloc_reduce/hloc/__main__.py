"""Run a module of the installed hloc with this project's features and extractors registered.

What follows the name of the module is the module's own.
"""

import argparse
import ast
import sys
from pathlib import Path

from ..utils import cli
from ..utils.cli import InputError
from ..utils.hloc import import_module
from . import register


def main(name: str, args: list[str]) -> None:
    """Run `python -m hloc.<name>` in this process, on the module's confs as they are now.

    Raises:
        InputError: when hloc has no such module, or it has no command line.
    """
    module = import_module(name)
    source = Path(module.__file__).read_text() if module.__file__ else ""
    # run as a module it would be executed anew, and with it its confs
    blocks = [
        node
        for node in ast.parse(source).body
        if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)
    ]
    if not blocks:
        raise InputError(f"hloc.{name} has no command line.")
    code = compile(ast.Module(blocks, type_ignores=[]), module.__file__, "exec")
    sys.argv = [f"python -m hloc_reduce.hloc {name}", *args]
    exec(code, {**vars(module), "__name__": "__main__"})


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.hloc extract_features --conf sift_sv64 "
        "--image_dir photos --export_dir outputs",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument(
        "--feature",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="YAML file of a feature to register too, under the name of the file",
    )
    parser.add_argument("module", help="such as extract_features or match_features")
    parser.add_argument("args", nargs=argparse.REMAINDER, help="of the module")
    args = parser.parse_args()
    register(args.feature)
    main(args.module, args.args)


if __name__ == "__main__":
    cli.run(_main)
