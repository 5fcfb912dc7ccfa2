"""Mirrored photos of a symmetric place, which have many inliers at a wrong pose."""

from dataclasses import replace

import cv2
import pytest
from command import outcome, run

from hloc_reduce import Localizer, extract_features
from hloc_reduce.localization import gate as gates
from hloc_reduce.localization.gate import DEFAULT_GATE, Gate
from hloc_reduce.localization.measures import Measures
from hloc_reduce.localization.records import log_file, measures_of, read_records
from hloc_reduce.utils.cli import InputError
from pipelines import aachen, localize

MATCHER = "--matcher", "NN-mutual"  # a ratio test would refuse most wrong matches here


@pytest.fixture
def symmetric() -> float:
    """Most of the plane mirrors itself."""
    return 0.7


@pytest.fixture
def as_certain_as_right_ones(monkeypatch):
    """The wrong pose is uncertain by 3.3 %, a skew fits a bit better, and most matches agree."""
    monkeypatch.setattr(gates, "SURE", 2.0)
    monkeypatch.setattr(gates, "PRECISE", gates.Tolerance(0.05, 2.0))
    monkeypatch.setitem(gates.ALTERNATIVES, "skew", gates.ALTERNATIVES["skew"]._replace(ratio=1.5))


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
    "kind, agreement, confidence, expected",
    [
        # mirrored photos of a castle
        ("ratio", 0.92, 432, True),
        ("ratio", 0.90, 375, True),
        ("ratio", 0.97, 2783, False),
        ("mutual", 0.56, 2863, True),
    ],
)
def test_poses_like_those_of_mirrored_photos_are_doubtful(kind, agreement, confidence, expected):
    gate = Gate(match_kind=kind)
    measures = Measures(agreement=agreement, confidence=confidence)
    assert gates.may_be_mirrored(measures, gate) == expected
    assert not gates.may_be_mirrored(replace(measures, is_camera_given=True), gate)


@pytest.mark.usefixtures("as_certain_as_right_ones")
def test_photos_of_ones_own(place, build_map, tmp_path, monkeypatch):
    """The mirrored photo is refused by the pipeline and in memory, and would not be otherwise."""
    build, images, outputs = place
    build_map(*MATCHER)
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
    assert mirror_images(outputs / "queries-new")["mirrored.png"] > 100

    localizer = Localizer(outputs / "map")
    pose, info = localizer.localize(new / "mirrored.png")
    assert pose is None and info["reason"] == rows["mirrored.png"]["reason"]
    # again, with nothing but the records
    run(monkeypatch, localize, *build, *MATCHER, "--query_images", new)
    assert outcome(outputs / "queries-new")[1] == rows

    # a photo of a calibrated camera is not mirrored
    pose, info = localizer.localize(new / "mirrored.png", info["camera"])
    assert pose is not None and info["num_inliers"] > 50
    assert "mirror_image" not in info["seconds"]


@pytest.mark.usefixtures("as_certain_as_right_ones")
def test_a_run_that_stops_before_the_mirror_images_resumes(place, build_map, tmp_path, monkeypatch):
    """Its records say localized, but no poses are written."""
    build, images, outputs = place
    build_map(*MATCHER)
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


def test_photos_of_a_calibrated_camera_are_not_mirrored(aachen_layout, tmp_path, monkeypatch):
    run(monkeypatch, aachen, "--dataset", aachen_layout, "--outputs", tmp_path / "out", *MATCHER)
    tried = mirror_images(tmp_path / "out")
    assert set(tried.values()) == {None}
