"""Run the jobs of a file: grids of data sets, features, matchers and options of the pipelines.

The jobs of a data set share their work: keypoints are detected once, each base descriptor is
computed once for all its projections, and retrieval is done once. A job that fails does not stop
the others. An interrupted batch resumes.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from hloc_reduce import logger
from hloc_reduce.runtime.executors import SERIAL, Executor
from hloc_reduce.runtime.outputs import SHARED, Lock
from hloc_reduce.utils import cli
from hloc_reduce.utils.codes import STORAGES, descriptor_bytes
from hloc_reduce.utils.h5 import list_h5_names
from hloc_reduce.utils.options import Option, parameters
from hloc_reduce.utils.paths import strings_as_paths
from hloc_reduce.utils.tables import aligned

from ..common.options import Method
from . import jobs, tables
from .jobs import Job
from .shared import Shared, is_shared

# what --dry_run assumes: keypoints of an image of 1600 pixels, and bytes of a keypoint without its
# descriptor in a feature file, in a pair of a match file, and in a map
KEYPOINTS_PER_IMAGE = 5000
FEATURE_BYTES, MATCH_BYTES, MAP_BYTES = 14, 0.75, 67


@strings_as_paths
def main(
    job_file: Annotated[Path, Option(flags=("job_file",))],
    outputs: Path | None = None,
    overwrite: bool = False,
    strict: bool = False,
    executor: Executor = SERIAL,
) -> list[dict]:
    """Run jobs; print and write their tables.

    Args:
        job_file: YAML file of jobs, see docs/operations.md.
        outputs: folder for jobs.csv, jobs.txt, failures.csv and a folder for each data set, with
            one for each job; default: the one that the file names.
        overwrite: recompute existing results.
        strict: fail the jobs of a data set at an unreadable image. Otherwise it is left out of the
            map, or is a query that is not localized; failures.csv lists it, and a later run
            retries it.
        executor: where the work is done.

    Returns:
        The rows of jobs.csv, with the keys `tables.COLUMNS`: one for each job, query list and
        recall threshold, or one with the `error`.

    Raises:
        InputError: when the job file is wrong, or another run is at work in `outputs`.
    """
    named, all_jobs = jobs.read(job_file)
    outputs = (outputs or named).resolve()
    cli.check_folder(outputs)
    with Lock(outputs):
        done: list[tuple[Shared, dict[Job, dict]]] = []
        for shared in list(plan(all_jobs, outputs)):
            summaries: dict[Job, dict] = {}
            done.append((shared, summaries))
            shared.main(executor, strict, overwrite)
            for job in shared.running():
                logger.info("%s, %s:", shared.dataset.name, job.name)
                with shared.failing([job]):
                    options = {name: getattr(job, name) for name in parameters(Method)}
                    options |= shared.numbers(job)
                    options |= {
                        "retrieval": shared.retrieval(job),
                        "features": shared.features[job],
                        "overwrite": overwrite,
                        "executor": executor,
                        "strict": strict,
                        "accept_partial": not strict,
                    }
                    folder = folder_of(shared, job)
                    summaries[job] = shared.pipeline.main(shared.dataset, folder, **options)
                tables.write(done, outputs)
        rows, text = tables.write(done, outputs)
    print(text)
    logger.info("The tables are %s and jobs.txt.", outputs / "jobs.csv")
    return rows


def plan(all_jobs: list[Job], outputs: Path) -> Iterator[Shared]:
    """Yield the jobs of each data set, checked."""
    for dataset, of_dataset in jobs.by_dataset(all_jobs).items():
        yield Shared(dataset, of_dataset, outputs / dataset.name / SHARED)


def folder_of(shared: Shared, job: Job) -> Path:
    """Return the outputs folder of a job."""
    return shared.folder.with_name(job.name)


@strings_as_paths
def dry_run(job_file: Path, outputs: Path | None = None, overwrite: bool = False) -> list[str]:
    """Print the steps that `main` would do, with the approximate number of bytes they write.

    Args:
        job_file: as in `main`.
        outputs: as in `main`.
        overwrite: as in `main`.

    Returns:
        The jobs that cannot be run.
    """
    named, all_jobs = jobs.read(job_file)
    outputs = (outputs or named).resolve()
    cli.check_folder(outputs)
    lines, total, failed = [["data set", "step", "of", "items", "", "MB"]], 0.0, []
    for shared in plan(all_jobs, outputs):
        failed += [f"{shared.dataset.name}/{job.name}" for job in shared.failed]
        for step, of, number, items, size in steps(shared, overwrite):
            if number:
                size /= 1e6
                lines.append([shared.dataset.name, step, of, f"{number:,}", items, f"{size:,.1f}"])
                total += size
    if len(lines) > 1:
        print(aligned(lines, left=3))
    print(
        f"About {total / 1e3:,.2f} GB in {outputs}, for {KEYPOINTS_PER_IMAGE:,} keypoints an "
        "image. Numbers of pairs are upper limits. Finished steps are not counted."
    )
    return failed


def steps(shared: Shared, overwrite: bool) -> Iterator[tuple[str, str, int, str, float]]:
    """Yield the steps for a data set: name, feature or job, number and kind of items, bytes."""
    running = shared.running()
    if not running:
        return
    map_images, queries = len(shared.map_names), len(shared.query_names)
    for group in shared.groups():
        todo, size = set(), 0.0
        for path in group:
            done = path.exists() and not overwrite
            missing = set(shared.images()) - set(list_h5_names(path) if done else ())
            storage = shared.confs[path].get("storage", STORAGES[0])
            each = FEATURE_BYTES + descriptor_bytes(shared.dims[path], storage)
            size += len(missing) * KEYPOINTS_PER_IMAGE * each
            todo |= missing
        names = ", ".join(path.stem.removeprefix("feats-dog-") for path in group)
        yield "extract_features", names, len(todo), "images", size
    for path in dict.fromkeys(Path(shared.retrieval(job)) for job in running if is_shared(job)):
        if overwrite or not path.exists():
            yield "retrieval", path.stem.removeprefix("pairs-query-"), queries, "queries", 0
    for job in running:
        if (folder_of(shared, job) / "summary.json").exists() and not overwrite:
            continue
        numbers = shared.numbers(job)
        if "num_covis" in numbers:
            pairs = map_images * min(numbers["num_covis"], map_images - 1)
            yield "match_map", job.name, pairs, "pairs", pairs * KEYPOINTS_PER_IMAGE * MATCH_BYTES
            size = map_images * KEYPOINTS_PER_IMAGE * MAP_BYTES
            yield "triangulation", job.name, map_images, "images", size
        pairs = queries * min(numbers["num_loc"], map_images)
        yield "match_queries", job.name, pairs, "pairs", pairs * KEYPOINTS_PER_IMAGE * MATCH_BYTES
        yield "localization", job.name, queries, "queries", 0
