"""Tell where the time of extracting the features of a folder of photos goes.

Extracts some photos by a command of its own and adds a row to results/extraction_parts.csv. Its
parts are core-seconds: `all_s`, wall seconds times cores, is the sum of

* `import_s`: until Python has the modules, while one core works;
* `start_s`: until the processes that detect keypoints have them, if the feature needs any;
* `copy_s`: handing photos to these processes, and keypoints back;
* `work_s`: reading, detecting and describing the photos, in one thread;
* `rest_s`: all else: writing, the first use of libraries, cores that share a memory or wait.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch

from benchmarks import rows
from hloc_reduce import extractors
from hloc_reduce.confs import features
from hloc_reduce.extractors import Detect
from hloc_reduce.runtime import parallel, processes
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images

NAME = "extraction_parts"
SAMPLE = 12  # photos on which seconds per photo are measured
TINY = np.zeros((32, 32), np.float32)


def python(cores: int, *arguments: str) -> float:
    """Run Python on some cores and return the wall seconds."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(cores)}
    return seconds(
        lambda: subprocess.run([sys.executable, *arguments], env=environment, check=True)
    )


def seconds(
    function: Callable[[], object], clock: Callable[[], float] = time.perf_counter
) -> float:
    """Return what a call takes by a clock."""
    start = clock()
    function()
    return clock() - start


def start_and_copy(detect: Detect, photos: list[np.ndarray], cores: int) -> tuple[float, float]:
    """Return the wall seconds until processes detect, and those of copying a photo's data."""
    start = time.perf_counter()
    with processes.pool(cores) as pool:
        for future in [pool.submit(detect, TINY) for _ in range(cores)]:
            future.result()
        started = time.perf_counter() - start
        shapes = [found.shape for found in detect(photos[0])]

        def copy() -> None:
            for photo in photos:
                for call in ((np.size, photo), *((np.zeros, shape) for shape in shapes)):
                    pool.submit(*call).result()

        return started, seconds(copy) / len(photos)


def parts(conf: str, images: Path, names: list[str], cores: int) -> dict[str, float]:
    """Return the parts of extracting photos with a feature, in core-seconds."""
    configuration = features.get(conf)[1]
    model, preprocessing = (
        extractors.load(configuration["model"]).eval(),
        configuration["preprocessing"],
    )
    sample = names[:: -(-len(names) // SAMPLE)]

    def work() -> None:
        for name in sample:
            extractors.extract(model, images / name, preprocessing)

    extractors.extract(model, images / names[0], preprocessing)  # libraries are used a first time
    found = {"work_s": seconds(work, time.process_time) / len(sample) * len(names)}
    found |= {"start_s": 0.0, "copy_s": 0.0}
    if model.detect and model.detection_blocks:
        photos = [
            extractors.load_image(images / name, preprocessing)[0][0, 0].numpy() for name in sample
        ]
        started, copied = start_and_copy(model.detect, photos, cores)
        found |= {"start_s": cores * started, "copy_s": copied * len(names)}
    modules = "import torch; from hloc_reduce import extract_features, extractors"
    found["import_s"] = cores * python(cores, "-c", modules)
    with TemporaryDirectory() as folder:
        names_file = Path(folder, "names.txt")
        names_file.write_text("\n".join(names))
        command = f"-m hloc_reduce.extract_features --conf {conf} --export_dir {folder}".split()
        given = "--image_dir", str(images), "--image_list", str(names_file)
        found["all_s"] = cores * python(cores, *command, *given)
    found["rest_s"] = 2 * found["all_s"] - sum(found.values())
    return found


def _main() -> None:
    parser = cli.Parser(__doc__, "--images photos --photos 30 300")
    add = parser.add_argument
    add("--images", type=Path, required=True, help="folder of photos")
    add("--photos", type=int, nargs="+", default=[30], help="numbers of photos, each a row")
    add("--feature", nargs="+", default=[features.RECOMMENDED, "mini64"], help="local features")
    rows.add_again_option(parser)
    args = parser.parse_args()
    cores = parallel.cores()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    known = [] if args.again else rows.read(NAME)
    names = list_images(args.images, None)
    for number in args.photos:
        if not 0 < number <= len(names):
            raise InputError(
                f"{args.images} has {len(names)} photos: --photos {number} is not in it."
            )
        chosen = names[:: len(names) // number][:number]
        for feature in args.feature:
            place = args.images.resolve().parent.name
            cells = {"place": place, "feature": feature, "photos": number}
            cells["variant"] = f"{number} photos, {cores} core{'s' * (cores > 1)}"
            if not rows.select(known, **cells):
                found = parts(feature, args.images, chosen, cores)
                rows.add(NAME, [cells | found | rows.how(found["all_s"] / cores, cores)])


if __name__ == "__main__":
    cli.run(_main)
