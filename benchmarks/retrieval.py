"""Measure how well images of a map retrieve their neighbours by global descriptors and by signs.

The true neighbours of an image are the five, or ten, others that show most points together with it.
Prints their share among as many retrieved images: by VLAD as floats, and as compact maps keep it,
in some bytes an image (`hloc_reduce.hlm.signs`).
"""

from pathlib import Path

import numpy as np

from hloc_reduce.hlm import signs
from hloc_reduce.maps.map import Map
from hloc_reduce.pairs_from_retrieval import read_global
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError

NUMBERS = 5, 10  # of neighbours


def common_points(shown: list[np.ndarray]) -> np.ndarray:
    """Count the points that pairs of images share (I, I), 0 on the diagonal."""
    _, points = np.unique(np.concatenate(shown), return_inverse=True)
    shows = np.zeros((len(shown), points.max(initial=0) + 1), np.float32)
    shows[np.repeat(np.arange(len(shown)), [len(part) for part in shown]), points] = 1
    common = shows @ shows.T
    np.fill_diagonal(common, 0)
    return common


def recall(similarity: np.ndarray, common: np.ndarray, number: int) -> float:
    """Return the mean share of the neighbours of images that are retrieved.

    Args:
        similarity: (I, I), of images in rows to those in columns.
        common: (I, I) points that images share.
        number: of images that are retrieved, and of neighbours, at most.
    """
    apart = np.where(np.eye(len(similarity), dtype=bool), -np.inf, similarity)
    shares = []
    for retrieved, points in zip(np.argsort(-apart, axis=1), common, strict=True):
        neighbours = np.argsort(-points, kind="stable")[:number]
        neighbours = neighbours[points[neighbours] > 0]
        if len(neighbours):
            shares.append(np.isin(neighbours, retrieved[:number]).mean())
    return float(np.mean(shares))


def measure(built: Map, sizes: list[int]) -> list[str]:
    """Return the cells of a map: recall by floats, then by signs of some bytes."""
    model = colmap.read_model(built.sfm)
    images = sorted(model.images.values(), key=lambda image: image.name)
    ids = [colmap.point3D_ids(image) for image in images]
    common = common_points([part[part >= 0] for part in ids])
    whole = read_global(built.descriptors, [image.name for image in images])
    transformed = signs.hadamard(whole, whole.shape[1])
    similarities = [whole @ whole.T]
    for size in sizes:
        part = transformed[:, : 8 * size]
        similarities.append(part @ np.where(part > 0, 1, -1).T)
    recalls = [[100 * recall(one, common, number) for number in NUMBERS] for one in similarities]
    return [str(len(images)), *(" / ".join(f"{share:.1f}" for share in row) for row in recalls)]


def _main() -> None:
    parser = cli.Parser(__doc__, "--map outputs/place/map")
    parser.add_argument(
        "--map", type=Path, nargs="+", required=True, help="map folders of pipelines.localize"
    )
    parser.add_argument("--bytes", type=int, nargs="+", default=[128, 256], help="an image")
    args = parser.parse_args()
    if min(args.bytes) < 1:
        raise InputError("--bytes: at least 1.")
    print("| map | feature | images | whole |", " | ".join(f"{n} bytes" for n in args.bytes), "|")
    print("| --- | --- |", " | ".join(["---:"] * (2 + len(args.bytes))), "|")
    for folder in args.map:
        built = Map(folder)
        cells = [folder.parent.name, built.feature, *measure(built, args.bytes)]
        print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    cli.run(_main)
