"""Job files: grids of runs of the pipelines of data sets, in YAML.

    outputs: outputs/example           # default: outputs/<name of the file>
    jobs:                              # grids: each option has a value or a list of values
      - dataset: [datasets/aachen_v1.1, datasets/demo_town]
        feature: [sift, {descriptor: [sift, mkd], scheme: sv, dim: [64, 16]}]
        matcher: NN-ratio
    exclude:                           # jobs that match all given options; * matches anything
      - {dataset: "*demo_town", feature: "*16"}

The options are those of `pipelines.aachen` and `pipelines.inloc`.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from itertools import product
from pathlib import Path

from hloc_reduce.confs import features as features_confs
from hloc_reduce.runtime.outputs import SHARED
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.options import declared, flat, taken
from hloc_reduce.utils.parsers import read_yaml

from ..common.options import Method, Positive

SHIPPED = Path(__file__).parents[2] / "confs/jobs"
CALLED: dict[type | None, str] = {int: "an integer", float: "a number"}  # others are names
# the options that name a job's folder if they are not the default, in this order
NAMED = ("matcher", "storage", "keypoints", "retrieval", "rigs")
NUMBERS = ("num_covis", "num_loc", "min_confidence", "min_inliers")
NAME_PARTS = ("descriptor", "scheme", "dim")  # of a feature's name


@dataclass(frozen=True, kw_only=True)
class Job(Method):
    """A run of a pipeline.

    Args:
        dataset: data set folder.
        retrieval: a key of `confs.retrieval`, with the first feature of the data set, or a file.
        num_covis: other images that each map image is matched with; default: the pipeline's.
        num_loc: retrieved map images per query; default: the pipeline's.
    """

    dataset: Path
    num_covis: Positive | None = None

    @property
    def name(self) -> str:
        """The name of its folder: the feature, and all options that are not the default."""
        parts, options = [Path(self.feature).stem], flat(self)
        for name in (*NAMED, *NUMBERS):
            value, default = options[name], OPTIONS[name].default
            if name == "matcher":
                default = features_confs.matcher_of(features_confs.get(self.feature)[1])
            if value not in (None, default):
                text = f"{value:g}" if name in NUMBERS else Path(value).stem
                prefix = name if name in (*NUMBERS, "keypoints") else ""
                parts.append(prefix + text.removeprefix("pairs-query-"))
        return "+".join(parts)

    @property
    def numbers(self) -> dict[str, int]:
        """The --num_... options that are given."""
        given = {"num_covis": self.num_covis, "num_loc": self.num_loc}
        return {name: number for name, number in given.items() if number is not None}


OPTIONS = declared(Job)


def read(path: Path) -> tuple[Path, list[Job]]:
    """Read a job file; if `path` does not exist, the one of that name that ships.

    Returns:
        The folder for the results, and the jobs in the order of the file, each once.

    Raises:
        InputError: when the file is missing or wrong.
    """
    shipped = SHIPPED / path.name
    if not path.exists() and shipped.exists() and path.parent in (Path(), Path("confs/jobs")):
        path = shipped
    content = read_yaml(path)
    try:
        content = _mapping("a job file", content, ("outputs", "jobs", "exclude"))
        found = [job for grid in _list(content.get("jobs")) for job in _expand(grid)]
        excluded = [
            _mapping("an entry of exclude", item, OPTIONS) for item in _list(content.get("exclude"))
        ]
        outputs = content.get("outputs", f"outputs/{path.stem}")
        if not isinstance(outputs, str):
            raise InputError(f"outputs is a folder, not {outputs!r}.")
        for item in excluded:
            if not any(_matches(job, item) for job in found):
                raise InputError(f"no job is excluded by {item}.")
        jobs = [job for job in dict.fromkeys(found) if not any(_matches(job, e) for e in excluded)]
        if found and not jobs:
            raise InputError(f"all {len(found)} jobs are excluded.")
        _check(jobs)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return Path(outputs), jobs


def by_dataset(jobs: Iterable[Job]) -> dict[Path, list[Job]]:
    """Group jobs by data set."""
    groups: dict[Path, list[Job]] = {}
    for job in jobs:
        # links keep their names
        groups.setdefault(Path(os.path.abspath(job.dataset)), []).append(job)
    return groups


def _expand(grid: object) -> Iterator[Job]:
    """Yield the jobs of a grid."""
    grid = _mapping("a grid of jobs", grid, OPTIONS)
    if "dataset" not in grid:
        raise InputError("a grid of jobs names no dataset.")
    axes = {name: _list(value) for name, value in grid.items()}
    if "feature" in axes:
        axes["feature"] = [name for item in axes["feature"] for name in _features(item)]
    if empty := [name for name, values in axes.items() if not values]:
        raise InputError(f"{empty[0]} of a grid of jobs has no value.")
    for values in product(*axes.values()):
        yield _job(dict(zip(axes, values, strict=True)))


def _features(item: str | dict) -> list[str]:
    """Return the name of a feature, or those of a grid of descriptors, schemes and dimensions."""
    if not isinstance(item, dict):
        return [item]
    item = _mapping("a grid of features", item, NAME_PARTS)
    if absent := [part for part in NAME_PARTS if part not in item]:
        raise InputError(f"a grid of features has no {absent[0]}.")
    parts = product(*(_list(item[part]) for part in NAME_PARTS))
    return [f"{descriptor}_{scheme}{dim}" for descriptor, scheme, dim in parts]


def _job(options: dict) -> Job:
    """Make a job; raise an InputError for an option of the wrong type."""
    for name, value in options.items():
        called = CALLED.get(OPTIONS[name].kind, "a name")
        kinds = {"an integer": int, "a number": int | float, "a name": str}[called]
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise InputError(f"{name} is {value!r}: {called} is needed.")
    paths = {
        name: Path(os.path.normpath(options[name]))
        for name in ("dataset", "ground_truth")
        if name in options
    }
    job = Job(**taken(Job, options | paths))
    _, conf = features_confs.get(job.feature, storage=job.storage, keypoints=job.keypoints)
    return replace(job, matcher=job.matcher or features_confs.matcher_of(conf))


def _matches(job: Job, excluded: dict) -> bool:
    """Tell whether a job has one of the given values of each given option."""
    options = flat(job)
    return all(
        any(fnmatchcase(_text(options[name]), _text(value)) for value in _list(values))
        for name, values in excluded.items()
    )


def _text(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _check(jobs: list[Job]) -> None:
    """Raise an InputError if there is no job, or two would have the same folder."""
    if not jobs:
        raise InputError("there is no job.")
    datasets: dict[str, Path] = {}
    folders: dict[tuple[str, str], Job] = {}
    for job in jobs:
        path = Path(os.path.abspath(job.dataset))
        if datasets.setdefault(path.name, path) != path:
            raise InputError(
                f"{path} and {datasets[path.name]} would have the same folder: rename one, or use "
                "two job files."
            )
        if job.name == SHARED:
            raise InputError(f"a feature cannot be called {SHARED}: rename {job.feature}.")
        other = folders.setdefault((path.name, job.name), job)
        if other != job:
            options, others = flat(job), flat(other)
            differ = [name for name in OPTIONS if options[name] != others[name]]
            raise InputError(
                f"two jobs are called {job.name} of {job.dataset.name}, but differ in "
                f"{' and '.join(differ)}: rename a file or a folder, or use two job files."
            )


def _mapping(what: str, value: object, keys: Iterable[str]) -> dict:
    if not isinstance(value, dict):
        raise InputError(f"{what} is a mapping of {', '.join(keys)}, not {value!r}.")
    for key in value:
        cli.choose(f"key of {what}", key, keys)
    return value


def _list(value: object) -> list:
    if value is None:
        return []
    return value if isinstance(value, list) else [value]
