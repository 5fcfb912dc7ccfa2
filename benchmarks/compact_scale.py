"""Measure compact maps at fractions of the size of Aachen Day-Night v1.1: size, time, memory.

The names of the map images are the real ones; the rest is synthetic. The images stand in a row, one
metre apart, in front of a wall with 299 points a metre. Each shows 1,493 of them, so that the whole
map has 2 million points, each seen in five images, and 10 million observations. A query stands
between two images and shows the points of one, among clutter.

For each fraction, a process writes the model and the features, another one builds the compact map,
and a third one opens it and localizes queries, whose features it is given. Adds rows to
results/compact_scale.csv.
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
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks import rows
from hloc_reduce.confs import features as features_confs
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
STAGES = ("retrieval", "matching", "pose", "mirror_image")


def unit(generator: np.random.Generator, number: int) -> np.ndarray:
    """Draw descriptors (N, D) float32 of unit norm."""
    drawn = generator.standard_normal((number, DIM), np.float32)
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def wall(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates (P, 3) of the points of a number of images, and descriptors (P, D)."""
    generator = np.random.default_rng(0)
    ids = np.arange((number - 1) * STEP + SEEN)
    height, relief = generator.uniform(-3, 3, len(ids)), generator.uniform(-1, 1, len(ids))
    xyz = np.stack([ids / STEP - SEEN / STEP / 2, height, DEPTH + SPREAD * relief], axis=1)
    return xyz, unit(generator, len(ids))


def view(place: float) -> pycolmap.Rigid3d:
    """Return the pose, camera from world, at a place in the row."""
    return pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-place, 0.0, 0.0]))


def seen(place: float, xyz: np.ndarray, descriptors: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the points that are seen from a place, their pixels (M, 2) and descriptors (M, D)."""
    generator = np.random.default_rng([1, int(10 * place)])
    ids = np.arange(SEEN) + int(place) * STEP
    pixels = CAMERA.img_from_cam(view(place) * xyz[ids])
    pixels += generator.normal(0, 0.5, pixels.shape)
    views = descriptors[ids] + NOISE * unit(generator, SEEN)
    return ids, pixels, views / np.linalg.norm(views, axis=1, keepdims=True)


def synthesize(names: list[str], folder: Path) -> None:
    """Write a COLMAP model and a feature file."""
    from hloc_reduce import aggregate_features

    xyz, descriptors = wall(len(names))
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
            ids, pixels, views = seen(place, xyz, descriptors)
            pose = 1.0, 0.0, 0.0, 0.0, *view(place).translation
            file.write(struct.pack("<I7dI", place + 1, *pose, CAMERA.camera_id))
            file.write(name.encode() + b"\0" + struct.pack("<Q", len(ids)))
            observed = np.empty(len(ids), [("pixel", "<f8", 2), ("point", "<u8")])
            observed["pixel"], observed["point"] = pixels, ids + 1
            file.write(observed.tobytes())
            stored = {"keypoints": (pixels - 0.5).astype(np.float32)}
            stored |= {"descriptors": views.T.astype(np.float16)}
            writer.add(name, stored | {"image_size": np.array([CAMERA.width, CAMERA.height])})
    write_points(xyz, len(names), sfm / "points3D.bin")
    vlad = aggregate_features.confs["vlad"]
    aggregate_features.main(vlad, features, names[:: -(-len(names) // 100)])


def write_points(xyz: np.ndarray, number: int, path: Path) -> None:
    """Write the points of a number of images, with their tracks, as COLMAP does."""
    ids = np.arange(len(xyz))
    first = np.maximum(0, -(-(ids - SEEN + 1) // STEP))
    lengths = np.minimum(ids // STEP, number - 1) - first + 1
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(xyz)))
        for i, (at, start, length) in enumerate(zip(xyz, first, lengths, strict=True)):
            file.write(struct.pack("<Q3d3BdQ", i + 1, *at, 0, 0, 0, 0.6, length))
            places = np.arange(start, start + length)
            file.write(np.stack([places + 1, i - places * STEP], 1).astype("<u4").tobytes())


def build(folder: Path) -> dict:
    """Build the compact map."""
    from hloc_reduce import compact

    start = time.perf_counter()
    parts = compact.main(
        folder / "place.hlm",
        sfm=folder / "sfm",
        features=folder / "features.h5",
        feature=FEATURE,
    )
    return {
        "points": parts["descriptors"] * 2 // DIM,
        "build_s": time.perf_counter() - start,
        "build_mb": peak(),
        "mb": (folder / "place.hlm").stat().st_size / 1e6,
    }


def localize(number: int, folder: Path) -> dict:
    """Open the compact map and localize queries, whose features are given."""
    start = time.perf_counter()
    from hloc_reduce import Localizer

    imported = time.perf_counter()
    localizer = Localizer(folder / "place.hlm")
    opened = time.perf_counter()
    resident = current()
    xyz, descriptors = wall(number)
    queries = [synthetic_query(place, xyz, descriptors) for place in places(number)]
    del xyz, descriptors
    before = current()
    stages: dict[str, list[float]] = {stage: [] for stage in STAGES}
    right, correspondences = 0, []
    for place, query in zip(places(number), queries, strict=True):
        localizer.engine.extract = lambda *_, query=query: dict(query)
        pose, info = localizer.localize(np.zeros((1200, 1600), np.uint8), CAMERA)
        for stage, seconds in stages.items():
            seconds.append(info["seconds"].get(stage, 0.0))
        correspondences.append(info["num_correspondences"])
        right += pose is not None and abs(pose.translation[0] + place) < 0.05
    return {
        "import_s": imported - start,
        "open_s": opened - imported,
        "resident_mb": resident,
        "queries_mb": current() - before,
        **{f"{stage}_s": float(np.mean(seconds)) for stage, seconds in stages.items()},
        "correspondences": float(np.mean(correspondences)),
        "queries": len(queries),
        "localized": int(right),
    }


def places(number: int) -> np.ndarray:
    """Return the places of queries in the row, between images."""
    return np.linspace(0, number - 2, QUERIES).astype(int) + 0.3


def synthetic_query(place: float, xyz: np.ndarray, descriptors: np.ndarray) -> dict:
    """Return the features of a query, as an extractor does."""
    generator = np.random.default_rng([2, int(10 * place)])
    _, pixels, views = seen(place, xyz, descriptors)
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


def _main() -> None:
    parser = cli.Parser(__doc__, "--data aachen_v1.1 --share 0.1 1")
    parser.add_argument(
        "--data", type=Path, required=True, help="folder of database_images.txt, a list of images"
    )
    parser.add_argument("--share", type=float, nargs="+", default=[0.01, 0.1], help="of its images")
    rows.add_again_option(parser)
    for hidden in ("--folder", "--stage"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not all(0 < share <= 1 for share in args.share):
        raise InputError("--share: numbers above 0 and at most 1.")
    names = image_names(args.data / "database_images.txt")
    features_confs.get(FEATURE)
    if args.stage:
        folder, some = Path(args.folder), names[: max(60, round(args.share[0] * len(names)))]
        stages = {
            "synthesize": lambda: synthesize(some, folder),
            "build": lambda: build(folder),
            "localize": lambda: localize(len(some), folder),
        }
        print(json.dumps({"photos": len(some)} | (stages[args.stage]() or {})))
        return
    for share in args.share:
        cells: dict = {"place": args.data.name, "list": f"share {share:g}", "feature": FEATURE}
        cells |= {"storage": "uint4"}
        if not args.again and rows.select(rows.read(NAME), **cells):
            continue
        with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as folder:
            for stage in ("synthesize", "build", "localize"):
                given = ["--data", args.data, "--share", str(share), "--folder", folder]
                done = subprocess.run(
                    [sys.executable, "-m", "benchmarks.compact_scale", "--stage", stage, *given],
                    stdout=subprocess.PIPE,
                    text=True,
                )
                if done.returncode:
                    raise InputError(f"The share {share} failed.")
                cells |= json.loads(done.stdout.splitlines()[-1])
        rows.add(NAME, [cells | rows.how(cells["build_s"])])


if __name__ == "__main__":
    cli.run(_main)
