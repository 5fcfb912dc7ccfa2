"""A model of photos in a row, some of them turned, with all matches."""

import numpy as np
import pycolmap

from hloc_reduce.utils import colmap

POINTS = np.random.default_rng(0).uniform(-1, 1, (60, 3))


def row(turned: dict[int, float]) -> tuple[pycolmap.Reconstruction, dict]:
    """Six photos of 60 points in a row, some turned by degrees; and their matches."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=640, height=480, params=[500, 320, 240], camera_id=1
    )
    for i in range(6):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), [0.4 * i - 1, 0, 6])
        pixels = camera.img_from_cam(POINTS + pose.translation)
        image = pycolmap.Image(name=f"{i}.jpg", keypoints=pixels, camera_id=1, image_id=i + 1)
        axis = np.radians(turned.get(i, 0)) * np.array([1, 0, 0])
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(axis), np.zeros(3))
        colmap.add_image(model, camera, image, turn * pose)
    for number, point in enumerate(POINTS):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, number) for i in range(6)])
        model.add_point3D(point, track)
    pairs = [(f"{i}.jpg", f"{j}.jpg") for i in range(6) for j in range(i)]
    return model, dict.fromkeys(pairs, np.repeat(np.arange(60)[:, None], 2, axis=1))
