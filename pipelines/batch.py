"""Run the jobs of a file: data sets, features, matchers and options of the pipelines, in grids.

What the jobs of a data set have in common is done once: keypoints are detected once, each base
descriptor is computed once for all its projections, and retrieval is done once. A job that fails
does not stop the others; a batch that was stopped goes on where it was.
"""

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from hloc_reduce import cli, executors, io, jobs, logger, results
from hloc_reduce.cli import InputError
from hloc_reduce.executors import SERIAL, Executor
from hloc_reduce.group_writer import failures
from hloc_reduce.jobs import Job

from .shared import Shared

# what --dry_run takes for granted, of keypoints as DoG finds them at 1600 pixels
KEYPOINTS = 5000  # of an image
FEATURE_BYTES, MATCH_BYTES, MAP_BYTES = 14, 0.75, 67  # of a keypoint but for its descriptor, ...
COLUMNS = (
    *("dataset", "job", "feature", "matcher", "storage", "error"),
    *("descriptor_bytes", "bytes_per_keypoint", "seconds", "shared_seconds"),
    *("list", "threshold_m", "threshold_deg", "recall_percent"),
)


def main(
    job_file: Path,
    outputs: Path | None = None,
    overwrite: bool = False,
    strict: bool = False,
    executor: Executor = SERIAL,
) -> list[dict]:
    """Run jobs, and print and write their tables.

    Args:
        job_file: as of `jobs.read`.
        outputs: the folder for the results: jobs.csv, failures.csv, and for each data set a folder
            with one for each job; default: that of the file.
        overwrite: begin anew.
        strict: stop the jobs of a data set at an image that cannot be read. Else it counts as one
            without keypoints, is listed in failures.csv, and read again by a later run.
        executor: does the work.

    Returns:
        The rows of jobs.csv, of `COLUMNS`: for each job one for each list and threshold of recall,
        or one with the `error`.

    Raises:
        InputError: when the file is none of jobs, or another run is at work in `outputs`.
    """
    named, all_jobs = jobs.read(job_file)
    outputs = (outputs or named).resolve()
    cli.check_folder(outputs)
    lock = io.Lock(outputs)
    try:
        rows, unreadable, tables = [], [], []
        for shared in plan(all_jobs, outputs):
            shared.main(executor, strict, overwrite)
            summaries = {}
            for job in shared.running():
                logger.info("%s, %s:", shared.dataset.name, job.name)
                with shared.failing([job]):
                    summaries[job] = shared.pipeline.main(
                        shared.dataset,
                        folder_of(shared, job),
                        job.feature,
                        job.matcher,
                        shared.retrieval(job),
                        ground_truth=job.ground_truth,
                        overwrite=overwrite,
                        storage=job.storage,
                        executor=executor,
                        features=shared.features[job],
                        **job.numbers,
                    )
            rows += [row for job in shared.jobs for row in job_rows(shared, job, summaries)]
            unreadable += unreadable_images(shared)
            tables.append(table(shared, summaries))
            io.write_csv(rows, outputs / "jobs.csv", COLUMNS)
            io.write_csv(unreadable, outputs / "failures.csv", ("dataset", "image", "reason"))
    finally:
        lock.release()
    print("\n\n".join(tables))
    if unreadable:
        logger.warning("%d images could not be read: %s", len(unreadable), outputs / "failures.csv")
    return rows


def plan(all_jobs: list[Job], outputs: Path) -> Iterator[Shared]:
    """Yield the jobs of each data set, checked."""
    for dataset, of_dataset in jobs.by_dataset(all_jobs).items():
        dataset = dataset.resolve()
        yield Shared(dataset, of_dataset, outputs / dataset.name / "shared")


def folder_of(shared: Shared, job: Job) -> Path:
    """Return the outputs folder of a job."""
    return shared.folder.with_name(job.name)


def unreadable_images(shared: Shared) -> list[dict]:
    """Return the rows of failures.csv."""
    found = {}
    for path in shared.confs:
        if path.exists():
            found |= failures(path)
    return [
        {"dataset": shared.dataset.name, "image": name, "reason": reason}
        for name, reason in sorted(found.items())
    ]


def job_rows(shared: Shared, job: Job, summaries: Mapping[Job, dict]) -> Iterator[dict]:
    """Yield the rows of a job in jobs.csv."""
    row = {
        **dict.fromkeys(COLUMNS),
        "dataset": shared.dataset.name,
        "job": job.name,
        "feature": Path(job.feature).stem,
        "matcher": job.matcher,
        "storage": job.storage,
    }
    if job not in summaries:
        yield row | {"error": " ".join(str(shared.failed[job]).split())}
        return
    summary = summaries[job]
    row |= {
        "descriptor_bytes": summary["bytes_per_keypoint"]["descriptor"],
        "bytes_per_keypoint": summary["bytes_per_keypoint"]["feature_file"],
        "seconds": round(sum(summary["seconds"].values()), 1),
        "shared_seconds": round(sum(shared.seconds().values()), 1),
    }
    for name, found in summary["lists"].items():
        known = zip(found.get("thresholds_m_deg", ()), found.get("recall_percent", ()), strict=True)
        for (metres, degrees), recall in list(known) or [((None, None), None)]:
            values = name, metres, degrees, recall
            yield row | dict(zip(COLUMNS[-4:], values, strict=True))


def table(shared: Shared, summaries: Mapping[Job, dict]) -> str:
    """Format what came out of the jobs of a data set, with a line for each."""
    lists = next(iter(summaries.values()))["lists"] if summaries else {}
    limits = [
        list(zip(*found.get("thresholds_m_deg", ()), strict=True)) for found in lists.values()
    ]
    lines = [
        [shared.dataset.name, "bytes", "bytes/keypoint", "seconds", *lists],
        [
            "distance [m]",
            "",
            "",
            "",
            *(_joined(limit[0], "g") if limit else "" for limit in limits),
        ],
        [
            "orient. [deg]",
            "",
            "",
            "",
            *(_joined(limit[1], "g") if limit else "" for limit in limits),
        ],
    ]
    for job, summary in summaries.items():
        size = summary["bytes_per_keypoint"]
        lines.append(
            [
                job.name,
                str(size["descriptor"]),
                str(size["feature_file"]),
                f"{sum(summary['seconds'].values()):.1f}",
                *(
                    _joined(found.get("recall_percent", ()), ".1f")
                    or f"{found['localized']} localized"
                    for found in summary["lists"].values()
                ),
            ]
        )
    common = [f"{name} {seconds:.1f} s" for name, seconds in shared.seconds().items()]
    said = [f"in common: {', '.join(common)}"] if common else []
    said += [
        f"{job.name} failed: {' '.join(str(shared.failed[job]).split())}" for job in shared.failed
    ]
    return "\n".join([results.aligned(lines), *said] if summaries else [shared.dataset.name, *said])


def _joined(values: Iterator[float], kind: str) -> str:
    return " / ".join(format(value, kind) for value in values)


def dry_run(job_file: Path, outputs: Path | None = None) -> str:
    """Format what `main` would do: the steps, with about how many bytes they write.

    Args:
        job_file: as of `jobs.read`.
        outputs: as of `main`.
    """
    named, all_jobs = jobs.read(job_file)
    outputs = (outputs or named).resolve()
    lines, total = [["data set", "step", "of", "items", "", "MB"]], 0.0
    for shared in plan(all_jobs, outputs):
        for step, of, number, items, size in steps(shared) if shared.running() else ():
            lines.append(
                [shared.dataset.name, step, of, f"{number:,}", items, f"{size / 1e6:,.1f}"]
            )
            total += size
    return (
        f"{results.aligned(lines, left=3)}\n"
        f"About {total / 1e9:,.2f} GB in {outputs}, for {KEYPOINTS:,} keypoints an image. Pairs "
        "are at most so many. What is done already is done no more."
    )


def steps(shared: Shared) -> Iterator[tuple[str, str, int, str, float]]:
    """Yield the steps of the jobs of a data set: name, of what, how many of what items, bytes."""
    images, queries = len(shared.images()), len(shared.query_names)
    map_images = len(shared.map_names)
    for group in shared.groups():
        each = [
            FEATURE_BYTES
            + shared.dims[path] * np.dtype(shared.confs[path].get("storage", "float16")).itemsize
            for path in group
        ]
        names = ", ".join(path.stem.removeprefix("feats-dog-") for path in group)
        yield "extract_features", names, images, "images", images * KEYPOINTS * sum(each)
    for path in {shared.retrieval(job) for job in shared.running() if job.retrieval == "vlad"}:
        yield "retrieval", Path(path).stem, queries, "queries", 0
    for job in shared.running():
        if (folder_of(shared, job) / "summary.json").exists():
            yield "done", job.name, queries, "queries", 0
            continue
        numbers = shared.numbers(job)
        if "num_covis" in numbers:
            pairs = map_images * min(numbers["num_covis"], map_images - 1)
            yield "match_map", job.name, pairs, "pairs", pairs * KEYPOINTS * MATCH_BYTES
            size = map_images * KEYPOINTS * MAP_BYTES
            yield "triangulation", job.name, map_images, "images", size
        pairs = queries * min(numbers["num_loc"], map_images)
        yield "match_queries", job.name, pairs, "pairs", pairs * KEYPOINTS * MATCH_BYTES
        yield "localization", job.name, queries, "queries", 0


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
        help="of a Ray cluster, for --executor ray (default: a new one, of this machine)",
    )
    parser.add_argument("--overwrite", action="store_true", help="compute anew what is there")
    args = parser.parse_args()
    cli.choose("executor", args.executor, executors.EXECUTORS)
    if args.address and args.executor != "ray":
        raise InputError("--address is of --executor ray.")
    if args.dry_run:
        print(dry_run(args.job_file, args.outputs))
        return
    jobs.read(args.job_file)  # is wrong before processes are started
    with executors.EXECUTORS[args.executor](args.address) as executor:
        rows = main(args.job_file, args.outputs, args.overwrite, args.strict, executor)
    failed = [f"{row['dataset']}/{row['job']}" for row in rows if row["error"]]
    if failed:
        raise InputError(f"{len(failed)} jobs failed, see above: {cli.some(failed)}.")


if __name__ == "__main__":
    cli.run(_main)
