"""The demo town: its files, its model, its seed, and interrupted runs."""

import json
import os

import numpy as np
import pycolmap
import pytest
from demo_photos import scaled

from hloc_reduce import demo
from hloc_reduce.demo import cameras, town
from hloc_reduce.demo.cameras import MAP
from hloc_reduce.demo.photo import take
from hloc_reduce.demo.render import rasterize
from hloc_reduce.demo.surface import View
from hloc_reduce.utils.cli import InputError

pytestmark = pytest.mark.check


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Four houses, few and small photos, rendered by the whole pipeline."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(town, "HOUSES", town.HOUSES[:3])
        patch.setattr(demo, "list_photos", small_photos)
        town.build_town.cache_clear()
        yield demo.main(tmp_path_factory.mktemp("demo") / "town")
    town.build_town.cache_clear()


def small_photos(seed, _=None):
    photos = cameras.list_photos(seed)
    chosen = photos[:7] + photos[-20:-18] + photos[-2:]
    return [scaled(photo, 256, 192) for photo in chosen]


def test_the_layout_is_that_of_aachen(small):
    names = {photo.name for photo in small_photos(0)}
    images = small / "images_upright"
    assert {str(p.relative_to(images)) for p in images.rglob("*") if p.is_file()} == names
    model = small / "3D-models" / "aachen_v_1_1"
    assert {p.name for p in model.iterdir()} == {"cameras.bin", "images.bin", "points3D.bin"}
    poses = (small / "queries" / "ground_truth_poses.txt").read_text().splitlines()
    for kind in ("day", "night"):
        lines = (small / "queries" / f"{kind}_time_queries_with_intrinsics.txt").read_text()
        for line in lines.splitlines():
            name, camera_model, *numbers = line.split()
            assert name in names and kind in name and camera_model == "PINHOLE"
            assert len(numbers) == 6 and len([p for p in poses if p.split()[0] == name]) == 1
    photo = small_photos(0)[-1]
    numbers = np.array([float(word) for word in poses[-1].split()[1:]])
    x, y, z, w = photo.cam_from_world.rotation.quat
    assert np.array_equal(numbers, [w, x, y, z, *photo.cam_from_world.translation])


def test_the_model_agrees_with_the_depth_buffer(small):
    model = pycolmap.Reconstruction(small / "3D-models" / "aachen_v_1_1")
    assert model.num_reg_images() == 7 and model.num_points3D() > 200
    scene = town.build_town(0)
    for image in model.images.values():
        view = View.of(image.camera, image.cam_from_world())
        _, nearness = rasterize(scene, view)
        for point2D in image.points2D:
            assert point2D.has_point3D()
            xyz = model.point3D(point2D.point3D_id).xyz
            assert np.allclose(image.project_point(xyz), point2D.xy, atol=1e-6)
            x, y = point2D.xy
            assert 0 < x < 256 and 0 < y < 192
            depth = (image.cam_from_world() * xyz)[2]
            assert depth > 0 and abs(nearness[int(y), int(x)] * depth - 1) < 0.0101
    assert all(point.track.length() >= 3 for point in model.points3D.values())


def test_the_seed_decides_every_byte(small):
    scene, photo = town.build_town(0), small_photos(0)[2]  # built anew
    content = (small / "images_upright" / photo.name).read_bytes()
    assert take(scene, photo, 0) == content
    assert take(scene, photo, 1) != content
    assert small_photos(1)[2].cam_from_world.matrix().tolist() != (
        photo.cam_from_world.matrix().tolist()
    )
    other = town.build_town.__wrapped__(1)
    assert take(other, photo, 0) != content


def test_an_interrupted_run_renders_only_what_is_missing(small):
    images = small / "images_upright"
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in images.rglob("*.jpg")}
    os.replace(small / "town.json", small / "town.json.partial")
    lost = [images / "db" / "0003.jpg", images / "query" / "night" / "phone" / "0008.jpg"]
    for path in lost:
        path.unlink()
    demo.main(small)
    for path, (content, time) in before.items():
        assert path.read_bytes() == content
        assert (path.stat().st_mtime_ns == time) == (path not in lost)
    assert (small / "town.json").exists() and not (small / "town.json.partial").exists()


def test_a_complete_town_is_left_alone_and_never_mixed(small, tmp_path):
    listing = {path: path.stat().st_mtime_ns for path in small.rglob("*")}
    assert demo.main(small) == small
    assert listing == {path: path.stat().st_mtime_ns for path in small.rglob("*")}
    with pytest.raises(InputError, match="seed"):
        demo.main(small, seed=1)
    (tmp_path / "3D-models").mkdir()
    with pytest.raises(InputError, match="not the demo town"):
        demo.main(tmp_path, overwrite=True)


def test_leftovers_of_another_seed_are_dropped(tmp_path):
    leftover = tmp_path / "images_upright" / "db" / "0000.jpg"
    for mark, overwrite in (("town.json.partial", False), ("town.json", True)):
        leftover.parent.mkdir(parents=True)
        leftover.touch()
        (tmp_path / mark).write_text('{"seed": 5, "version": 1}')
        state = {"seed": 0, "version": 1}
        assert demo._start(tmp_path, state, overwrite)
        assert not leftover.exists() and not (tmp_path / "town.json").exists()
        assert json.loads((tmp_path / "town.json.partial").read_text()) == state


def test_a_larger_town_has_the_same_first_photos():
    """And more of them elsewhere, where one can stand, with two queries for each eight."""
    photos, more = cameras.list_photos(0), cameras.list_photos(0, 100)
    sizes = [[photo.kind for photo in more].count(kind) for kind in range(3)]
    assert sizes == [100, 12, 12]
    names = {photo.name: photo.cam_from_world.matrix().tolist() for photo in more}
    assert len(names) == 124
    assert all(names[p.name] == p.cam_from_world.matrix().tolist() for p in photos)
    centres = [p.cam_from_world.inverse().translation for p in more[len(cameras.WALK) : 100]]
    assert len(centres) == 100 - len(cameras.WALK)
    inside = [
        any(x0 < x < x1 and y0 < y < y1 for x0, y0, x1, y1 in town.OPEN_GROUND)
        for x, y, _ in centres
    ]
    assert all(inside)


def test_wrong_sizes_of_the_town(small, tmp_path):
    with pytest.raises(InputError, match="at least 32 photos"):
        demo.main(tmp_path / "town", num_photos=5)
    with pytest.raises(InputError, match="'photos': 40"):
        demo.main(small, num_photos=40)


def test_all_photos_have_their_own_names_and_kinds():
    photos = cameras.list_photos(0)
    assert len({photo.name for photo in photos}) == len(photos)
    assert 26 <= sum(photo.kind == MAP for photo in photos) <= 32
