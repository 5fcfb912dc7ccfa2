"""Mirrored photos among those of a map."""

import itertools

import cv2
import numpy as np
import pycolmap
import pytest
from command import state

from hloc_reduce import maps
from hloc_reduce.confs import retrieval as retrieval_confs
from hloc_reduce.mapping.checks import Inputs, contradictions, mirrored
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.maps.by_others import ByOthers
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError
from pipelines import localize

pytestmark = pytest.mark.check

PIPELINE = localize
OTHERS = [f"{i}.png" for i in (0, 2, 3, 4)]


def mirror(path):
    cv2.imwrite(str(path), cv2.imread(str(path))[:, ::-1])


def build_with_one_mirrored(plane, outputs, run):
    """Build a map with a mirrored photo, which it must leave out; return the arguments."""
    mirror(plane / "images/1.png")
    arguments = "--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single"
    run(*arguments)
    built = maps.Map(outputs / "map")
    assert names_in(built.findings, "mirrored") == {"1.png"} and built.names() == OTHERS
    [sfm] = [path.name for path in built.folder.glob("sfm*")]
    assert sfm.endswith("-unmirrored")
    assert not (built.folder / "mirrored").exists()
    return arguments


def test_a_mirrored_photo_is_named(plane, tmp_path, caplog, run):
    build_with_one_mirrored(plane, tmp_path / "outputs", run)
    assert "Mirrored photos do not belong in the map: 1.png." in caplog.text
    assert "images are not in the map" not in caplog.text


@pytest.mark.parametrize("symmetric", [0.25])
def test_one_that_the_mapper_places_is_left_out(plane, symmetric, tmp_path, caplog, run):
    """As it may where a part of the place is symmetric; also after an interruption."""
    caplog.set_level("INFO")
    folder = tmp_path / "outputs/map"
    arguments = build_with_one_mirrored(plane, tmp_path / "outputs", run)
    assert "5 of 5 photos are in the map." in caplog.text
    written = state(folder)
    caplog.clear()
    run(*arguments)
    assert state(folder) == written
    assert "Mirrored photos do not belong in the map: 1.png." in caplog.text


@pytest.mark.parametrize("symmetric", [0.25])
def test_the_others_are_tried_when_one_is_mirrored(plane, symmetric, tmp_path, monkeypatch, run):
    """Also one that seemed to be sound; a run that was stopped after it leaves nothing behind."""
    for name in ("1.png", "3.png"):
        mirror(plane / "images" / name)
    sound = ["0.png", "1.png", "2.png", "4.png"]
    monkeypatch.setattr(mirrored, "groups", lambda _: [sound, ["3.png"]])
    folder = tmp_path / "outputs/map"
    arguments = "--map_images", plane / "images", "--outputs", folder.parent
    arguments += "--camera_mode", "single"

    def stops(*_):
        raise InputError("stopped")

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(contradictions, "judge", stops)
        run(*arguments)
    assert (folder / "mirrored").exists() and len(list(folder.glob("sfm*"))) > 1
    run(*arguments)
    built = maps.Map(folder)
    assert names_in(built.findings, "mirrored") == {"1.png", "3.png"}
    assert built.names() == ["0.png", "2.png", "4.png"]
    assert not (folder / "mirrored").exists() and len(list(folder.glob("sfm*"))) == 1


def test_photos_without_keypoints(plane, tmp_path, run):
    cv2.imwrite(str(plane / "images/black.png"), np.zeros((270, 360), np.uint8))
    outputs = tmp_path / "outputs"
    run("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    assert names_in(built.findings) == {"black.png"} == names_in(built.findings, "partial")
    assert built.names() == [f"{i}.png" for i in range(5)]


@pytest.mark.parametrize(
    ("as_it_is", "of_mirror_image", "agreement", "is_named"),
    [
        (20.0, 400.0, 0.95, True),
        (500.0, 400.0, 0.95, False),
        (20.0, 200.0, 0.95, False),
        (20.0, 400.0, 0.8, False),
    ],
)
def test_only_what_is_beyond_doubt_is_named(as_it_is, of_mirror_image, agreement, is_named):
    """Lower confidences and agreements of mirror images are those of symmetric places."""

    def localize(names, by, is_mirrored):
        confidence = of_mirror_image if is_mirrored else as_it_is
        return {name: {"confidence": confidence, "agreement": agreement} for name in names}

    expected = {"0.png"} if is_named else set()
    assert mirrored.mirrored(localize, {"0.png"}, {*OTHERS}) == expected
    assert mirrored.mirrored(localize, {"0.png"}, {*OTHERS[:2]}) == set()  # too few tell
    assert mirrored.mirrored(lambda *_: {}, {"0.png"}, {*OTHERS}) == set()


def sharing(tracks):
    """Return a model of points that some photos each see."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=100, height=100, params=[100, 50, 50], camera_id=1
    )
    numbers = sorted({i for track in tracks for i in track})
    seen = {i: [row for row, track in enumerate(tracks) if i in track] for i in numbers}
    for i, rows in seen.items():
        image = pycolmap.Image(
            name=f"{i}.png", keypoints=np.full((len(rows), 2), 50.0), camera_id=1, image_id=i
        )
        colmap.add_image(model, camera, image, pycolmap.Rigid3d())
    for row, track in enumerate(tracks):
        elements = [pycolmap.TrackElement(i, seen[i].index(row)) for i in track]
        model.add_point3D(np.array([0, 0, 1.0 + row]), pycolmap.Track(elements))
    return model


def test_a_few_photos_of_each_group_are_tried():
    """Three groups; only the last photo of the second one, which has the fewest points, is not."""
    tracks = [*[(1, 2, 3, 4, 5)] * 20, *[(6, 7, 8, 9)] * 20, (6, 7, 8), *[(1, 6, 10)] * 4]
    model = sharing(tracks)
    tried = []

    def localize(names, by, is_mirrored):
        tried.append((sorted(names), sorted(by), is_mirrored))
        return {name: {"confidence": 300.0, "agreement": 1.0} for name in names}

    assert mirrored.find(Inputs(model, localize=localize)) == []
    some, largest = ["10.png", "6.png", "7.png", "8.png"], [f"{i}.png" for i in range(1, 6)]
    assert tried == [(some, largest, True), (some, largest, False)]


def test_photos_that_share_little_are_not_judged(tmp_path):
    """Five photos, each pair of which sees other points: no group tells anything."""
    pairs = [pair for pair in itertools.combinations(range(1, 6), 2) for _ in range(60)]
    model = sharing(pairs)
    for i in range(1, 6):
        cv2.imwrite(str(tmp_path / f"{i}.png"), np.zeros((100, 100), np.uint8))
    by_others = ByOthers(model, {}, "", tmp_path, *3 * [tmp_path / "none"], {})
    assert mirrored.find(Inputs(model, localize=by_others)) == []


@pytest.mark.parametrize("symmetric", [0.0, 1.0])
def test_no_photo_is_mirrored(plane, symmetric, tmp_path, caplog, run):
    """Not even one of a symmetric place that seems to be apart from the others."""
    outputs = tmp_path / "outputs"
    run("--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single")
    built = maps.Map(outputs / "map")
    assert not built.findings and len(built.names()) == 5
    assert "Mirrored" not in caplog.text
    sfm = colmap.read_model(built.sfm)
    names = built.names()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mirrored, "groups", lambda _: [names[1:], names[:1]])
        by_others = ByOthers(
            sfm,
            conf=built.conf,
            matcher=built.matcher,
            image_dir=built.images,
            features=built.features,
            descriptors=built.descriptors,
            folder=tmp_path / "mirrored",
            retrieval=retrieval_confs.get(built.retrieval),
        )
        assert mirrored.find(Inputs(sfm, localize=by_others)) == []
