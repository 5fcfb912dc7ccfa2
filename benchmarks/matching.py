"""Time the matching of image pairs: mutual nearest neighbours with a ratio test.

Compares the nearest_neighbor of the installed hloc (or else the same computation in torch); ours,
for a run of pairs, one per core, whose floats are multiplied; and runs of pairs stored as float32,
uint8 and uint4, which are restored for every pair and matched as integers, as on a CPU. Adds rows
to results/matching.csv: milliseconds per pair, the least of several rounds in which all take turns.
A tenth of the descriptors of a pair match.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks import rows
from hloc_reduce.matchers.nearest_neighbor import NearestNeighbor
from hloc_reduce.runtime import parallel
from hloc_reduce.utils import best_two, cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.codes import CODED, restore, store, to_integers

NAME = "matching"
RATIO = 0.8
MATCHING = 0.1  # share of the descriptors
DIMS = (128, 64, 32, 24, 16)

# share of the matches that rounding to codes may change; uint4 changes what is matched
ROUNDED = {"float32": 0.01, "uint8": 0.02, "uint4": np.inf}

Pair = tuple[torch.Tensor, torch.Tensor]  # descriptors (N, D) and (M, D)
Stored = tuple[dict[str, np.ndarray], dict[str, dict]]  # as `codes.store` returns it


def make_pair(number: int, dim: int, seed: int, device: str) -> Pair:
    """Draw the descriptors (N, D) of two images, of unit norm."""
    generator = torch.Generator().manual_seed(seed)
    first, second = (
        torch.nn.functional.normalize(torch.randn(number, dim, generator=generator), dim=1)
        for _ in range(2)
    )
    matching = int(MATCHING * number)
    second[:matching] = first[:matching] + 0.3 * second[:matching]
    second = torch.nn.functional.normalize(second, dim=1)
    return first.to(device), second[torch.randperm(number, generator=generator)].to(device)


def coded(descriptors: torch.Tensor, storage: str) -> Stored:
    """Store descriptors (N, D); the levels of codes are quantiles."""
    numbers, levels = descriptors.T.cpu().numpy(), None
    if storage in CODED:
        number = 2 ** CODED[storage]
        levels = np.quantile(numbers, (np.arange(number) + 0.5) / number, axis=1).T
    return store({"descriptors": numbers}, storage, levels)


def hloc_matcher(device: str) -> tuple[str, Callable[[Pair], torch.Tensor]]:
    """Return the name and the function of hloc's matcher, or of `plain` without hloc."""
    try:
        from hloc.matchers.nearest_neighbor import NearestNeighbor as Original
    except ImportError:
        return "torch", plain
    model = Original({"ratio_threshold": RATIO}).eval().to(device)

    def match(pair: Pair) -> torch.Tensor:
        data = {f"descriptors{i}": part.T[None] for i, part in enumerate(pair)}
        return model(data)["matches0"][0]

    return "hloc", match


def plain(pair: Pair) -> torch.Tensor:
    """Match as hloc does: compute all similarities, and the best two of each row and column."""
    similarity = pair[0] @ pair[1].T
    nearest = []
    for view in (similarity, similarity.T):
        cosines, indices = view.topk(2, dim=1)
        accepted = 1 - cosines[:, 0] <= RATIO**2 * (1 - cosines[:, 1])
        nearest.append(torch.where(accepted, indices[:, 0], -1))
    forward, backward = nearest
    own = torch.arange(len(forward), device=forward.device)
    return torch.where((forward >= 0) & (backward[forward] == own), forward, -1)


def methods(data: list[Pair], device: str) -> dict[str, Callable[[list[Pair]], list]]:
    """Return the compared methods, functions of the list of pairs."""
    reference, match = hloc_matcher(device)
    ours = NearestNeighbor({"ratio_threshold": RATIO})
    batches = 1 if device == "cpu" else 64

    def match_pairs(pairs: list[Pair]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        return ours.match([tuple({"descriptors": part.T} for part in pair) for pair in pairs])

    def run(pairs: list[Pair]) -> list:
        parts = [pairs[i : i + batches] for i in range(0, len(pairs), batches)]
        workers = None if device == "cpu" else 1
        found = parallel.ordered("match", match_pairs, parts, workers)
        return [matches for part in found for matches, _ in part]

    def match_codes(pair: list[Stored]) -> torch.Tensor:
        first, second = (
            torch.from_numpy(to_integers(restore(*part, unbiased=True))) for part in pair
        )
        return match_pairs([(first, second)])[0][0]

    def run_codes(storage: str) -> Callable[[list[Pair]], list]:
        stored = [[coded(part, storage) for part in pair] for pair in data]
        return lambda _: list(parallel.ordered("match", match_codes, stored))

    return {
        reference: lambda pairs: [match(pair) for pair in pairs],
        "ours, run": run,
        **{storage: run_codes(storage) for storage in ROUNDED if device == "cpu"},
    }


@torch.no_grad()
def measure(number: int, dim: int, pairs: int, rounds: int, device: str) -> dict[str, float]:
    """Return the least seconds per pair of each method; check that all find the same matches."""
    data = [make_pair(number, dim, seed, device) for seed in range(pairs)]
    compared = methods(data, device)
    seconds = dict.fromkeys(compared, np.inf)
    expected = None
    for _ in range(rounds):
        for name, method in compared.items():
            start = time.perf_counter()
            found = method(data)
            if device != "cpu":
                torch.cuda.synchronize()
            seconds[name] = min(seconds[name], (time.perf_counter() - start) / pairs)
            if expected is None:
                expected = found
            for matches, right in zip(found, expected, strict=False):
                differing = int((matches.cpu() != right.cpu()).sum())
                if differing > ROUNDED.get(name, 0) * MATCHING * number:
                    print(f"{name}, {dim}: {differing} of {number} differ", file=sys.stderr)
    return seconds


def _main() -> None:
    parser = cli.Parser(__doc__, "--keypoints 8000")
    parser.add_argument("--keypoints", type=int, default=8000, help="of each image")
    parser.add_argument("--pairs", type=int, default=6, help="pairs in a run")
    parser.add_argument("--rounds", type=int, default=5, help="rounds in which all take turns")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    rows.add_again_option(parser)
    args = parser.parse_args()
    cli.check_positive(args, "keypoints", "pairs", "rounds")
    if args.device != "cpu" and not torch.cuda.is_available():
        raise InputError("There is no GPU.")
    device = "" if args.device == "cpu" else torch.cuda.get_device_name()
    code = next(iter(best_two.instructions()), "NumPy")
    for dim in DIMS:
        cells = {"place": f"{args.keypoints} x {args.keypoints}", "feature": f"{dim} numbers"}
        known = [row["variant"] for row in rows.select(rows.read(NAME), **cells)]
        if not args.again and any(device in variant for variant in known):
            continue
        start = time.perf_counter()
        seconds = measure(args.keypoints, dim, args.pairs, args.rounds, args.device)
        how = rows.how(time.perf_counter() - start, torch.get_num_threads())
        for method, value in seconds.items():
            stored = method if method in ROUNDED else "float32"
            with_code = f"{method} by {code}" if method in ROUNDED else method
            variant = " on ".join(filter(None, (with_code, device)))
            found = {"storage": stored, "variant": variant, "ms": 1000 * value}
            rows.add(NAME, [cells | found | how])


if __name__ == "__main__":
    cli.run(_main)
