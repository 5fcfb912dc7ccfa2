"""What the jobs of a batch share on a data set: features and retrieval."""

import errno
import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hloc_reduce import extract_features, logger, match_features
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import matchers as matchers_confs
from hloc_reduce.confs.retrieval import confs
from hloc_reduce.datasets import true_poses
from hloc_reduce.datasets.layouts import layout_of
from hloc_reduce.detectors.dog import KEYPOINT_SETTINGS
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.executors import Executor
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.runtime.outputs import STAGES, RunFolder
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import STORAGES
from hloc_reduce.utils.files import announce

from ..common.dataset import SHARED_POINTS
from ..common.retrieval import check_model, check_retrieval, retrieve
from ..common.run import readable
from ..layouts import pipeline_of
from .jobs import Job

RECORD = "shared.json"  # the feature file that retrieval uses, in later runs too


def is_shared(job: Job) -> bool:
    """Tell whether a job retrieves by global descriptors, which jobs share, not by a file."""
    return job.retrieval in confs


class Shared:
    """The jobs of a data set, checked as far as can be before any work is done.

    Args:
        dataset: the folder of the data set.
        jobs: its jobs.
        folder: for the shared files.

    Attributes:
        failed: the reason why a job cannot be run, by job.
        features: the feature file of each other job.
        confs: the configuration of each feature file.
        dims: the number of dimensions in each feature file.
        pipeline: the module of the pipeline.
    """

    def __init__(self, dataset: Path, jobs: list[Job], folder: Path):
        self.dataset, self.jobs, self.folder = dataset, jobs, folder
        self.failed: dict[Job, Exception] = {}
        self.features: dict[Job, Path] = {}
        self.confs: dict[Path, dict] = {}
        self.dims: dict[Path, int] = {}
        self._detections: dict[Path, str] = {}  # provenance of the keypoints, by feature file
        self._used: set[str] = set()  # map images
        self._truths: set[Path | None] = set()  # checked values of ground_truth
        with self.failing(jobs):
            self.pipeline = pipeline_of(dataset)
            self._place = layout_of(dataset)(dataset)
            self.map_names = self._place.map_names()
            self.query_names = self._place.query_names()
            for job in jobs:
                with self.failing([job]):
                    self._check(job)

    def _check(self, job: Job) -> None:
        """Note what a job needs, or raise an error if it cannot be run."""
        from hloc_reduce import extractors

        for name in job.numbers:
            cli.choose(f"option for {self.dataset.name}", name, self.pipeline.Options().numbers)
        num_loc = self.numbers(job)["num_loc"]
        check_model(job.retrieval)
        used = check_retrieval(
            job.retrieval, self.folder, num_loc, self.query_names, self.map_names
        )
        self._place.check(used)
        if job.ground_truth not in self._truths:
            if job.ground_truth is None:
                self._place.true_poses()
            else:
                true_poses(self.query_names, job.ground_truth, True)
            self._truths.add(job.ground_truth)
        _, conf = features_confs.get(job.feature, None, job.storage, job.keypoints)
        made_from = extract_features.provenance(conf)
        fast = features_confs.matcher_of(conf)
        for step in matchers_confs.steps_of(job.matcher or fast, fast):
            match_features.check_model(matchers_confs.confs[step], made_from)
        model = extractors.load(conf["model"])
        stored = "" if job.storage == STORAGES[0] else f"-{job.storage}"
        found = "" if job.keypoints == KEYPOINT_SETTINGS[0] else f"-keypoints_{job.keypoints}"
        path = self.folder / f"{conf['output']}{stored}{found}.h5"
        if self.confs.setdefault(path, conf) != conf:
            raise InputError(f"{path.name} is the file of two features: rename a YAML file.")
        self.features[job] = path
        self.dims[path] = model.dim
        self._detections[path] = json.dumps([model.detection, conf["preprocessing"]], default=str)
        self._used |= set(self.map_names if self._place.whole_map else used)

    @contextmanager
    def failing(self, jobs: list[Job]) -> Iterator[None]:
        """Record an error in a block as the failure of jobs."""
        try:
            yield
        except Exception as error:
            if getattr(error, "errno", None) == errno.ENOSPC:  # a full disk concerns all jobs
                raise
            logger.error(
                "%s, %s: %s",
                self.dataset.name,
                cli.some(job.name for job in jobs),
                error,
                exc_info=not isinstance(error, (InputError, OSError)),
            )
            self.failed = dict.fromkeys(jobs, error) | self.failed

    def running(self) -> list[Job]:
        """Return the jobs that have not failed."""
        return [job for job in self.jobs if job not in self.failed]

    def numbers(self, job: Job) -> dict[str, int]:
        """Return the --num_... options of a job, with the defaults of its pipeline."""
        return self.pipeline.Options(**job.numbers).numbers

    def images(self) -> list[str]:
        """Return the images whose features are needed."""
        return [*sorted(self._used), *self.query_names]

    def groups(self) -> list[list[Path]]:
        """Return the feature files that are extracted together."""
        groups: dict[str, list[Path]] = {}
        for path in dict.fromkeys(self.features[job] for job in self.running()):
            groups.setdefault(self._detections[path], []).append(path)
        return list(groups.values())

    def retrieval(self, job: Job) -> str:
        """Return the retrieval file of a job, its own or a shared one."""
        if not is_shared(job):
            return str(Path(job.retrieval).resolve())
        name = f"pairs-query-{job.retrieval}{self.numbers(job)['num_loc']}.txt"
        return str(self.folder / f"{job.retrieval}_{self._features_of_retrieval().stem}" / name)

    def _features_of_retrieval(self) -> Path:
        """Return the feature file of retrieval: the first one, or that of an earlier run."""
        before = self.folder / provenance.read(self.folder / RECORD).get("vlad", "")
        return before if before in self.confs else self.features[next(iter(self.features))]

    def seconds(self) -> dict[str, float]:
        """Return the seconds of each stage of `main`, summed over all runs."""
        kept = provenance.read(self.folder / STAGES)
        return {name: stage["seconds"] for name, stage in kept.items()}

    def main(self, executor: Executor, strict: bool, overwrite: bool) -> None:
        """Extract the features and retrieve.

        Args:
            executor: where the work is done.
            strict: as in `extract_features.extract_several`.
            overwrite: recompute existing results.
        """
        if not self.running():
            return
        conf = {"dataset": str(self.dataset)}
        with (
            self.failing(self.running()),
            RunFolder(self.folder, conf, overwrite) as folder,
        ):
            for name in (SHARED_POINTS, f"{SHARED_POINTS}.pieces"):  # written by jobs
                announce(self.folder / name)
            with folder.stage("extract_features"):
                for group in self.groups():
                    with self.failing([j for j in self.running() if self.features[j] in group]):
                        self._extract(group, executor, strict)
            with folder.stage("retrieval"):
                for name in {job.retrieval: None for job in self.running() if is_shared(job)}:
                    jobs = [job for job in self.running() if job.retrieval == name]
                    with self.failing(jobs):
                        self._retrieve(name, jobs, not strict)

    def _extract(self, paths: list[Path], executor: Executor, strict: bool) -> None:
        """Extract features that have the same keypoints."""
        with ExitStack() as stack:
            features = {}
            for path in paths:
                made_from = extract_features.provenance(self.confs[path])
                writer = stack.enter_context(GroupWriter(path, made_from))
                features[path] = {"storage": STORAGES[0], **self.confs[path]}, writer
            extract_features.extract_several(
                features, self._place.images, self.images(), executor, strict, self.query_names
            )

    def _retrieve(self, retrieval: str, jobs: list[Job], accept_partial: bool) -> None:
        """Retrieve for the jobs with a key of `confs.retrieval`."""
        features = self._features_of_retrieval()
        if features not in {self.features[job] for job in self.running()}:
            raise InputError(f"Retrieval needs the features {features.stem}, which failed.")
        provenance.write(self.folder / RECORD, {"vlad": features.name})
        queries = readable(features, self.query_names)
        mapped = extract_features.keep_readable(features, self.map_names, accept_partial)
        for pairs, num_loc in {(self.retrieval(j), self.numbers(j)["num_loc"]) for j in jobs}:
            retrieve(retrieval, features, Path(pairs), num_loc, queries, mapped, self._place.images)
