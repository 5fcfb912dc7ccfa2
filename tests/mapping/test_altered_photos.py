"""Maps whose photos were cropped: their principal points are not in their centres."""

import numpy as np
import pycolmap
import pytest

from hloc_reduce.mapping.checks import Inputs, intrinsics
from hloc_reduce.utils import colmap

SIZE = np.array([1000, 800])


def reconstructed(
    shift: float = 0.0,
    zoomed: tuple[int, ...] = (),
    is_shared: bool = False,
    number: int = 300,
    noise: float = 0.5,
) -> pycolmap.Reconstruction:
    """Adjust a map of photos with principal points that are assumed in their centres.

    Args:
        shift: distance of the true ones from there, as a share of the size.
        zoomed: photos that were enlarged by a quarter.
        is_shared: whether all photos share a camera.
        number: of points.
        noise: of keypoints, in pixels.
    """
    generator = np.random.default_rng(0)
    points = generator.uniform(-1, 1, (number, 3))
    model = pycolmap.Reconstruction()
    tracks = [pycolmap.Track() for _ in points]
    true = pycolmap.Camera(model="PINHOLE", width=1000, height=800, params=[1100, 1100, *SIZE / 2])
    for i in range(8):
        signs = generator.choice([-1, 1], 2)
        centred = pycolmap.Camera(
            model="SIMPLE_RADIAL",
            width=1000,
            height=800,
            params=[1100, *SIZE / 2, 0],
            camera_id=1 if is_shared else i + 1,
        )
        turn = pycolmap.Rotation3d(np.array([generator.uniform(-0.3, 0.3), 0.2 * (i - 4), 0]))
        pose = pycolmap.Rigid3d(turn, [*generator.uniform(-0.3, 0.3, 2), 4])
        pixels = true.img_from_cam(pose * points) + generator.normal(0, noise, (number, 2))
        if i in zoomed:
            pixels = 1.25 * (pixels - SIZE / 2) + SIZE / 2
        image = pycolmap.Image(
            name=f"{i}.jpg",
            keypoints=pixels + signs * shift * SIZE,
            camera_id=centred.camera_id,
            image_id=i + 1,
        )
        colmap.add_image(model, centred, image, pose)
        for row, track in enumerate(tracks):
            track.add_element(i + 1, row)
    for at, track in zip(points, tracks, strict=True):
        model.add_point3D(at, track)
    pycolmap.bundle_adjustment(model)
    model.update_point_3d_errors()
    return model


@pytest.mark.parametrize(("shift", "is_cropped"), [(0.0, False), (0.2, True)])
def test_cropped_photos_fit_better_with_free_principal_points(shift, is_cropped):
    model = reconstructed(shift)
    before = model.compute_mean_reprojection_error()
    poses = {i: image.cam_from_world() for i, image in model.images.items()}
    fit = intrinsics.measure(model)
    assert model.compute_mean_reprojection_error() == before
    assert all(image.cam_from_world() == poses[i] for i, image in model.images.items())
    assert fit.gain > 0.3 if is_cropped else abs(fit.gain) < 0.02
    found = intrinsics.find(Inputs(model))
    assert len(found) == is_cropped and all("cropped" in one.message for one in found)


@pytest.mark.parametrize(("shift", "gain"), [(0.0, 0.0), (0.1, 0.9)])
def test_few_points_are_adjusted_to_the_end(shift, gain):
    """Their gradient is small from the start."""
    assert intrinsics.measure(reconstructed(shift, number=40, noise=0.1)).gain == pytest.approx(
        gain, abs=0.05
    )


@pytest.mark.parametrize("zoomed", [(), (2,), (1, 4, 6)])
def test_enlarged_photos_of_a_shared_camera_are_named(zoomed):
    """As photos whose EXIF data do not say that they were enlarged."""
    model = reconstructed(zoomed=zoomed, is_shared=True)
    fit = intrinsics.measure(model)
    assert fit.altered == [f"{i}.jpg" for i in zoomed]
    assert fit.gain > 0.3 if zoomed else abs(fit.gain) < 0.02
    found = intrinsics.find(Inputs(model))
    assert [one.names for one in found] == ([tuple(fit.altered)] if zoomed else [])
    assert all("are misplaced" in one.message and "{" not in one.message for one in found)


def test_photos_with_few_points_hide_no_others():
    """Three photos with 60 points tell nothing of themselves, and nothing against the others."""
    model = reconstructed(zoomed=(2,), is_shared=True)
    few = [model.images[i] for i in (1, 5, 8)]
    for image in few:
        for row in range(60, 300):
            model.delete_observation(image.image_id, row)
    assert [image.num_points3D for image in few] == [60] * 3
    fit = intrinsics.measure(model)
    assert fit.altered == ["2.jpg"] and fit.gain > intrinsics.GAIN_OF_FREE


def test_crops_of_a_shared_camera_gain_by_cameras_of_their_own():
    """The principal points differ by less than tells one photo from the others."""
    (found,) = intrinsics.find(Inputs(reconstructed(0.03, is_shared=True)))
    assert found.names == () and found.values["gain"] > intrinsics.GAIN_OF_OWN
    assert "their principal points are not in their centres" in found.message


def test_one_half_is_named_if_the_other_was_enlarged():
    fit = intrinsics.measure(reconstructed(zoomed=(0, 3, 5, 6), is_shared=True))
    halves = [["0.jpg", "3.jpg", "5.jpg", "6.jpg"], ["1.jpg", "2.jpg", "4.jpg", "7.jpg"]]
    assert fit.altered in halves and fit.gain > 0.3


def test_photos_that_were_removed_do_not_count():
    model = reconstructed(0.0)
    worst = model.images[1]
    for point in worst.points2D:
        point.xy += 3.0
    model.update_point_3d_errors()
    colmap.remove_images(model, [worst.name])
    assert abs(intrinsics.measure(model).gain) < 0.02


def test_large_maps_are_not_judged(monkeypatch):
    monkeypatch.setattr(intrinsics, "MAX_ADJUSTED_IMAGES", 7)
    assert intrinsics.measure(reconstructed(0.2)) == intrinsics.NOT_TRIED
