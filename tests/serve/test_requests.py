"""What the HTTP service makes of requests, without a server."""

import base64
import json
from io import BytesIO

import numpy as np
import pycolmap
import pytest
from PIL import Image

from hloc_reduce.serve import answer, answer_of_rig, requests
from hloc_reduce.serve.requests import Refused
from hloc_reduce.utils.cli import InputError

CAMERA = "PINHOLE,8,6,9,9.5,4,3"
ALL = tuple(requests.PARAMETERS)


def photo(size=(8, 6), kind="PNG"):
    buffer = BytesIO()
    Image.new("L", size).save(buffer, kind)
    return buffer.getvalue()


def of_rig(**changed):
    """Return a camera of a rig as clients send it; None leaves a key out."""
    pose = {"qvec": [0.5, 0.5, 0.5, 0.5], "tvec": [1, 2.5, -3]}
    given = {"photo": base64.b64encode(photo()).decode(), "camera": CAMERA, "cam_from_rig": pose}
    return {key: value for key, value in {**given, **changed}.items() if value is not None}


def refusal(make, *given):
    with pytest.raises(Refused) as caught:
        make(*given)
    reason = caught.value.reason
    assert "\n" not in reason and len(reason) < 400
    return caught.value.status, reason


@pytest.mark.parametrize("separator", [" ", ",", ", "])
def test_parameters_have_their_types(separator):
    numbers = separator.join(["0.5", "-0.5", "0.5", "0.5005", "1", "2e1", "-3"])
    text = separator.join(CAMERA.split(","))
    given = [("near", numbers), ("radius", "0.5"), ("inliers", "1"), ("camera", text)]
    found = requests.parameters(given, ALL)
    assert found["radius"] == 0.5 and found["inliers"] is True
    assert found["camera"].params.tolist() == [9, 9.5, 4, 3]
    near = found["near"]
    np.testing.assert_allclose(near.rotation.quat, [-0.5, 0.5, 0.5, 0.5], atol=1e-3)
    assert np.linalg.norm(near.rotation.quat) == pytest.approx(1, abs=1e-12)
    assert near.translation.tolist() == [1, 20, -3]
    assert requests.parameters([], ALL) == {}


@pytest.mark.parametrize(
    "given, said",
    [
        ({"near": ""}, "near: it has 0 numbers; it is qw,qx,qy,qz,tx,ty,tz, camera from world"),
        ({"near": "1,0,0,0,0,0"}, "near: it has 6 numbers"),
        ({"near": "1,0,0,0,0,0,0,0"}, "near: it has 8 numbers"),
        ({"near": "1,0,0,0,0,x,0"}, "near: could not convert string to float: 'x'"),
        ({"near": "1,0,0,0,0,nan,0"}, "near: its numbers are not finite"),
        ({"near": "1,0,0,0,0,1e999,0"}, "near: its numbers are not finite"),
        ({"near": "0,0,0,0,0,0,0"}, "near: its quaternion has the length 0, not 1"),
        ({"near": "2,0,0,0,0,0,0"}, "near: its quaternion has the length 2, not 1"),
        ({"near": "1e200,0,0,0,0,0,0"}, "near: its quaternion has the length"),
        ({"near": "1,0,0,0,0,0,0", "radius": "x" * 99}, f"radius is '{'x' * 20}': it is a number"),
        ({"radius": "1"}, "radius: it is that of near, which is not given"),
    ],
)
def test_wrong_parameters_are_named(given, said):
    status, reason = refusal(requests.parameters, list(given.items()), ALL)
    assert status == 400 and reason.startswith(said)


def test_rigs_do_not_have_the_parameters_of_photos():
    said = "unknown parameters: near; there are inliers"
    assert refusal(requests.parameters, [("near", "")], ("inliers",)) == (400, said)


def test_a_rig_is_read():
    other = of_rig(photo=base64.b64encode(photo(kind="JPEG")).decode())
    first, second = requests.rig(json.dumps({"cameras": [of_rig(), other]}).encode())
    assert first.photo == photo() and second.photo == photo(kind="JPEG")
    assert first.camera.params.tolist() == [9, 9.5, 4, 3] and first.camera.width == 8
    assert first.cam_from_rig.rotation.quat.tolist() == [0.5, 0.5, 0.5, 0.5]
    assert first.cam_from_rig.translation.tolist() == [1, 2.5, -3]


def test_the_largest_rig_is_read():
    lens = "FULL_OPENCV,8,6,9,9,4,3,0.1,0.01,0.001,0.001,0.0001,0.0001,0.0001,0.0001"
    body = json.dumps({"cameras": [of_rig(camera=lens)] * requests.MAX_CAMERAS}, indent=4)
    assert len(requests.rig(body.encode())) == requests.MAX_CAMERAS


NO_OBJECT = "the body is not a JSON object with a list of cameras"


@pytest.mark.parametrize(
    "body, said",
    [
        (b"", "the body is not JSON"),
        (photo(), "the body is not JSON"),
        (b"[" * 1_000_000, "the body is not JSON"),
        (b"[" + b"9" * 10_000 + b"]", "the body is not JSON"),
        (
            b'{"cameras": [' + b"[]," * 10_000 + b"[]]}",
            "the body has too many values: a rig has 1 to 16 cameras",
        ),
        (b"[]", NO_OBJECT),
        (b"{}", NO_OBJECT),
        (b'{"cameras": {}}', NO_OBJECT),
        (b'{"cameras": []}', "0 cameras: a rig has 1 to 16"),
        (b'{"cameras": [' + b"1," * 16 + b"1]}", "17 cameras: a rig has 1 to 16"),
        (b'{"cameras": [], "near": 1}', "unknown keys: near; there are cameras"),
    ],
)
def test_what_is_no_rig(body, said):
    assert refusal(requests.rig, body) == (400, said)


POSE = 'it is {"qvec": [w, x, y, z], "tvec": [x, y, z]}'


@pytest.mark.parametrize(
    "changed, said",
    [
        ({"photo": None}, "it has photo, camera and cam_from_rig"),
        ({"names": 1}, "unknown keys: names; there are photo, camera and cam_from_rig"),
        ({"photo": 7}, "photo: it is a JPEG or PNG file in base64"),
        ({"photo": ""}, "photo: it is a JPEG or PNG file in base64"),
        ({"photo": "a*bc"}, "photo: it is a JPEG or PNG file in base64"),
        ({"photo": "\u00e9"}, "photo: it is a JPEG or PNG file in base64"),
        ({"photo": "abcd"}, "the photo is not a JPEG or PNG file"),
        (
            {"photo": base64.b64encode(photo(kind="GIF")).decode()},
            "the photo cannot be read: it is GIF, not JPEG or PNG; `magick mogrify -format jpg` "
            "converts it",
        ),
        ({"camera": ["PINHOLE", 8, 6]}, "camera: it is a string, MODEL WIDTH HEIGHT PARAMS"),
        ({"camera": "PINHOLE"}, "camera: it has no camera model, width and height; it is MODEL"),
        ({"cam_from_rig": [1, 0, 0, 0, 0, 0, 0]}, f"cam_from_rig: it has other keys; {POSE}"),
        ({"cam_from_rig": {"qvec": [1, 0, 0, 0]}}, f"cam_from_rig: it has other keys; {POSE}"),
        (
            {"cam_from_rig": {"qvec": [1, 0, 0, 0], "tvec": [0, 0, "0"]}},
            f"cam_from_rig: it has no lists of numbers; {POSE}",
        ),
        (
            {"cam_from_rig": {"qvec": [True, 0, 0, 0], "tvec": [0, 0, 0]}},
            f"cam_from_rig: it has no lists of numbers; {POSE}",
        ),
        (
            {"cam_from_rig": {"qvec": [1, 0, 0], "tvec": [0, 0, 0]}},
            f"cam_from_rig: it has 6 numbers; {POSE}",
        ),
        (
            {"cam_from_rig": {"qvec": [1, 0, 0, 1], "tvec": [0, 0, 0]}},
            f"cam_from_rig: its quaternion has the length 1.41, not 1; {POSE}",
        ),
        (
            {"cam_from_rig": {"qvec": [1, 0, 0, 0], "tvec": [0, 0, float("nan")]}},
            f"cam_from_rig: its numbers are not finite; {POSE}",
        ),
        (
            {"cam_from_rig": {"qvec": [1, 0, 0, 0], "tvec": [0, 0, 10**999]}},
            f"cam_from_rig: int too large to convert to float; {POSE}",
        ),
    ],
)
def test_a_wrong_camera_of_a_rig_is_named(changed, said):
    body = json.dumps({"cameras": [of_rig(), of_rig(**changed)]}).encode()
    status, reason = refusal(requests.rig, body)
    assert status == 400 and reason.startswith(f"camera 1: {said}")


def test_a_huge_photo_of_a_rig_is_refused():
    huge = base64.b64encode(photo((12_000, 9_000), "PNG")).decode()
    body = json.dumps({"cameras": [of_rig(photo=huge)]}).encode()
    said = "camera 0: a photo has at most 100,000,000 pixels"
    assert refusal(requests.rig, body) == (413, said)


class Double:
    """A localizer that answers what it was told to."""

    def __init__(self, pose, **info):
        self.pose, self.info = pose, info

    def localize(self, path, camera, **near):
        self.near = near
        return self.pose, self.info

    def localize_rig(self, files, cameras, cams_from_rig):
        assert [file.read_bytes() for file in files] == [photo(), photo()]
        raise InputError(f"Cannot read image {files[1]}: it is truncated.")


def test_the_answer_has_what_the_localizer_tells():
    """The place on Earth only with a pose, and if it is known."""
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.6, 0, 0.8])), [1, 2, 3])
    info = dict.fromkeys(("confidence", "agreement", "probability", "num_inliers"), 1.0)
    info |= {"reason": None, "again": False, "turned": 0, "near": True, "intrinsics": "given"}
    info |= {"map_doubts": [], "retrieved": list("abcdefg"), "seconds": {"pose": 0.123456}}
    info |= {"camera": requests.parameters([("camera", CAMERA)], ALL)["camera"]}
    info |= {"covariance": np.eye(6)}
    localizer = Double(pose, **info)
    found = answer(localizer, photo(), near=pose, radius=2.0)
    assert localizer.near == {"near": pose, "radius": 2.0}
    assert found["localized"] and found["near"] and "wgs84" not in found
    assert found["qvec"] == [0.8, 0, 0.6, 0] and found["tvec"] == [1, 2, 3]
    assert found["covariance"] == np.eye(6).tolist() and found["retrieved"] == list("abcde")
    assert found["seconds"] == {"pose": 0.1235}
    earth = {"latitude": 47.0, "longitude": 8.0}
    assert answer(Double(pose, **info, wgs84=earth), photo())["wgs84"] == earth
    for given in (Double(None, **info, wgs84=earth), Double(pose, **info, wgs84=None)):
        assert "wgs84" not in answer(given, photo())


def test_an_unreadable_photo_of_a_rig_is_named_by_its_camera():
    body = json.dumps({"cameras": [of_rig(), of_rig()]}).encode()
    said = "Cannot read image of camera 1: it is truncated."
    assert refusal(answer_of_rig, Double(None), body) == (400, said)
