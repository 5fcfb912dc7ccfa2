"""Measure what keypoints and descriptors of features keep when a photo changes.

Each photo is paired with itself turned, made smaller, noisy or dark, so that the true place of
every keypoint is known. Prints two Markdown tables. The first one has, for each feature and change,
the keypoints of the first photo that the second one should show; the share that is found again
within a pixel of the second photo; the median error of those found within three pixels; and the
mutual nearest neighbours that are right, also within three pixels. The second one tells how well
scores rank keypoints of noisy photos by whether they are found again: within each photo, and among
all photos together, which needs comparable scores. 0.5 would be by chance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from darken_place import darken, resize
from keypoints import add_noise
from scipy.spatial import cKDTree
from sklearn.metrics import roc_auc_score

from hloc_reduce import extractors
from hloc_reduce.confs import features
from hloc_reduce.matchers.nearest_neighbor import mutual_nearest
from hloc_reduce.utils import cli
from hloc_reduce.utils.images import list_images, read_image
from hloc_reduce.utils.progress import progress

LONGEST = 1024  # pixels of a photo
AGAIN, RIGHT = 1.0, 3.0  # pixels of the second photo: of a keypoint found again, of a right match
MARGIN = 8  # pixels from the sides of either photo; nothing is expected beyond
NOISE, GAIN = 0.05, (0.06, 0.12)
FEATURES = ("mini32", "mini64", "edgepoint2_m32", "edgepoint2_m64", "xfeat", "colmap_sift")
Change = Callable[[np.ndarray, np.random.Generator], tuple[np.ndarray, np.ndarray]]


def turned(degrees: float) -> Change:
    """Return a change that turns a photo, on a canvas that holds all of it."""

    def change(photo: np.ndarray, _: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        height, width = photo.shape[:2]
        matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1)
        cos, sin = abs(matrix[0, 0]), abs(matrix[0, 1])
        wide, high = round(width * cos + height * sin), round(width * sin + height * cos)
        matrix[:, 2] += (wide - width) / 2, (high - height) / 2
        return cv2.warpAffine(photo, matrix, (wide, high), flags=cv2.INTER_CUBIC), matrix

    return change


def smaller(factor: float) -> Change:
    """Return a change that divides the size of a photo by a factor."""

    def change(photo: np.ndarray, _: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        small = resize(photo, 1 / factor)
        ratio = np.array(small.shape[1::-1]) / photo.shape[1::-1]
        return small, np.column_stack([np.diag(ratio), ratio / 2 - 0.5])  # centres at integers

    return change


def in_place(vary: Callable[..., np.ndarray], *arguments: object) -> Change:
    """Return a change of the values of pixels only."""

    def change(photo: np.ndarray, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        return vary(photo, generator, *arguments), np.eye(2, 3)

    return change


NOISY = "noisy"
CHANGES: dict[str, Change] = {
    **{f"turned by {degrees}°": turned(degrees) for degrees in (15, 30, 45)},
    **{f"{factor:g} times smaller": smaller(factor) for factor in (1.5, 2, 3, 4)},
    NOISY: in_place(add_noise, NOISE),
    "dark": in_place(darken, GAIN),
}


@dataclass(frozen=True)
class Compared:
    """Keypoints of two photos that show the same, and what was found of them.

    Args:
        number: of keypoints of the first photo that the second one should show.
        expected: number of those that either photo should show again, of the one with fewer.
        errors: (R,) pixels of the second photo, of keypoints that are nearest to each other within
            the limit of a right match.
        right, matched: numbers of mutual nearest neighbours of these, and of right ones.
        scores, again: (N,) of keypoints that should be seen in the second photo: their scores, and
            whether they were found within the limit of a right match.
    """

    number: int
    expected: int
    errors: np.ndarray
    right: int
    matched: int
    scores: np.ndarray
    again: np.ndarray


def inside(points: np.ndarray, photo: np.ndarray) -> np.ndarray:
    """Tell which points (N, 2) lie within a photo, away from its sides."""
    limits = np.array(photo.shape[1::-1]) - 1 - MARGIN
    return ((points >= MARGIN) & (points <= limits)).all(axis=1)


def compare(one: dict, other: dict, photos: tuple, matrix: np.ndarray) -> Compared:
    """Compare the features of a photo with those of the changed photo.

    Args:
        one: features of the photo, as `extractors.extract` returns them.
        other: those of the changed photo.
        photos: the two.
        matrix: (2, 3) from pixels of the first photo to the second.
    """
    there = one["keypoints"] @ matrix[:, :2].T + matrix[:, 2]
    back = (other["keypoints"] - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    first = np.flatnonzero(inside(one["keypoints"], photos[0]) & inside(there, photos[1]))
    second = np.flatnonzero(inside(back, photos[0]) & inside(other["keypoints"], photos[1]))
    if not len(first) or not len(second):
        none = np.zeros(0)
        return Compared(len(first), 0, none, 0, 0, none, none.astype(bool))
    there, found = there[first], other["keypoints"][second]
    distances, nearest = cKDTree(found).query(there)
    _, nearest_back = cKDTree(there).query(found)
    both = nearest_back[nearest] == np.arange(len(first))
    errors = distances[both & (distances <= RIGHT)]
    described = one["descriptors"][:, first], other["descriptors"][:, second]
    match = mutual_nearest(*(torch.from_numpy(array.T) for array in described), None)[0].numpy()
    matched = match >= 0
    apart = np.linalg.norm(there[matched] - found[match[matched]], axis=1)
    scores = one.get("scores", np.zeros(len(one["keypoints"])))[first]
    right = int((apart <= RIGHT).sum())
    expected = min(len(first), len(second))
    return Compared(len(first), expected, errors, right, len(apart), scores, distances <= RIGHT)


def describe(found: list[Compared]) -> list[str]:
    """Return the cells of the first table."""
    errors = np.concatenate([one.errors for one in found])
    expected, right, matched = (
        sum(getattr(one, key) for one in found) for key in ("expected", "right", "matched")
    )
    return [
        f"{np.mean([one.number for one in found]):,.0f}",
        f"{100 * (errors <= AGAIN).sum() / max(expected, 1):.1f}",
        f"{np.median(errors):.2f}" if len(errors) else "",
        f"{right / len(found):,.0f}",
        f"{100 * right / max(matched, 1):.1f}",
    ]


def rank(found: list[Compared]) -> list[str]:
    """Return the cells of the second table: AUC within photos and among all."""
    kept = [one for one in found if 0 < one.again.sum() < len(one.again)]
    if not any(np.ptp(one.scores) for one in kept):
        return ["", ""]
    within = [roc_auc_score(one.again, one.scores) for one in kept]
    again, scores = (np.concatenate([getattr(o, key) for o in kept]) for key in ("again", "scores"))
    return [f"{np.mean(within):.3f}", f"{roc_auc_score(again, scores):.3f}"]


def _main() -> None:
    parser = cli.Parser(__doc__, "--images scenes/fountain-P11/images scenes/sceaux/images")
    add = parser.add_argument
    add("--images", type=Path, nargs="+", required=True, help="folders of photos")
    add("--feature", nargs="+", default=list(FEATURES), help="local features")
    add("--photos", type=int, default=4, help="evenly drawn of each folder")
    args = parser.parse_args()
    cli.check_positive(args, "photos")
    paths = []
    for folder in args.images:
        names = list_images(folder)
        chosen = np.linspace(0, len(names) - 1, min(args.photos, len(names))).round().astype(int)
        paths += [folder / names[index] for index in chosen]
    confs = {name: features.get(name)[1] for name in args.feature}
    columns = "feature", "change", "keypoints", "again [%]", "error [px]", "right", "of matches [%]"
    print(f"| {' | '.join(columns)} |\n| --- | --- |{' ---: |' * (len(columns) - 2)}", flush=True)
    ranks = []
    for name, conf in confs.items():
        model = extractors.load(conf["model"]).eval()
        found: dict[str, list[Compared]] = {change: [] for change in CHANGES}
        for number, path in enumerate(progress(paths, name, "photo")):
            photo = read_image(path)
            photo = resize(photo, min(1, LONGEST / max(photo.shape)))
            one = extractors.extract(model, photo, conf["preprocessing"])
            for key, change in CHANGES.items():
                changed, matrix = change(photo, np.random.default_rng(number))
                other = extractors.extract(model, changed, conf["preprocessing"])
                found[key].append(compare(one, other, (photo, changed), matrix))
        for key, several in found.items():
            print(f"| {' | '.join([f'`{name}`', key, *describe(several)])} |", flush=True)
        ranks.append(f"| {' | '.join([f'`{name}`', *rank(found[NOISY])])} |")
    print("\n| feature | within photos | among all |\n| --- | ---: | ---: |")
    print("\n".join(ranks))


if __name__ == "__main__":
    cli.run(_main)
