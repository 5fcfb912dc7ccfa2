"""Compare adaptive DoG settings with hloc's.

From each map, data sets are made with every third photo as a query: with photos of other sizes, and
with darker, blurred or noisy queries. These and the given data sets are run with --keypoints hloc
and adaptive. Prints a Markdown table of keypoints, points, recall, inliers, seconds and memory.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import darken_place
import numpy as np

from hloc_reduce.training.tracks import parse_maps
from hloc_reduce.utils import cli
from hloc_reduce.utils.images import read_image
from pipelines.layouts import pipeline_of

MEGAPIXELS = (0.3, 0.5, 1.0, 2.0, 12.0)
GAINS = (0.06, 0.12, 0.25, 0.5)
BLURS = (1.5, 3.0)  # standard deviations in pixels
NOISES = (0.02, 0.05)  # standard deviations, relative to full scale
COMPARED = ("hloc", "adaptive")
UNCHANGED = "as they are"
HEADINGS = (
    *("place", "photos", "--keypoints", "keypoints a photo", "points", "localized", "recall [%]"),
    *("median error", "mean inliers", "extraction [s]", "all [s]", "memory [MiB]"),
)


def keep(image: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """Return a photo as it is."""
    return image


def dim(image: np.ndarray, generator: np.random.Generator, gain: float) -> np.ndarray:
    """Darken a photo by a gain, with the blur and noise of `darken_place.darken`."""
    return darken_place.darken(image, generator, (gain, gain * 1.0001))


def blur(image: np.ndarray, _: np.random.Generator, sigma: float) -> np.ndarray:
    """Blur a photo."""
    return cv2.GaussianBlur(image, (0, 0), sigma)


def add_noise(image: np.ndarray, generator: np.random.Generator, sigma: float) -> np.ndarray:
    """Add noise to each pixel and channel of a photo."""
    view = image / 255 + sigma * generator.standard_normal(image.shape)
    return np.round(255 * view.clip(0, 1)).astype(np.uint8)


def conditions(images: Path) -> dict[str, tuple[Callable, float]]:
    """Return by name how queries are altered, and the scale of all photos."""
    height, width = read_image(min(images.iterdir())).shape[:2]
    sizes = {f"{size:g} MP": (keep, (size * 1e6 / (width * height)) ** 0.5) for size in MEGAPIXELS}
    varied = {f"gain {gain:g}": (partial(dim, gain=gain), 1.0) for gain in GAINS}
    varied |= {f"blur {sigma:g} px": (partial(blur, sigma=sigma), 1.0) for sigma in BLURS}
    varied |= {f"noise {sigma:g}": (partial(add_noise, sigma=sigma), 1.0) for sigma in NOISES}
    return {**sizes, UNCHANGED: (keep, 1.0), **varied}


def datasets(
    maps: dict[str, tuple[Path, Path]], given: list[Path], output: Path
) -> Iterator[tuple[str, str, Path]]:
    """Yield the place, condition and folder of each data set; make those that are missing."""
    for place, (images, model) in maps.items():
        for name, (vary, scale) in conditions(images).items():
            dataset = output / place / name.replace(" ", "_")
            if not (dataset / "queries/ground_truth_poses.txt").exists():
                darken_place.main(images, model, dataset, vary, scale)
            yield place, name, dataset
    for dataset in given:
        yield dataset.name, UNCHANGED, dataset


def run(dataset: Path, outputs: Path, feature: str, keypoints: str) -> tuple[dict, float]:
    """Run the pipeline of a data set; return its summary and its peak memory in MiB."""
    options = {"dataset": dataset, "outputs": outputs, "feature": feature, "keypoints": keypoints}
    command = [sys.executable, "-m", pipeline_of(dataset).__name__]
    command += [word for key, value in options.items() for word in (f"--{key}", str(value))]
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(command, stdout=quiet, stderr=quiet)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise cli.InputError(f"This failed: {' '.join(command)}")
    return json.loads((outputs / "summary.json").read_text()), usage.ru_maxrss / 1024


def _main() -> None:
    parser = cli.Parser(__doc__, "--map sceaux/images:sceaux/sparse")
    parser.add_argument("--map", action="append", default=[], metavar="IMAGES:MODEL")
    parser.add_argument(
        "--dataset", type=Path, action="append", default=[], help="in Aachen's or InLoc's layout"
    )
    parser.add_argument("--feature", default="colmap_sift_sv64", help="local feature")
    parser.add_argument("--output", type=Path, default=Path("outputs/keypoints"))
    args = parser.parse_args()
    print(
        f"| {' | '.join(HEADINGS)} |\n|{' --- |' * 3}{' ---: |' * (len(HEADINGS) - 3)}", flush=True
    )
    for place, name, dataset in datasets(parse_maps(args.map), args.dataset, args.output):
        for keypoints in COMPARED:
            outputs = args.output / "outputs" / place / dataset.name / keypoints
            summary, memory = run(dataset, outputs, args.feature, keypoints)
            photos = summary["map_images"] + summary["queries"]
            for part, found in summary["lists"].items():
                error = found.get("median_position_error_m")
                listed = part.removesuffix("_time_queries_with_intrinsics")
                values = (
                    *(place, name if len(summary["lists"]) == 1 else listed, keypoints),
                    f"{summary['bytes_per_keypoint']['keypoints'] / photos:,.0f}",
                    f"{summary.get('map_points3D', 0):,}",
                    f"{found['localized']} of {found['queries']}",
                    " / ".join(f"{value:.0f}" for value in found.get("recall_percent", ())),
                    f"{error:.4f}" if error is not None else "",
                    f"{found['mean_inliers']:.0f}",
                    f"{summary['seconds']['extract_features']:.1f}",
                    f"{sum(summary['seconds'].values()):.1f}",
                    f"{memory:.0f}",
                )
                print(f"| {' | '.join(values)} |", flush=True)


if __name__ == "__main__":
    cli.run(_main)
