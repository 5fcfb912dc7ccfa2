"""The picture of a query beside its best retrieved map image, with their matches."""

from pathlib import Path

import cv2
import numpy as np

from ..localization.projection import reprojection_errors
from ..localization.records import camera_of, pose_of
from ..utils.feature_files import get_keypoints
from ..utils.h5 import open_h5
from ..utils.images import read_image
from ..utils.match_files import get_matches
from .runs import Run

PICTURE_HEIGHT = 320  # pixels of both images
GAP = 8
FRAME = 5  # pixels
MAX_LINES = 80  # of each colour
GREEN, RED = (40, 170, 60), (225, 50, 40)
QUALITY = 80  # of JPEG


def matched(run: Run, query: str) -> dict | None:
    """Find the retrieved map image with the most inliers of a query, and their matches.

    The matches of a panorama are those of a view, see `Run.shown`.

    Among scans it is one of the floor that the query was localized on. If the query was not
    localized, it is the first retrieved image.

    Returns:
        `name` of the map image; keypoints `first` and `second` (M, 2) of the matches, pixel
        centres at integers; and `inliers` (M,) bool: matches whose point reprojects within the
        inlier threshold, none if the query was not localized. None if nothing was retrieved.
    """
    shown, record, _ = run.shown(query)
    if record["db"] is None:
        return None
    names = [record["db"]]
    if record["localized"]:
        present = [name for name in run.retrieved_for(query) if name in run.reference]
        clusters = run.reference.clusters(present)
        names = next((part for part in clusters if record["db"] in part), names)
    with open_h5(run.file_of(query, "features")) as file:
        keypoints, _ = get_keypoints(file, shown)
    found = []
    with open_h5(run.file_of(query, "matches")) as file:
        for name in names:
            sizes = len(keypoints), run.reference.num_keypoints(name)
            matches, _ = get_matches(file, shown, name, sizes)
            inliers = _inliers(run, record, name, keypoints[matches[:, 0]], matches[:, 1])
            found.append((name, matches, inliers))
    name, matches, inliers = max(found, key=lambda item: item[2].sum())
    with open_h5(run.files["map_features"]) as file:
        map_keypoints, _ = get_keypoints(file, name)
    first, second = keypoints[matches[:, 0]], map_keypoints[matches[:, 1]]
    return {"name": name, "first": first, "second": second, "inliers": inliers}


def _inliers(
    run: Run, record: dict, name: str, keypoints: np.ndarray, map_keypoints: np.ndarray
) -> np.ndarray:
    """Tell which matches are inliers (M,).

    Args:
        run: the run.
        record: of the query.
        name: of the map image.
        keypoints: (M, 2) of the query, pixel centres at integers.
        map_keypoints: (M,) indices of the keypoints of the map image.
    """
    inliers = np.zeros(len(keypoints), bool)
    pose = pose_of(record)
    if record["localized"] and pose is not None:
        ids, points = run.reference.lift(name, map_keypoints)
        known = ids >= 0
        errors, _ = reprojection_errors(
            keypoints[known] + 0.5, points[known], pose, camera_of(record)
        )
        inliers[known] = errors <= record["max_error"]
    return inliers


def draw(run: Run, query: str, found: dict) -> np.ndarray:
    """Draw a query and the map image of `matched` side by side.

    Inliers are green, other matches red. The frame is green if the query was localized, else red.

    Returns:
        (H, W, 3) RGB uint8.
    """
    first, scale0 = _resized(run.shown(query)[2])
    second, scale1 = _resized(run.files["map_images"] / found["name"])
    shift = first.shape[1] + GAP
    gap = np.full((PICTURE_HEIGHT, GAP, 3), 255, np.uint8)
    canvas = np.ascontiguousarray(np.concatenate([first, gap, second], axis=1))
    starts = (found["first"] + 0.5) * scale0
    ends = (found["second"] + 0.5) * scale1 + [shift, 0]
    eighths = np.round(8 * np.stack([starts, ends], axis=1)).astype(int)
    # inliers last, on top of the others
    for colour, chosen in ((RED, ~found["inliers"]), (GREEN, found["inliers"])):
        rows = np.flatnonzero(chosen)
        rows = rows[np.linspace(0, len(rows) - 1, min(MAX_LINES, len(rows))).astype(int)]
        for start, end in eighths[rows].tolist():
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA, shift=3)
            for place in (start, end):
                cv2.circle(canvas, place, 16, colour, -1, cv2.LINE_AA, shift=3)
    frame = GREEN if run.records[query]["localized"] else RED
    return cv2.copyMakeBorder(canvas, FRAME, FRAME, FRAME, FRAME, cv2.BORDER_CONSTANT, value=frame)


def _resized(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read an image and resize it to HEIGHT; return the image and its scale in x and y (2,)."""
    image = read_image(path)
    height, width = image.shape[:2]
    size = max(1, round(width * PICTURE_HEIGHT / height)), PICTURE_HEIGHT
    interpolation = cv2.INTER_AREA if height > PICTURE_HEIGHT else cv2.INTER_LINEAR
    return cv2.resize(image, size, interpolation=interpolation), np.array(size) / (width, height)


def jpeg(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) RGB."""
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)[1].tobytes()
