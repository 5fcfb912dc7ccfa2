"""Compute the global descriptors of images, by which similar ones are retrieved."""

import hashlib
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import h5py
import numpy as np

from . import logger
from .confs import retrieval as retrieval_confs
from .runtime import parallel
from .runtime.group_writer import failures, resume_or_replace
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.feature_files import get_descriptors, get_features
from .utils.files import file_sha256, replacing
from .utils.h5 import file_provenance, list_h5_names, open_h5
from .utils.images import UnreadableImage
from .utils.options import Option
from .utils.paths import strings_as_paths
from .utils.progress import progress

if TYPE_CHECKING:
    from .retrieval import Retrieval

confs = retrieval_confs.confs


@strings_as_paths
def main(
    conf: dict,
    features: Path,
    vocabulary_images: list[str] | None = None,
    export_dir: Path | None = None,
    overwrite: bool = False,
    vocabulary: Path | None = None,
    image_list: list[str] | None = None,
    image_dir: Path | None = None,
) -> Path:
    """Compute a global descriptor for each readable image of a feature file, or for some.

    Stale ones, of other features or another vocabulary, are replaced.

    Args:
        conf: an entry of `confs`.
        features: feature file.
        vocabulary_images: the images to learn a vocabulary from: those of the map.
        export_dir: folder of `<conf["output"]>_<features>.h5` and the vocabulary; default: that of
            the features.
        overwrite: learn the vocabulary and compute all descriptors again.
        vocabulary: file of an existing vocabulary, such as the map's for queries.
        image_list: the images; default: all.
        image_dir: folder of the images, for a retrieval that needs them.

    Returns:
        The h5 file of global descriptors, `global_descriptor` (G,) float16 of unit norm.

    Raises:
        InputError: when there are no features to learn a vocabulary from, or no images.
    """
    from . import retrieval
    from .retrieval.vlad import read_vocabulary

    output = output_of(conf, features, export_dir)
    model = retrieval.load(conf["model"])
    if model.needs_image and image_dir is None:
        raise InputError(
            f"{output.name} needs the images, not only their features: give their folder."
        )
    failed = failures(features)
    listed = list_h5_names(features) if image_list is None else image_list
    names = [name for name in listed if name not in failed]
    made_from = {"model": conf["model"]}
    if model.needs_image:
        made_from["preprocessing"] = conf["preprocessing"]
    if model.learns:
        learned_from = "\n".join(vocabulary_images or [])
        made_from["vocabulary"] = (
            file_sha256(vocabulary)
            if vocabulary
            else hashlib.sha256(learned_from.encode()).hexdigest()
        )
    with open_h5(features) as file:
        made_from["features"] = file_provenance(file)
        with resume_or_replace(output, made_from, overwrite) as writer:
            todo = [name for name in names if name not in writer]
            if not todo:
                return output
            if model.learns:
                learned = vocabulary or vocabulary_of(output)
                if vocabulary is None and len(todo) == len(names):
                    _learn(model, file, vocabulary_images or [], learned)
                elif not learned.exists():
                    raise InputError(f"The vocabulary {learned} of {output} is gone: overwrite.")
                model.vocabulary = read_vocabulary(learned)
            preprocessing = conf.get("preprocessing", {})

            def describe(one: tuple[str, dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
                name, local = one
                image = image_dir and image_dir / name
                try:
                    found = model.describe_photo(local, image, preprocessing)
                except UnreadableImage:
                    raise
                except InputError as error:
                    raise InputError(f"{features}, {name}: {error}") from None
                return {"global_descriptor": found}

            read = ((name, get_features(file, name, model.feature_keys)) for name in todo)
            with closing(parallel.ordered("aggregate", describe, read)) as found:
                bar = progress(found, "Aggregating", "image", len(todo))
                for name, group in zip(todo, bar, strict=True):
                    writer.add(name, group)
    logger.info("Global descriptors are in %s.", output)
    return output


def output_of(conf: dict, features: Path, export_dir: Path | None = None) -> Path:
    """Return the file of the global descriptors of images, given the file of their features."""
    return (export_dir or features.parent) / f"{conf['output']}_{features.stem}.h5"


def vocabulary_of(descriptors: Path) -> Path:
    """Return the file of the vocabulary learned for a file of global descriptors."""
    return descriptors.with_suffix(".vocabulary.safetensors")


def vocabulary_if_any(conf: dict, descriptors: Path) -> Path | None:
    """Return `vocabulary_of` a file of global descriptors of a configuration that learns one."""
    from .retrieval import find

    return vocabulary_of(descriptors) if find(conf["model"]).learns else None


def _learn(model: "Retrieval", file: h5py.File, names: list[str], vocabulary: Path) -> None:
    """Learn a vocabulary from the local descriptors of images and write it."""
    from safetensors.numpy import save

    model.fit(_sample(file, names, model.conf["max_samples"]))
    with replacing(vocabulary) as temporary:
        temporary.write_bytes(save({"vocabulary": model.vocabulary}))


def _sample(file: h5py.File, names: list[str], max_samples: int) -> np.ndarray:
    """Read an even share of each image's descriptors: (N, D), about `max_samples` at most."""
    share = -(-max_samples // max(len(names), 1))
    samples: list[np.ndarray] = []
    for name in names:
        descriptors = get_descriptors(file, name)
        if samples and descriptors.shape[1] != samples[0].shape[1]:
            raise InputError(
                f"{file.filename}: the descriptors of {name} are {descriptors.shape[1]}-D, those "
                f"of {names[0]} {samples[0].shape[1]}-D."
            )
        samples.append(descriptors[:: -(-len(descriptors) // share) or 1])
    if not sum(map(len, samples)):
        raise InputError(f"No image for the vocabulary has features in {file.filename}.")
    return np.concatenate(samples)


@strings_as_paths
def of_map(
    features: Path,
    model: Path,
    conf: Annotated[dict, Option("retrieval", confs)],
    export_dir: Path | None = None,
    overwrite: bool = False,
    image_dir: Path | None = None,
) -> Path:
    """Compute global descriptors, with a vocabulary of the images of a map if they need one.

    Args:
        features: feature file.
        model: COLMAP model of the map images.
        conf: what computes global descriptors.
        export_dir: folder for the output; default: that of the features.
        overwrite: compute all descriptors again.
        image_dir: folder of the images, for a `conf` that needs them.
    """
    images = [image.name for image in colmap.read_model(model).images.values()]
    return main(conf, features, images, export_dir, overwrite, image_dir=image_dir)


def _main() -> None:
    example = "--features outputs/feats-dog-colmap_sift_sv64.h5 --model outputs/sfm"
    options.call(of_map, __doc__, example, conf="vlad")


if __name__ == "__main__":
    cli.run(_main)
