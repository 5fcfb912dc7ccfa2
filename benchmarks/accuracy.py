"""Localize the queries of several places with several features, and write rows.

Runs the jobs of a file of `pipelines.batch` and adds a row for each query list of each job to
results/accuracy.csv. Jobs that have rows are left out, unless --again is given. The runs are kept
in the outputs folder: an interrupted benchmark resumes. Seconds are those of a run's stages without
the extraction, which jobs share.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import yaml

from benchmarks import rows
from hloc_reduce import logger
from hloc_reduce.evaluation.poses import ERRORS, counted_errors
from hloc_reduce.runtime.executors import EXECUTORS
from hloc_reduce.utils import cli
from hloc_reduce.utils.files import MEGABYTE, replacing
from hloc_reduce.utils.options import flat
from pipelines import batch
from pipelines.batch import jobs
from pipelines.batch.jobs import Job

NAME = "accuracy"


def what(job: Job) -> dict[str, str]:
    """Return the cells of all rows of a job."""
    given = {
        "place": job.dataset.name,
        "feature": Path(job.feature).stem,
        "storage": job.storage,
        "matcher": str(job.matcher),
    }
    # the name of a job tells further options that are not the default
    parts = job.name.replace(f"+{job.matcher}", "").split("+")[1:]
    named = {f"keypoints{job.keypoints}": rows.with_keypoints(job.keypoints)}
    parts = [named.get(part, part) for part in parts]
    return given | {"variant": " ".join(part for part in parts if part not in given.values())}


def measured(folder: Path) -> Iterator[dict[str, object]]:
    """Yield the cells of each query list of a finished run, without those of its job."""
    summary = json.loads((folder / "summary.json").read_text())
    size = summary["bytes_per_keypoint"]
    with (folder / "queries.csv").open() as file:
        queries = list(csv.DictReader(file))
    seconds = {key: value for key, value in summary["seconds"].items() if "extract" not in key}
    for name, result in summary["lists"].items():
        listed = [row for row in queries if row["list"] == name and row[ERRORS[0]]]
        errors = counted_errors(row | {key: float(row[key]) for key in ERRORS} for row in listed)
        yield {
            "list": name.split("_")[0],
            "bytes": size["descriptor"],
            "photos": summary["map_images"],
            "points": summary.get("map_points3D"),
            "mb": summary["map_bytes"] / MEGABYTE if "map_bytes" in summary else None,
            **rows.localization(
                errors, [int(row["num_inliers"]) for row in listed], result["localized"]
            ),
            "keypoints": round(size["keypoints"] / size["images"]),
            **rows.how(sum(seconds.values())),
        }


def _main() -> None:
    parser = cli.Parser(__doc__, "results/accuracy.yaml")
    parser.add_argument("job_file", type=Path, help="YAML file of jobs, see docs/operations.md")
    parser.add_argument("--outputs", type=Path, default=Path("outputs/accuracy"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    missing = [job for job in jobs.read(args.job_file)[1] if not rows.select(known, **what(job))]
    if not missing:
        logger.info("All jobs of %s have rows.", args.job_file)
        return
    with EXECUTORS["processes"](None) as executor:
        for place in jobs.by_dataset(missing).values():
            todo = args.outputs / "missing.yaml"
            with replacing(todo) as temporary:
                temporary.write_text(yaml.safe_dump({"jobs": [_options(job) for job in place]}))
            batch.main(todo, args.outputs, overwrite=args.again, executor=executor)
            for job in place:
                folder = args.outputs / job.dataset.name / job.name
                if (folder / "summary.json").exists():
                    rows.add(NAME, (what(job) | cells for cells in measured(folder)))


def _options(job: Job) -> dict[str, object]:
    """Return the options of a job that are not the default, as a job file has them."""
    given = {key: value for key, value in flat(job).items() if value is not None}
    return {key: str(value) if isinstance(value, Path) else value for key, value in given.items()}


if __name__ == "__main__":
    cli.run(_main)
