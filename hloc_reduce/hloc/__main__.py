"""Run a module of the installed hloc with this project's features and extractors registered.

The module gets the arguments after its name.
"""

import ast
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from ..utils import cli, options
from ..utils.cli import InputError
from ..utils.hloc import import_module
from ..utils.options import Option
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


def run(
    module: Annotated[str, Option(flags=("module",))],
    args: Annotated[list[str], Option(flags=("args",), rest=True)],
    feature: Annotated[Sequence[Path], Option(repeated=True, metavar="FILE")] = (),
) -> None:
    """Register features, and run a module.

    Args:
        module: such as extract_features or match_features.
        args: arguments of the module.
        feature: YAML file of another feature to register, named after the file; may be repeated.
    """
    register(feature)
    main(module, args)


def _main() -> None:
    example = "extract_features --conf sift_sv64 --image_dir photos --export_dir outputs"
    options.call(run, __doc__, example)


if __name__ == "__main__":
    cli.run(_main)
