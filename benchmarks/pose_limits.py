"""Localize the queries of several places with other limits of the estimation of poses.

Runs the jobs of a file of `pipelines.batch` once, and then localizes their queries again with each
value of one limit of `localization.absolute_pose`, all others as they are. Features, maps and
matches are kept in the outputs folder, and an interrupted benchmark resumes. Adds a row for each
query list of each job to results/pose_limits.csv, whose sums are in docs/lab.md. Seconds are those
of the localization.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks import rows
from benchmarks.accuracy import measured, what
from hloc_reduce.localization import absolute_pose
from hloc_reduce.localization.records import log_file
from hloc_reduce.utils import cli
from pipelines import batch
from pipelines.batch import jobs

NAME = "pose_limits"
# values that are tried of each limit, the others being as they are
LIMITS = {
    "STRICT": (1 / 3, 2 / 3),
    "WIDER": (1, 2, 10, 20),
    "RIVAL_SHARE": (1 / 2, 1),
}


def variants() -> dict[str, dict[str, float]]:
    """Return the limits of each variant, today's first."""
    today = {name: float(getattr(absolute_pose, name)) for name in LIMITS}
    tried = [today, *(today | {name: value} for name in LIMITS for value in LIMITS[name])]
    return {", ".join(f"{name} {value:.3g}" for name, value in one.items()): one for one in tried}


@contextmanager
def changed(limits: dict[str, float]) -> Iterator[None]:
    """Change limits for a while."""
    before = {name: getattr(absolute_pose, name) for name in limits}
    vars(absolute_pose).update(limits)
    try:
        yield
    finally:
        vars(absolute_pose).update(before)


def _main() -> None:
    parser = cli.Parser(__doc__, "results/pose_limits.yaml")
    parser.add_argument("job_file", type=Path, help="YAML file of jobs, see docs/operations.md")
    parser.add_argument("--outputs", type=Path, default=Path("outputs/pose_limits"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    wanted = jobs.read(args.job_file)[1]
    known = [] if args.again else rows.read(NAME)
    for variant, limits in variants().items():
        todo = [job for job in wanted if not rows.select(known, **_what(job, variant))]
        if not todo:
            continue
        folders = {job: args.outputs / job.dataset.name / job.name for job in todo}
        for folder in folders.values():
            for log in folder.glob(log_file(Path("*")).name):
                log.unlink()
        before = {job: _seconds(folder) for job, folder in folders.items()}
        with changed(limits):
            batch.main(args.job_file, args.outputs)
        for job, folder in folders.items():
            found = [cells | _what(job, variant) for cells in measured(folder)]
            seconds = (_seconds(folder) - before[job]) / len(found)
            rows.add(NAME, [cells | {"seconds": seconds} for cells in found])


def _seconds(folder: Path) -> float:
    """Return the seconds of localization in all runs in a folder so far."""
    path = folder / "summary.json"
    return json.loads(path.read_text())["seconds"]["localization"] if path.exists() else 0.0


def _what(job: jobs.Job, variant: str) -> dict[str, str]:
    return what(job) | {"variant": variant}


if __name__ == "__main__":
    cli.run(_main)
