"""Localize the frames of a rendered video in the demo town, each near the last ones, and anew.

The map is a compact one of the town's map photos; the frames are those of `benchmarks.video`. They
are localized one by one, by `Localizer.track` in order and in random order, when each last pose is
wrong, and each photo of --strangers near a frame's true pose, where none may be localized. Adds
rows to results/tracking.csv: errors, the share of frames for which the last pose helped, and the
median milliseconds beyond extraction, on as many cores as OMP_NUM_THREADS says.
"""

import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from benchmarks import rows
from benchmarks.video import CAMERA, town
from hloc_reduce import Localizer, compact, demo, maps
from hloc_reduce.datasets.aachen import Aachen
from hloc_reduce.evaluation.poses import FAILED, pose_error
from hloc_reduce.runtime import parallel
from hloc_reduce.utils import cli
from hloc_reduce.utils.images import list_images
from hloc_reduce.utils.progress import progress

NAME = "tracking"
SEED = 0

Found = tuple[pycolmap.Rigid3d | None, dict]


def measures(found: Sequence[Found], true: Sequence[pycolmap.Rigid3d]) -> dict[str, object]:
    """Return the measures of frames with known poses."""
    errors = [
        FAILED if pose is None else pose_error(pose, its)
        for (pose, _), its in zip(found, true, strict=True)
    ]
    localized = sum(pose is not None for pose, _ in found)
    inliers = [0 if pose is None else info["num_inliers"] for pose, info in found]
    return rows.localization(errors, inliers, localized) | times(found)


def times(found: Sequence[Found]) -> dict[str, object]:
    """Return how often the last pose helped, and the time beyond extraction."""
    helped = [info["near"] for pose, info in found if pose is not None]
    seconds = [sum(info["seconds"].values()) - info["seconds"]["extraction"] for _, info in found]
    return {
        "near_percent": 100 * float(np.mean(helped)) if helped else None,
        "ms": 1000 * float(np.median(seconds)),
    }


def variants(
    localizer: Localizer, paths: list[Path], true: list[pycolmap.Rigid3d], strangers: list[Path]
) -> dict[str, Callable[[], dict[str, object]]]:
    """Return what measures each variant.

    Args:
        localizer: the map.
        paths: the frames.
        true: their poses.
        strangers: photos of other places, if any.
    """

    def anew() -> dict[str, object]:
        return measures([localizer.localize(path, CAMERA) for path in progress(paths)], true)

    def tracked(order: Sequence[int]) -> dict[str, object]:
        tracker = localizer.track(CAMERA)
        found = [tracker.localize(paths[i]) for i in progress(order)]
        return measures(found, [true[i] for i in order])

    def of_strangers() -> dict[str, object]:
        near = [true[i % len(true)] for i in range(len(strangers))]
        pairs = zip(progress(strangers), near, strict=True)
        found = [localizer.localize(path, near=pose) for path, pose in pairs]
        localized = sum(pose is not None for pose, _ in found)
        return {"queries": len(found), "localized": localized} | times(found)

    shuffled = np.random.default_rng(SEED).permutation(len(paths)).tolist()
    found = {
        "anew": anew,
        "tracked": lambda: tracked(range(len(paths))),
        "tracked in random order": lambda: tracked(shuffled),
    }
    return found | ({"strangers near a frame": of_strangers} if strangers else {})


def _main() -> None:
    parser = cli.Parser(__doc__, "--feature colmap_sift_sv32:uint4 --strangers datasets/strangers")
    add = parser.add_argument
    add("--feature", nargs="+", default=["colmap_sift_sv32:uint4"], help="with the map's storage")
    add("--frames", type=int, default=100, help="of the video")
    add("--dataset", type=Path, default=Path("datasets/demo_town"), help="the demo town")
    add("--strangers", type=Path, help="folder of photos that are not of the town")
    add("--outputs", type=Path, default=Path("outputs/tracking"))
    rows.add_again_option(parser)
    args = parser.parse_args()
    known = [] if args.again else rows.read(NAME)
    place, photos = Aachen(demo.main(args.dataset, SEED)), args.outputs / "frames"
    model = town(args.frames, photos)
    images = sorted(model.images.values(), key=lambda image: image.name)
    paths = [photos / image.name for image in images]
    true = [image.cam_from_world() for image in images]
    others = args.strangers
    strangers = [others / name for name in list_images(others)] if others else []
    cores = parallel.cores()
    for given in args.feature:
        feature, _, storage = given.partition(":")
        options = {"feature": feature, "storage": storage or "float16"}
        folder = args.outputs / "-".join(options.values())
        built = maps.main(folder, place.images, place.reference_model, **options)
        file = folder.with_suffix(".hlm")
        if not file.exists():
            compact.main(file, built.folder)
        localizer = Localizer(file)
        localizer.localize(paths[0], CAMERA)  # libraries are used a first time
        for name, measure in variants(localizer, paths, true, strangers).items():
            variant = f"{name}, {cores} core{'s' * (cores > 1)}"
            cells = {"place": place.root.name, "list": f"{args.frames} frames", **options}
            cells |= {"variant": variant}
            if not rows.select(known, **cells):
                size = {"mb": file.stat().st_size / 1e6, "photos": built.num_images}
                rows.add(NAME, [cells | size | measure() | rows.how(cores=cores)])


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "2")
    cli.run(_main)
