"""Maps and queries of videos."""

import shutil

import cv2
import numpy as np
import pytest
from command import outcome, state, table

from hloc_reduce import frames_from_video, maps
from hloc_reduce.utils import colmap, parsers
from pipelines import localize
from pipelines.common import videos

PIPELINE = localize
FPS = 10.0
SIZE = (360, 270)


def encode(path, pictures):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), FPS, SIZE)
    for picture in pictures:
        writer.write(picture)
    writer.release()
    return path


@pytest.fixture
def video(plane):
    """A video whose frames are the five photos of the plane."""
    return encode(
        plane / "walk.avi", [cv2.imread(str(plane / f"images/{i}.png")) for i in range(5)]
    )


def test_frames_of_a_video_share_a_camera_unless_they_are_panoramas(video, tmp_path):
    given = {"outputs": tmp_path, "overwrite": False, "map_images": video, "query_images": None}
    given |= {"camera_mode": None, "pairs": None}
    assert videos.as_folders(given | {"panoramas": False})["camera_mode"] == "single"
    assert videos.as_folders(given | {"panoramas": True})["camera_mode"] is None


def test_a_map_and_queries_of_videos(video, plane, tmp_path, monkeypatch, run, refused, caplog):
    monkeypatch.setattr(frames_from_video, "NEAR", 0)
    monkeypatch.setattr(frames_from_video, "FAR", 0)
    outputs = tmp_path / "outputs"
    given = ("--map_images", video, "--query_images", video, "--outputs", outputs)
    run(*given, "--fps", 5)
    frames = outputs / "map_images/walk"
    names = [f"0000.{i}00.jpg" for i in range(5)]
    assert sorted(path.name for path in frames.glob("*.jpg")) == names
    built = maps.Map(outputs / "map")
    assert sorted(built.names()) == names and built.camera_mode == "single"
    assert colmap.read_model(built.sfm).num_cameras() == 1
    assert (built.folder / "pairs-db-sequential.txt").exists()
    results = outputs / "queries-walk-5fps"
    summary, rows = outcome(results)
    assert [*rows] == [names[0], names[2], names[4]]
    localized = [name for name, row in rows.items() if row["status"] == "localized"]
    assert {names[0], names[4]} <= {*localized}  # the plane is seen from the front in between
    lines = [line.split() for line in (results / "trajectory_tum.txt").read_text().splitlines()]
    assert [f"000{line[0]}.jpg" for line in lines] == localized
    poses = parsers.parse_poses(results / summary["poses"])
    for name, (_, *numbers) in zip(localized, lines, strict=True):
        world_from_cam = poses[name].inverse()
        assert np.array(numbers[:3], float) == pytest.approx(world_from_cam.translation)
        assert np.array(numbers[3:], float) == pytest.approx(world_from_cam.rotation.quat)

    written = state(outputs)
    run(*given, "--fps", 5)  # all is there
    kept = {path: at for path, at in written.items() if path.suffix in (".jpg", ".h5", ".bin")}
    assert kept.items() <= state(outputs).items()
    assert table(results / "trajectory.csv")[1]["query"] == names[2]
    # a video that has changed
    encode(video, [cv2.imread(str(plane / f"images/{i}.png")) for i in (4, 3, 2, 1)])
    caplog.clear()
    run("--map", built.folder, "--query_images", video, "--fps", 5, "--outputs", outputs)
    assert "Results are stale" in caplog.text
    assert [*outcome(results)[1]] == [names[0], names[2]]
    before = state(frames)
    message = refused(*given[:2], *given[4:])
    assert "walk.avi has changed since the map" in message
    assert state(frames) == before  # those of the map


def test_photos_whose_names_are_no_times(place, build_map, run):
    """A trajectory of earlier names is deleted."""
    build, images, outputs = place
    build_map()
    new = images / "times"
    new.mkdir()
    shutil.copy(images / "query/day/a.png", new / "7.png")
    given = ("--map", outputs / "map", "--query_images", new, "--outputs", outputs)
    run(*given)
    results = outputs / "queries-times"
    assert (results / "trajectory_tum.txt").read_text().startswith("7 ")
    shutil.copy(images / "query/day/a.png", new / "night.png")
    run(*given)
    assert not [*results.glob("trajectory*")]


def test_videos_of_the_same_name_and_other_rates(video, tmp_path):
    """Have folders of their own."""
    other = tmp_path / "other" / video.name
    other.parent.mkdir()
    shutil.copy(video, other)
    options = ("query_images", "camera_mode", "pairs", "fps", "overwrite")
    given = dict.fromkeys(options) | {"outputs": tmp_path / "outputs", "pairs": "retrieval"}
    first, second, again = (
        videos.as_folders(given | {"map_images": path}) for path in (video, other, video)
    )
    assert first["map_images"] == again["map_images"] == tmp_path / "outputs/map_images/walk"
    assert second["map_images"].name.startswith("walk-")
    assert second["map_images"].parent == first["map_images"].parent
    assert first["camera_mode"] == "single" and first["pairs"] == "retrieval"
    given |= {"map_images": None, "query_images": video}
    found = [videos.as_folders(given | {"fps": fps}) for fps in (None, 2.5)]
    names = [one["query_images"].name for one in found]
    assert names == ["walk", "walk-2_5fps"]  # results are in queries-<name without a suffix>
    assert len([*found[1]["query_images"].glob("*.jpg")]) == 2
    assert found[0]["camera_mode"] is None


def test_wrong_input(video, plane, tmp_path, monkeypatch, refused):
    outputs = tmp_path / "outputs"
    build = ("--map_images", video, "--outputs", outputs)
    text = tmp_path / "notes.txt"
    text.write_text("no photos")
    message = refused("--map_images", text, "--outputs", outputs)
    assert message.startswith(f"{text} is neither a folder of photos nor a video (.3gp, .avi")
    broken = tmp_path / "broken.mp4"
    broken.write_text("no video")
    for option in ("--map_images", "--query_images"):
        others = build if option == "--query_images" else build[2:]
        assert "broken.mp4 cannot be decoded" in refused(option, broken, *others)
    assert not (outputs / "map").exists()
    assert "There is no file" in refused("--map_images", tmp_path / "none.mov", *build[2:])
    one = encode(tmp_path / "one.avi", [np.full((270, 360, 3), 90, np.uint8)])
    assert "only one frame" in refused("--map_images", one, *build[2:])
    black = encode(tmp_path / "black.avi", [np.zeros((270, 360, 3), np.uint8)] * 9)
    assert "no sharp frame" in refused("--map_images", black, *build[2:])
    message = refused(*build, "--map", plane / "model")
    assert "is a video, of which a map is built without --map" in message
    assert "is built without --database" in refused(*build, "--database", text)
    assert "--fps is for a video of queries" in refused(*build, "--fps", 2)
    message = refused("--map", outputs / "map", "--add_images", video)
    assert f"frames_from_video --video {video} --output FOLDER" in message
    folder = ("--query_images", plane / "images", "--fps", 2)
    assert "--fps is for a video of queries" in refused(*build, *folder)
    assert "--fps -1: it must be above 0" in refused(*build, "--fps", -1)
    monkeypatch.setattr(frames_from_video, "main", None)
    assert "Unknown kind of pairs 'all'" in refused(*build, "--pairs", "all")
