"""Run the jobs of a file: data sets, features, matchers and options of the pipelines, in grids."""

import argparse
from pathlib import Path

from hloc_reduce.runtime import executors
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError

from . import dry_run, jobs, main


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m pipelines.batch confs/jobs/aachen_table1.yaml --dry_run",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("job_file", type=Path, help="YAML file of jobs (docs/operations.md)")
    parser.add_argument(
        "--outputs", type=Path, help="folder for all results (default: that of the file)"
    )
    parser.add_argument("--dry_run", action="store_true", help="show what would be done, and exit")
    parser.add_argument(
        "--strict",
        action="store_true",
        help="fail at an image that cannot be read, instead of listing it in failures.csv",
    )
    parser.add_argument(
        "--executor",
        default="processes",
        help=f"what does the work, one of {', '.join(executors.EXECUTORS)}",
    )
    parser.add_argument(
        "--address",
        help="of a Ray cluster, for --executor ray (default: RAY_ADDRESS, or a new one here)",
    )
    parser.add_argument("--overwrite", action="store_true", help="compute anew what is there")
    args = parser.parse_args()
    cli.choose("executor", args.executor, executors.EXECUTORS)
    if args.address and args.executor != "ray":
        raise InputError("--address is of --executor ray.")
    jobs.read(args.job_file)  # is wrong before processes are started
    if args.dry_run:
        failed = dry_run(args.job_file, args.outputs, args.overwrite)
    else:
        with executors.EXECUTORS[args.executor](args.address) as executor:
            rows = main(args.job_file, args.outputs, args.overwrite, args.strict, executor)
        failed = [f"{row['dataset']}/{row['job']}" for row in rows if row["error"]]
    if failed:
        raise InputError(f"Failed, as said above: {cli.some(failed)} ({len(failed)} in all).")


if __name__ == "__main__":
    cli.run(_main)
