"""Extract local features from images into an h5 file."""

import argparse
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from . import logger, projections
from .confs import features as features_confs
from .descriptors import DESCRIPTORS, check_weights
from .runtime import parallel, processes
from .runtime.executors import SERIAL, Executor
from .runtime.group_writer import FAILURE, Group, GroupWriter, failures, fill
from .runtime.trace import span
from .utils import cli
from .utils.cli import InputError
from .utils.feature_files import STORAGES, store
from .utils.images import UnreadableImage, list_images
from .utils.parsers import image_names
from .utils.paths import strings_as_paths
from .utils.progress import progress

confs = features_confs.confs
CHUNK = 8  # images
BLACK = 32  # pixels, the sides of what stands for an image that cannot be read


@strings_as_paths
def main(
    conf: dict,
    image_dir: Path,
    export_dir: Path | None = None,
    as_half: bool = True,
    image_list: Path | str | Iterable[str] | None = None,
    feature_path: Path | None = None,
    overwrite: bool = False,
    executor: Executor = SERIAL,
    strict: bool = True,
) -> Path:
    """Extract the features of all images of a folder, or of a list of them.

    Args:
        conf: an entry of `confs`.
        image_dir: the folder that the image names are relative to.
        export_dir: where `<conf["output"]>.h5` goes.
        as_half: store everything but keypoints as float16, unless `conf` says how.
        image_list: names, or a text file of them; default: every image of the folder.
        feature_path: the h5 file itself, instead of `export_dir`.
        overwrite: extract anew what is there.
        executor: does the work.
        strict: stop at an image that cannot be read, instead of recording the failure.

    Returns:
        The feature file; images it holds already are skipped.

    Raises:
        InputError: for an unknown storage, or if `strict` for an image that is not there or cannot
            be read.
    """
    if feature_path is None:
        feature_path = Path(export_dir) / f"{conf['output']}.h5"
    stored = {"storage": "float16" if as_half else "float32", **conf}
    cli.choose("storage", stored["storage"], STORAGES)
    if strict or image_list is None:
        names = list_images(image_dir, image_list)
    else:
        names = image_names(image_list)
    if overwrite:
        check_model(conf)
    with GroupWriter(feature_path, provenance(conf, as_half), overwrite) as writer:
        extract_several({feature_path: (stored, writer)}, image_dir, names, executor, strict)
    return feature_path


def extract_several(
    features: Mapping[Path, tuple[dict, GroupWriter]],
    image_dir: Path,
    names: list[str],
    executor: Executor = SERIAL,
    strict: bool = True,
) -> None:
    """Extract several features of images at once.

    Keypoints are detected once, and each base descriptor is computed once for all its projections.

    Args:
        features: from feature file to the configuration, with `storage`, and the writer; all with
            the same keypoints (`extractors.Extractor.detection`) and preprocessing.
        image_dir: the folder that names are relative to.
        names: the images; a file's own are skipped.
        executor: does the work.
        strict: stop at an image that cannot be read. Else it has the features of a black one, and
            a `group_writer.FAILURE`; a later run tries to read it again.

    Raises:
        UnreadableImage: as said.
    """
    confs = {path: conf for path, (conf, _) in features.items()}
    writers = {path: writer for path, (_, writer) in features.items()}
    wanted = (
        (name, [path for path, writer in writers.items() if name not in writer]) for name in names
    )
    todo = [(name, paths) for name, paths in wanted if paths]
    if todo:
        work = partial(_extract, confs, image_dir, strict)
        # counts files: an image is as many as are wanted of it
        number = sum(len(paths) for _, paths in todo)
        with closing(fill(writers, work, todo, executor, CHUNK, gpu=True)) as done:
            for _ in progress(done, "Extracting features", "image", number):
                pass
    for path in writers:
        logger.info("Features of %d images are in %s.", len(names), path)


def _extract(
    confs: Mapping[Path, dict],
    image_dir: Path,
    strict: bool,
    items: Iterable[tuple[str, list[Path]]],
) -> Iterator[tuple[Path, Group]]:
    """Yield the features of images, for each the wanted ones, as files keep them.

    COLMAP's detector lets no other thread of its process run, so what an extractor detects apart
    is detected in processes.
    """
    import torch

    from . import extractors

    items, preprocessing = list(items), next(iter(confs.values()))["preprocessing"]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    models = {path: extractors.load(conf["model"]).eval() for path, conf in confs.items()}
    models = {path: model.to(device) for path, model in models.items()}

    def work(item: tuple[str, list[Path]], detect: Callable | None = None) -> list:
        name, paths = item
        wanted = [models[path] for path in paths]
        extract = partial(extractors.extract_several, wanted, device=device, detect=detect)
        failure = None
        try:
            found = extract(image_dir / name, preprocessing)
        except UnreadableImage as error:
            if strict:
                raise
            failure = str(error)
            found = extract(np.zeros((BLACK, BLACK), np.uint8), preprocessing)
        groups = [
            _to_group(name, features, confs[path]["storage"], failure)
            for path, features in zip(paths, found, strict=True)
        ]
        return list(zip(paths, groups, strict=True))

    workers, detect = min(parallel.cores(), len(items)), next(iter(models.values())).detect
    if workers == 1 or detect is None:
        for item in items:
            with span("extract"):
                groups = work(item)
            yield from groups
        return
    with _in_processes(detect, workers) as detect:
        results = parallel.ordered("extract", partial(work, detect=detect), items, workers)
        with closing(results):  # at once if writing fails: it has processes
            for groups in results:
                yield from groups


@contextmanager
def _in_processes(detect: Callable, workers: int) -> Iterator[Callable]:
    """Give a function that does in processes what another does here."""
    with processes.pool(workers) as pool:

        def detect_there(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            try:
                with span("detect"):
                    return pool.submit(detect, image).result()
            except BrokenExecutor:
                raise InputError(
                    "A process that detects keypoints was killed, perhaps for want of memory: "
                    "try fewer cores, for example OMP_NUM_THREADS=1. What is written is kept."
                ) from None

        yield detect_there


def _to_group(
    name: str, features: dict[str, np.ndarray], storage: str, failure: str | None
) -> Group:
    """Return the features of an image as a file keeps them."""
    if failure:
        logger.warning(failure)
    elif len(features["keypoints"]) == 0:
        logger.warning("Image %s has no keypoints.", name)
    arrays, attrs = store({k: v for k, v in features.items() if k != "uncertainty"}, storage)
    attrs["keypoints"] = {"uncertainty": features["uncertainty"]}
    return name, arrays, attrs | ({"": {FAILURE: failure}} if failure else {})


def provenance(conf: dict, as_half: bool = True) -> dict:
    """Return what determines the features: the configuration and the projection's checksum.

    Raises:
        InputError: when the projection or the weights of its base descriptor are not to be had.
    """
    made_by = {"model": conf["model"], "preprocessing": conf["preprocessing"], "as_half": as_half}
    if "storage" in conf:
        made_by["storage"] = conf["storage"]
    if (projection := conf["model"].get("projection")) is not None:
        # a file may be moved
        made_by["model"] = {**conf["model"], "projection": Path(projection).name}
        made_by["projection_sha256"] = projections.checksum(projection)
    descriptor = features_confs.descriptor_of(conf["model"])
    if descriptor in list(DESCRIPTORS):  # a wrong one may be of any kind
        check_weights(descriptor)
    return made_by


def check_model(conf: dict) -> None:
    """Fail for a bad configuration of a feature before anything is deleted.

    Raises:
        InputError: when its extractor cannot be made.
    """
    from . import extractors

    extractors.load(conf["model"])


def keep_present(image_dir: Path, names: list[str], accept_partial: bool) -> list[str]:
    """Return the images of a map whose files are there.

    Args:
        image_dir: the folder that names are relative to.
        names: the images of the map.
        accept_partial: leave out those that are not there.

    Raises:
        InputError: when one is missing that may not be left out, or all are.
    """
    absent = [name for name in names if not (image_dir / name).is_file()]
    if absent and (not accept_partial or len(absent) == len(names)):
        raise InputError(
            f"{len(absent)} of {len(names)} images of the map are not in {image_dir}: "
            f"{cli.some(absent)}."
            + (" Give --accept_partial to do without them." if len(absent) < len(names) else "")
        )
    return _without(names, absent)


def keep_readable(features: Path, names: list[str], accept_partial: bool) -> list[str]:
    """Return the images of a map that could be read, as its feature file tells.

    Args:
        features: feature file, made without `strict`.
        names: the images of the map.
        accept_partial: leave out those that could not be read.

    Raises:
        InputError: when one could not be read that may not be left out, or all could not.
    """
    failed = failures(features)
    broken = [name for name in names if name in failed]
    if broken and (not accept_partial or len(broken) == len(names)):
        raise InputError(
            f"{len(broken)} of {len(names)} images of the map cannot be read: "
            f"{with_reasons({name: failed[name] for name in broken})}."
            + (" Give --accept_partial to do without them." if len(broken) < len(names) else "")
        )
    return _without(names, broken)


def _without(names: list[str], left_out: list[str]) -> list[str]:
    if left_out:
        logger.warning("The map is without %d images: %s.", len(left_out), cli.some(left_out))
    dropped = set(left_out)
    return [name for name in names if name not in dropped]


def with_reasons(failed: Mapping[str, str]) -> str:
    """Name the first few images that could not be read, and why."""
    return cli.some(
        f"{name} ({reason.rpartition(': ')[2].rstrip('.')})" for name, reason in failed.items()
    )


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.extract_features --conf colmap_sift_sv64 "
        "--image_dir photos --export_dir outputs",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--image_dir", type=Path, required=True, help="folder of images")
    parser.add_argument("--export_dir", type=Path, help="folder for the feature file")
    parser.add_argument("--feature_path", type=Path, help="the feature file itself")
    parser.add_argument(
        "--conf",
        default=features_confs.RECOMMENDED,
        help="feature, see pipelines.aachen --list_features, or a YAML file of one",
    )
    parser.add_argument("--image_list", type=Path, help="text file of names, one a line")
    features_confs.add_storage_option(parser)
    features_confs.add_keypoints_option(parser)
    parser.add_argument("--overwrite", action="store_true", help="extract anew what is there")
    args = parser.parse_args()
    if args.export_dir is None and args.feature_path is None:
        raise InputError("Give --export_dir or --feature_path.")
    _, conf = features_confs.get(args.conf, storage=args.storage, keypoints=args.keypoints)
    main(
        conf,
        args.image_dir,
        args.export_dir,
        image_list=args.image_list,
        feature_path=args.feature_path,
        overwrite=args.overwrite,
    )


if __name__ == "__main__":
    cli.run(_main)
