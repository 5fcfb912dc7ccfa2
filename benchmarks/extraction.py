"""Time the extraction of features of the map photos of a place, with different numbers of cores.

Adds rows to results/extraction.csv: milliseconds per photo, from reading it to writing its
features, the least of several rounds, in each of which the model is loaded once; and CPU seconds
per photo, for resizing, detection and description in this process, so that work of others on the
machine hardly counts. With a GPU, a photo is read on each core, up to eight.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from benchmarks import rows
from hloc_reduce import extract_features, extractors
from hloc_reduce.confs import features
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.utils import cli
from hloc_reduce.utils.images import read_image

NAME = "extraction"
PHOTOS = 16  # that CPU seconds are measured on, at most


def cpu_seconds(place: Aachen, conf: dict, rounds: int) -> tuple[float, float]:
    """Return the least mean CPU seconds per photo of several rounds, and the mean keypoints."""
    model = extractors.load(conf["model"]).eval()
    preprocessing, seconds, keypoints = conf["preprocessing"], [], []
    names = place.map_names()
    for name in names[:: -(-len(names) // PHOTOS)] * rounds:
        photo = read_image(place.images / name, preprocessing["grayscale"])
        start = time.process_time()
        keypoints.append(len(extractors.extract(model, photo, preprocessing)["keypoints"]))
        seconds.append(time.process_time() - start)
    return float(np.reshape(seconds, (rounds, -1)).mean(axis=1).min()), float(np.mean(keypoints))


def elapsed(place: Aachen, conf: dict, rounds: int) -> float:
    """Return the least seconds per photo of several rounds, after one photo that is not timed."""
    names, found = place.map_names(), []
    with TemporaryDirectory() as folder:
        extract_features.main(conf, place.images, Path(folder), image_list=names[:1])
        for number in range(rounds):
            start = time.perf_counter()
            extract_features.main(conf, place.images, Path(folder, str(number)), image_list=names)
            found.append((time.perf_counter() - start) / len(names))
    return min(found)


def _main() -> None:
    parser = cli.Parser(__doc__, "--dataset datasets/herz-jesus")
    add = parser.add_argument
    add("--dataset", type=Path, required=True, help="in Aachen's layout")
    add("--feature", nargs="+", default=["colmap_sift_sv64", "mini64"], help="local features")
    add("--cores", type=int, nargs="+", default=[1], help="numbers of cores to use")
    add("--rounds", type=int, default=3, help="rounds, of which the fastest counts")
    rows.add_again_option(parser)
    args = parser.parse_args()
    cli.check_positive(args, "rounds")
    place = Aachen(args.dataset)
    known = [] if args.again else rows.read(NAME)
    device = f" and {torch.cuda.get_device_name()}" if torch.cuda.is_available() else ""
    for cores in args.cores:
        torch.set_num_threads(cores)
        cv2.setNumThreads(cores)
        for name in args.feature:
            variant = f"{cores} core{'s' * (cores > 1)}{device}"
            cells = {"place": place.root.name, "feature": name, "variant": variant}
            if rows.select(known, **cells):
                continue
            conf, start = features.get(name)[1], time.perf_counter()
            cpu, keypoints = cpu_seconds(place, conf, args.rounds)
            cells |= {"photos": len(place.map_names()), "keypoints": keypoints}
            cells |= {"cpu_s": cpu, "ms": 1000 * elapsed(place, conf, args.rounds)}
            rows.add(NAME, [cells | rows.how(time.perf_counter() - start, cores)])


if __name__ == "__main__":
    cli.run(_main)
