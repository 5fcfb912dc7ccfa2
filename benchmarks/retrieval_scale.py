"""Search the signs of global descriptors in up to a million images, by this project and by faiss.

A compact map keeps 1,024 signs of an image's global descriptor, 128 bytes; of more than 100,000
images, queries are compared with 512 of all, and with all of the most similar ones. The descriptors
are those of a map's images, drawn again and again with noise. Queries are noisy, too. Adds rows to
results/retrieval.csv: milliseconds of a query on one core, seconds to build an index, and how many
of the first 20 images are of the image that a query is of. Needs faiss (pip install faiss-cpu).
"""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks import rows
from hloc_reduce import aggregate_features, extract_features
from hloc_reduce.confs import features as features_confs
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.hlm.signs import CANDIDATES, COARSE, Signs, columns, pack
from hloc_reduce.retrieval.ranking import rank, read_global
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.progress import progress

NAME = "retrieval"
QUERIES, FOUND = 50, 20
NOISE = 1.0  # norm of that of an image, and of a query, relative to the descriptor
BLOCK = 5000  # descriptors in memory at once
LINKS, EFFORT = 16, 256  # of HNSW, and of a search in it
CELLS_OF_ROOT, VISITED = 4, 0.05  # cells of IVF by the root of the images; share that is searched

Search = Callable[[np.ndarray], np.ndarray]  # the rows (FOUND,) of a query (G,), best first


def descriptors(place: Aachen, outputs: Path) -> np.ndarray:
    """Return the global descriptors (N, G) of the map images of a place."""
    conf, names = features_confs.get(features_confs.RECOMMENDED)[1], place.map_names()
    features = extract_features.main(conf, place.images, outputs, image_list=names)
    path = aggregate_features.main(retrieval_confs.get(retrieval_confs.VLAD), features, names)
    return read_global(path, names)


def noisy(descriptors: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Add noise to descriptors (N, G) of unit norm."""
    number = descriptors.shape[1]
    noise = generator.standard_normal(descriptors.shape, np.float32) * (NOISE / number**0.5)
    found = descriptors + noise
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def synthesize(
    real: np.ndarray, number: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Draw images and queries.

    Returns:
        The packed signs of the images, the rows (N,) of `real` that they are of; the queries (Q, G)
        and their rows (Q,).
    """
    generator = np.random.default_rng(0)
    of_query = generator.choice(len(real), QUERIES)
    queries = noisy(real[of_query], generator)
    of_image = generator.choice(len(real), number)
    packed = [
        pack(noisy(real[of_image[start : start + BLOCK]], generator))[0]
        for start in progress(range(0, number, BLOCK), "Images", "block")
    ]
    return np.concatenate(packed), of_image, queries, of_query


def searches(packed: np.ndarray, number: int) -> Iterator[tuple[str, Callable[[], Search]]]:
    """Yield the name of each way of searching, and what builds it."""
    import faiss

    bits = 8 * packed.shape[1]

    def by_signs() -> Search:
        found = Signs(columns(packed), number)
        return lambda query: rank(found.similarity(query)[None], FOUND)[0]

    def by_faiss(index: "faiss.IndexBinary") -> Search:
        if not index.is_trained:
            index.train(packed[:: max(1, len(packed) // 50_000)])
        index.add(packed)
        return lambda query: index.search(pack(query[None])[0], FOUND)[1][0]

    def hnsw() -> Search:
        index = faiss.IndexBinaryHNSW(bits, LINKS)
        index.hnsw.efSearch = EFFORT
        return by_faiss(index)

    def ivf() -> Search:
        cells = int(CELLS_OF_ROOT * len(packed) ** 0.5)
        quantizer = faiss.IndexBinaryFlat(bits)
        index = faiss.IndexBinaryIVF(quantizer, bits, cells)
        index.nprobe = max(1, int(VISITED * cells))
        return by_faiss(index)

    def by_some_signs() -> Search:
        first = Signs(columns(packed[:, :COARSE]), number)

        def search(query: np.ndarray) -> np.ndarray:
            rough = first.similarity(query)
            rows = np.argpartition(-rough, CANDIDATES * FOUND)[: CANDIDATES * FOUND]
            some = Signs(columns(packed[rows]), number)
            return rows[rank(some.similarity(query)[None], FOUND)[0]]

        return search

    yield "products with signs, all images", by_signs
    yield f"products with {8 * COARSE} signs, then all", by_some_signs
    yield "faiss, Hamming, all images", lambda: by_faiss(faiss.IndexBinaryFlat(bits))
    yield "faiss, Hamming, HNSW", hnsw
    yield "faiss, Hamming, IVF", ivf


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/demo_town-400 --images 10000 100000")
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="a place in Aachen's layout")
    add("--images", nargs="+", type=int, default=[10_000, 100_000, 1_000_000], help="numbers")
    add("--outputs", type=Path, default=Path("outputs/retrieval"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    if min(args.images) < FOUND:
        raise InputError(f"--images: at least {FOUND}.")
    import faiss

    faiss.omp_set_num_threads(1)
    real = descriptors(Aachen(args.dataset), args.outputs / args.dataset.name)
    for number in args.images:
        cells = {"place": args.dataset.name, "list": f"{number} images"}
        if not args.again and rows.select(rows.read(NAME), **cells):
            continue
        packed, of_image, queries, of_query = synthesize(real, number)
        found_rows = []
        for name, build in searches(packed, real.shape[1]):
            start = time.perf_counter()
            search = build()
            built = time.perf_counter()
            found = np.array([search(query) for query in queries])
            seconds = (time.perf_counter() - built) / len(queries)
            right = float((of_image[found] == of_query[:, None]).sum(axis=1).mean())
            measures = {"variant": name, "bytes": packed.shape[1], "photos": number}
            measures |= {"ms": 1000 * seconds, "build_s": built - start, "right": right}
            found_rows.append(cells | measures | rows.how(cores=1))
        rows.add(NAME, found_rows)


if __name__ == "__main__":
    cli.run(_main)
