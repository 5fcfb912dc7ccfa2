"""Time the extraction of a folder of photos with different numbers of cores.

With a GPU, a photo is read on each core, up to eight. Prints a Markdown table of the milliseconds
per photo, from reading it to writing its features, the least of several rounds, in each of which
the network is loaded once; and, with a GPU, the peak of the memory that torch took there.
"""

import shutil
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import torch

from hloc_reduce import extract_features
from hloc_reduce.confs import features
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.images import list_images

MIN_PHOTOS = 64  # of a round


def measure(images: Path, conf: dict, cores: int, rounds: int) -> float:
    """Return the least seconds per photo of several rounds, after one photo that is not timed."""
    torch.set_num_threads(cores)
    cv2.setNumThreads(cores)
    names = list_images(images)
    found = []
    with TemporaryDirectory() as folder:
        extract_features.main(conf, images, Path(folder), image_list=names[:1])
        for number in range(rounds):
            start = time.perf_counter()
            extract_features.main(conf, images, Path(folder, str(number)), image_list=names)
            found.append((time.perf_counter() - start) / len(names))
    return min(found)


def copy_photos(images: Path, folder: Path) -> None:
    """Copy the photos of a folder into another, more than once if they are few."""
    names = list_images(images)
    for number in range(-(-MIN_PHOTOS // len(names))):
        for name in names:
            copy = folder / str(number) / name
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(images / name, copy)


def _main() -> None:
    parser = cli.Parser(__doc__, "--image_dir herz-jesus/images_upright/db --cores 1 4 8")
    add = parser.add_argument
    add("--image_dir", type=Path, required=True, help="folder of photos")
    add("--feature", nargs="+", default=["mini64", "xfeat", "aliked"], help="local features")
    add("--cores", type=int, nargs="+", default=[1, 8], help="numbers of cores to use")
    add("--rounds", type=int, default=3, help="rounds, of which the fastest counts")
    args = parser.parse_args()
    if min(*args.cores, args.rounds) < 1:
        raise InputError("--cores and --rounds: at least 1.")
    confs = {name: features.get(name)[1] for name in args.feature}
    gpu = torch.cuda.is_available()
    columns = [f"{cores} core{'s' * (cores > 1)} [ms]" for cores in args.cores]
    if gpu:
        columns.append("memory [MiB]")
    print(f"| feature | {' | '.join(columns)} |\n| --- |{' ---: |' * len(columns)}")
    with TemporaryDirectory() as folder:
        copy_photos(args.image_dir, Path(folder))
        for name, conf in confs.items():
            if gpu:
                torch.cuda.reset_peak_memory_stats()
            seconds = [measure(Path(folder), conf, cores, args.rounds) for cores in args.cores]
            cells = [f"{1000 * value:.1f}" for value in seconds]
            if gpu:
                cells.append(f"{torch.cuda.max_memory_allocated() / 2**20:,.0f}")
            print(f"| `{name}` | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    cli.run(_main)
