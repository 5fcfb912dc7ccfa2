"""Where the photos are taken: the walk of the map, and queries between and beside it."""

from dataclasses import dataclass

import numpy as np
import pycolmap

from .town import OBSTACLES, OPEN_GROUND

MAP, DAY, NIGHT = range(3)  # kinds of photos, which seed them
# of each kind, and one for each eight map photos if these are more
MIN_QUERIES = 10

# Positions of the camera and of its target, (x, y, x, y) in metres.
WALK = [
    # northwards
    (-8.5, -7, -9, 10),
    (-5.5, -7.5, -3, 10),
    (-1, -8, -1, 10),
    (4.5, -7, 1, 10),
    (8.5, -6.5, 7, 10),
    (0, -6.5, 9, 10),
    (8.5, 1.5, -1, 10),
    # southwards
    (-8.5, 7.5, -8, -10),
    (-5, 7, -1, -10),
    (1, 7.5, 3, -10),
    (7.5, 7.5, 8, -10),
    # westwards
    (9, 5.5, -12, 7),
    (8.8, -0.5, -12, -1),
    (8, -6.5, -12, -6),
    (0.5, 2.5, -12, 5),
    # eastwards
    (-9, 6.5, 12, 6),
    (-8.5, 1.5, 12, 2),
    (-9, -5, 12, -4),
    (0, -7.5, 12, 0),
    # in the north street
    (6, 6.5, 6.3, 27),
    (6.8, 12, 4.5, 27),
    (7.6, 14, 2.5, 23),
    (4.4, 15, 9, 24),
    (6, 23.5, 6, 8),
    # in the west street
    (-8, -1, -28, -1),
    (-12.5, -2.6, -24, 1.5),
    (-12.5, 0.4, -24, -3.5),
    (-24, -1, -8, -1),
    # in the east street
    (7.5, -7.2, 27, -7),
    (11.5, -5.4, 20, -10),
    (13, -8.3, 23, -4),
    (23.5, -7, 8, -6),
]
WINDOWS = {2: 4.6, 11: 5.2}  # from the index of a photo taken from a window to its height


@dataclass(frozen=True)
class Photo:
    """A photo to be taken; `name` is relative to the folder of the images."""

    kind: int
    index: int
    name: str
    camera: pycolmap.Camera
    cam_from_world: pycolmap.Rigid3d


def list_photos(seed: int, num_map: int = len(WALK)) -> list[Photo]:
    """List all photos of the data set: the map, then the queries by day, then by night.

    Map photos after those of the walk are taken anywhere, as queries are.
    """
    photos = [_map_photo(seed, index) for index in range(num_map)]
    number = max(MIN_QUERIES, num_map // 8)
    return photos + [_query(seed, kind, i) for kind in (DAY, NIGHT) for i in range(number)]


def _map_photo(seed: int, index: int) -> Photo:
    rng = np.random.default_rng([seed, 10 + MAP, index])
    if index < len(WALK):
        x, y, x_target, y_target = WALK[index] + rng.uniform(-0.35, 0.35, 4)
        position = np.array([x, y, WINDOWS.get(index, rng.uniform(1.6, 1.9))])
        target = np.array([x_target, y_target, rng.uniform(2.8, 4.2)])
        ahead, aside, up = target - position
        yaw, pitch = np.arctan2(aside, ahead), np.arctan(up / np.hypot(ahead, aside))
    else:
        x, y, yaw = _anywhere(rng)
        position, pitch = np.array([x, y, rng.uniform(1.6, 1.9)]), rng.uniform(0.03, 0.2)
    if index % 3:
        camera = _pinhole(1, (845.0, 846.0, 508.5, 387.0))
    else:
        camera = _pinhole(2, (890.0, 890.0, 512.0, 384.0))
    pose = look(position, yaw, pitch, np.radians(rng.normal(0, 1.2)))
    return Photo(MAP, index, f"db/{index:04}.jpg", camera, pose)


def _query(seed: int, kind: int, index: int) -> Photo:
    rng = np.random.default_rng([seed, 10 + kind, index])
    x, y, yaw = _anywhere(rng)
    position = np.array([x, y, rng.uniform(1.5, 1.9)])
    camera = (951.0, 949.0, 514.0, 380.0) if rng.random() < 0.5 else (752.0, 751.0, 509.0, 386.5)
    pitch, roll = rng.uniform(0.03, 0.2), np.radians(rng.normal(0, 2))
    name = f"query/{'night' if kind == NIGHT else 'day'}/phone/{index:04}.jpg"
    pose = look(position, yaw, pitch, roll)
    return Photo(kind, index, name, _pinhole(3, camera), pose)


def _anywhere(rng: np.random.Generator) -> tuple[float, float, float]:
    """Draw a position and a yaw beside the walk, from where something can be seen."""
    while True:
        x, y, x_target, y_target = WALK[rng.integers(len(WALK))]
        yaw = np.arctan2(y_target - y, x_target - x)
        step, heading = rng.uniform(0.5, 3), rng.uniform(0, 2 * np.pi)
        x, y = x + step * np.cos(heading), y + step * np.sin(heading)
        yaw += np.radians(rng.uniform(-25, 25))
        if _free_view(x, y, yaw):
            return x, y, yaw


def _pinhole(camera_id: int, params: tuple[float, ...]) -> pycolmap.Camera:
    return pycolmap.Camera(
        camera_id=camera_id, model="PINHOLE", width=1024, height=768, params=list(params)
    )


def look(position: np.ndarray, yaw: float, pitch: float, roll: float) -> pycolmap.Rigid3d:
    """Return the pose of a camera, camera from world.

    Args:
        position: float (3,), metres.
        yaw: of the view from the x axis towards the y axis, radians.
        pitch: upwards, radians.
        roll: clockwise, radians.
    """
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0])
    down = np.cross(forward, right)
    cos, sin = np.cos(roll), np.sin(roll)
    rotation = np.stack([cos * right + sin * down, cos * down - sin * right, forward])
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ position)


def _free_view(x: float, y: float, yaw: float) -> bool:
    """Return whether one can stand here and has some metres of open ground in view."""
    for turn, reach in ((-0.4, 2.5), (0, 5), (0.4, 2.5)):
        for step in np.arange(0, reach, 0.25):
            u, v = x + step * np.cos(yaw + turn), y + step * np.sin(yaw + turn)
            if not any(x0 < u < x1 and y0 < v < y1 for x0, y0, x1, y1 in OPEN_GROUND):
                return False
            near = step < 2.5
            if near and any(np.hypot(u - a, v - b) < r + 0.3 for a, b, r in OBSTACLES):
                return False
    return True
