"""Masks of the photos of a map and of queries, in pipelines."""

import shutil

import cv2
import h5py
import numpy as np
import pytest
from command import outcome, refused, state, write
from command import run as run_pipeline
from conftest import FOCAL, SIZE

from hloc_reduce import Localizer
from hloc_reduce.maps.map import Map
from hloc_reduce.utils import colmap
from hloc_reduce.utils.parsers import parse_query_list
from pipelines import aachen, inloc, localize

PIPELINE = localize
BUMPER = 180  # rows from here on are black


@pytest.fixture
def masks(tmp_path):
    """Writes masks of photos into a folder, which it returns."""

    def write(*names: str, rows: int = BUMPER):
        mask = np.full(SIZE[::-1], 255, np.uint8)
        mask[rows:] = 0
        for name in names:
            path = tmp_path / f"masks/{name}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), mask)
        return tmp_path / "masks"

    return write


def lowest(features, *names) -> float:
    """Return the y of the lowest keypoint of photos."""
    with h5py.File(features) as file:
        return max(float(file[f"{name}/keypoints"][:, 1].max()) for name in names)


MAP = [f"db/{i}.png" for i in range(4)]


def test_one_folder_for_the_map_and_queries(place, masks, run, refused, caplog):
    """Names decide; what has changed is noticed."""
    build, images, outputs = place
    caplog.set_level("INFO")
    given = masks(*MAP[:3], "a.png")
    new = ("--query_images", images / "query/day", "--masks", given)
    run(*build, *new)
    assert "3 of 4 photos are masked" in caplog.text and "1 of 2 photos are masked" in caplog.text
    features = Map(outputs / "map").features
    assert lowest(features, *MAP[:3]) < BUMPER < lowest(features, MAP[3])
    results = outputs / "queries-day"
    assert lowest(results / features.name, "a.png") < BUMPER
    rows = outcome(results)[1]
    assert rows["a.png"]["status"] == "localized"
    before = state(outputs)
    run(*build, *new)
    assert {path: time for path, time in state(outputs).items() if path in before} == before
    # of a query
    (given / "a.png.png").unlink()
    caplog.clear()
    run(*build, *new)
    assert "Results are stale, as these changed: the mask of a.png." in caplog.text
    assert lowest(results / features.name, "a.png") > BUMPER
    more = int(outcome(results)[1]["a.png"]["num_matches"])
    assert more > int(rows["a.png"]["num_matches"])
    masks("grey.png", "a.png", rows=90)
    run(*build, *new)
    assert "the mask of a.png, the mask of grey.png" in caplog.text
    assert int(outcome(results)[1]["a.png"]["num_matches"]) < more
    # of the map
    before = state(outputs / "map")
    masks(MAP[3])
    assert "differs: masks (db/3.png" in refused(*build, *new)
    (given / "db/3.png.png").unlink()
    (given / "db/0.png.png").unlink()
    assert "differs: masks (db/0.png" in refused(*build, *new)
    masks(MAP[0], rows=100)
    assert "differs: masks (db/0.png" in refused(*build, *new)
    assert "differs: masks (db/0.png, db/1.png" in refused(*build, *new[:2])
    assert state(outputs / "map") == before
    run(*build, *new, "--overwrite")
    assert lowest(Map(outputs / "map").features, MAP[0]) < 100


def test_masks_of_the_map_or_of_queries_only(place, masks, run, refused):
    build, images, outputs = place
    given = masks(*MAP)
    run(*build, "--query_images", images / "query/day", "--masks", given)
    name = Map(outputs / "map").features.name
    assert lowest(outputs / "map" / name, *MAP) < BUMPER
    assert lowest(outputs / "queries-day" / name, "a.png") > BUMPER
    built = ("--map", outputs / "map", "--outputs", outputs)
    new = (*built, "--query_images", images / "query/night", "--masks", given)
    message = refused(*new)
    assert message == (
        f"No mask in {given} belongs to a photo in {images / 'query/night'}. "
        f"That of a.png would be {given / 'a.png.png'}."
    )
    masks("a.png")
    run(*new)
    assert lowest(outputs / "queries-night" / name, "a.png") < BUMPER
    message = f"--masks {given} needs photos to mask, such as --query_images."
    assert refused(*built, "--masks", given) == message


def test_wrong_masks_lose_nothing(place, masks, build_map, tmp_path, run, refused):
    build, images, outputs = place
    build_map()
    new = (*build, "--query_images", images / "query/day", "--overwrite", "--masks")
    run(*new[:-2])
    before = state(outputs)
    assert refused(*new, tmp_path / "no").startswith("There is no folder or file")
    given = masks("0.png")  # the photo is db/0.png
    message = refused(*new, given)
    assert f"No mask in {given} belongs to a photo in" in message
    assert f"That of a.png would be {given / 'a.png.png'}." in message
    for name in ("db/0.png", "a.png"):
        shutil.rmtree(given)
        masks(name, rows=0)
        assert f"{given / name}.png is all black" in refused(*new, given)
        mask = cv2.imread(str(given / f"{name}.png"))
        cv2.imwrite(str(given / f"{name}.png"), mask[:100] + 1)
        assert "has 360x100 pixels, its photo" in refused(*new, given)
        (given / f"{name}.png").write_text("no image")
        assert f"{given / name}.png is not an image" in refused(*new, given)
        if name == "db/0.png":
            assert state(outputs) == before
    message = refused(*new[:2], "--map_images", tmp_path / "nowhere", *new[4:], given)
    assert message == f"There is no folder {tmp_path / 'nowhere'}."


def test_photos_that_are_added_are_masked(place, masks, tmp_path, run, refused):
    (_, model, _, images, *rest), _, outputs = place
    run(
        "--map", colmap.write_part(model, MAP[:3], tmp_path / "part"), "--map_images", images, *rest
    )
    (tmp_path / "new/db").mkdir(parents=True)
    shutil.copy(images / MAP[3], tmp_path / "new/db")
    add = (
        "--map",
        outputs / "map",
        "--add_images",
        tmp_path / "new",
        "--add_model",
        model,
        "--masks",
    )
    before = state(outputs / "map")
    wrong = masks(MAP[3], rows=0)
    assert "all black" in refused(*add, wrong)
    after = state(outputs / "map")
    assert {path.name for path in before if after[path] != before[path]} == {"stages.json"}
    assert MAP[3] not in Map(outputs / "map").names()
    run(*add, masks(MAP[3]))
    built = Map(outputs / "map")
    assert MAP[3] in built.names()
    assert lowest(built.features, MAP[3]) < BUMPER < lowest(built.features, *MAP[:3])
    before = state(outputs / "map")
    said = "in the map already, with other masks or without"
    assert f"{MAP[3]} are {said}" in refused(*add, masks(MAP[3], rows=100))
    shutil.copy(images / MAP[0], tmp_path / "new/db")
    assert f"{MAP[0]} are {said}" in refused(*add, masks(MAP[0], MAP[3]))
    after = state(outputs / "map")
    assert {path.name for path in before if after[path] != before[path]} <= {"stages.json"}


def test_data_sets(aachen_layout, masks, tmp_path, monkeypatch, caplog):
    given = masks("db/0.png", "query/day/a.png")
    arguments = ("--dataset", aachen_layout, "--outputs", tmp_path / "out")
    run_pipeline(monkeypatch, aachen, *arguments, "--masks", given)
    (features,) = (tmp_path / "out").glob("feats-dog*_sv64.h5")
    assert lowest(features, "db/0.png", "query/day/a.png") < BUMPER
    assert lowest(features, "query/night/a.png") > BUMPER
    assert outcome(tmp_path / "out")[1]["query/day/a.png"]["status"] == "localized"
    before = state(tmp_path / "out")
    run_pipeline(monkeypatch, aachen, *arguments, "--masks", given)
    masks("db/1.png")
    for options in ((), ("--masks", given)):
        message = refused(monkeypatch, caplog, aachen, *arguments, *options)
        assert "differs: masks (db/" in message
    wrong = masks("db/1.png", rows=0)
    options = "--masks", wrong, "--overwrite"
    assert "all black" in refused(monkeypatch, caplog, aachen, *arguments, *options)
    assert {p: t for p, t in state(tmp_path / "out").items() if p.suffix == ".h5"} == {
        p: t for p, t in before.items() if p.suffix == ".h5"
    }


def test_inloc(inloc_layout, masks, tmp_path, monkeypatch):
    """By one mask for all photos of its size."""
    mask = masks("bumper") / "bumper.png"
    arguments = ("--dataset", inloc_layout, "--outputs", tmp_path / "out", "--masks", mask)
    run_pipeline(monkeypatch, inloc, *arguments)
    (features,) = (tmp_path / "out").glob("feats-dog*_sv64.h5")
    names = "query/iphone7/a.JPG", "database/cutouts/PLA1/000/PLA_cutout_000_0_0.jpg"
    assert lowest(features, *names) < BUMPER


def test_queries_in_other_views(place, masks, tmp_path, run):
    """A mask is turned with its photo, and mirrored with it."""
    build, images, outputs = place
    queries = tmp_path / "turned"
    queries.mkdir()
    photo = cv2.imread(str(images / "query/day/a.png"))
    cv2.imwrite(str(queries / "a.png"), np.rot90(photo))
    given = masks("a.png")
    upright = cv2.imread(str(given / "a.png.png"))
    cv2.imwrite(str(given / "a.png.png"), np.rot90(upright))
    listed = write(tmp_path / "turned.txt", f"a.png SIMPLE_PINHOLE 270 360 {FOCAL} 135 180\n")
    new = "--query_images", queries, "--queries", listed, "--masks", given
    run(*build, "--feature", "mini32", *new)
    folder = outputs / "queries-turned"
    row = outcome(folder)[1]["a.png"]
    assert row["status"] == "localized" and row["turned"] == "270"
    with h5py.File(folder / "feats-mini32-turned270.h5") as file:
        keypoints = file["a.png/keypoints"][()]
    assert len(keypoints) > 100 and keypoints[:, 0].max() < BUMPER
    camera = parse_query_list(listed)[0][1]
    _, info = Localizer(outputs / "map").localize(queries / "a.png", camera, given / "a.png.png")
    assert info["turned"] == 270 and info["num_inliers"] == int(row["num_inliers"])
