"""Aggregate local features into global descriptors, for retrieval without trained weights."""

import hashlib
from contextlib import closing
from pathlib import Path
from typing import Annotated

import h5py
import numpy as np

from . import logger
from .confs import retrieval as retrieval_confs
from .runtime import parallel
from .runtime.group_writer import failures, resume_or_replace
from .utils import cli, colmap, options
from .utils.cli import InputError
from .utils.feature_files import get_descriptors
from .utils.files import file_sha256, replacing
from .utils.h5 import file_provenance, list_h5_names, open_h5
from .utils.options import Option
from .utils.paths import strings_as_paths
from .utils.progress import progress

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

    Returns:
        The h5 file of global descriptors, `global_descriptor` (G,) float16 of unit norm.

    Raises:
        InputError: when there are no features to learn a vocabulary from.
    """
    import torch
    from safetensors.numpy import save

    from . import aggregators
    from .retrieval.vlad import read_vocabulary

    output = (export_dir or features.parent) / f"{conf['output']}_{features.stem}.h5"
    model = aggregators.load(conf["model"]).eval()
    failed = failures(features)
    listed = list_h5_names(features) if image_list is None else image_list
    names = [name for name in listed if name not in failed]
    learned_from = "\n".join(vocabulary_images or [])
    made_from = {
        "model": conf["model"],
        "vocabulary": file_sha256(vocabulary)
        if vocabulary
        else hashlib.sha256(learned_from.encode()).hexdigest(),
    }
    with open_h5(features) as file:
        made_from["features"] = file_provenance(file)
        with resume_or_replace(output, made_from, overwrite) as writer:
            todo = [name for name in names if name not in writer]
            if not todo:
                return output
            if vocabulary is None:
                vocabulary = vocabulary_of(output)
                if len(todo) == len(names):
                    model.fit(_sample(file, vocabulary_images or [], conf["model"]["max_samples"]))
                    with replacing(vocabulary) as temporary:
                        temporary.write_bytes(save({"vocabulary": model.vocabulary}))
                elif not vocabulary.exists():
                    raise InputError(f"The vocabulary {vocabulary} of {output} is gone: overwrite.")
            model.vocabulary = read_vocabulary(vocabulary)

            def aggregate(described: tuple[str, np.ndarray]) -> dict[str, np.ndarray]:
                name, local = described
                try:
                    found = model({"descriptors": torch.from_numpy(local.T)[None]})
                except InputError as error:
                    raise InputError(f"{features}, {name}: {error}") from None
                return {"global_descriptor": found["global_descriptor"][0].half().numpy()}

            described = ((name, get_descriptors(file, name)) for name in todo)
            with closing(parallel.ordered("aggregate", aggregate, described)) as found:
                bar = progress(found, "Aggregating", "image", len(todo))
                for name, group in zip(todo, bar, strict=True):
                    writer.add(name, group)
    logger.info("Global descriptors are in %s.", output)
    return output


def vocabulary_of(descriptors: Path) -> Path:
    """Return the file of the vocabulary learned for a file of global descriptors."""
    return descriptors.with_suffix(".vocabulary.safetensors")


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
    conf: Annotated[dict, Option("aggregation", confs)],
    export_dir: Path | None = None,
    overwrite: bool = False,
) -> Path:
    """Compute global descriptors, with a vocabulary of the images of a map.

    Args:
        features: feature file.
        model: COLMAP model of the map images.
        conf: how local features are aggregated.
        export_dir: folder for the output; default: that of the features.
        overwrite: compute all descriptors again.
    """
    images = [image.name for image in colmap.read_model(model).images.values()]
    return main(conf, features, images, export_dir, overwrite)


def _main() -> None:
    example = "--features outputs/feats-dog-colmap_sift_sv64.h5 --model outputs/sfm"
    options.call(of_map, __doc__, example, conf="vlad")


if __name__ == "__main__":
    cli.run(_main)
