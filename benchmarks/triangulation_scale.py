"""Triangulate maps at fractions of the size of Aachen Day-Night v1.1: seconds and memory.

The names of the map images are the real ones; keypoints and matches are synthetic. As in
`benchmarks.aachen_scale`, an image has 8,000 keypoints, 1,200 of which show landmarks, 48 of these
not in the next image, and is paired with the 40 most covisible ones. The landmarks are the points
of the wall of `benchmarks.compact_scale`, seen with half a pixel of noise. All landmarks that a
pair shows are matched, and as many wrong matches are added as the nearest neighbours of codes have.

For each fraction, a process writes the files of a map, and another one triangulates it by the stage
that pipelines run, which verifies the pairs by the known poses, and checks the points. Adds rows to
results/scale.csv, the last of which extrapolates linearly to all map images.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from benchmarks import rows
from benchmarks.aachen_scale import NAME, NUM_COVIS, WHOLE_MAP, ids_of
from benchmarks.compact_scale import CAMERA, STEP, coordinates_of, in_new_process, peak, view, wall
from benchmarks.video import model_of_poses
from hloc_reduce import triangulation
from hloc_reduce.pairs_from_covisibility import most_covisible
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.match_files import names_to_pair
from hloc_reduce.utils.parsers import image_names, parse_pairs, write_pairs

KEYPOINTS = 8000
VARIANT = "triangulation"
WRONG = 0.02  # share of the matches, as `right` in the rows of codes in results/scale.csv
NOISE = 0.5  # pixels
FEWEST = 50  # images
NEAR = 0.05  # metres within which a point is right
GROWING = "points", "pairs", "triangulation_s", "triangulation_cpu_s", "peak_mib"


def synthesize(names: list[str], folder: Path) -> None:
    """Write the model, features, pairs and matches of images, and a photo that all are."""
    generator = np.random.default_rng(0)
    photo = generator.integers(0, 256, (CAMERA.height // 8, CAMERA.width // 8, 3), np.uint8)
    cv2.imwrite(str(folder / "photo.jpg"), cv2.resize(photo, (CAMERA.width, CAMERA.height)))
    first = [int(ids_of(place, KEYPOINTS)[0]) for place in range(len(names))]
    seen = len(ids_of(0, KEYPOINTS))
    poses = {name: view(start / STEP) for name, start in zip(names, first, strict=True)}
    colmap.write_model(model_of_poses(poses, CAMERA), folder / "model")
    size = np.array([CAMERA.width, CAMERA.height])
    with GroupWriter(folder / "features.h5", {"synthesized": len(names)}) as writer:
        for name, start in zip(names, first, strict=True):
            pixels = CAMERA.img_from_cam(poses[name] * wall(start, start + seen, coordinates_of))
            pixels += generator.normal(0, NOISE, pixels.shape)
            clutter = generator.uniform(0, size, (KEYPOINTS - seen, 2))
            keypoints = np.concatenate([pixels, clutter]).astype(np.float32) - 0.5
            writer.add(name, {"keypoints": keypoints, "image_size": size})
            (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / "images" / name).symlink_to(folder / "photo.jpg")
    ranking = most_covisible((ids_of(i, KEYPOINTS) for i in range(len(names))), NUM_COVIS)
    pairs = ((names[i], names[j]) for i, row in enumerate(ranking) for j in row)
    write_pairs(pairs, folder / "pairs.txt")
    start_of = dict(zip(names, first, strict=True))
    with GroupWriter(folder / "matches.h5", {"synthesized": len(names)}) as writer:
        for pair in different(folder / "pairs.txt"):
            a, b = (start_of[name] for name in pair)
            shown = np.arange(max(a, b), min(a, b) + seen)  # landmarks
            matches = np.full(KEYPOINTS, -1, np.int32)
            matches[shown - a] = shown - b
            wrong = generator.choice(shown - a, round(WRONG * len(shown)), replace=False)
            matches[wrong] = generator.integers(seen, KEYPOINTS, len(wrong))
            scores = (matches >= 0).astype(np.float16)
            writer.add(names_to_pair(*pair), {"matches0": matches, "matching_scores0": scores})


def different(pairs: Path) -> Iterator[tuple[str, str]]:
    """Yield the pairs of a file, each unordered pair once."""
    known = set()
    for pair in parse_pairs(pairs):
        if frozenset(pair) not in known:
            known.add(frozenset(pair))
            yield pair


def triangulate(folder: Path) -> dict[str, object]:
    """Triangulate the map and check its points."""
    start, cpu = time.perf_counter(), time.process_time()
    model = triangulation.main(
        folder / "sfm",
        folder / "model",
        folder / "images",
        folder / "pairs.txt",
        folder / "features.h5",
        folder / "matches.h5",
    )
    return {
        "pairs": sum(1 for _ in different(folder / "pairs.txt")),
        "points": model.num_points3D(),
        "triangulation_s": time.perf_counter() - start,
        "triangulation_cpu_s": time.process_time() - cpu,
        "peak_mib": peak() * 1e6 / 2**20,
        "near": 100 * share_near(model),
    }


def share_near(model: pycolmap.Reconstruction) -> float:
    """Return the share of the landmarks, but those at the ends, that are where they should be.

    COLMAP leaves out points that only two images see.
    """
    seen, step = len(ids_of(0, KEYPOINTS)), int(ids_of(1, KEYPOINTS)[0])
    landmarks, xyz = [], []
    for point in model.points3D.values():
        element = point.track.elements[0]
        if element.point2D_idx < seen:
            landmarks.append(ids_of(element.image_id - 1, KEYPOINTS)[0] + element.point2D_idx)
            xyz.append(point.xyz)
    last = ids_of(len(model.images) - 1, KEYPOINTS)[-1] + 1
    errors = np.linalg.norm(wall(0, last, coordinates_of)[landmarks] - xyz, axis=1)
    right = np.unique(np.array(landmarks)[errors <= NEAR])
    inner = (right >= 2 * step) & (right < last - 2 * step)
    return inner.sum() / (last - 4 * step)


def whole(smaller: dict, larger: dict) -> dict[str, object]:
    """Extrapolate linearly from two fractions to all map images."""
    further = (WHOLE_MAP - larger["photos"]) / (larger["photos"] - smaller["photos"])
    continued = {key: larger[key] + further * (larger[key] - smaller[key]) for key in GROWING}
    return {"photos": WHOLE_MAP} | continued


def _main() -> None:
    parser = cli.Parser(__doc__, "--data aachen_v1.1 --share 0.05 0.1")
    parser.add_argument(
        "--data", type=Path, required=True, help="folder of database_images.txt, a list of images"
    )
    parser.add_argument(
        "--share", type=float, nargs="+", default=[0.05, 0.1], help="of its images, in (0, 1]"
    )
    rows.add_again_option(parser)
    for hidden in ("--folder", "--stage"):
        parser.add_argument(hidden, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if not all(0 < share <= 1 for share in args.share) or len(set(args.share)) < len(args.share):
        raise InputError("--share: different numbers above 0 and at most 1.")
    if args.stage:
        names, folder = image_names(args.data / "database_images.txt"), Path(args.folder)
        some = names[: max(FEWEST, round(args.share[0] * len(names)))]
        stages = {"synthesize": lambda: synthesize(some, folder)}
        stages |= {"triangulate": lambda: triangulate(folder)}
        print(json.dumps({"photos": len(some)} | (stages[args.stage]() or {})))
        return
    cells = {"place": args.data.name, "variant": VARIANT}
    known = [] if args.again else rows.select(rows.read(NAME), **cells)
    if rows.select(known, list="whole"):
        return
    fractions: list[dict] = []
    for share in sorted(args.share):
        measured: dict = {}
        with tempfile.TemporaryDirectory(dir=os.environ.get("TMPDIR")) as folder:
            for stage in ("synthesize", "triangulate"):
                measured |= in_new_process("triangulation_scale", stage, args.data, share, folder)
        fractions.append(measured)
        how = rows.how(measured["triangulation_s"], cores=1)
        rows.add(NAME, [cells | {"list": f"share {share:g}"} | measured | how])
    if len(fractions) > 1:
        continued = whole(fractions[0], fractions[-1])
        rows.add(NAME, [cells | {"list": "whole"} | continued | rows.how(cores=1)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    cli.run(_main)
