"""The frames of rigs in maps of floors, each of which has a frame of its own."""

import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce.localization import rig_stage
from hloc_reduce.localization.gate import Gate
from hloc_reduce.localization.inputs import Settings
from hloc_reduce.runtime.executors import SERIAL

CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
TRUE = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.1, 0.4, -0.2])), np.array([0.3, -0.1, 0.5]))
LEFT = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 1.5, 0])), np.array([0.2, 0, 0.1]))
RIG = {"front/1.jpg": pycolmap.Rigid3d(), "left/1.jpg": LEFT}
UPSTAIRS, DOWNSTAIRS = "upstairs/1.jpg", "downstairs/1.jpg"


class Floors:
    """A map whose images each see as many points as a query has keypoints, on their floor."""

    def __init__(self, points):
        self.points, self.numbers = points, {name: i for i, name in enumerate(sorted(points))}

    def __contains__(self, name):
        return name in self.points

    def num_keypoints(self, name):
        return len(self.points[name])

    def lift(self, name, keypoints):
        return (self.numbers[name] << 32) + keypoints, self.points[name][keypoints]

    def floors(self, names):
        return [
            [name for name in names if name[0] == first]
            for first in dict.fromkeys(name[0] for name in names)
        ]

    clusters = floors

    def fallback(self, names):
        return None


def localized(folder, right):
    """Return why a frame is not localized, and the records of its photos.

    The image upstairs was retrieved first. `right` has the floors where matches are right: they are
    in frames that are a turn and 100 units apart.
    """
    generator = np.random.default_rng(0)
    away = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, 0, 2.0])), np.array([100.0, 0, 0]))
    rig_from = {DOWNSTAIRS: TRUE, UPSTAIRS: TRUE * away}
    points, frames = {}, []
    with (
        h5py.File(folder / "features.h5", "w") as features,
        h5py.File(folder / "matches-NN-mutual_.h5", "w") as matches,
    ):
        matches.attrs["conf"] = "{}"
        for photo, cam_from_rig in RIG.items():
            in_camera = generator.uniform([-2, -1.5, 3], [2, 1.5, 6], (60, 3))
            group = features.create_group(photo)
            group["keypoints"] = (CAMERA.img_from_cam(in_camera) - 0.5).astype(np.float32)
            group["descriptors"] = np.zeros((64, 60), np.float16)
            for floor, pose in rig_from.items():
                seen = (cam_from_rig * pose).inverse() * in_camera
                if floor not in right:
                    seen = generator.permutation(seen)
                own = points.setdefault(floor, [])
                matched = np.arange(60) + 60 * len(own)
                own.append(seen)
                pair = f"{photo.replace('/', '-')}/{floor.replace('/', '-')}"
                matches.create_group(pair)["matches0"] = matched.astype(np.int32)
            images = [UPSTAIRS, DOWNSTAIRS]
            frames.append(rig_stage.RigPhoto(photo, CAMERA, cam_from_rig, images))
    reference = Floors({floor: np.concatenate(own) for floor, own in points.items()})
    options = {"estimation": {"ransac": {"max_error": 6.0}}}
    gate = Gate(match_kind="mutual")
    settings = Settings(lambda: reference, lambda *_: options, 0, gate, SERIAL)
    files = folder / "features.h5", folder / "matches-NN-mutual_.h5"
    [(_, pose, records)] = rig_stage.localize_frames(settings, *files, [("front/1.jpg", frames)])
    return pose.refusal, records


@pytest.mark.parametrize("floor", [UPSTAIRS, DOWNSTAIRS])
def test_the_image_of_a_photo_is_on_the_floor_of_the_rig(floor, tmp_path):
    """Also if that of another floor looks more alike, and by the matches of that floor only."""
    reason, records = localized(tmp_path, [floor])
    assert reason is None
    for record in records.values():
        assert record["localized"] and record["db"] == floor
        assert record["num_matches"] == record["num_inliers"] == 60


def test_a_rig_that_may_be_on_two_floors_is_not_localized(tmp_path):
    reason, records = localized(tmp_path, [UPSTAIRS, DOWNSTAIRS])
    assert "a pose by other images has 120 inliers" in reason
    assert not any(record["localized"] for record in records.values())
