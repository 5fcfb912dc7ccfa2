"""Time the extraction of features of one photo, on one thread or several.

Prints a Markdown table: the keypoints, and the seconds of the CPU for resizing, detection and
description (not for reading the file), the least of several rounds in which all features take
turns. CPU seconds of all threads are added, so that work of others on the machine hardly counts.
"""

import time
from pathlib import Path

import cv2
import torch

from hloc_reduce import extractors
from hloc_reduce.confs import features
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import read_image

NETWORKS = ("mini32", "mini64", "edgepoint2_m32", "edgepoint2_m64", "xfeat", "aliked")
COMPARED = "colmap_sift"


def measure(image: Path, names: list[str], rounds: int) -> dict[str, tuple[int, float]]:
    """Return the number of keypoints and the least CPU seconds of each feature."""
    confs = {name: features.get(name)[1] for name in names}
    models = {name: extractors.load(conf["model"]).eval() for name, conf in confs.items()}
    photos = {grey: read_image(image, grey) for grey in (True, False)}
    found: dict[str, tuple[int, float]] = {}
    for _ in range(rounds):
        for name, model in models.items():
            preprocessing = confs[name]["preprocessing"]
            photo = photos[preprocessing["grayscale"]]
            start = time.process_time()
            extracted = extractors.extract(model, photo, preprocessing)
            seconds = time.process_time() - start
            found[name] = len(extracted["keypoints"]), min(seconds, found.get(name, (0, 1e9))[1])
    return found


def _main() -> None:
    parser = cli.Parser(__doc__, "--image herz-jesus/images_upright/db/0000.jpg")
    add = parser.add_argument
    add("--image", type=Path, required=True, help="a photo")
    add("--feature", nargs="+", default=[*NETWORKS, COMPARED], help="local features")
    add("--rounds", type=int, default=5, help="rounds in which all take turns")
    add("--threads", type=int, default=1, help="threads of torch and OpenCV")
    args = parser.parse_args()
    if min(args.rounds, args.threads) < 1:
        raise InputError("--rounds and --threads: at least 1.")
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    found = measure(args.image, args.feature, args.rounds)
    print("| feature | keypoints | CPU [s] |\n| --- | ---: | ---: |")
    for name, (keypoints, seconds) in found.items():
        print(f"| `{name}` | {keypoints:,} | {seconds:.2f} |")


if __name__ == "__main__":
    cli.run(_main)
