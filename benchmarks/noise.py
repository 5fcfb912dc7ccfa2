"""Measure which blur helps a network in noisy photos.

Darkens the queries of a data set in Aachen's layout, adds noise, and localizes them with their
intrinsics in a map of its photos, after no blur, after given ones, and after the automatic one.
Noise and its estimate are in units of the contrast. Prints mean inliers; queries that are not
localized have none. With any blur lamps are cut off, too.
"""

from pathlib import Path

import numpy as np

from hloc_reduce import Localizer, maps
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.localization.confidence import AGREEMENT_NOISY, Gate
from hloc_reduce.networks import noise
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import read_image
from hloc_reduce.utils.progress import progress

GAIN = 0.2
AUTOMATIC = "automatic"
estimate = noise.relative_noise


def add_noise(photo: np.ndarray, amount: float, generator: np.random.Generator) -> np.ndarray:
    """Return a darker photo (H, W, 3) uint8, with noise in units of its contrast."""
    dark = GAIN * photo.astype(np.float32)
    deviation = amount * dark.mean(axis=2).std() * np.sqrt(3)  # the channels are averaged
    noisy = dark + deviation * generator.standard_normal(dark.shape, np.float32)
    return noisy.round().clip(0, 255).astype(np.uint8)


def blurred_by(blur: str) -> None:
    """Make networks blur every photo by a number of pixels, or as they think best."""
    if blur == AUTOMATIC:
        noise.relative_noise = estimate
    else:
        sigma = float(blur)
        needed = max((sigma / noise.BLUR) ** 2, sigma / noise.BLUR_LITTLE)
        noise.relative_noise = lambda _: needed


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset herz-jesus --feature edgepoint2_m32 xfeat")
    parser.add_argument("--dataset", type=Path, required=True, help="in Aachen's layout")
    parser.add_argument(
        "--feature", nargs="+", default=["edgepoint2_m32", "xfeat"], help="networks"
    )
    parser.add_argument("--list", default="day", help="queries: part of the name of their list")
    amounts = [0.0, 0.05, 0.1, 0.2, 0.4, 0.7]
    parser.add_argument("--noise", type=float, nargs="+", default=amounts, help="in contrasts")
    blurs = ["0", "1", "1.5", "2"]
    parser.add_argument("--blur", nargs="+", default=blurs, help="standard deviations in pixels")
    parser.add_argument("--output", type=Path, default=Path("outputs/noise"))
    args = parser.parse_args()
    place, noisy = Aachen(args.dataset), noise.NOISY
    lists = place.query_lists()
    queries = [query for name, part in lists.items() if args.list in name for query in part]
    if not queries:
        raise InputError(f"--list {args.list}: the lists are {', '.join(lists)}.")
    tried = [*args.blur, AUTOMATIC]
    print("| feature | noise | estimate | " + " | ".join(tried) + " |")
    print("| --- | ---: | ---: |" + " ---: |" * len(tried), flush=True)
    for feature in args.feature:
        built = maps.main(args.output / feature, place.images, place.reference_model, feature)
        localizer = Localizer(built.folder, gate=Gate(min_agreement=AGREEMENT_NOISY))
        for amount in args.noise:
            generator, estimates = np.random.default_rng(0), []
            inliers: dict[str, list[int]] = {blur: [] for blur in tried}
            for name, camera in progress(queries, f"Noise {amount}", "photo"):
                photo = add_noise(read_image(place.images / name), amount, generator)
                estimates.append(estimate(photo.mean(axis=2, dtype=np.float32) / 255))
                for blur, found in inliers.items():
                    blurred_by(blur)
                    noise.NOISY = noisy if blur == AUTOMATIC else 1e-9
                    pose, info = localizer.localize(photo, camera)
                    found.append(info["num_inliers"] if pose is not None else 0)
            cells = [f"{np.mean(found):,.0f}" for found in inliers.values()]
            print(
                f"| {feature} | {amount:g} | {np.mean(estimates):.3f} | " + " | ".join(cells) + " |"
            )


if __name__ == "__main__":
    cli.run(_main)
