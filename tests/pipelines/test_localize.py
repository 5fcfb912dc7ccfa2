"""Which results of queries are kept, and wrong input."""

import shutil

import pytest
from command import outcome, state

from pipelines import localize

PIPELINE = localize


def test_results_of_another_map_are_kept(place, build_map, tmp_path, run, refused):
    build, images, outputs = place
    build_map()
    new = ("--query_images", images / "query/day")
    run(*build, *new)
    results = state(outputs / "queries-day")
    other = tmp_path / "other"
    run(*build[:4], "--outputs", other)
    message = refused("--map", other / "map", *new, "--outputs", outputs)
    assert "differs: map" in message
    assert state(outputs / "queries-day") == results


def test_another_num_loc_needs_no_other_map(place, build_map, run, refused):
    """The message offered --overwrite, with which --map_images builds the whole map again."""
    build, images, outputs = place
    new = ("--query_images", images / "query/day")
    build_map()
    run(*build, *new)
    message = refused(*build, *new, "--num_loc", 2)
    assert "differs: num_loc (50 before, 2 now)" in message
    assert f"--map {outputs / 'map'} --overwrite" in message
    written = (outputs / "map/map.json").stat().st_mtime_ns
    run("--map", outputs / "map", *new, "--outputs", outputs, "--num_loc", 2, "--overwrite")
    assert (outputs / "queries-day/pairs-query-vlad2.txt").exists()
    assert (outputs / "map/map.json").stat().st_mtime_ns == written


def test_queries_of_the_same_name_have_folders_of_their_own(place, build_map, tmp_path, run):
    build, images, outputs = place
    build_map()
    run(*build, "--query_images", images / "query/day")
    results = state(outputs / "queries-day")
    other = shutil.move(images / "query/night", tmp_path / "day")
    for _ in range(2):
        run(*build, "--query_images", other)
        assert state(outputs / "queries-day") == results
        (found,) = outputs.glob("queries-day-*")
        assert list(outcome(found)[1]) == ["a.png"]
    # a list of that name is another one, too; the first keeps its folder
    listed = tmp_path / "day.txt"
    listed.write_text("a.png SIMPLE_PINHOLE 360 270 375 180 135\n")
    run(*build, "--query_images", images / "query/day", "--queries", listed)
    assert len(list(outputs.glob("queries-day-*"))) == 2
    run(*build, "--query_images", images / "query/day")
    assert state(outputs / "queries-day") == results


def test_queries_that_have_changed_are_localized_anew(place, build_map, run):
    build, images, outputs = place
    build_map()
    run(*build, "--query_images", images / "query/day")
    assert outcome(outputs / "queries-day")[1]["grey.png"]["status"] == "fallback"
    shutil.copy(images / "query/day/a.png", images / "query/day/grey.png")
    shutil.copy(images / "query/day/a.png", images / "query/day/new.png")
    run(*build, "--query_images", images / "query/day")
    rows = outcome(outputs / "queries-day")[1]
    assert [row["status"] for row in rows.values()] == ["localized"] * 3
    assert len({row["num_inliers"] for row in rows.values()}) == 1


@pytest.mark.parametrize("kind", ["text", "dangling link"])
def test_a_folder_with_a_broken_photo_only(kind, place, tmp_path, run, refused, caplog, capsys):
    build, images, outputs = place
    photo = tmp_path / "new/a.png"
    photo.parent.mkdir()
    if kind == "text":
        photo.write_text("no image")
    else:
        photo.symlink_to(tmp_path / "gone.png")
    given = (*build, "--query_images", photo.parent, "--feature", "sift_sv16")
    assert f"Cannot read image {photo}" in refused(*given, "--strict")
    run(*given)
    assert "Localized 0 of 1 queries (1 unreadable) in" in caplog.text
    results = outputs / "queries-new"
    printed = capsys.readouterr().out
    assert printed == f"No query is localized. {results / 'queries.csv'} gives the reasons.\n"
    assert f"Cannot read image {photo}" in outcome(results)[1]["a.png"]["reason"]
    for number in (1, 2):
        shutil.copy(images / f"db/{number}.png", photo.parent)
    message = refused("--map_images", photo.parent, "--outputs", tmp_path / "o")
    assert "a.png" in message and str(photo.parent) in message


def test_wrong_input(place, build_map, tmp_path, refused):
    build, images, outputs = place
    assert "Give --map_images" in refused("--outputs", outputs)
    assert "--query_images, too" in refused(*build, "--queries", "list.txt")
    assert "is not a COLMAP model" in refused("--map", images, *build[2:])
    assert "is not a map" in refused("--map", images, "--outputs", outputs)
    message = refused(*build[:2], "--outputs", outputs)
    assert "is a COLMAP model: give its photos" in message
    message = refused("--map_images", tmp_path / "nowhere", *build[4:])
    assert "no folder" in message and "nowhere" in message
    message = refused("--map_images", images / "db/1.png", *build[4:])
    assert "1.png is neither a folder of photos nor a video" in message
    one = tmp_path / "few"
    one.mkdir()
    for number in (1, 2):
        shutil.copy(images / f"db/{number}.png", one)
        message = refused("--map_images", one, *build[4:])
        given = "1 image is given" if number == 1 else f"{number} images are given"
        assert f"needs 3 or more, from different places: {given} of {one}." in message
        assert not (outputs / "map").exists()
    assert "Unknown matcher" in refused(*build, "--matcher", "NN")
    photos = tmp_path / "photos"
    photos.mkdir()
    for name in ("IMG\t1.png", "#2.png"):
        shutil.copy(images / "db/1.png", photos / name)
        message = refused("--map_images", photos, *build[4:])
        assert repr(name) in message and "Rename" in message
        (photos / name).unlink()
    assert "Give --outputs" in refused(*build[:4])
    photo = images / "db/1.png"
    message = f"{photo} is a file: choose a folder for the results."
    assert refused(*build[:4], "--outputs", photo) == message
    assert "--num_covis 0" in refused(*build, "--num_covis", 0)
    assert not (outputs / "map").exists()
    build_map()
    for name in ("x/1.png", "x-1.png"):
        (tmp_path / "new/x").mkdir(parents=True, exist_ok=True)
        shutil.copy(photo, tmp_path / "new" / name)
    message = refused(*build, "--query_images", tmp_path / "new")
    assert "x/1.png and x-1.png have the same name in match files" in message
    queries = tmp_path / "list.txt"
    queries.write_text("query/day/gone.png PINHOLE 360 270 375 375 180 135\n")
    new = ("--queries", queries, "--query_images", images)
    assert "query/day/gone.png" in refused(*build, *new)
    assert not (outputs / "queries-list").exists()
