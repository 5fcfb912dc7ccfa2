"""Pair each image of a COLMAP model with the images that share most points with it."""

from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap

from . import logger
from .utils import cli, colmap, options
from .utils.parsers import write_pairs
from .utils.paths import strings_as_paths

IMAGES_PER_BLOCK = 256  # whose covisibility with all others is computed at once


@strings_as_paths
def main(model: Path, output: Path, num_matched: int) -> Path:
    """Write the pairs of every image with the `num_matched` most covisible others.

    Args:
        model: COLMAP model folder.
        output: text file of pairs.
        num_matched: maximum number of pairs per image.

    Returns:
        `output`.

    Raises:
        InputError: when there is no model, or no images of it are covisible.
    """
    if num_matched < 1:
        raise cli.InputError(f"num_matched is {num_matched}: at least 1.")
    reconstruction = colmap.read_model(model)
    if not reconstruction.images:
        raise cli.InputError(f"The model {model} has no images.")

    def pairs() -> Iterator[tuple[str, str]]:
        alone = 0
        for name, others in covisible(reconstruction, num_matched):
            if not others:
                logger.warning("Image %s has no covisible image.", name)
                alone += 1
            yield from ((name, other) for other in others)
        if alone == len(reconstruction.images):
            raise cli.InputError(
                f"The model {model} has no covisible images: it has no 3D point that two of them "
                "see. Use pairs_from_exhaustive or pairs_from_retrieval."
            )

    number = write_pairs(pairs(), output)
    logger.info("Found %d covisible pairs.", number)
    return output


def covisible(model: pycolmap.Reconstruction, number: int) -> Iterator[tuple[str, list[str]]]:
    """Yield each image of a model, by id, with those that share most points with it, best first.

    Args:
        model: with one or more images.
        number: maximum number of the others.
    """
    images = [model.images[i] for i in sorted(model.images)]
    ranking = most_covisible((colmap.point3D_ids(image) for image in images), number)
    for image, others in zip(images, ranking, strict=True):
        yield image.name, [images[j].name for j in others]


def most_covisible(point3D_ids: Iterable[np.ndarray], number: int) -> Iterator[np.ndarray]:
    """Yield for each image the rows of those that share most points with it, best first.

    Args:
        point3D_ids: for each image the points of its keypoints (N,), -1 for none.
        number: maximum number of rows for each image; ties keep the order of the images.
    """
    observed = colmap.visibility(point3D_ids)
    seen_by = observed.T.tocsr()
    for start in range(0, observed.shape[0], IMAGES_PER_BLOCK):
        counts = (observed[start : start + IMAGES_PER_BLOCK] @ seen_by).tocsr()
        for i, (begin, end) in enumerate(pairwise(counts.indptr), start):
            others, shared = counts.indices[begin:end], counts.data[begin:end]
            best = np.lexsort((others, -shared))
            yield others[best[others[best] != i][:number]]


def _main() -> None:
    example = "--model 3D-models/aachen_v_1_1 --output pairs.txt"
    options.call(main, __doc__, example, num_matched=20)


if __name__ == "__main__":
    cli.run(_main)
