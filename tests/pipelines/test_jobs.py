"""Job files."""

from pathlib import Path

import pytest
from command import write

from hloc_reduce.evaluation import published
from hloc_reduce.localization.gate import Gate
from hloc_reduce.utils.cli import InputError
from pipelines.batch import jobs, tables
from pipelines.batch.jobs import Job
from pipelines.batch.shared import Shared


def names(found):
    return [f"{job.dataset.name}/{job.name}" for job in found]


def test_a_grid_with_exclusions(tmp_path):
    file = write(
        tmp_path / "some.yaml",
        """
        jobs:
          - dataset: [data/a, data/b]
            feature: [sift, {descriptor: [sift, mkd], scheme: sv, dim: [64, 16]}]
          - {dataset: data/a, feature: sift, matcher: [NN-ratio, NN-mutual], num_loc: 3}
        exclude:
          - {dataset: "*b", feature: ["sift_sv*", mkd_sv16]}
        """,
    )
    outputs, found = jobs.read(file)
    assert outputs == Path("outputs/some")
    assert names(found) == [
        "a/sift",
        "a/sift_sv64",
        "a/sift_sv16",
        "a/mkd_sv64",
        "a/mkd_sv16",
        "b/sift",
        "b/mkd_sv64",
        "a/sift+num_loc3",
        "a/sift+NN-mutual+num_loc3",
    ]
    assert found[-1].numbers == {"num_loc": 3} and found[0].numbers == {}
    assert list(jobs.by_dataset(found)) == [Path("data/a").absolute(), Path("data/b").absolute()]


def test_the_gate_of_jobs(tmp_path):
    text = "jobs: [{dataset: a, feature: sift, min_confidence: [8, 12.5], min_inliers: [8, 20]}]"
    found = jobs.read(write(tmp_path / "a.yaml", text))[1]
    assert names(found)[3] == "a/sift+min_confidence12.5+min_inliers20"
    assert found[3].gate == Gate(12.5, 20)
    assert jobs.read(write(tmp_path / "a.yaml", "jobs: [{dataset: a}]"))[1][0].gate == Gate()
    text = "jobs: [{dataset: a, min_confidence: [8.0, 9]}]\nexclude: [{min_confidence: 8}]"
    assert len(jobs.read(write(tmp_path / "a.yaml", text))[1]) == 1


def test_a_job_that_is_listed_twice_is_one(tmp_path):
    text = "jobs: [{dataset: a, feature: [sift, sift]}, {dataset: [a], feature: sift}]"
    assert names(jobs.read(write(tmp_path / "a.yaml", text))[1]) == ["a/sift"]


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "a job file is a mapping of outputs, jobs, exclude, not None"),
        ("jobs: []", "there is no job"),
        ("jobs: [{feature: sift}]", "a grid of jobs names no dataset"),
        ("jobs: [{dataset: a, features: sift}]", "Unknown key of a grid of jobs 'features'"),
        ("jobs: [{dataset: a, feature: sft}]", "Unknown feature 'sft'. The nearest .* sift,"),
        ("jobs: [{dataset: a, feature: {descriptor: sift, dim: 64}}]", "has no scheme"),
        ("jobs: [{dataset: a, matcher: NN}]", "Unknown matcher 'NN'"),
        ("jobs: [{dataset: a, storage: int4}]", "Unknown storage 'int4'"),
        ("jobs: [{dataset: a, num_loc: 0}]", "num_loc is 0: at least 1"),
        ("jobs: [{dataset: a, num_loc: many}]", "num_loc is 'many': an integer is needed"),
        ("jobs: [{dataset: a, min_inliers: 8.5}]", "min_inliers is 8.5: an integer is needed"),
        ("jobs: [{dataset: a, min_confidence: -1}]", "must be finite and at least 0"),
        ("jobs: [{dataset: 3}]", "dataset is 3: a name is needed"),
        ("jobs: [{dataset: a}]\nexclude: [{job: a}]", "Unknown key of an entry of exclude 'job'"),
        ("jobs: [{dataset: [x/a, y/a]}]", "y/a and .*x/a would have the same folder"),
        ("jobs: [{dataset: a, num_loc: 2, retrieval: [x/b, y/b]}]", "two jobs .* differ in retri"),
        ("jobs: [{dataset: a, feature: [], num_loc: 3}]", "feature of a grid of jobs has no value"),
        ("jobs: [{dataset: a}]\nexclude: [{feature: mdk}]", "no job is excluded by"),
        ("outputs: [a]\njobs: [{dataset: a}]", "outputs is a folder, not"),
        ("jobs: !!python/object/apply:os.getcwd []", "cannot be read"),
        ("jobs: [", "cannot be read"),
    ],
)
def test_what_is_no_job_file(text, message, tmp_path):
    path = write(tmp_path / "jobs.yaml", text)
    with pytest.raises(InputError, match=message) as error:
        jobs.read(path)
    assert str(error.value).startswith(str(path))


def test_the_job_files_of_the_tables_have_all_features_of_the_paper(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where they are not
    for place in ("aachen", "inloc"):
        files = [Path("confs/jobs") / f"{place}_table{number}.yaml" for number in range(1, 5)]
        found = [job.feature for file in files for job in jobs.read(file)[1]]
        assert sorted(found) == sorted(published.localization())
    assert names(jobs.read(Path("demo.yaml"))[1])[0] == "demo_town/sift_sv64"


def test_a_job_without_a_list_of_another(aachen_layout, tmp_path):
    found = {"recall_percent": [50.0], "thresholds_m_deg": [[0.25, 10]]}
    size = {"descriptor": 32, "feature_file": 40.0}
    found |= {"queries": 3, "localized": 2}
    rest = {"bytes_per_keypoint": size, "seconds": {}, "queries": 3, "queries_localized": 2}
    made = [Job(dataset=aachen_layout, feature="sift", num_loc=n) for n in (1, 2)]
    shared = Shared(aachen_layout, made, tmp_path / "shared")
    summaries = {
        made[0]: {"lists": {"DUC1": found}, **rest},
        made[1]: {"lists": {"DUC2": {**found, "recall_percent": [25.0]}}, **rest},
    }
    lines = [
        [cell.strip() for cell in line.split("|")][-2:]
        for line in tables.table(shared, summaries).splitlines()
    ]
    assert lines == [["DUC1", "DUC2"], ["0.25", "0.25"], ["10", "10"], ["50.0", "-"], ["-", "25.0"]]
    assert [(row["job"], row["list"]) for row in tables.job_rows(shared, summaries)] == [
        ("sift+num_loc1", "DUC1"),
        ("sift+num_loc2", "DUC2"),
    ]
