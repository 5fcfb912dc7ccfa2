"""The picture of a query beside its best retrieved map image, with their matches."""

import cv2
import numpy as np

from ..localization.records import camera_of, pose_of
from ..utils.feature_files import get_keypoints
from ..utils.h5 import open_h5
from ..utils.images import read_image
from ..utils.match_files import get_matches
from .runs import Run

HEIGHT = 320  # pixels of both images
GAP = 8
BORDER = 5
LINES = 80  # of each colour, at most
GREEN, RED, WHITE = (40, 170, 60), (225, 50, 40), (255, 255, 255)
QUALITY = 80  # of JPEG


def matched(run: Run, query: str) -> dict | None:
    """Find the matches of a query with the retrieved map image that has most inliers.

    Of scans it is of the floor that the query was localized on. Where the query was not localized
    it is the first retrieved one.

    Returns:
        `name` of the map image; keypoints `first` and `second` (M, 2) of the matches, pixel
        centres at integers; and `inliers` (M,) bool, those whose point reprojects within the
        threshold of the query's pose, none if it was not localized. None if nothing was retrieved.
    """
    record = run.records[query]
    if record["db"] is None:
        return None
    names = [record["db"]]
    if record["localized"]:
        present = [name for name in run.retrieved.get(query, ()) if name in run.reference]
        clusters = run.reference.clusters(present)
        names = next((part for part in clusters if record["db"] in part), names)
    with open_h5(run.files["features"]) as file:
        keypoints, _ = get_keypoints(file, query)
    best = None
    with open_h5(run.files["matches"]) as file:
        for name in names:
            sizes = len(keypoints), run.reference.num_keypoints(name)
            matches, _ = get_matches(file, query, name, sizes)
            inliers = _inliers(run, record, name, keypoints[matches[:, 0]], matches[:, 1])
            if best is None or inliers.sum() > best[2].sum():
                best = name, matches, inliers
    name, matches, inliers = best
    with open_h5(run.files["map_features"]) as file:
        map_keypoints, _ = get_keypoints(file, name)
    first, second = keypoints[matches[:, 0]], map_keypoints[matches[:, 1]]
    return {"name": name, "first": first, "second": second, "inliers": inliers}


def _inliers(
    run: Run, record: dict, name: str, matched_to: np.ndarray, keypoints: np.ndarray
) -> np.ndarray:
    """Tell which points that keypoints (M,) of a map image show reproject to those (M, 2)."""
    inliers = np.zeros(len(keypoints), bool)
    if record["localized"]:
        pose = pose_of(record)
        ids, points = run.reference.lift(name, keypoints)
        known = np.flatnonzero(ids >= 0)
        in_camera = points[known] @ pose.rotation.matrix().T + pose.translation
        projected = camera_of(record).img_from_cam(in_camera)
        apart = np.linalg.norm(projected - (matched_to[known] + 0.5), axis=1)
        inliers[known] = (apart <= record["max_error"]) & (in_camera[:, 2] > 0)
    return inliers


def draw(run: Run, query: str, found: dict) -> np.ndarray:
    """Draw a query and the map image of `matched` side by side.

    Matches that are inliers are green, others red; so is the frame, by whether the query was
    localized.

    Returns:
        (H, W, 3) RGB uint8.
    """
    first, scale0 = _resized(run.files["query_images"] / query)
    second, scale1 = _resized(run.files["map_images"] / found["name"])
    shift = first.shape[1] + GAP
    gap = np.full((HEIGHT, GAP, 3), 255, np.uint8)
    canvas = np.ascontiguousarray(np.concatenate([first, gap, second], axis=1))
    starts = (found["first"] + 0.5) * scale0
    ends = (found["second"] + 0.5) * scale1 + [shift, 0]
    # inliers last, which are above the others
    for colour, chosen in ((RED, ~found["inliers"]), (GREEN, found["inliers"])):
        rows = np.flatnonzero(chosen)
        rows = rows[np.linspace(0, len(rows) - 1, min(LINES, len(rows))).astype(int)]
        for start, end in zip(starts[rows], ends[rows], strict=True):
            ends_of_line = [
                tuple(np.round(8 * place).astype(int).tolist()) for place in (start, end)
            ]
            cv2.line(canvas, *ends_of_line, colour, 1, cv2.LINE_AA, shift=3)
            for place in ends_of_line:
                cv2.circle(canvas, place, 16, colour, -1, cv2.LINE_AA, shift=3)
    frame = GREEN if run.records[query]["localized"] else RED
    return cv2.copyMakeBorder(canvas, *[BORDER] * 4, cv2.BORDER_CONSTANT, value=frame)


def _resized(path) -> tuple[np.ndarray, np.ndarray]:
    """Read an image and resize it to HEIGHT; return the factors of x and y, too."""
    image = read_image(path)
    height, width = image.shape[:2]
    size = max(1, round(width * HEIGHT / height)), HEIGHT
    interpolation = cv2.INTER_AREA if height > HEIGHT else cv2.INTER_LINEAR
    return cv2.resize(image, size, interpolation=interpolation), np.array(size) / (width, height)


def jpeg(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) RGB."""
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    return cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), options)[1].tobytes()
