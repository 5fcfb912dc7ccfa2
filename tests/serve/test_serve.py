"""The HTTP service, with a real client."""

import base64
import json
import socket
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import Request, urlopen

import numpy as np
import pycolmap
import pytest
import uvicorn
from PIL import Image

from hloc_reduce import Localizer, compact, serve
from hloc_reduce.serve.__main__ import _main
from hloc_reduce.utils import cli
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize


@pytest.fixture
def start():
    """Starts the service in a thread; returns its address."""
    servers = []

    def start(localizer, **options):
        app = serve.make_app(localizer, **options)
        server = uvicorn.Server(uvicorn.Config(app, port=0, log_level="error"))
        thread = threading.Thread(target=server.run, daemon=True)
        thread.start()
        while not server.started:
            time.sleep(0.01)
        servers.append((server, thread))
        (port,) = {s.getsockname()[1] for part in server.servers for s in part.sockets}
        return f"http://127.0.0.1:{port}"

    yield start
    for server, thread in servers:
        server.should_exit = True
        thread.join()


def ask(url, body=None):
    """Return the status and the content of an answer."""
    try:
        with urlopen(Request(url, body), timeout=60) as answer:
            return answer.status, json.loads(answer.read())
    except HTTPError as error:
        content = error.read()
        return error.code, json.loads(content) if content.startswith(b"{") else content


KNOWN = "camera, inliers, near and radius"
CAMERA = "?camera=" + quote("SIMPLE_PINHOLE 360 270 375 180 135")


def test_a_photo_gets_its_pose(place, build_map, tmp_path, start):
    """As from the Localizer, eight at a time; photos of nothing get a reason."""
    _, images, _ = place
    file = tmp_path / "place.hlm"
    compact.main(file, build_map())
    localizer = Localizer(file)
    url = start(localizer)
    photo = (images / "query/day/a.png").read_bytes()
    _, camera = next(q for q in _queries(images) if q[0].endswith("a.png"))
    pose, info = localizer.localize(images / "query/day/a.png", camera)
    status, found = ask(url + "/localize" + CAMERA + "&inliers=1", photo)
    assert status == 200 and found["localized"] and found["intrinsics"] == "given"
    assert found["tvec"] == pytest.approx(pose.translation.tolist())
    assert found["num_inliers"] == info["num_inliers"] == len(found["points2D"])
    assert len(found["points3D"]) == info["num_inliers"] and found["retrieved"]
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: ask(url + "/localize", photo), range(24)))
    assert {status for status, _ in answers} == {200}
    assert len({tuple(found["tvec"]) for _, found in answers}) == 1
    assert "points2D" not in answers[0][1]
    grey = (images / "query/day/grey.png").read_bytes()
    status, found = ask(url + "/localize", grey)
    assert status == 200 and not found["localized"] and found["reason"] == "no keypoints"
    assert "tvec" not in found
    assert ask(url + "/health")[1] == {"images": 4, "served": 26, "waiting": 0}
    bad = quote("SIMPLE_PINHOLE 10 10 9 5 5")
    status, found = ask(f"{url}/localize?camera={bad}", photo)
    assert status == 400 and found["error"].startswith("The camera has 10x10 pixels, the photo has")


def test_a_photo_is_localized_near_a_pose(place, build_map, start):
    """As from the Localizer, also from the pose in an answer; another frame's is refused."""
    _, images, _ = place
    localizer = Localizer(build_map())
    url = start(localizer) + "/localize" + CAMERA
    photo = (images / "query/day/a.png").read_bytes()
    _, found = ask(url, photo)
    assert not found["near"] and np.array(found["covariance"]).shape == (6, 6)
    near = ",".join(map(str, found["qvec"] + found["tvec"]))
    status, again = ask(f"{url}&near={near}&radius=0.3", photo)
    assert status == 200 and again["near"] and again["reason"] is None
    assert again["tvec"] == pytest.approx(found["tvec"], abs=0.02)
    for wrong, said in (
        ("&near=1,0,0,0,0,0,1e6", "near is 1e+06 units from the nearest image of the map, which"),
        ("&near=1,0,0,0,0,0,1e300", "near is "),
        (f"&near={near}&radius=-1", "radius is -1.0: a distance above 0, in the units of the map."),
        (f"&near={near}&radius=nan", "radius is nan: a distance above 0"),
    ):
        status, answered = ask(url + wrong, photo)
        assert status == 400 and answered["error"].startswith(said), answered


def test_a_rig_gets_its_pose(place, plane, build_map, start):
    _, images, _ = place
    model = pycolmap.Reconstruction(plane / "model")
    by_name = {image.name: image for image in model.images.values()}
    first, second = by_name["4.png"].cam_from_world(), by_name["0.png"].cam_from_world()
    cams_from_rig = [pycolmap.Rigid3d(), second * first.inverse()]
    cameras = []
    for name, pose in zip(("query/day/a.png", "db/0.png"), cams_from_rig, strict=True):
        x, y, z, w = pose.rotation.quat.tolist()
        cameras.append(
            {
                "photo": base64.b64encode((images / name).read_bytes()).decode(),
                "camera": "SIMPLE_PINHOLE,360,270,375,180,135",
                "cam_from_rig": {"qvec": [w, x, y, z], "tvec": pose.translation.tolist()},
            }
        )
    localizer = Localizer(build_map())
    url = start(localizer) + "/localize_rig"
    status, found = ask(url + "?inliers=1", json.dumps({"cameras": cameras}).encode())
    assert status == 200 and found["localized"] and found["reason"] is None
    assert found["tvec"] == pytest.approx(first.translation.tolist(), abs=0.02)
    numbers = [camera["num_inliers"] for camera in found["cameras"]]
    assert found["num_inliers"] == sum(numbers) and np.array(found["covariance"]).shape == (6, 6)
    for number, camera in zip(numbers, found["cameras"], strict=True):
        assert len(camera["points2D"]) == len(camera["points3D"]) == number and camera["retrieved"]
    _, short = ask(url, json.dumps({"cameras": cameras}).encode())
    assert "points2D" not in short["cameras"][0] and short["tvec"] == found["tvec"]
    wrong = [cameras[0], {**cameras[1], "camera": "SIMPLE_PINHOLE,9,9,9,4,4"}]
    said = "camera 1 has 9x9 pixels, the photo has 360x270."
    assert ask(url, json.dumps({"cameras": wrong}).encode()) == (400, {"error": said})
    assert ask(url, b"{}")[0] == 400 and ask(url)[0] == 405


def _queries(images):
    from hloc_reduce.utils.parsers import parse_query_lists

    lists = images.parent / "queries/*_time_queries_with_intrinsics.txt"
    return [query for part in parse_query_lists(lists).values() for query in part]


class Blocked:
    """A localizer that waits to be released."""

    names = ("a",)

    def __init__(self):
        self.released = threading.Event()

    def localize(self, path, *_, **__):
        self.released.wait(30)
        raise InputError(f"Cannot read image {path}: it is truncated.")


def png(size, mode="L"):
    buffer = BytesIO()
    Image.new(mode, size).save(buffer, "PNG")
    return buffer.getvalue()


def test_garbage_is_refused(start):
    localizer = Blocked()
    localizer.released.set()
    url = start(localizer, max_mb=0.1)
    photo = png((8, 8))
    noise = np.random.default_rng(0).bytes(1000)
    for body in (noise, photo[:20]):
        assert ask(url + "/localize", body) == (
            400,
            {"error": "the body is not a JPEG or PNG file"},
        )
    assert ask(url + "/localize", b"")[1] == {"error": "the body cannot be read: it is empty"}
    assert ask(url + "/localize", photo) == (400, {"error": "Cannot read image: it is truncated."})
    for path, what in (("/localize", "photo"), ("/localize_rig", "request")):
        said = f"a {what} has at most 100,000 bytes"
        assert ask(url + path, bytes(100_001)) == (413, {"error": said})
    for size in ((12_000, 9_000), (30_000, 20_000)):
        status, found = ask(url + "/localize", png(size, "1"))
        assert status == 413 and "100,000,000 pixels" in found["error"]
    status, found = ask(url + "/localize?inliers=abc", photo)
    assert status == 400 and found["error"] == "inliers is 'abc': it is 0 or 1"
    for camera in (
        "",
        "x",
        "PINHOLE 9 9 0 1 1 1",
        "PINHOLE",
        "PINHOLE 1 1 1",
        "PINHOLE 9 9 nan 1 1 1",
        "NONE 1 1 1 1 1",
    ):
        status, found = ask(f"{url}/localize?camera={quote(camera)}", photo)
        assert status == 400 and "MODEL WIDTH HEIGHT PARAMS" in found["error"], camera
    assert ask(url + "/localize")[0] == 405 and ask(url + "/map")[0] == 404
    assert ask(url + "/health")[1]["waiting"] == 0


@pytest.mark.fault(10)
@pytest.mark.parametrize("kind", ["GIF", "WEBP"])
def test_photos_of_other_formats_are_refused(kind, start):
    """By what pipelines say of them."""
    buffer = BytesIO()
    Image.new("L", (8, 8)).save(buffer, kind)
    name = {"WEBP": "WebP"}.get(kind, kind)
    how = "`magick mogrify -format jpg` converts it"
    said = f"the body cannot be read: it is {name}, not JPEG or PNG; {how}"
    assert ask(start(Blocked()) + "/localize", buffer.getvalue()) == (400, {"error": said})


@pytest.mark.fault(13)
@pytest.mark.parametrize(
    "given, error",
    [
        ("?foo", f"unknown parameters: foo; there are {KNOWN}"),
        ("?Camera=PINHOLE&inliers=1", f"unknown parameters: Camera; there are {KNOWN}"),
        ("?b=1&a=2&inliers=0", f"unknown parameters: a, b; there are {KNOWN}"),
        ("?" + "x" * 99, f"unknown parameters: {'x' * 20}; there are {KNOWN}"),
        ("?inliers=0&inliers=1", "inliers: give it once"),
    ],
)
def test_parameters_that_would_be_ignored_are_refused(given, error, start):
    localizer = Blocked()
    localizer.released.set()
    assert ask(f"{start(localizer)}/localize{given}", png((8, 8))) == (400, {"error": error})


@pytest.mark.fault(13)
@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "203.0.113.7", "a..b"])
def test_an_address_that_cannot_be_had(host, monkeypatch, caplog):
    """Where another program listens, or of another machine; before anything is served."""

    def loaded(*_, **__):
        pytest.fail("the map is loaded although nothing can listen there")

    monkeypatch.setattr("hloc_reduce.maps.localizer.Localizer", loaded)
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        given = ["serve", "--map", "place.hlm", "--host", host, "--port", str(port)]
        monkeypatch.setattr(sys, "argv", given)
        with pytest.raises(SystemExit) as exit:
            cli.run(_main)
    (line,) = [record.getMessage() for record in caplog.records if record.name == "hloc_reduce"]
    assert exit.value.code == 2 and line.startswith(f"Cannot listen on {host}:{port}: ")
    assert line.endswith(". Choose another --port or --host.") and "(" not in line
    assert ("in use" in line) == (host in ("127.0.0.1", "localhost"))


def test_a_full_queue_is_refused(start):
    localizer = Blocked()
    url = start(localizer, queue=2)
    photo = png((8, 8))
    with ThreadPoolExecutor(2) as pool:
        accepted = [pool.submit(ask, url + "/localize", photo) for _ in range(2)]
        while ask(url + "/health")[1]["waiting"] < 2:
            time.sleep(0.01)
        status, found = ask(url + "/localize", photo)
        assert status == 503 and "2 requests are waiting" in found["error"]
        localizer.released.set()
        assert [answer.result()[0] for answer in accepted] == [400, 400]
    assert ask(url + "/localize", photo)[0] == 400


def test_slow_and_broken_uploads_hold_nobody_up(start, monkeypatch):
    """Clients that send a part of a photo, and go away or not."""
    monkeypatch.setattr(serve, "UPLOAD_SECONDS", 1.0)
    localizer = Blocked()
    localizer.released.set()
    url = start(localizer, queue=1)
    address = ("127.0.0.1", int(url.rpartition(":")[2]))
    head = b"POST /localize HTTP/1.1\r\nHost: a\r\nContent-Length: 1000\r\n\r\nabc"
    with socket.create_connection(address) as slow, socket.create_connection(address) as gone:
        slow.sendall(head)
        gone.sendall(head)
        gone.close()
        assert ask(url + "/localize", png((8, 8)))[0] == 400
        assert b"408" in slow.recv(100)
    assert ask(url + "/health")[1]["waiting"] == 0


def test_a_missing_map(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(sys, "argv", ["serve", "--map", str(tmp_path / "place.hlm")])
    with pytest.raises(SystemExit) as exit:
        cli.run(_main)
    assert exit.value.code == 2 and "There is no map" in caplog.text
