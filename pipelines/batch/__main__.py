"""Run the jobs of a file: grids of data sets, features, matchers and options of the pipelines."""

from dataclasses import dataclass
from typing import Annotated

from hloc_reduce.runtime.executors import EXECUTORS
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.options import Option, Parser, taken

from . import dry_run, jobs, main


@dataclass(frozen=True)
class Command:
    """What the command line has beyond the options of `main`.

    Args:
        dry_run: show the steps and exit.
        executor: where the work is done.
        address: Ray cluster for `executor` ray; default: RAY_ADDRESS, or a new one on this machine.
    """

    dry_run: bool = False
    executor: Annotated[str, Option("executor", EXECUTORS)] = "processes"
    address: str | None = None


def _main() -> None:
    parser = Parser(__doc__, "confs/jobs/aachen_table1.yaml --dry_run")
    parser.add(main)
    parser.add(Command)
    given = parser.read()
    command = Command(**taken(Command, given))
    if command.address and command.executor != "ray":
        raise InputError("--address needs --executor ray.")
    jobs.read(given["job_file"])  # a wrong file fails before processes start
    if command.dry_run:
        failed = dry_run(given["job_file"], given["outputs"], given["overwrite"])
    else:
        with EXECUTORS[command.executor](command.address) as executor:
            rows = main(**taken(main, given), executor=executor)
        failed = [f"{row['dataset']}/{row['job']}" for row in rows if row["error"]]
    if failed:
        raise InputError(f"{len(failed)} jobs failed, see above: {cli.some(failed)}.")


if __name__ == "__main__":
    cli.run(_main)
