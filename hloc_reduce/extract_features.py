"""Extract local features from images into an h5 file."""

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import closing
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from confs import features as features_confs

from . import cli, detection, extractors, logger, parallel, processes, projections
from .cli import InputError, no_folder
from .descriptors import DESCRIPTORS, check_weights
from .executors import SERIAL, Executor
from .extractors.dog import DoG
from .group_writer import FAILURE, Group, GroupWriter, Key, failures, fill
from .io import UnreadableImage, read_image
from .parsers import check_names, image_names
from .paths import strings_as_paths
from .progress import progress
from .storage import STORAGES, store
from .trace import span

confs = features_confs.confs
CHUNK = 8  # images
BLACK = 32  # pixels, the sides of what stands for an image that cannot be read
Detect = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]  # as colmap.detect_dog
IMAGE_SUFFIXES = {".jpg", ".jpeg", ".png"}
# of images that are not read
OTHER_SUFFIXES = {".bmp", ".gif", ".heic", ".jp2", ".ppm", ".tif", ".tiff", ".webp"}


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
        extractors.load(conf["model"])  # is wrong before anything is deleted, if it is
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
        features: from feature file to the configuration, with `storage`, and the writer; all of
            one `shared_key`.
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
        work = partial(_extract_groups, confs, image_dir, strict)
        # counts files: an image is as many as are wanted of it
        number = sum(len(paths) for _, paths in todo)
        with closing(fill(writers, work, todo, executor, CHUNK, gpu=True)) as done:
            for _ in progress(done, "Extracting features", "image", number):
                pass
    for path in writers:
        logger.info("Features of %d images are in %s.", len(names), path)


def shared_key(conf: dict) -> str:
    """Return what features have in common whose keypoints are the same."""
    base = conf["model"].get("base", conf["model"])
    if base["name"] == "dog":
        base = {key: value for key, value in base.items() if key != "descriptor"}
    return json.dumps([base, conf["preprocessing"]], sort_keys=True)


def _extract_groups(
    confs: Mapping[Path, dict],
    image_dir: Path,
    strict: bool,
    items: Iterable[tuple[str, list[Path]]],
) -> Iterator[tuple[Path, Group]]:
    """Yield the features of images, for each the wanted ones, as files keep them."""
    items = list(items)
    images = [(image_dir / name, paths) for name, paths in items]
    # closed at once if writing fails: it has processes
    with closing(extract_all(confs, images, strict)) as extracted:
        for (name, _), several in zip(items, extracted, strict=True):
            for path, features in several.items():
                uncertainty, failure = features.pop("uncertainty"), features.pop(FAILURE, None)
                if failure:
                    logger.warning(failure)
                elif len(features["keypoints"]) == 0:
                    logger.warning("Image %s has no keypoints.", name)
                arrays, attrs = store(features, confs[path]["storage"])
                attrs |= {"keypoints": {"uncertainty": uncertainty}}
                yield path, (name, arrays, attrs | ({"": {FAILURE: failure}} if failure else {}))


def extract_all(
    confs: Mapping[Key, dict], images: list[tuple[Path, list[Key]]], strict: bool = True
) -> Iterator[dict[Key, dict[str, np.ndarray]]]:
    """Extract features of images on all cores, and yield them in order.

    COLMAP's detector, which lets no other thread of its process run, gets processes. An extractor
    of another kind takes one image after the other, on all cores or a GPU.

    Args:
        confs: configurations, all of one `shared_key`.
        images: files, each with the keys of what is wanted of it.
        strict: raise an UnreadableImage. Else the features are those of a black image, and
            `FAILURE` says why.

    Yields:
        For each image the features, as of `extract`, by key.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    models = {key: extractors.load(conf["model"]).eval().to(device) for key, conf in confs.items()}
    model, conf = next(iter(models.values())), next(iter(confs.values()))
    base = getattr(model, "base", model)
    workers = min(parallel.cores(), len(images))

    def work(item: tuple[Path, list[Key]], detect: Detect | None = None) -> dict:
        image, keys = item
        extract = partial(extract_each, [models[key] for key in keys], device=device, detect=detect)
        try:
            found = extract(image, conf["preprocessing"])
        except UnreadableImage as error:
            if strict:
                raise
            black = np.zeros((BLACK, BLACK), np.uint8)
            found = [
                {**features, FAILURE: str(error)}
                for features in extract(black, conf["preprocessing"])
            ]
        return dict(zip(keys, found, strict=True))

    if workers == 1 or not isinstance(base, DoG):
        for item in images:
            with span("extract"):
                features = work(item)
            yield features
        return
    with processes.pool(workers) as pool:

        def detect(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            try:
                with span("detect"):
                    arguments = image, *base.settings
                    return pool.submit(detection.detect, *arguments).result()
            except BrokenExecutor:
                raise InputError(
                    "A process that detects keypoints was killed, perhaps for want of memory: "
                    "try fewer cores, for example OMP_NUM_THREADS=1. What is written is kept."
                ) from None

        yield from parallel.ordered("extract", partial(work, detect=detect), images, workers)


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
    base = conf["model"].get("base", conf["model"])
    if base["name"] == "dog" and base.get("descriptor") in list(DESCRIPTORS):
        check_weights(base["descriptor"])
    return made_by


def list_images(
    image_dir: Path, image_list: Path | str | Iterable[str] | None = None, folder: str = ""
) -> list[str]:
    """Return the names of the images of a folder, or of a list, checked to be there.

    Args:
        image_dir: the folder that names are relative to.
        image_list: names, or a text file of them; default: every image of `folder`.
        folder: a folder in `image_dir`.

    Raises:
        InputError: when there is none, or one of the list is not there.
    """
    within = Path(image_dir, folder)
    if not within.is_dir():
        raise no_folder(within)
    if image_list is None:
        files = sorted(path.relative_to(image_dir) for path in within.rglob("*"))
        names = [file.as_posix() for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
        others = [str(file) for file in files if file.suffix.lower() in OTHER_SUFFIXES]
        read = ", ".join(sorted(IMAGE_SUFFIXES))
        if not names:
            there_are = f" It has {cli.some(others)}, but only {read} are read." if others else ""
            raise InputError(f"There is no image in {within}.{there_are}")
        if others:
            logger.warning(
                "%d images in %s are ignored, as only %s are read: %s.",
                *(len(others), within, read, cli.some(others)),
            )
        return check_names(names, within)
    names = image_names(image_list)
    missing = [name for name in names if not (image_dir / name).is_file()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(names)} images are not in {image_dir}: "
            f"{', '.join(missing[:5])}{', ...' if len(missing) > 5 else ''}"
        )
    return names


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


def load_image(image: Path | np.ndarray, preprocessing: dict) -> tuple[torch.Tensor, np.ndarray]:
    """Read an image and resize it to at most `resize_max` pixels on its longer side.

    With `resize_force` smaller ones get so many, too.

    Args:
        image: its file, or its pixels (H, W) or (H, W, 3) RGB, uint8.
        preprocessing: `grayscale`, `resize_max`, `resize_force` of a feature's configuration.

    Returns:
        The image (1, C, H, W) float32 in [0, 1], and its original (width, height).

    Raises:
        InputError: when it cannot be read.
    """
    grayscale = preprocessing.get("grayscale", False)
    image = (
        convert(image, grayscale) if isinstance(image, np.ndarray) else read_image(image, grayscale)
    )
    image = image.astype(np.float32)
    size = np.array(image.shape[1::-1])
    resize_max = preprocessing.get("resize_max")
    if resize_max and (size.max() > resize_max or preprocessing.get("resize_force")):
        # one pixel at least: a panorama may be a thousand times wider than high
        new_size = np.maximum(1, np.round(size * (resize_max / size.max())).astype(int))
        smaller = (new_size <= size).all()
        interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR  # as hloc
        image = cv2.resize(image, new_size.tolist(), interpolation=interpolation)
    image = np.atleast_3d(image).transpose(2, 0, 1) / 255
    return torch.from_numpy(np.ascontiguousarray(image))[None], size


def convert(image: np.ndarray, grayscale: bool) -> np.ndarray:
    """Return pixels (H, W) or (H, W, 3) RGB, uint8, as (H, W) if `grayscale` or else (H, W, 3).

    Raises:
        InputError: for other arrays.
    """
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.size == 0:
        raise InputError(
            f"An image is uint8 (H, W) or (H, W, 3) RGB, not {image.dtype} {image.shape}."
        )
    if image.ndim == 3 and grayscale:
        return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 and not grayscale else image


def extract(
    model: torch.nn.Module,
    image: Path | np.ndarray,
    preprocessing: dict,
    device: str = "cpu",
) -> dict[str, np.ndarray]:
    """Extract the features of one image.

    Args:
        model: an extractor.
        image: as of `load_image`.
        preprocessing: as of `load_image`.
        device: of the model.

    Returns:
        keypoints (N, 2) float32 (x, y) in pixels of the original image, centres at integers;
        descriptors (D, N); scores, scales (pixels), oris (degrees) (N,), as far as the model has
        them; image_size (2,) width, height; and the uncertainty of the keypoints in pixels.
    """
    return extract_each([model], image, preprocessing, device)[0]


@torch.no_grad()
def extract_each(
    models: list[torch.nn.Module],
    image: Path | np.ndarray,
    preprocessing: dict,
    device: str = "cpu",
    detect: Detect | None = None,
) -> list[dict[str, np.ndarray]]:
    """Extract several features of one image, what they have in common once.

    Args:
        models: extractors, all of one `shared_key`.
        image: as of `load_image`.
        preprocessing: as of `load_image`.
        device: of the models.
        detect: finds DoG keypoints in place of the models, as `colmap.detect_dog`.

    Returns:
        Of each model what `extract` returns.
    """
    image, size = load_image(image, preprocessing)
    data = {"image": image.to(device)}
    bases = [getattr(model, "base", model) for model in models]
    if detect is not None:
        data["detected"] = detect(image[0, 0].numpy())
    elif len(models) > 1 and isinstance(bases[0], DoG):
        data["detected"] = bases[0].detect(data["image"])
    ratio = (size / np.array(image.shape[:1:-1])).astype(np.float32)
    described, extracted = {}, []
    for model, base in zip(models, bases, strict=True):
        key = json.dumps(base.conf, sort_keys=True, default=str)
        if key not in described:
            described[key] = base(data)
        found = described[key] if model is base else model.reduce(described[key])
        features = {key: value[0].cpu().numpy() for key, value in found.items()}
        features["keypoints"] = (features["keypoints"] + 0.5) * ratio - 0.5
        if "scales" in features:
            features["scales"] = features["scales"] * ratio.mean()
        features["image_size"] = size
        features["uncertainty"] = model.detection_noise * ratio.mean()
        extracted.append(features)
    return extracted


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
