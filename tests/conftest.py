"""What tests share: the folder of real data, and a small scene with answers known in advance."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture(scope="session")
def herz_jesus() -> Path:
    path = SHARED / "aachen_like/herz-jesus"
    if not path.is_dir():
        pytest.skip(f"the real place {path} is not on this machine")
    return path


@pytest.fixture
def textured() -> np.ndarray:
    """A grey image (240, 320) uint8 of smooth blobs of all sizes: many DoG keypoints."""
    generator = np.random.default_rng(0)
    image = np.zeros((240, 320))
    for sigma in (1.5, 3, 6, 12):
        noise = cv2.GaussianBlur(generator.standard_normal(image.shape), (0, 0), sigma)
        image += noise / noise.std()
    return (128 + 30 * image).clip(0, 255).astype(np.uint8)


@pytest.fixture
def scene(tmp_path) -> SimpleNamespace:
    """Eight cameras around random points, each point with a descriptor of its own.

    Images 0-5 are the map, 6 and 7 queries. Files are in hloc's formats, exact but for the
    descriptors' float16.
    """
    generator = np.random.default_rng(1)
    points = generator.uniform(-1, 1, (300, 3))
    descriptors = generator.standard_normal((300, 64))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    camera = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=640, height=480, params=[500, 320, 240, 0.02], camera_id=1
    )
    reference = pycolmap.Reconstruction()
    reference.add_camera_with_trivial_rig(camera)
    poses, seen = {}, {}
    features = tmp_path / "features.h5"
    with h5py.File(features, "w") as file:
        for i in range(8):
            name = f"db/{i}.jpg" if i < 6 else f"query/{i}.jpg"
            angle = 0.25 * (i if i < 6 else i - 4.5)
            rotation = cv2.Rodrigues(np.array([0.1 * np.cos(3 * angle), angle, 0.05]))[0]
            poses[name] = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), np.array([0, 0, 4.0]))
            pixels = camera.img_from_cam(points @ rotation.T + [0, 0, 4.0])
            order = generator.permutation(len(points))
            group = file.create_group(name)
            # COLMAP's pixels have their origin at the corner, hloc's at the first centre
            group["keypoints"] = (pixels[order] - 0.5).astype(np.float32)
            group["descriptors"] = descriptors[order].T.astype(np.float16)
            seen[name] = order
            if i < 6:
                image = pycolmap.Image(name=name, camera_id=1, image_id=i + 1)
                reference.add_image_with_trivial_frame(image, poses[name])
            (tmp_path / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(tmp_path / "images" / name), np.full((480, 640), 99, np.uint8))
    model = tmp_path / "reference"
    model.mkdir()
    reference.write(model)
    queries = tmp_path / "day_time_queries_with_intrinsics.txt"
    queries.write_text(
        "".join(f"query/{i}.jpg SIMPLE_RADIAL 640 480 500 320 240 0.02\n" for i in (6, 7))
    )
    return SimpleNamespace(
        root=tmp_path,
        images=tmp_path / "images",
        model=model,
        reference=reference,
        features=features,
        queries=queries,
        poses=poses,
        seen=seen,
        points=points,
    )
