"""Run a module of the installed hloc with this project's features and extractors registered.

The module gets the arguments after its name.
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
    """Run the command line of `hloc.<name>` in this process, with the registered confs.

    Raises:
        InputError: when hloc has no such module, or it has no command line.
    """
    module = import_module(name)
    path = module.__file__ or ""
    # runpy would execute the whole module again, and drop the registered confs
    blocks: list[ast.stmt] = [
        node
        for node in ast.parse(Path(path).read_text() if path else "").body
        if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)
    ]
    if not blocks:
        raise InputError(f"hloc.{name} has no command line.")
    code = compile(ast.Module(blocks, type_ignores=[]), path, "exec")
    sys.argv = [f"python -m hloc_reduce.hloc {name}", *args]
    exec(code, {**vars(module), "__name__": "__main__"})


def _main() -> None:
    parser = cli.Parser(
        __doc__, "extract_features --conf sift_sv64 --image_dir photos --export_dir outputs"
    )
    parser.add_argument(
        "--feature",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="YAML file of another feature to register, named after the file",
    )
    parser.add_argument("module", help="such as extract_features or match_features")
    parser.add_argument("args", nargs=argparse.REMAINDER, help="arguments of the module")
    args = parser.parse_args()
    register(args.feature)
    main(args.module, args.args)


if __name__ == "__main__":
    cli.run(_main)
