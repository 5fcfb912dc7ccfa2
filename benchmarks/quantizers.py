"""Compare the levels of projections with other ways to code the same numbers in as many bytes.

The others are fitted to descriptors of the maps of --fit: `pq` and `opq` are product quantization,
plain and after a rotation; `rq` is residual quantization (all of faiss, a byte for each part);
`itq` rotates the numbers so that coding by levels loses less, and fits new levels; with `tcq`,
trellis coded quantization, the last eight bits of the code up to a number are the index of its
level; `signs` keeps a bit of each number, so that both sides coded compare by Hamming distance. AP
is that of matching_ap.py, on maps that no projection was trained on: with queries as floats, and
with both sides coded. Prints a Markdown table. Needs faiss-cpu.
"""

import argparse
import importlib.util
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from matching_ap import KINDS, draw_all
from rate import ap, load, stored
from torch.nn.functional import normalize

from hloc_reduce import projections
from hloc_reduce.training import levels
from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import CODED, descriptor_bytes
from hloc_reduce.utils.progress import progress

ROUNDS = {"itq": 50, "tcq": 25}
WINDOW = 256  # levels of a number, with `tcq`
FITTED = 40_000  # descriptors that a trellis is fitted to
Code = Callable[[torch.Tensor], torch.Tensor]  # numbers (N, D) to what their codes stand for


def product(numbers: np.ndarray, size: int) -> Code:
    """Fit a product quantizer of `size` bytes to numbers (N, D)."""
    import faiss

    return _faiss(faiss.ProductQuantizer(numbers.shape[1], size, 8), numbers)


def residual(numbers: np.ndarray, size: int) -> Code:
    """Fit a residual quantizer of `size` bytes to numbers (N, D)."""
    import faiss

    return _faiss(faiss.ResidualQuantizer(numbers.shape[1], size, 8), numbers)


def rotated_product(numbers: np.ndarray, size: int) -> Code:
    """Fit a rotation and a product quantizer of `size` bytes to numbers (N, D)."""
    import faiss

    rotation = faiss.OPQMatrix(numbers.shape[1], size)
    rotation.train(numbers)
    code = product(rotation.apply(numbers), size)

    def both(given: torch.Tensor) -> torch.Tensor:
        coded = code(torch.from_numpy(rotation.apply(given.numpy())))
        return torch.from_numpy(rotation.reverse_transform(coded.numpy()))

    return both


def rotated_levels(numbers: np.ndarray, size: int) -> Code:
    """Fit a rotation and levels to numbers (N, D), as many bits of each as `size` bytes hold."""
    dim = numbers.shape[1]
    storage = _storage(dim, size)
    fitted = torch.from_numpy(numbers)
    rotation = torch.linalg.eigh(torch.cov(fitted.T)).eigenvectors  # from the principal axes
    for _ in progress(range(ROUNDS["itq"]), "Rotating", "round"):
        turned = fitted @ rotation
        table = levels.fit(turned, CODED[storage]).numpy()
        left, _, right = torch.linalg.svd(fitted.T @ stored(turned, storage, table))
        rotation = left @ right
    table = levels.fit(fitted @ rotation, CODED[storage]).numpy()
    return lambda given: stored(given @ rotation, storage, table) @ rotation.T


def trellis(numbers: np.ndarray, size: int) -> Code:
    """Fit a trellis coded quantizer of `size` bytes to numbers (N, D)."""
    fitted = torch.from_numpy(numbers[:: -(-len(numbers) // FITTED)])
    bits = CODED[_storage(fitted.shape[1], size)]
    # neighbours in a trellis need levels that are far from each other: in random order
    normal = torch.distributions.Normal(fitted.mean(0), fitted.std(0))
    even = normal.icdf((torch.arange(WINDOW)[:, None] + 0.5) / WINDOW).T
    order = torch.rand(even.shape, generator=torch.Generator().manual_seed(0)).argsort(1)
    table = even.gather(1, order)
    for _ in progress(range(ROUNDS["tcq"]), "Fitting a trellis", "round"):
        chosen = _path(fitted, table, bits).T
        count = torch.zeros_like(table).scatter_add_(1, chosen, torch.ones_like(fitted.T))
        total = torch.zeros_like(table).scatter_add_(1, chosen, fitted.T)
        table = torch.where(count > 0, total / count, table)
    return lambda given: normalize(table.gather(1, _path(given, table, bits).T).T, dim=1)


def _path(numbers: torch.Tensor, table: torch.Tensor, bits: int) -> torch.Tensor:
    """Choose levels with the least squared error by the Viterbi algorithm.

    Args:
        numbers: (N, D) float32.
        table: (D, W) levels; the index of the level of number i is the last log2(W) bits of the
            code up to i, with zeros before the code.
        bits: of a number.

    Returns:
        Indices of levels (N, D) int64.
    """
    states, branches = table.shape[1] >> bits, 1 << bits
    cost = torch.full((len(numbers), states), torch.inf)
    cost[:, 0] = 0
    dropped = []  # the bits that leave the window
    for column, own in zip(numbers.T, table, strict=True):
        cost = cost.repeat_interleave(branches, 1) + (column[:, None] - own) ** 2
        cost, best = cost.view(-1, branches, states).min(1)
        dropped.append(best.to(torch.uint8))
    state, path = cost.argmin(1, keepdim=True), []
    for best in reversed(dropped):
        path.append(best.gather(1, state).long() * states + state)
        state = path[-1] >> bits
    return torch.cat(path[::-1], 1)


def signs(numbers: np.ndarray, size: int) -> Code:
    """Return a code of one bit of each number: whether it is positive."""
    return lambda given: normalize(torch.where(given > 0, 1.0, -1.0), dim=1)


QUANTIZERS = {
    "pq": product,
    "opq": rotated_product,
    "rq": residual,
    "itq": rotated_levels,
    "tcq": trellis,
    "signs": signs,
}


def fits(quantizer: str, dim: int, size: int) -> bool:
    """Tell whether a quantizer can code `dim` numbers in `size` bytes."""
    if quantizer == "signs":
        return dim == 8 * size
    if quantizer in ("itq", "tcq"):
        return _storage(dim, size) is not None
    return quantizer == "rq" or dim % size == 0


def _storage(dim: int, size: int) -> str | None:
    """Return the storage that codes `dim` numbers in `size` bytes, if there is one."""
    return next((s for s in CODED if descriptor_bytes(dim, s) == size), None)


def _faiss(quantizer, numbers: np.ndarray) -> Code:
    quantizer.train(numbers)

    def code(given: torch.Tensor) -> torch.Tensor:
        codes = quantizer.compute_codes(np.ascontiguousarray(given.numpy()))
        return normalize(torch.from_numpy(quantizer.decode(codes)), dim=1)

    return code


def _main() -> None:
    example = "--map sceaux/images:sceaux/sparse --fit fox/images:fox/sparse --feature sift_sv32"
    parser = cli.Parser(__doc__, example)
    add = parser.add_argument
    where = {"action": "append", "required": True, "metavar": "IMAGES:MODEL"}
    add("--map", **where, help="map to measure AP on")
    add("--fit", **where, help="map to fit the others to")
    add("--feature", nargs="+", default=["sift_sv32"], help="projections that ship")
    add("--quantizer", nargs="+", default=list(QUANTIZERS), help="what to compare levels with")
    add("--bytes", type=int, nargs="+", default=[8, 16], help="of a descriptor")
    add("--cache", type=Path, default=Path("outputs/training/maps"), help="folder for the tracks")
    add("--draws", type=int, default=1, help="draws of pairs of observations")
    args = parser.parse_args()
    cli.check_positive(args, "draws")
    for quantizer in args.quantizer:
        cli.choose("quantizer", quantizer, QUANTIZERS)
    for size in args.bytes:
        if size < 1:
            raise InputError(f"--bytes {size}: it must be at least 1.")
    if not importlib.util.find_spec("faiss"):
        raise InputError("The quantizers need faiss: pip install faiss-cpu.")
    loaded = {feature: projections.load(feature) for feature in args.feature}
    for feature, project in loaded.items():
        for size in args.bytes:
            if not any(fits(quantizer, project.dim, size) for quantizer in args.quantizer):
                raise InputError(f"No quantizer codes {feature} in {size} bytes.")
    maps, fit = parse_maps(args.map), parse_maps(args.fit, "--fit")
    print(f"| bytes | feature | code | {' / '.join(KINDS)} | both sides coded |")
    print("| ---: | --- | --- | ---: | ---: |")
    for feature, project in loaded.items():
        base = project.metadata["descriptor"]
        pairs = [draw_all(data, args.draws) for data in load(maps, base, args.cache)]
        fitted = levels.sample(load(fit, base, args.cache))
        _compare(args, feature, project, pairs, fitted)


def _compare(
    args: argparse.Namespace,
    feature: str,
    project: torch.nn.Module,
    pairs: list[dict[str, list]],
    fitted: torch.Tensor,
) -> None:
    """Print the rows of a feature, on pairs of base descriptors, fitted to others (N, B)."""
    with torch.inference_mode():
        numbers = np.ascontiguousarray(project(fitted).numpy())
    for size in args.bytes:
        codes: dict[str, Code] = {}
        if storage := _storage(project.dim, size):
            table = projections.levels(feature, storage)
            codes[f"`{storage}`"] = lambda x, s=storage, t=table: stored(x, s, t)
        for quantizer in args.quantizer:
            if fits(quantizer, project.dim, size):
                codes[quantizer] = QUANTIZERS[quantizer](numbers, size)
        for name, code in progress(codes.items(), f"{feature}, {size} bytes", "code", len(codes)):

            def coded(base: torch.Tensor, code=code) -> torch.Tensor:
                return code(project(base))

            values = ap(project, coded, pairs), ap(coded, coded, pairs)
            cells = (" / ".join(f"{value:.1f}" for value in row) for row in values)
            print(f"| {size} | {feature} | {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    cli.run(_main)
