"""A COLMAP model of some of the images."""

from hloc_reduce.utils import colmap


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
