"""Run the jobs of a file: grids of data sets, features, matchers and options of the pipelines."""

from pathlib import Path

from hloc_reduce.runtime import executors
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

from . import dry_run, jobs, main


def _main() -> None:
    parser = cli.Parser(__doc__, "confs/jobs/aachen_table1.yaml --dry_run")
    parser.add_argument("job_file", type=Path, help="YAML file of jobs, see docs/operations.md")
    parser.add_argument(
        "--outputs", type=Path, help="folder for all results (default: the one that the file names)"
    )
    parser.add_argument("--dry_run", action="store_true", help="show the steps and exit")
    parser.add_argument(
        "--strict",
        action="store_true",
        help="fail at an unreadable image instead of listing it in failures.csv",
    )
    parser.add_argument(
        "--executor",
        default="processes",
        help=f"where the work is done, one of {', '.join(executors.EXECUTORS)}",
    )
    parser.add_argument(
        "--address",
        help="Ray cluster for --executor ray (default: RAY_ADDRESS, or a new one on this machine)",
    )
    parser.add_argument("--overwrite", action="store_true", help="recompute existing results")
    args = parser.parse_args()
    cli.choose("executor", args.executor, executors.EXECUTORS)
    if args.address and args.executor != "ray":
        raise InputError("--address needs --executor ray.")
    jobs.read(args.job_file)  # a wrong file fails before processes start
    if args.dry_run:
        failed = dry_run(args.job_file, args.outputs, args.overwrite)
    else:
        with executors.EXECUTORS[args.executor](args.address) as executor:
            rows = main(args.job_file, args.outputs, args.overwrite, args.strict, executor)
        failed = [f"{row['dataset']}/{row['job']}" for row in rows if row["error"]]
    if failed:
        raise InputError(f"{len(failed)} jobs failed, see above: {cli.some(failed)}.")


if __name__ == "__main__":
    cli.run(_main)
