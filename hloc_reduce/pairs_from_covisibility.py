"""Pair each image of a COLMAP model with those that see most of the same points."""

import argparse
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array

from . import cli, colmap, logger
from .parsers import write_pairs


def main(model: Path, output: Path, num_matched: int) -> Path:
    """Write the pairs of every image with the `num_matched` most covisible others.

    Args:
        model: COLMAP model folder.
        output: text file of pairs.
        num_matched: pairs an image, at most.

    Returns:
        `output`.

    Raises:
        InputError: when there is no model or it has no covisible images.
    """
    if num_matched < 1:
        raise cli.InputError(f"num_matched is {num_matched}: at least 1.")
    reconstruction = colmap.read_model(model)
    if not reconstruction.images:
        raise cli.InputError(f"The model {model} has no images.")
    images = [reconstruction.images[i] for i in sorted(reconstruction.images)]
    counts = covisibility([colmap.point3D_ids(image) for image in images])
    pairs = []
    for i, image in enumerate(images):
        others = most_covisible(counts, i, num_matched)
        if not len(others):
            logger.warning("Image %s has no covisible image.", image.name)
        pairs += [(image.name, images[j].name) for j in others]
    if not pairs:
        raise cli.InputError(f"The model {model} has no covisible images: has it 3D points?")
    write_pairs(pairs, output)
    logger.info("Found %d covisible pairs.", len(pairs))
    return output


def covisibility(point3D_ids: list[np.ndarray]) -> "coo_array":
    """Count the points that images share.

    Args:
        point3D_ids: for each image the point of each keypoint, -1 where it has none.

    Returns:
        Sparse (images, images) counts with an empty diagonal, in CSR form.
    """
    points = [ids[ids >= 0] for ids in point3D_ids]
    rows = np.repeat(np.arange(len(points)), [len(ids) for ids in points])
    _, columns = np.unique(np.concatenate(points), return_inverse=True)
    shape = (len(points), columns.max(initial=-1) + 1)
    observed = coo_array((np.ones(len(rows), np.int64), (rows, columns)), shape).tocsr()
    counts = (observed @ observed.T).tolil()
    counts.setdiag(0)
    counts = counts.tocsr()
    counts.eliminate_zeros()
    return counts


def most_covisible(counts: "coo_array", i: int, number: int) -> np.ndarray:
    """Return the images that share most points with image `i`, best first, at most `number`."""
    row = counts[[i]].tocoo()
    return row.coords[1][np.lexsort((row.coords[1], -row.data))[:number]]


def _main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog="example: python -m hloc_reduce.pairs_from_covisibility "
        "--model 3D-models/aachen_v_1_1 --output pairs.txt",
        formatter_class=cli.HelpFormatter,
    )
    parser.add_argument("--model", type=Path, required=True, help="COLMAP model folder")
    parser.add_argument("--output", type=Path, required=True, help="text file of pairs")
    parser.add_argument("--num_matched", type=int, default=20, help="pairs an image, at most")
    main(**vars(parser.parse_args()))


if __name__ == "__main__":
    cli.run(_main)
