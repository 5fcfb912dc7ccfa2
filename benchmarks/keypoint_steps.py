"""Search keypoints in photos of all sizes and exposures with each of the detector's settings.

Adds rows to results/keypoint_steps.csv, one for each photo, size and exposure: the keypoints that
each step of `detectors.dog.LADDERS` finds, as a share of those that are enough, up to the first
step that finds enough, and the CPU seconds of each. Prints for several limits how often a step that
found a smaller share than the limit was followed by one that found enough, and the seconds that
skipping the next step saves: `detectors.dog.HOPELESS` is the largest that was never wrong.
"""

from pathlib import Path

import cv2
import numpy as np

from benchmarks import rows
from benchmarks.split_place import DARK, darken
from hloc_reduce.detectors import dog, opencv
from hloc_reduce.utils import cli, colmap
from hloc_reduce.utils.images import list_images, read_image
from hloc_reduce.utils.progress import progress

NAME = "keypoint_steps"
LONGER_SIDES = 1600, 1000, 640
GAINS = {"as it is": None, "dusk": (0.2, 0.4), "night": DARK}
LIMITS = 0.01, 0.02, 0.05, 0.1, 0.2
PHOTOS = 6  # of a place


def ladder_of(side: int) -> tuple[tuple[float, float], ...]:
    """Return the steps after the first for a photo with a longer side in pixels."""
    return dog.LADDERS["small" if side <= dog.SMALL_PHOTO_PIXELS else "large"]


def steps(image: np.ndarray, fast: bool) -> list[tuple[float, float]]:
    """Return of each step the share of enough keypoints that it finds, and its CPU seconds.

    Args:
        image: (H, W) float32 in [0, 1].
        fast: search by OpenCV.
    """
    search = opencv.detect if fast else colmap.detect_dog
    enough, found = dog.enough(image.size), []
    first = tuple(dog.HLOC_OPTIONS.values())
    for first_octave, peak_threshold in (first, *ladder_of(max(image.shape))):
        options = {"first_octave": first_octave, "peak_threshold": peak_threshold}
        start = cv2.getTickCount()
        number = len(search(image, options)[0])
        found.append((number / enough, (cv2.getTickCount() - start) / cv2.getTickFrequency()))
        if number >= enough:
            break
    return found


def measure(path: Path, generator: np.random.Generator, fast: bool) -> list[dict[str, object]]:
    """Return the rows of a photo, without what tells its place."""
    pixels, found = read_image(path, True), []
    for side in LONGER_SIDES:
        scale = min(1.0, side / max(pixels.shape))
        photo = cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        for exposure, gain in GAINS.items():
            seen = photo if gain is None else darken(photo, generator, gain)
            image = seen.astype(np.float32) / 255
            if dog.is_noise(image):
                continue
            of_steps = steps(image, fast)
            row: dict[str, object] = {"variant": f"{max(image.shape)} pixels, {exposure}"}
            row |= {f"share_{i}": share for i, (share, _) in enumerate(of_steps)}
            found.append(row | {f"step_{i}_s": seconds for i, (_, seconds) in enumerate(of_steps)})
    return found


def report(known: list[rows.Row]) -> None:
    """Print what skipping a step after one that found few keypoints costs and saves."""
    keys = [key for key in rows.read(NAME)[0] if key.startswith("share_")]
    photos = [
        [
            (float(row[key]), float(row[key.replace("share", "step") + "_s"]))
            for key in keys
            if row[key]
        ]
        for row in known
    ]
    total = sum(seconds for photo in photos for _, seconds in photo)
    lasts = [len(ladder_of(int(row["variant"].split()[0]))) for row in known]  # never skipped
    print(f"{len(photos)} photos, {total:.0f} s. Skip a step if the one before found less than")
    for limit in LIMITS:
        skipped = [
            after
            for photo, last in zip(photos, lasts, strict=True)
            for (share, _), after in zip(photo, photo[1:last], strict=False)
            if share < limit
        ]
        wrong = sum(share >= 1 for share, _ in skipped)
        saved = sum(seconds for share, seconds in skipped if share < 1)
        print(
            f"{limit:.0%} of enough: {len(skipped)} skipped, {wrong} wrongly, saves {saved:.1f} s"
        )


def _main() -> None:
    parser = cli.Parser(__doc__, "--scenes datasets/scenes")
    add = parser.add_argument
    add("--scenes", type=Path, required=True, help="folder of places, <place>/images")
    add("--place", nargs="+", help="places; default: all")
    add("--fast", action="store_true", help="search by OpenCV, as --keypoints fast")
    rows.add_again_option(parser)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    how = rows.with_keypoints("fast" if args.fast else "adaptive")
    known = [] if args.again else rows.read(NAME)
    for place in args.place or sorted(path.name for path in args.scenes.iterdir()):
        folder = args.scenes / place / "images"
        names = list_images(folder)
        for name in progress(names[:: -(-len(names) // PHOTOS)], place, "photo"):
            cells = {"place": place, "list": name, "feature": how}
            if not rows.select(known, **cells):
                generator = np.random.default_rng(0)
                found = measure(folder / name, generator, args.fast)
                rows.add(NAME, [cells | row | rows.how(cores=1) for row in found])
    report(rows.select(rows.read(NAME), feature=how))


if __name__ == "__main__":
    cli.run(_main)
