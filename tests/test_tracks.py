"""Training data from photos with poses: a textured plane seen by five cameras."""

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce.cli import InputError
from hloc_reduce.training import tracks

SIZE = (480, 360)
FOCAL = 500.0


@pytest.fixture
def plane(tmp_path):
    """Photos of the plane z = 0 and a COLMAP model of their poses with covisibility."""
    generator = np.random.default_rng(0)
    texture = np.zeros((800, 800))
    for sigma in (2, 4, 8):
        noise = cv2.GaussianBlur(generator.standard_normal(texture.shape), (0, 0), sigma)
        texture += noise / noise.std()
    texture = (128 + 30 * texture).clip(0, 255).astype(np.uint8)

    reference = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=SIZE[0],
        height=SIZE[1],
        params=[FOCAL, SIZE[0] / 2, SIZE[1] / 2],
        camera_id=1,
    )
    reference.add_camera_with_trivial_rig(camera)
    points = np.column_stack([generator.uniform(-0.5, 0.5, (30, 2)), np.zeros(30)])
    (tmp_path / "images").mkdir()
    poses = []
    for i in range(5):
        rotation = cv2.Rodrigues(np.array([0.1 * i - 0.2, 0.15 * i - 0.3, 0.2 * i]))[0]
        translation = np.array([0.05 * i, -0.05, 2.2 + 0.1 * i])
        poses.append(pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation))
        # texture index (u, v) -> plane (u - 399.5, v - 399.5) / 400 -> image index
        to_plane = np.array([[1 / 400, 0, -399.5 / 400], [0, 1 / 400, -399.5 / 400], [0, 0, 1]])
        matrix = np.column_stack([rotation[:, :2], translation])
        calibration = camera.calibration_matrix() - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        homography = calibration @ matrix @ to_plane
        photo = cv2.warpPerspective(texture, homography, SIZE, flags=cv2.INTER_AREA)
        cv2.imwrite(str(tmp_path / f"images/{i}.png"), photo)
        pixels = camera.img_from_cam(points @ rotation.T + translation)
        image = pycolmap.Image(
            name=f"{i}.png", keypoints=pixels.reshape(-1, 2), camera_id=1, image_id=i + 1
        )
        reference.add_image_with_trivial_frame(image, poses[i])
    for j, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(i, j) for i in range(1, 6)])
        reference.add_point3D(point, track)
    (tmp_path / "model").mkdir()
    reference.write(tmp_path / "model")
    return tmp_path


def test_tracks_of_a_plane(plane):
    path = tracks.main(plane / "images", plane / "model", plane / "out")
    data = tracks.load(path)
    assert data.num_tracks > 100
    assert data.descriptors.shape == (len(data.track), 2, tracks.VARIANTS, 128)
    assert (np.diff(data.track) >= 0).all() and data.track[0] == 0
    # the photo's descriptors are those of the feature file, found again by their places
    with h5py.File(plane / "out/feats-dog-sift.h5") as file:
        for number in range(5):
            group = file[f"{number}.png"]
            stored = group["descriptors"][()].T.astype(np.float32)
            keypoints = group["keypoints"][()]
            mine = np.flatnonzero(data.image == number)
            for i in mine[:20]:
                near = np.abs(keypoints - data.xy[i]).max(axis=1) < 1e-4
                best = (stored[near] @ data.descriptors[i, 0, 0].astype(np.float32)).max()
                assert best > 0.999
    photos = data.descriptors[:, 0, 0].astype(np.float32)
    follows = np.flatnonzero(np.diff(data.track) == 0)
    similarity = (photos[follows] * photos[follows + 1]).sum(1)
    assert np.median(similarity) > 0.9
    transposed = data.descriptors[:, 1, 0].astype(np.float32)
    similarity = (transposed[follows] * transposed[follows + 1]).sum(1)
    assert np.median(similarity) > 0.9
    assert np.median((transposed * photos).sum(1)) < 0.9


def test_tracks_are_computed_once_and_the_same(plane):
    path = tracks.main(plane / "images", plane / "model", plane / "out")
    content, time = path.read_bytes(), path.stat().st_mtime_ns
    tracks.main(plane / "images", plane / "model", plane / "out")
    assert path.stat().st_mtime_ns == time
    again = tracks.main(plane / "images", plane / "model", plane / "again")
    assert again.read_bytes() == content


def test_a_map_without_tracks_is_refused(plane):
    for path in (plane / "images").iterdir():
        cv2.imwrite(str(path), np.full(SIZE[::-1], 100, np.uint8))
    with pytest.raises(InputError, match="The map is empty"):
        tracks.main(plane / "images", plane / "model", plane / "out")
