"""The tables of a batch: recall, bytes and seconds of its jobs, or their errors."""

import csv
from collections.abc import Iterator, Mapping
from pathlib import Path

from hloc_reduce.runtime.group_writer import failures
from hloc_reduce.utils.files import replacing, write_csv
from hloc_reduce.utils.tables import aligned, joined

from .jobs import Job
from .shared import Shared

HEADINGS = ("bytes/descriptor", "bytes/keypoint", "seconds", "localized")
LIMITS = "thresholds_m_deg"  # of a list in summary.json
COLUMNS = (
    "dataset",
    "job",
    "feature",
    "matcher",
    "storage",
    "keypoints",
    "retrieval",
    "num_covis",
    "num_loc",
    "error",
    "descriptor_bytes",
    "bytes_per_keypoint",
    "seconds",
    "shared_seconds",
    "list",
    "queries",
    "localized",
    "threshold_m",
    "threshold_deg",
    "recall_percent",
)


def write(done: list[tuple[Shared, dict[Job, dict]]], outputs: Path) -> tuple[list[dict], str]:
    """Write jobs.csv, jobs.txt and failures.csv; return the rows and the text of the first two.

    jobs.csv keeps the rows of jobs that are not in this batch.
    """
    rows = [row for shared, summaries in done for row in job_rows(shared, summaries)]
    over = {(row["dataset"], row["job"]) for row in rows}
    before = [
        row for row in read_rows(outputs / "jobs.csv") if (row["dataset"], row["job"]) not in over
    ]
    unreadable = [row for shared, _ in done for row in unreadable_images(shared)]
    texts = [table(shared, summaries) for shared, summaries in done]
    if unreadable:
        texts.append(
            f"Images that could not be read: {len(unreadable)}, in {outputs / 'failures.csv'}"
        )
    text = "\n\n".join(texts)
    write_csv(before + rows, outputs / "jobs.csv", COLUMNS)
    write_csv(unreadable, outputs / "failures.csv", ("dataset", "image", "reason"))
    with replacing(outputs / "jobs.txt") as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")
    return rows, text


def read_rows(path: Path) -> list[dict]:
    """Read the rows of an earlier jobs.csv; none if it has other columns."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        return list(reader) if tuple(reader.fieldnames or ()) == COLUMNS else []


def unreadable_images(shared: Shared) -> list[dict]:
    """Return the rows of failures.csv."""
    found: dict[str, str] = {}
    for path in shared.confs:
        if path.exists():
            found |= failures(path)
    return [
        {"dataset": shared.dataset.name, "image": name, "reason": reason}
        for name, reason in sorted(found.items())
    ]


def job_rows(shared: Shared, summaries: Mapping[Job, dict]) -> Iterator[dict]:
    """Yield the rows of jobs.csv for the jobs that are finished or failed."""
    for job in shared.jobs:
        row = {
            **dict.fromkeys(COLUMNS),
            "dataset": shared.dataset.name,
            "job": job.name,
            "feature": Path(job.feature).stem,
            "matcher": job.matcher,
            "storage": job.storage,
            "keypoints": job.keypoints,
            "retrieval": job.retrieval,
        }
        if job in shared.features:
            row |= shared.numbers(job)
        if job in shared.failed:
            yield row | {"error": one_line(shared.failed[job])}
        elif job in summaries:
            yield from _recall_rows(row, summaries[job], sum(shared.seconds().values()))


def _recall_rows(row: dict, summary: dict, shared_seconds: float) -> Iterator[dict]:
    """Yield the rows of a job, one for each query list and threshold."""
    row = row | {
        "descriptor_bytes": summary["bytes_per_keypoint"]["descriptor"],
        "bytes_per_keypoint": summary["bytes_per_keypoint"]["feature_file"],
        "seconds": round(sum(summary["seconds"].values()), 1),
        "shared_seconds": round(shared_seconds, 1),
    }
    for name, found in summary["lists"].items():
        known = zip(found.get(LIMITS, ()), found.get("recall_percent", ()), strict=True)
        for (metres, degrees), recall in list(known) or [((None, None), None)]:
            values = name, found["queries"], found["localized"], metres, degrees, recall
            yield row | dict(zip(COLUMNS[-6:], values, strict=True))


def table(shared: Shared, summaries: Mapping[Job, dict]) -> str:
    """Format the results of the jobs of a data set, one line each."""
    lists = {name: found for s in summaries.values() for name, found in s["lists"].items()}
    lines = [[shared.dataset.name, *HEADINGS, *lists]]
    for label, place in (("distance [m]", 0), ("orient. [deg]", 1)):
        limits = ([m_deg[place] for m_deg in found.get(LIMITS, ())] for found in lists.values())
        lines.append([label, *[""] * 4, *(joined(values, "g") for values in limits)])
    for job, summary in summaries.items():
        size = summary["bytes_per_keypoint"]
        recall = (summary["lists"].get(name, {}).get("recall_percent") for name in lists)
        lines.append(
            [
                job.name,
                str(size["descriptor"]),
                str(size["feature_file"]),
                f"{sum(summary['seconds'].values()):.1f}",
                f"{summary['queries_localized']} of {summary['queries']}",
                *(joined(values, ".1f") for values in recall),
            ]
        )
    said = [aligned(lines)] if summaries else [f"{shared.dataset.name}:"]
    if seconds := shared.seconds():
        said.append("shared: " + ", ".join(f"{name} {s:.1f} s" for name, s in seconds.items()))
    failed = [job for job in shared.jobs if job in shared.failed]
    said += [f"{job.name} failed: {one_line(shared.failed[job])}" for job in failed]
    return "\n".join(said)


def one_line(error: Exception) -> str:
    """Return the message of an error in one line."""
    return " ".join(str(error).split()) or type(error).__name__
