"""Measure compact maps of up to 100 times the size of Aachen Day-Night v1.1: size, time, memory.

The names of the map images are the real ones; the rest is synthetic. The images stand in a row, one
metre apart, in front of a wall with 299 points a metre. Each shows 1,493 of them, so that the whole
map has 2 million points, each seen in five images, and 10 million observations. A query stands
between two images and shows the points of one, among clutter.

For each share, a process writes the model and the features, another one builds the compact map, and
a third one opens it and localizes queries, whose features it is given. For a share above 1, which
no model in memory can have, names are repeated, and the file is written from blocks of points; the
global descriptor of an image is then of the points, not of its keypoints. Queries are localized
twice: first after the system has forgotten the file, to count the bytes of it that are touched, by
the resident pages of its mapping; then to measure times. CPU seconds are of the process. Adds rows
to results/compact_scale.csv.
"""

import argparse
import json
import os
import resource
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
from safetensors.numpy import save_file

from benchmarks import rows
from hloc_reduce.confs import features as features_confs
from hloc_reduce.hlm import signs
from hloc_reduce.localization import intrinsics
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import image_names
from hloc_reduce.utils.progress import progress

NAME = "compact_scale"
FEATURE, DIM = "colmap_sift_sv32", 32
SEEN, STEP = 1493, 299  # points of an image; those that the next image does not show
DEPTH, SPREAD = 10.0, 2.0  # metres from the images to the wall, and its relief
NOISE = 0.2  # length of the noise vector that is added to a descriptor
CLUTTER = 6500  # keypoints of a query that show nothing
CAMERA = pycolmap.Camera(
    model="PINHOLE", width=1600, height=1200, params=[1600.0, 1600.0, 800.0, 600.0], camera_id=1
)
QUERIES = 20
BLOCK = 2**16  # points that are drawn at once
STAGES = ("retrieval", "matching", "pose", "mirror_image")


def unit(generator: np.random.Generator, number: int) -> np.ndarray:
    """Draw descriptors (N, D) float32 of unit norm."""
    drawn = generator.standard_normal((number, DIM), np.float32)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


@lru_cache(8)
def coordinates_of(block: int) -> np.ndarray:
    """Return the coordinates (BLOCK, 3) of a block of points."""
    generator = np.random.default_rng([0, block])
    ids = np.arange(BLOCK) + block * BLOCK
    height, relief = generator.uniform(-3, 3, BLOCK), generator.uniform(-1, 1, BLOCK)
    return np.stack([ids / STEP - SEEN / STEP / 2, height, DEPTH + SPREAD * relief], axis=1)


@lru_cache(8)
def descriptors_of(block: int) -> np.ndarray:
    """Return the descriptors (BLOCK, D) of a block of points."""
    return unit(np.random.default_rng([1, block]), BLOCK)


def wall(first: int, last: int, of_block: Callable[[int], np.ndarray]) -> np.ndarray:
    """Return the rows of points from first to last, which a function returns by blocks."""
    parts = []
    for block in range(first // BLOCK, (last - 1) // BLOCK + 1):
        parts.append(of_block(block)[max(0, first - block * BLOCK) : last - block * BLOCK])
    return np.concatenate(parts)


def num_points(images: int) -> int:
    """Return the number of points that a number of images show."""
    return (images - 1) * STEP + SEEN


def view(place: float) -> pycolmap.Rigid3d:
    """Return the pose, camera from world, at a place in the row."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-place, 0.0, 0.0]))


def seen(place: float) -> tuple[np.ndarray, ...]:
    """Return the points that are seen from a place, their pixels (M, 2) and descriptors (M, D)."""
    generator = np.random.default_rng([1, int(10 * place)])
    ids = np.arange(SEEN) + int(place) * STEP
    shown = int(ids[0]), int(ids[-1]) + 1
    pixels = CAMERA.img_from_cam(view(place) * wall(*shown, coordinates_of))
    pixels += generator.normal(0, 0.5, pixels.shape)
    views = wall(*shown, descriptors_of) + NOISE * unit(generator, SEEN)
    return ids, pixels, views / np.linalg.norm(views, axis=1, keepdims=True)


def synthesize(names: list[str], folder: Path) -> None:
    """Write a COLMAP model and a feature file."""
    from hloc_reduce import aggregate_features

    features, sfm = folder / "features.h5", folder / "sfm"
    sfm.mkdir()
    cameras = pycolmap.Reconstruction()
    cameras.add_camera(CAMERA)
    cameras.write(sfm)
    for file in sfm.glob("[!c]*.bin"):  # what pycolmap would take minutes to write
        file.unlink()
    with (
        GroupWriter(features, {"synthesized": len(names)}) as writer,
        (sfm / "images.bin").open("wb") as file,
    ):
        file.write(struct.pack("<Q", len(names)))
        for place, name in enumerate(progress(names, "Writing", "image")):
            ids, pixels, views = seen(place)
            pose = 1.0, 0.0, 0.0, 0.0, *view(place).translation
            file.write(struct.pack("<I7dI", place + 1, *pose, CAMERA.camera_id))
            file.write(name.encode() + b"\0" + struct.pack("<Q", len(ids)))
            observed = np.empty(len(ids), [("pixel", "<f8", 2), ("point", "<u8")])
            observed["pixel"], observed["point"] = pixels, ids + 1
            file.write(observed.tobytes())
            stored = {"keypoints": (pixels - 0.5).astype(np.float32)}
            stored |= {"descriptors": views.T.astype(np.float16)}
            writer.add(name, stored | {"image_size": np.array([CAMERA.width, CAMERA.height])})
    write_points(len(names), sfm / "points3D.bin")
    vlad = aggregate_features.confs["vlad"]
    aggregate_features.main(vlad, features, names[:: -(-len(names) // 100)])


def write_points(number: int, path: Path) -> None:
    """Write the points of a number of images, with their tracks, as COLMAP does."""
    xyz = wall(0, num_points(number), coordinates_of)
    ids = np.arange(len(xyz))
    first = np.maximum(0, -(-(ids - SEEN + 1) // STEP))
    lengths = np.minimum(ids // STEP, number - 1) - first + 1
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(xyz)))
        for i, (at, start, length) in enumerate(zip(xyz, first, lengths, strict=True)):
            file.write(struct.pack("<Q3d3BdQ", i + 1, *at, 0, 0, 0, 0.6, length))
            places = np.arange(start, start + length)
            file.write(np.stack([places + 1, i - places * STEP], 1).astype("<u4").tobytes())


class Wall:
    """The points of a wall, as `hlm.writer.Content`.

    Args:
        images: number of images.
    """

    def __init__(self, images: int):
        self._number = num_points(images)

    def __len__(self) -> int:
        return self._number

    def xyz(self, part: slice) -> np.ndarray:
        """Return the coordinates (K, 3) of some points."""
        return wall(part.start, min(part.stop, self._number), coordinates_of)

    def descriptors(self, part: slice) -> np.ndarray:
        """Return the descriptors (K, D) of some points."""
        return wall(part.start, min(part.stop, self._number), descriptors_of)

    def visible(self, image: int) -> np.ndarray:
        """Return the points that an image shows."""
        return np.arange(SEEN) + image * STEP


def global_signs(images: int, words: np.ndarray) -> np.ndarray:
    """Return the packed signs (I, B) of the VLAD of the points that images show.

    Args:
        images: number of images.
        words: the vocabulary (W, D).
    """
    packed, shown = [], -(-SEEN // STEP)  # metres that an image shows
    for start in progress(range(0, images, 1000), "Global descriptors", "block"):
        metres = min(1000, images - start) + shown - 1
        described = wall(start * STEP, (start + metres) * STEP, descriptors_of)
        nearest = (2 * described @ words.T - (words**2).sum(axis=1)).argmax(axis=1)
        of_word = np.repeat(np.arange(metres), STEP) * len(words) + nearest
        order = np.argsort(of_word, kind="stable")
        used, first = np.unique(of_word[order], return_index=True)
        sums = np.zeros((metres * len(words), DIM), np.float32)
        sums[used] = np.add.reduceat((described - words[nearest])[order], first)
        sums = sums.reshape(metres, len(words), DIM)
        rows = sum(sums[i : metres - shown + 1 + i] for i in range(shown))
        rows /= np.maximum(np.linalg.norm(rows, axis=2, keepdims=True), 1e-9)
        packed.append(signs.pack(rows.reshape(len(rows), -1))[0])
    return np.concatenate(packed)


def stream(names: list[str], folder: Path) -> dict:
    """Write the compact map block by block, without a model."""
    from hloc_reduce.hlm import writer
    from hloc_reduce.hlm.images import Images
    from hloc_reduce.retrieval.vlad import VLAD

    start, number = time.perf_counter(), len(names)
    vlad = VLAD({})
    vlad.fit(wall(0, 100 * STEP, descriptors_of))
    vocabulary = folder / "vocabulary.safetensors"
    save_file({"vocabulary": vlad.vocabulary.astype(np.float32)}, vocabulary)
    camera, unturned = np.zeros(number, int), np.tile([0.0, 0.0, 0.0, 1.0], (number, 1))
    centers = np.stack([np.arange(number), np.zeros(number), np.zeros(number)], axis=1)
    images = Images(names, unturned, centers, [CAMERA], camera)
    source = writer.Source(
        pycolmap.Reconstruction(),
        FEATURE,
        features_confs.get(FEATURE)[1] | {"storage": "uint4"},
        "NN-ratio90",
        Path(),
        vocabulary,
        intrinsics.of_cameras([CAMERA]),
    )
    described = global_signs(number, vlad.vocabulary.astype(np.float32))
    dim, step = vlad.vocabulary.size, 0.1 * DEPTH / CAMERA.mean_focal_length()
    with (folder / "place.hlm").open("wb") as file:
        parts = writer.write(file, Wall(number), images, source, described, dim, step)
        os.fsync(file.fileno())
    return built(parts, start)


def build(folder: Path, max_mb: float | None) -> dict:
    """Build the compact map, of a size at most."""
    from hloc_reduce import compact

    start = time.perf_counter()
    parts = compact.main(
        folder / "place.hlm",
        sfm=folder / "sfm",
        features=folder / "features.h5",
        feature=FEATURE,
        max_mb=max_mb,
    )
    return built(parts, start)


def built(parts: dict[str, int], start: float) -> dict:
    """Return the measures of a compact map of some bytes by part, whose building has begun."""
    return {
        "points": parts["descriptors"] * 2 // DIM,
        "build_s": time.perf_counter() - start,
        "build_cpu_s": time.process_time(),
        "build_mb": peak(),
        "mb": sum(parts.values()) / 1e6,
    }


def localize(number: int, folder: Path) -> dict:
    """Open the compact map and localize queries, whose features are given."""
    file = folder / "place.hlm"
    with file.open("rb") as opened_file:
        os.posix_fadvise(opened_file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    start = time.perf_counter()
    from hloc_reduce import Localizer

    imported, cpu = time.perf_counter(), time.process_time()
    localizer = Localizer(file)
    opened, open_cpu = time.perf_counter(), time.process_time() - cpu
    resident, open_mb = current(), touched(file)
    queries = [synthetic_query(place) for place in places(number)]
    coordinates_of.cache_clear()
    descriptors_of.cache_clear()
    before = current()
    touching: list[float] = []
    for again in (False, True):
        stages: dict[str, list[float]] = {stage: [] for stage in STAGES}
        right, correspondences, query_cpu = 0, [], []
        for place, query in zip(places(number), queries, strict=True):
            localizer.engine.extract = lambda *_, query=query: dict(query)
            last, cpu = touched(file), time.process_time()
            pose, info = localizer.localize(np.zeros((1200, 1600), np.uint8), CAMERA)
            query_cpu.append(time.process_time() - cpu)
            if not again:
                touching.append(touched(file) - last)
            for stage, seconds in stages.items():
                seconds.append(info["seconds"].get(stage, 0.0))
            correspondences.append(info["num_correspondences"])
            right += pose is not None and abs(pose.translation[0] + place) < 0.05
        if not again:
            cold = sum(sum(seconds) for seconds in stages.values()) / len(queries)
    return {
        "import_s": imported - start,
        "open_s": opened - imported,
        "open_cpu_s": open_cpu,
        "resident_mb": resident,
        "open_file_mb": open_mb,
        "first_query_file_mb": touching[0],
        "query_file_mb": float(np.mean(touching[1:])),
        "cold_query_s": cold,
        "queries_mb": current() - before,
        **{f"{stage}_s": float(np.mean(seconds)) for stage, seconds in stages.items()},
        "query_cpu_s": float(np.mean(query_cpu)),
        "correspondences": float(np.mean(correspondences)),
        "queries": len(queries),
        "localized": int(right),
    }


def touched(path: Path) -> float:
    """Return the resident size of the mapping of a file in this process, in 1,000,000 bytes."""
    kilobytes, found = 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        words = line.split()
        if "-" in words[0]:
            found = line.endswith(str(path))
        elif found and words[0] == "Rss:":
            kilobytes += int(words[1])
    return kilobytes * 1024 / 1e6


def places(number: int) -> np.ndarray:
    """Return the places of queries in the row, between images."""
    return np.linspace(0, number - 2, QUERIES).astype(int) + 0.3


def synthetic_query(place: float) -> dict:
    """Return the features of a query, as an extractor does."""
    generator = np.random.default_rng([2, int(10 * place)])
    _, pixels, views = seen(place)
    clutter = generator.uniform(0, [CAMERA.width, CAMERA.height], (CLUTTER, 2))
    return {
        "keypoints": (np.concatenate([pixels, clutter]) - 0.5).astype(np.float32),
        "descriptors": np.concatenate([views, unit(generator, CLUTTER)]).T,
        "image_size": np.array([CAMERA.width, CAMERA.height]),
        "blur": 0.0,
    }


def current() -> float:
    """Return the resident size of this process in 1,000,000 bytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def peak() -> float:
    """Return the largest resident size of this process so far, in 1,000,000 bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def in_new_process(
    name: str, stage: str, data: Path, share: float, folder: str, *options: str
) -> dict:
    """Return the measures that a stage of a benchmark prints, of a share of the images."""
    given = ["--data", str(data), "--share", str(share), "--folder", folder, "--stage", stage]
    command = [sys.executable, "-m", f"benchmarks.{name}", *given, *options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise InputError(f"The share {share} failed.")
    return json.loads(done.stdout.splitlines()[-1])


def _main() -> None:
    parser = cli.Parser(__doc__, "--data aachen_v1.1 --share 0.1 1")
    parser.add_argument(
        "--data", type=Path, required=True, help="folder of database_images.txt, a list of images"
    )
    parser.add_argument("--share", type=float, nargs="+", default=[0.01, 0.1], help="of its images")
    parser.add_argument("--max_mb", type=float, help="size of the maps, of shares up to 1")
    rows.add_again_option(parser)
    for hidden in ("--folder", "--stage"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not all(0 < share <= 100 for share in args.share):
        raise InputError("--share: numbers above 0 and at most 100.")
    if args.max_mb and max(args.share) > 1:
        raise InputError("--max_mb limits maps of shares up to 1.")
    names = sorted(image_names(args.data / "database_images.txt"))
    features_confs.get(FEATURE)
    if args.stage:
        folder, number = Path(args.folder), max(60, round(args.share[0] * len(names)))
        some = names[:number]
        if number > len(names):
            some = [f"{i:03}/{name}" for i in range(-(-number // len(names))) for name in names]
        some = some[:number]
        stages = {
            "synthesize": lambda: synthesize(some, folder),
            "stream": lambda: stream(some, folder),
            "build": lambda: build(folder, args.max_mb),
            "localize": lambda: localize(len(some), folder),
        }
        print(json.dumps({"photos": len(some)} | (stages[args.stage]() or {})))
        return
    variant = f"at most {args.max_mb:g} MB" if args.max_mb else ""
    limited = ["--max_mb", str(args.max_mb)] if args.max_mb else []
    for share in args.share:
        cells: dict = {"place": args.data.name, "list": f"share {share:g}", "feature": FEATURE}
        cells |= {"storage": "uint4", "variant": variant}
        if not args.again and rows.select(rows.read(NAME), **cells):
            continue
        with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as folder:
            for stage in (*(("stream",) if share > 1 else ("synthesize", "build")), "localize"):
                cells |= in_new_process(NAME, stage, args.data, share, folder, *limited)
        rows.add(NAME, [cells | rows.how(cells["build_s"])])


if __name__ == "__main__":
    cli.run(_main)
