"""Mirrored photos of a symmetric place, which have many inliers at a wrong pose."""

import cv2
import pytest
from command import outcome, run

from hloc_reduce import Localizer, extract_features
from hloc_reduce.localization import gate as gates
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.localization.measures import Measures
from hloc_reduce.localization.records import log_file, measures_of, read_records
from hloc_reduce.utils.cli import InputError
from pipelines import aachen, inloc, localize

MATCHER = "--matcher", "NN-mutual"  # a ratio test would refuse most wrong matches here


@pytest.fixture
def symmetric() -> float:
    """Most of the plane mirrors itself."""
    return 0.7


@pytest.fixture
def as_certain_as_right_ones(monkeypatch):
    """Without intrinsics the wrong pose is uncertain by 3.3 %, for which it would be refused."""
    monkeypatch.setattr(gates, "PRECISE", (1.0, 1.0))


def mirror(path, of):
    """Write the mirror image of a photo."""
    cv2.imwrite(str(path), cv2.imread(str(of))[:, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])


def mirror_images(outputs):
    """Return the confidences of the mirror images that were tried."""
    summary, rows = outcome(outputs)
    path = log_file(outputs / summary["poses"])
    records = read_records(path)
    assert len(path.read_text().splitlines()) == 1 + len(rows)  # each query once
    return {name: measures_of(record).mirror_image for name, record in records.items()}


@pytest.mark.parametrize(
    "agreement, confidence, expected",
    [(0.92, 432, True), (0.90, 375, True), (0.85, 2000, True), (0.96, 2783, False)],
)
def test_poses_like_those_of_mirrored_photos_are_doubtful(agreement, confidence, expected):
    """The first two were of mirrored photos of a castle, and were not tried."""
    measures = Measures(agreement=agreement, confidence=confidence)
    assert gates.may_be_mirrored(measures) == expected


@pytest.mark.usefixtures("as_certain_as_right_ones")
def test_photos_of_ones_own(place, tmp_path, monkeypatch):
    """The mirrored photo is refused by the pipeline and in memory, and would not be otherwise."""
    monkeypatch.setattr(gates, "DOUBTFUL", (0.9, 250.0))
    build, images, outputs = place
    new = tmp_path / "new"
    new.mkdir()
    photo = images / "query/day/a.png"
    mirror(new / "mirrored.png", photo)
    (new / "right.png").write_bytes(photo.read_bytes())
    run(monkeypatch, localize, *build, *MATCHER, "--query_images", new)
    _, rows = outcome(outputs / "queries-new")
    assert rows["right.png"]["status"] == "localized"
    assert rows["mirrored.png"]["status"] == "fallback"
    assert rows["mirrored.png"]["reason"].startswith("it may be mirrored: the confidence is ")
    tried = mirror_images(outputs / "queries-new")
    assert tried["right.png"] is None  # most matches agree

    localizer = Localizer(outputs / "map")
    pose, info = localizer.localize(new / "mirrored.png")
    assert pose is None and info["reason"] == rows["mirrored.png"]["reason"]
    # again, with nothing but the records
    run(monkeypatch, localize, *build, *MATCHER, "--query_images", new)
    assert outcome(outputs / "queries-new")[1] == rows

    monkeypatch.setattr(gates, "DOUBTFUL", (0.0, 0.0))
    pose, info = localizer.localize(new / "mirrored.png")
    assert pose is not None and info["num_inliers"] > 50
    monkeypatch.setattr(gates, "DOUBTFUL", (1.0, 0.0))
    pose, info = localizer.localize(new / "right.png")
    assert pose is not None and "mirror_image" in info["seconds"]


@pytest.mark.usefixtures("as_certain_as_right_ones")
def test_a_run_that_stops_before_the_mirror_images_resumes(place, tmp_path, monkeypatch):
    """Its records say localized, but no poses are written."""
    build, images, outputs = place
    new = tmp_path / "new"
    new.mkdir()
    mirror(new / "mirrored.png", images / "query/day/a.png")
    extract = extract_features.main

    def stopped(conf, *args, **options):
        if conf["preprocessing"].get("mirrored"):
            raise InputError("stopped")
        return extract(conf, *args, **options)

    command = localize, *build, *MATCHER, "--query_images", new
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(extract_features, "main", stopped)
        run(monkeypatch, *command)
    results = outputs / "queries-new"
    (records,) = results.glob("*_logs.jsonl")
    assert read_records(records)["mirrored.png"]["localized"]
    assert not list(results.glob("poses_*.txt")) and not (results / "summary.json").exists()
    run(monkeypatch, *command)
    assert outcome(results)[1]["mirrored.png"]["reason"].startswith("it may be mirrored")


@pytest.mark.parametrize(
    "matcher, confidence, of_mirror_image, expected",
    [
        ({"ratio_threshold": 0.8}, 1147, 536, True),  # a mirrored photo of a courtyard, 90° off
        ({"ratio_threshold": 0.8}, 370, 131, False),  # a right one
        ({}, 6794, 4959, False),  # a right one of a castle, by xfeat
        ({}, 1000, 850, True),
    ],
)
def test_mirror_images_that_fit_nearly_as_well(matcher, confidence, of_mirror_image, expected):
    gate = DEFAULT_GATE.of_matches(matcher, 64)
    measures = Measures(confidence=confidence, mirror_image=of_mirror_image)
    assert bool(gates._mirrored(measures, gate)) == expected


def test_the_gate_of_a_user_decides_on_mirror_images(place, tmp_path, monkeypatch):
    """In the pipeline and in memory; the mirror image has 0.7 times the confidence."""
    build, images, outputs = place
    monkeypatch.setattr(gates, "DOUBTFUL", (1.0, 0.0))
    monkeypatch.setattr(gates, "MIRRORED", 0.5)
    new = tmp_path / "new"
    new.mkdir()
    (new / "right.png").write_bytes((images / "query/day/a.png").read_bytes())
    run(monkeypatch, localize, *build, *MATCHER, "--query_images", new)
    _, rows = outcome(outputs / "queries-new")
    assert rows["right.png"]["reason"].startswith("it may be mirrored")
    for gate, trusted in (
        (DEFAULT_GATE, False),
        (Gate(max_mirrored=0.9), True),
        (Gate(max_mirrored=0.9, min_agreement=((0, 0.1),)), True),
        (Gate(min_agreement=((0, 0.1),)), False),
    ):
        pose, _ = Localizer(outputs / "map", gate=gate).localize(new / "right.png")
        assert (pose is not None) == trusted
    with pytest.raises(InputError, match="max_mirrored is -1"):
        Gate(max_mirrored=-1)


def test_aachen(aachen_layout, tmp_path, monkeypatch):
    """The query by day is mirrored; the one by night is not."""
    photo = aachen_layout / "images_upright/query/day/a.png"
    mirror(photo, photo)
    run(monkeypatch, aachen, "--dataset", aachen_layout, "--outputs", tmp_path / "out", *MATCHER)
    _, rows = outcome(tmp_path / "out")
    assert rows["query/day/a.png"]["reason"].startswith("it may be mirrored")
    assert rows["query/night/a.png"]["status"] == "localized"


def test_inloc(inloc_layout, tmp_path, monkeypatch):
    """One of two photos is mirrored."""
    photos = inloc_layout / "query/iphone7"
    mirror(photos / "b.JPG", photos / "a.JPG")
    run(monkeypatch, inloc, "--dataset", inloc_layout, "--outputs", tmp_path / "out", *MATCHER)
    _, rows = outcome(tmp_path / "out")
    assert rows["query/iphone7/b.JPG"]["reason"].startswith("it may be mirrored")
    assert rows["query/iphone7/a.JPG"]["status"] == "localized"
