"""A COLMAP model of some of the images."""

import numpy as np
import pytest
import rigs

from hloc_reduce.utils import colmap

NAMES = {f"db/{i}.png" for i in range(4)}


def test_a_part_of_a_model_keeps_its_poses_and_times(aachen_layout, tmp_path):
    model = aachen_layout / "3D-models/aachen_v_1_1"
    part = colmap.write_part(model, {"db/0.png", "db/2.png"}, tmp_path / "part")
    times = {path: path.stat().st_mtime_ns for path in part.iterdir()}
    whole, found = colmap.read_model(model), colmap.read_model(part)
    assert {image.name for image in found.images.values()} == {"db/0.png", "db/2.png"}
    for image in found.images.values():
        pose = whole.find_image_with_name(image.name).cam_from_world()
        assert (image.cam_from_world().matrix() == pose.matrix()).all()
    assert found.num_points3D() == whole.num_points3D()
    colmap.write_part(model, {"db/0.png", "db/2.png"}, part)
    assert times == {path: path.stat().st_mtime_ns for path in part.iterdir()}


@pytest.mark.fault(3)
@pytest.mark.parametrize(
    ("missing", "rig_stays"),
    [
        (["db/0.png"], False),  # by the camera whose pose is that of the rig
        (["db/1.png"], False),
        (["db/0.png", "db/3.png"], False),
        (["db/0.png", "db/1.png"], True),  # all that were taken at once
        (["db/0.png", "db/1.png", "db/2.png"], False),
    ],
)
def test_photos_of_a_rig_do_without_the_others(missing, rig_stays, aachen_layout, tmp_path):
    model = rigs.taken_by_a_rig(colmap.read_model(aachen_layout / "3D-models/aachen_v_1_1"))
    for point in model.points3D.values():
        point.color, point.error = [1, 2, 3], 0.5
    (tmp_path / "rig").mkdir()
    model.write(tmp_path / "rig")
    left = NAMES - {*missing}
    found = colmap.read_model(colmap.write_part(tmp_path / "rig", left, tmp_path / "part"))
    assert {image.name for image in found.images.values()} == left
    for image in found.images.values():
        before = model.find_image_with_name(image.name)
        pose = before.cam_from_world().matrix()
        np.testing.assert_allclose(image.cam_from_world().matrix(), pose, atol=1e-12)
        assert image.camera.params.tolist() == before.camera.params.tolist()
        assert [p.xy.tolist() for p in image.points2D] == [p.xy.tolist() for p in before.points2D]
    # each point is seen by all images, and a point that one image sees is none
    assert found.num_points3D() == (model.num_points3D() if len(left) > 1 else 0)
    for point in found.points3D.values():
        assert point.track.length() == len(left)
        assert point.color.tolist() == [1, 2, 3] and point.error == 0.5
    assert (max(rig.num_sensors() for rig in found.rigs.values()) == 2) == rig_stays
