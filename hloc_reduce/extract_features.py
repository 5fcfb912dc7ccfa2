"""Extract local features from images into an h5 file."""

from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import BrokenExecutor, Future
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from . import logger, projections
from .confs import features as features_confs
from .descriptors import DESCRIPTORS, check_weights
from .detectors.dog import KEYPOINT_SETTINGS, KeypointSettings
from .networks import NETWORKS, NOISE_REDUCTION, fetch_weights
from .runtime import parallel, processes
from .runtime.executors import SERIAL, Executor, Results
from .runtime.group_writer import FAILURE, Arrays, Group, GroupWriter, failures, fill
from .runtime.trace import span
from .utils import cli, options
from .utils.cli import InputError
from .utils.codes import FLOATS, STORAGES, Storage, store
from .utils.files import file_sha256
from .utils.images import UnreadableImage, check_readable, list_images, with_reasons
from .utils.masks import Mask
from .utils.masks import find as find_masks
from .utils.masks import read as read_mask
from .utils.options import HIDDEN
from .utils.parsers import image_names
from .utils.paths import strings_as_paths
from .utils.progress import progress

if TYPE_CHECKING:
    from .extractors import Detect, Extractor

confs = features_confs.confs
MASK = "mask"  # group attribute: the sha256 of the mask of the image
CHUNK = 8  # images
BLACK = np.zeros((32, 32), np.uint8)  # extracted instead of an image that cannot be read


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
    queries: Annotated[Collection[str], HIDDEN] = (),
    masks: Path | None = None,
) -> Path:
    """Extract the features of all images of a folder, or of a list of them.

    Args:
        conf: an entry of `confs`.
        image_dir: folder of images, which image names are relative to.
        export_dir: folder for the feature file, `<conf["output"]>.h5`.
        as_half: store everything but keypoints as float16, unless `conf` has a `storage`.
        image_list: text file of names, one per line (in Python, also the names); default: every
            image of the folder.
        feature_path: the feature file itself, instead of `export_dir`.
        overwrite: extract all features again.
        executor: runs the extraction.
        strict: stop at an image that cannot be read, instead of recording the failure.
        queries: images whose descriptors are stored as floats even if `conf` has another storage.
        masks: folder of masks, as COLMAP's: keypoints of `image_dir`/a/photo.jpg in black pixels of
            `masks`/a/photo.jpg.png are dropped; or one mask for all photos of its size.

    Returns:
        The feature file. Images that it has already are skipped.

    Raises:
        InputError: for an unknown storage or, if `strict`, a missing or unreadable image; and for
            wrong masks (`utils.masks.find`), or others than those of images that the file has.
    """
    if feature_path is None:
        if export_dir is None:
            raise InputError("Give --export_dir or --feature_path.")
        feature_path = export_dir / f"{conf['output']}.h5"
    stored = {"storage": "float16" if as_half else "float32", **conf}
    cli.choose("storage", stored["storage"], STORAGES)
    if strict or image_list is None:
        names = list_images(image_dir, image_list)
    else:
        names = image_names(image_list)
    found = find_masks(masks, image_dir, names)
    if overwrite:
        check_model(conf)
    with GroupWriter(feature_path, provenance(conf, as_half), overwrite) as writer:
        features = {feature_path: (stored, writer)}
        extract_several(features, image_dir, names, executor, strict, queries, found)
    return feature_path


def extract_several(
    features: Mapping[Path, tuple[dict, GroupWriter]],
    image_dir: Path,
    names: list[str],
    executor: Executor = SERIAL,
    strict: bool = True,
    queries: Collection[str] = (),
    masked: Mapping[str, Mask] | None = None,
) -> None:
    """Extract several features of images at once.

    Keypoints are detected once, and each base descriptor is computed once for all its projections.

    Args:
        features: from feature file to its configuration, with `storage`, and its writer. All have
            the same preprocessing and the same keypoints (`extractors.Extractor.detection`).
        image_dir: the folder that names are relative to.
        names: the images; those that a file has already are skipped.
        executor: runs the extraction.
        strict: stop at an image that cannot be read. Otherwise it gets the features of a black
            image and a `group_writer.FAILURE`, and a later run tries to read it again.
        queries: images whose descriptors are stored as floats. They are not kept for long, so that
            rounding them would save little.
        masked: the masks of images by name.

    Raises:
        UnreadableImage: if `strict`; it names all images that cannot be read.
        InputError: if a file has features of images with other masks.
    """
    masked = masked or {}
    for path, (_, writer) in features.items():
        _check_masks(path, writer, names, masked)
    confs = {path: conf for path, (conf, _) in features.items()}
    writers = {path: writer for path, (_, writer) in features.items()}
    missing = [(name, [path for path in writers if name not in writers[path]]) for name in names]
    todo = [(name, paths) for name, paths in missing if paths]
    if todo:
        if masked:
            number = sum(name in masked for name in names)
            logger.info("%d of %d photos are masked.", number, len(names))
        extract = partial(_extract, confs, image_dir, strict, frozenset(queries), masked)
        groups = sum(len(paths) for _, paths in todo)
        try:
            with closing(fill(writers, extract, todo, executor, CHUNK, gpu=True)) as written:
                for _ in progress(written, "Extracting features", "image", groups):
                    pass
        except UnreadableImage:
            todo_names = [name for name, _ in todo]
            check_readable(image_dir, progress(todo_names, "Checking photos", "image"))
            raise
    for path in writers:
        logger.info("Features of %d images are in %s.", len(names), path)


def _check_masks(
    path: Path, writer: GroupWriter, names: Iterable[str], masked: Mapping[str, Mask]
) -> None:
    """Raise an InputError if a file has features of images with other masks."""
    before = writer.texts(MASK)
    changed = [
        name
        for name in names
        if name in writer and before.get(name) != (masked[name].sha256 if name in masked else None)
    ]
    if changed:
        raise InputError(
            f"The features of {len(changed)} photos in {path} were made with other masks, or "
            f"without: {cli.some(changed)}. Give the same --masks, choose another output, or "
            "--overwrite."
        )


def _extract(
    confs: Mapping[Path, dict],
    image_dir: Path,
    strict: bool,
    queries: Collection[str],
    masked: Mapping[str, Mask],
    items: Iterable[tuple[str, list[Path]]],
) -> Results[tuple[Path, Group]]:
    """Yield the groups of images for those feature files that lack them.

    COLMAP's detector, unlike OpenCV's, blocks the other threads of its process, so several images
    are detected in processes and described in threads. Beside a GPU, reading an image takes longer
    than a network does, so several are read, and have their noise estimated, at once.
    """
    import torch

    from . import extractors

    items, preprocessing = list(items), next(iter(confs.values()))["preprocessing"]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    models = {path: extractors.load(confs[path]["model"]).eval().to(device) for path in confs}
    stores = {
        path: partial(_store, conf["storage"], features_confs.levels(conf), queries)
        for path, conf in confs.items()
    }
    model = next(iter(models.values()))
    detect, workers = model.detect, _workers(model, device, len(items))
    with ExitStack() as stack:
        if detect and model.detection_blocks and workers > 1:
            submit = stack.enter_context(processes.pool(workers)).submit
            detect = partial(_detect_elsewhere, submit, detect)
        extract = partial(
            extractors.extract_several, preprocessing=preprocessing, device=device, detect=detect
        )
        work = partial(_extract_image, extract, models, stores, image_dir, strict, masked)
        extracted: Iterable[list[tuple[Path, Group]]]
        if workers == 1:
            extracted = map(span("extract")(work), items)
        else:
            results = parallel.ordered("extract", work, items, workers)
            extracted = stack.enter_context(closing(results))
        for groups in extracted:
            yield from groups


def _workers(model: "Extractor", device: str, images: int) -> int:
    """Return how many of the images are extracted at once."""
    if model.detect is None:
        images = min(images, model.gpu_images if device == "cuda" else model.cpu_images)
    return min(images, parallel.cores())


def _detect_elsewhere(
    submit: Callable[..., Future], detect: "Detect", image: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Detect keypoints in the process that a function is submitted to."""
    try:
        with span("detect"):
            return submit(detect, image).result()
    except BrokenExecutor:
        raise InputError(
            "A process that detects keypoints was killed, perhaps for lack of memory: use fewer "
            "cores, for example with OMP_NUM_THREADS=1. Finished work is kept."
        ) from None


def _extract_image(
    extract: Callable[..., list[dict[str, np.ndarray]]],
    models: Mapping[Path, "Extractor"],
    stores: Mapping[Path, Callable[..., tuple[Arrays, dict[str, dict]]]],
    image_dir: Path,
    strict: bool,
    masked: Mapping[str, Mask],
    item: tuple[str, list[Path]],
) -> list[tuple[Path, Group]]:
    """Extract the features of one image for some feature files, and return their groups."""
    name, paths = item
    wanted, failure = [models[path] for path in paths], None
    mask = masked.get(name)
    try:
        kept = None if mask is None else read_mask(mask.path)
        extracted = extract(wanted, image_dir / name, mask=kept)
    except UnreadableImage as error:
        if strict:
            raise
        failure = str(error)
        extracted = extract(wanted, BLACK)
        logger.warning(failure)
    if failure is None and len(extracted[0]["keypoints"]) == 0:
        logger.warning("Image %s has no keypoints.", name)
    groups = []
    for path, features in zip(paths, extracted, strict=True):
        measured = {key: features.pop(key) for key in ("uncertainty", "blur", "turns")}
        arrays, attrs = stores[path](name, features)
        attrs["keypoints"] = measured
        if failure is not None:
            attrs[""] = {FAILURE: failure}
        elif mask is not None:
            attrs[""] = {MASK: mask.sha256}
        groups.append((path, (name, arrays, attrs)))
    return groups


def _store(
    storage: str,
    levels: np.ndarray | None,
    queries: Collection[str],
    name: str,
    features: dict[str, np.ndarray],
) -> tuple[Arrays, dict[str, dict]]:
    """Return what a file stores of the features of an image."""
    if name in queries and storage not in FLOATS:
        storage = FLOATS[0]
    return store(features, storage, levels)


def provenance(conf: dict, as_half: bool = True) -> dict:
    """Return what determines the features: the configuration and the projection's checksum.

    Raises:
        InputError: when the projection, its levels or the weights of its base descriptor cannot be
            found.
    """
    made_from = {"model": conf["model"], "preprocessing": conf["preprocessing"], "as_half": as_half}
    if "storage" in conf:
        made_from["storage"] = conf["storage"]
    if (projection := conf["model"].get("projection")) is not None:
        # the name only, as the file may be moved
        made_from["model"] = {**conf["model"], "projection": Path(projection).name}
        made_from["projection_sha256"] = projections.checksum(projection)
    if features_confs.levels(conf) is not None and projection is None:
        made_from["levels_sha256"] = projections.checksum(features_confs.level_file(conf) or "")
    descriptor = features_confs.descriptor_of(conf["model"])
    if descriptor in list(DESCRIPTORS):  # one from a YAML file may be unhashable
        check_weights(descriptor)
    network = features_confs.network_of(conf["model"])
    if network in list(NETWORKS):
        given = features_confs.base_of(conf["model"]).get("weights")
        weights = fetch_weights(network, given)
        if given or not NETWORKS[network].urls:  # which may be trained anew
            made_from["weights_sha256"] = file_sha256(weights)
        made_from["noise_reduction"] = NOISE_REDUCTION
        if version := NETWORKS[network].version:
            made_from["network_version"] = version
    return made_from


def check_model(conf: dict) -> None:
    """Fail on a bad configuration of a feature before deleting anything.

    Raises:
        InputError: when its extractor cannot be made.
    """
    from . import extractors

    extractors.load(conf["model"])


def keep_present(image_dir: Path, names: list[str], accept_partial: bool) -> list[str]:
    """Return the images of a map whose files exist.

    Args:
        image_dir: the folder that names are relative to.
        names: the images of the map.
        accept_partial: leave out missing images.

    Raises:
        InputError: when an image is missing and `accept_partial` is not set, or all are missing.
    """
    absent = [name for name in names if not (image_dir / name).is_file()]
    return without(absent, names, accept_partial, f"are not in {image_dir}: {cli.some(absent)}")


def keep_readable(features: Path, names: list[str], accept_partial: bool) -> list[str]:
    """Return the images of a map that could be read, according to its feature file.

    Args:
        features: feature file, made without `strict`.
        names: the images of the map.
        accept_partial: leave out unreadable images.

    Raises:
        InputError: when an image is unreadable and `accept_partial` is not set, or all are
            unreadable.
    """
    failed = failures(features)
    broken = {name: failed[name] for name in names if name in failed}
    return without(list(broken), names, accept_partial, f"cannot be read: {with_reasons(broken)}")


def without(left_out: list[str], names: list[str], accept_partial: bool, reason: str) -> list[str]:
    """Return the other images of a map, if it may do without some.

    Args:
        left_out: the images that cannot be used.
        names: the images of the map.
        accept_partial: leave out some.
        reason: what is wrong with them, a predicate.

    Raises:
        InputError: when some are left out and `accept_partial` is not set, or all are.
    """
    if not left_out:
        return names
    if not accept_partial or len(left_out) == len(names):
        raise InputError(
            f"{len(left_out)} of {len(names)} images of the map {reason}."
            + (" Give --accept_partial to do without them." if len(left_out) < len(names) else "")
        )
    logger.warning("The map is without %d images, which %s.", len(left_out), reason)
    dropped = set(left_out)
    return [name for name in names if name not in dropped]


def _conf(
    conf: str = features_confs.RECOMMENDED,
    storage: Storage = STORAGES[0],
    keypoints: KeypointSettings = KEYPOINT_SETTINGS[0],
) -> dict:
    """Return the configuration of a feature.

    Args:
        conf: feature, see pipelines.aachen --list_features, or its YAML file.
        storage: storage of descriptors.
        keypoints: settings of the DoG detector.
    """
    return features_confs.get(conf, storage=storage, keypoints=keypoints)[1]


def _main() -> None:
    example = "--conf colmap_sift_sv64 --image_dir photos --export_dir outputs"
    parser = options.Parser(__doc__, example)
    parser.add(main)
    parser.add(_conf)
    given = parser.read()
    main(conf=_conf(**options.taken(_conf, given)), **options.taken(main, given))


if __name__ == "__main__":
    cli.run(_main)
