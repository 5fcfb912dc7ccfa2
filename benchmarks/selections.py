"""Other ways to rank the points of a map, to compare `hlm.selection.Sights.ranked` with.

Each ranks points (P,), those that are kept first, as that function does.
"""

import numpy as np
import pycolmap

from hloc_reduce.hlm.points import Points

CELLS_PER_SIDE = 8  # of an image, over which `cover` spreads points
AT_ONCE = 0.05  # points that `cover` ranks at once, as a share of those ranked before
TRIPLETS = 300  # drawn in each image
ACCURATE = 2.0  # pixels by which the pose of an accurate triplet moves the image's points
STEPS = 3  # by which the pose of a triplet is refined
NEAREST = 1e-9  # depth
REGULAR = 1e-6  # of the largest singular value: smaller ones do not fix a pose


def cover(points: Points, model: pycolmap.Reconstruction) -> np.ndarray:
    """Rank points by how many images show them, and how few ranked ones are in their cells."""
    point, cell = np.concatenate(points.visible), _cells(points, model)
    count = np.zeros(len(points.names) * CELLS_PER_SIDE**2)
    ranking, is_ranked = np.zeros(0, np.int64), np.zeros(len(points), bool)
    while len(ranking) < len(points):
        gain = np.bincount(point, 1 / (1 + count[cell]), minlength=len(points))
        gain[is_ranked] = -1
        more = min(max(1, int(AT_ONCE * len(ranking))), len(points) - len(ranking))
        best = np.argsort(-gain, kind="stable")[:more]
        is_new = np.zeros(len(points), bool)
        is_new[best] = True
        is_ranked |= is_new
        count += np.bincount(cell[is_new[point]], minlength=len(count))
        ranking = np.concatenate([ranking, best])
    return ranking


def longest(points: Points, _: pycolmap.Reconstruction) -> np.ndarray:
    """Rank points by how many images show them."""
    return np.argsort(-_tracks(points), kind="stable")


def drawn(points: Points, _: pycolmap.Reconstruction) -> np.ndarray:
    """Rank points at random."""
    return np.random.default_rng(0).permutation(len(points))


def triplets(points: Points, model: pycolmap.Reconstruction) -> np.ndarray:
    """Rank points of triplets that fix the pose of an image, after Sattler and Kukelova, CVPR 2026.

    Of triplets drawn in each image, those with accurate poses are kept. Each image in turn gets
    points of its triplets, those with the most ranked points first, until it has 3, then 4, and so
    on.
    """
    generator, track = np.random.default_rng(0), _tracks(points)
    accurate = [
        rows[_accurate(model.find_image_with_name(name), points.xyz[rows], keypoints, generator)]
        for name, rows, keypoints in zip(
            points.names, points.visible, points.keypoints, strict=True
        )
    ]
    order = np.argsort([-track[rows].sum() for rows in points.visible], kind="stable")
    candidates = [np.unique(part) for part in accurate]
    is_ranked, ranking = np.zeros(len(points), bool), [np.zeros(0, np.int64)]
    for number in range(3, 1 + max(map(len, candidates))):
        for i in order:
            while is_ranked[candidates[i]].sum() < min(number, len(candidates[i])):
                new = (~is_ranked[accurate[i]]).sum(axis=1)
                seen = track[accurate[i]].sum(axis=1)
                best = accurate[i][np.lexsort((-seen, np.where(new > 0, new, 4)))[0]]
                added = best[~is_ranked[best]]
                is_ranked[added] = True
                ranking.append(added)
    rest = np.flatnonzero(~is_ranked)
    return np.concatenate([*ranking, rest[np.argsort(-track[rest], kind="stable")]])


def _accurate(
    image: pycolmap.Image, xyz: np.ndarray, keypoints: np.ndarray, generator: np.random.Generator
) -> np.ndarray:
    """Draw triplets (T, 3) of the points (M, 3) of an image, and return those with accurate poses.

    The pose of a triplet is the one near the image's that explains its three keypoints (P3P by
    Newton's method). It is accurate if it hardly moves the projections of the image's points.
    """
    if len(xyz) < 3:
        return np.zeros((0, 3), np.int64)
    rows = np.array([generator.choice(len(xyz), 3, replace=False) for _ in range(TRIPLETS)])
    pixels = np.array([image.points2D[int(i)].xy for i in keypoints])
    seen = np.asarray(image.camera.cam_from_img(pixels))[rows]
    local = image.cam_from_world() * xyz
    rotations, translations = np.tile(np.eye(3), (TRIPLETS, 1, 1)), np.zeros((TRIPLETS, 1, 3))
    for _ in range(STEPS):
        moved = local[rows] @ rotations.swapaxes(1, 2) + translations
        across = np.zeros((TRIPLETS, 3, 2, 3)) + np.eye(2, 3)  # z times the derivative by a shift
        across[..., 2] = -_projected(moved)
        across /= np.maximum(moved[..., 2:, None], NEAREST)
        derivatives = np.concatenate([-across @ _cross(moved), across], axis=3)
        residuals = (seen - _projected(moved)).reshape(TRIPLETS, 6, 1)
        step = np.linalg.pinv(derivatives.reshape(TRIPLETS, 6, 6), REGULAR) @ residuals
        half = _cross(step[:, :3, 0]) / 2  # Cayley's map from vectors to rotations
        turns = np.linalg.solve(np.eye(3) - half, np.eye(3) + half)
        rotations = turns @ rotations
        translations = translations @ turns.swapaxes(1, 2) + step[:, 3:].swapaxes(1, 2)
    shifted = _projected(local @ rotations.swapaxes(1, 2) + translations) - _projected(local)
    errors = np.linalg.norm(shifted, axis=2).mean(axis=1) * image.camera.mean_focal_length()
    return rows[errors < ACCURATE]


def _projected(local: np.ndarray) -> np.ndarray:
    """Project points (..., 3) of a camera; those behind it as those just before it."""
    return local[..., :2] / np.maximum(local[..., 2:], NEAREST)


def _cross(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    return np.cross(vectors[..., None, :], np.eye(3)).swapaxes(-1, -2)


def _tracks(points: Points) -> np.ndarray:
    """Return how many images show each point (P,)."""
    return np.bincount(np.concatenate(points.visible), minlength=len(points))


def _cells(points: Points, model: pycolmap.Reconstruction) -> np.ndarray:
    """Return the cell (O,) that each image shows each of its points in."""
    cells = [np.zeros(0, np.int64)]
    for i, (name, keypoints) in enumerate(zip(points.names, points.keypoints, strict=True)):
        image = model.find_image_with_name(name)
        pixels = np.array([image.points2D[int(k)].xy for k in keypoints]).reshape(-1, 2)
        parts = pixels * CELLS_PER_SIDE / [image.camera.width, image.camera.height]
        column, row = parts.clip(0, CELLS_PER_SIDE - 1).astype(int).T
        cells.append((i * CELLS_PER_SIDE + row) * CELLS_PER_SIDE + column)
    return np.concatenate(cells)


RANKINGS = {"cover": cover, "longest": longest, "random": drawn, "triplets": triplets}
