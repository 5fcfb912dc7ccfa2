"""The report, read as text and opened in a real browser."""

import json
import re
import shutil
from functools import partial

import command
import h5py
import pytest
from conftest import PLANE

from hloc_reduce.evaluation import published
from hloc_reduce.report import __main__ as report
from hloc_reduce.report import pictures, runs
from hloc_reduce.utils.h5 import iterate_h5_names
from pipelines import aachen, compare, inloc, localize

pytestmark = pytest.mark.check

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


@pytest.fixture
def compared(aachen_layout, tmp_path, written_once, monkeypatch):
    """Two runs in the plane: of three queries, one is grey and cannot be localized."""
    folders = [tmp_path / feature for feature in ("colmap_sift", "colmap_sift_sv32")]
    for folder in folders:
        given = ("--dataset", aachen_layout, "--outputs", folder, "--feature", folder.name)
        write = partial(command.run, monkeypatch, aachen, *given)
        written_once(folder, write, "compared", folder.name)
    return folders


@pytest.fixture
def show(tmp_path, monkeypatch):
    """Write a report; return its text."""

    def show(*arguments):
        command.run(monkeypatch, report, *arguments, "-o", tmp_path / "r.html")
        return (tmp_path / "r.html").read_text()

    return show


def text_of(page):
    """The text of each cell of a page's tables, row by row."""
    rows = re.findall(r"<tr[^>]*>(.*?)</tr>", page, re.S)
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row, re.S) for row in rows]
    return [[re.sub(r"<[^>]*>", "", cell).strip() for cell in row] for row in cells]


def test_numbers_are_those_of_the_runs(compared, show):
    page = show(*compared)
    rows = text_of(page)
    for folder in compared:
        summary, queries = command.outcome(folder)
        size = summary["bytes_per_keypoint"]["descriptor"]
        (row,) = [row for row in rows if row[:1] == [folder.name] and row[1] == "dataset"]
        assert row[2:4] == ["2 of 3", str(size)]
        recall = [row for row in rows if row[:1] == [folder.name] and len(row) == 7]
        for row, result in zip(recall, summary["lists"].values(), strict=True):
            assert row[1:4] == [f"{value:.1f}" for value in result["recall_percent"]]
            assert row[5:] == [
                f"{result['localized']} of {result['queries']}",
                f"{result['mean_inliers']:.1f}",
            ]
            assert row[4].startswith(f"{result['median_position_error_m']:.3f} m")
        for name, query in queries.items():
            (row,) = [row for row in rows if row[:2] == [name, folder.name]]
            assert row[2:5] == [query[k] for k in ("status", "num_inliers", "num_correspondences")]
            assert float(row[5]) == pytest.approx(float(query["position_error_m"]), abs=1e-4)
    assert page.count("data:image/jpeg;base64,") == 2 * 3
    assert "http:" not in page.replace("http://www.w3.org", "") and "https:" not in page
    assert show(*compared) == page


def test_inliers_of_pictures(compared):
    """What one map image sees of a query agrees with what PnP found."""
    run = runs.Run(compared[0])
    found = pictures.matched(run, "query/day/a.png")
    assert 0.7 < found["inliers"].mean() <= 1
    assert found["inliers"].sum() <= run.rows["query/day/a.png"]["num_inliers"]
    picture = pictures.draw(run, "query/day/a.png", found)
    assert tuple(picture[0, 0]) == pictures.GREEN
    # of those retrieved it is the one with most inliers, wherever it is in the list
    names, record = run.retrieved["query/day/a.png"], run.records["query/day/a.png"]
    numbers = {}
    for record["db"] in names:
        run.retrieved["query/day/a.png"] = [record["db"]]
        numbers[record["db"]] = pictures.matched(run, "query/day/a.png")["inliers"].sum()
    run.retrieved["query/day/a.png"] = sorted(names, key=numbers.get)
    assert pictures.matched(run, "query/day/a.png")["name"] == found["name"]
    assert numbers[found["name"]] == max(numbers.values()) > min(numbers.values())
    del run.retrieved["query/day/a.png"]  # by a run that goes on
    assert pictures.matched(run, "query/day/a.png")["name"] == record["db"]
    found = pictures.matched(run, "query/day/grey.png")
    assert len(found["inliers"]) == 0
    assert tuple(pictures.draw(run, "query/day/grey.png", found)[0, 0]) == pictures.RED


def test_queries_are_ranked_from_worst_to_best(compared):
    ranked = runs.ranked(runs.load(compared))
    assert ranked[0] == "query/day/grey.png" and len(ranked) == 3
    assert runs.spread(list("abcdefg"), 3) == ["a", "d", "g"]
    assert runs.spread(["a"], 3) == ["a"]


def test_runs_of_scans_and_of_a_map_of_ones_own(
    inloc_layout, aachen_layout, tmp_path, monkeypatch, show, caplog
):
    given = ("--outputs", tmp_path / "i", "--feature", "colmap_sift_sv32")
    command.run(monkeypatch, inloc, "--dataset", inloc_layout, *given)
    model = aachen_layout / "3D-models/aachen_v_1_1"
    photos = aachen_layout / "images_upright"
    given = ("--outputs", tmp_path / "l", "--feature", "colmap_sift_sv32")
    given += ("--map", model, "--map_images", photos, "--query_images", photos / "query/day")
    command.run(monkeypatch, localize, *given)
    folders = [tmp_path / "i", tmp_path / "l/queries-day"]
    page = show(*folders, "--num_queries", 9)
    # one feature, twice
    assert "colmap_sift_sv32 (i)" in page and "colmap_sift_sv32 (queries-day)" in page
    by_run = runs.load(folders)
    scenes = json.loads(re.search(r'type="application/json">(.*?)</script>', page, re.S)[1])
    # of scans one for each floor, with the scans in place of cameras
    assert len(scenes) == 3
    for label, scene in scenes.items():
        assert len(scene["points"]) > 1000 and len(scene["map"]) > 0
        assert len(scene["map"][0]) == 12 and label.startswith(by_run[0].summary["feature"])
    (good,) = [name for name in by_run[0].rows if name.endswith("a.JPG")]
    assert show(folders[0], "--queries", good).count("data:image/jpeg;base64,") == 1

    # without maps, or the keypoints that one is of
    (points,) = (tmp_path / "i").glob("*-points3D.h5")
    (sfm,) = (tmp_path / "l/map").glob("sfm*")
    sfm.rename(tmp_path / "l/away")
    points.rename(tmp_path / "i/away")
    show(*folders, "--num_queries", 1)
    for path in (points, sfm):
        said = rf"in the report: Cannot open \S*{path.parent.name}/{path.name}: it does not exist"
        assert re.search(said, caplog.text)
    (tmp_path / "i/away").rename(points)
    features = next((tmp_path / "i").glob("feats-*_sv32.h5"))
    with h5py.File(shutil.copy(features, tmp_path / "other.h5"), "r+") as file:
        for name in iterate_h5_names(file["database"].id, "database/"):
            file[name]["keypoints"][0] += 1
    (tmp_path / "other.h5").replace(features)
    show(folders[0], "--num_queries", 1)
    assert f"{points} has no points of the present keypoints of database/cutouts/" in caplog.text


def test_nothing_in_a_name_is_taken_for_html(compared, tmp_path, show):
    odd = tmp_path / "<script>alert(1)</script>".replace("/", "_")
    shutil.copytree(compared[0], odd)
    page = show(compared[0], odd, "--num_queries", 1)
    assert "<script>alert" not in page and "&lt;script&gt;alert" in page


def test_runs_of_one_feature_are_told_apart(compared, tmp_path, show):
    other = tmp_path / "other" / compared[0].name
    shutil.copytree(compared[0], other)
    file = other / "summary.json"
    summary = json.loads(file.read_text())
    day = summary["lists"]["day_time_queries_with_intrinsics"]
    day["recall_percent"] = [11, 22, 33]
    file.write_text(json.dumps(summary))
    found = runs.load([compared[0], other, compared[0]])
    labels = [run.label for run in found]
    assert labels == [
        f"colmap_sift ({folder.parent.name}/colmap_sift)" for folder in (compared[0], other)
    ]
    rows = text_of(show(compared[0], other, "--num_queries", 1))
    for label, recall in zip(labels, (["50.0"] * 3, ["11.0", "22.0", "33.0"]), strict=True):
        assert recall in [row[1:4] for row in rows if row[0] == label and len(row) == 7]


def test_without_true_poses_columns_stay_in_place(
    compared, tmp_path, monkeypatch, aachen_layout, show
):
    monkeypatch.setattr(published, "DATASETS", PLANE)
    (aachen_layout / "queries/ground_truth_poses.txt").rename(tmp_path / "truth.txt")
    unknown = tmp_path / "sift_sv16"
    given = ("--dataset", aachen_layout, "--outputs", unknown, "--feature", "sift_sv16")
    command.run(monkeypatch, aachen, *given)
    for folders in ([unknown], [unknown, compared[0]], [compared[0], unknown]):
        rows = [row for row in text_of(show(*folders, "--num_queries", 1)) if len(row) == 7]
        assert ["", "0.25 m, 2°", "0.5 m, 5°", "5 m, 10°"] in [row[:4] for row in rows]
        (row, _) = [row for row in rows if row[0] == "sift_sv16"]
        assert row[:6] == ["sift_sv16", "", "", "", "", "1 of 2"]
        assert ["in the paper", "85.9", "91.5", "96.2", "", "", ""] in rows
    # of another place nothing is known
    monkeypatch.setattr(published, "DATASETS", {})
    page = show(unknown, "--num_queries", 1)
    assert ["sift_sv16", "", "1 of 2"] in [row[:3] for row in text_of(page) if len(row) == 4]
    assert "the paper" not in page
    # a comparison keeps what a folder was made with
    for truth in (["--ground_truth", tmp_path / "truth.txt"], []):
        outputs = ("--outputs", tmp_path, "-o", tmp_path / "r.html")
        given = ("--dataset", aachen_layout, "--features", "sift_sv16", *outputs, *truth)
        command.run(monkeypatch, compare, *given)
        day = command.outcome(unknown)[0]["lists"]["day_time_queries_with_intrinsics"]
        assert day["recall_percent"] == [50, 50, 50]


def test_without_photos_there_is_a_report_all_the_same(
    compared, tmp_path, show, caplog, aachen_layout
):
    (aachen_layout / "images_upright").rename(tmp_path / "moved")
    page = show(*compared)
    assert page.count("There is no picture: Cannot read image") == 6
    assert "There is no picture of query/day/a.png" in caplog.text
    assert len(json.loads(re.search(r'application/json">(.*?)</script>', page, re.S)[1])) == 2


def test_pictures_as_files(compared, tmp_path, show):
    folder = tmp_path / "pictures"
    show(*compared, "--pictures_dir", folder, "--queries", "query/day/a.png")
    errors = {f"{e}_{time}.svg" for e in ("position", "rotation") for time in ("day", "night")}
    sizes = {
        f"{what}_{by}.svg" for what in ("mean_inliers", "recall") for by in ("bytes", "seconds")
    }
    photos = {f"query_day_a.png_{run.name}.jpg" for run in compared}
    assert {path.name for path in folder.iterdir()} == errors | sizes | photos
    assert ">bytes a descriptor</text>" in (folder / "recall_bytes.svg").read_text()


@pytest.fixture
def batch(compared, tmp_path):
    """Runs in the layout of a batch, with what is beside them; two are not finished."""
    outputs = tmp_path / "batch"
    for run, place in zip(compared, ("town", "park"), strict=True):
        shutil.copytree(run, outputs / place / run.name)
        for name in ("shared", "begun"):
            (outputs / place / name).mkdir()
            (outputs / place / name / "conf.json").write_text("{}")
    (outputs / "jobs.csv").touch()
    # not of runs: a map, and a folder of other files
    (outputs / "park/map").mkdir()
    for name in ("conf.json", "map.json"):
        (outputs / "park/map" / name).write_text("{}")
    (outputs / "park/other").mkdir()
    shutil.copytree(compared[0], outputs / "too/far/below")
    return outputs


def test_the_finished_runs_of_a_batch(batch, show, caplog):
    page = show(batch, "--num_queries", 1)
    said = f"Skipping 2 unfinished runs in {batch}: park/begun, town/begun."
    assert said in [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    found = [run.folder.relative_to(batch).as_posix() for run in runs.load([batch])]
    assert found == ["park/colmap_sift_sv32", "town/colmap_sift"]
    assert all(name.rpartition("/")[2] in page for name in found)

    # as a shell expands town/*
    shutil.rmtree(batch / "town/begun")
    assert [run.folder for run in runs.load(sorted((batch / "town").iterdir()))] == [
        batch / "town/colmap_sift"
    ]

    # of one data set; a run that is also named is shown once
    town = batch / "town"
    page = show(town, town / "colmap_sift", "--num_queries", 1)
    assert "given twice" in caplog.text
    assert "sv32" not in re.sub("<script.*?</script>", "", page, flags=re.S)


def test_a_batch_without_finished_runs_is_refused(batch, tmp_path, monkeypatch, caplog):
    for file in batch.glob("*/*/summary.json"):
        file.unlink()
    said = command.refused(monkeypatch, caplog, report, batch, "-o", tmp_path / "r.html")
    runs_of = "park/begun, park/colmap_sift_sv32, town/begun, town/colmap_sift"
    assert f"{batch} is not the outputs folder of a pipeline or a batch, or its runs" in said
    assert f"are not finished ({runs_of})" in said and "run the pipeline again" in said
    # named by itself it is not skipped
    for name in ("begun", "shared"):
        said = command.refused(monkeypatch, caplog, report, batch / "town" / name)
        assert "no summary.json" in said


def test_wrong_input(compared, tmp_path, monkeypatch, caplog):
    def message(*arguments):
        return command.refused(monkeypatch, caplog, report, "-o", tmp_path / "r.html", *arguments)

    assert "There is no folder" in message(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "or it has no runs" in message(tmp_path / "empty")
    assert "Unknown query 'b.png'" in message(compared[0], "--queries", "b.png")
    assert "is a folder" in message(compared[0], "-o", tmp_path)
    assert "--num_queries 0: at least 1" in message(compared[0], "--num_queries", "0")
    file = compared[1] / "summary.json"
    summary = json.loads(file.read_text())
    del summary["files"]
    for broken, why in (("{", "broken"), ("[]", "no 'files'"), (json.dumps(summary), "no 'files'")):
        file.write_text(broken)
        said = message(*compared)
        assert why in said and "run its pipeline again" in said
    logs = next(compared[0].glob("*_logs.jsonl"))
    lines = logs.read_text().splitlines()
    logs.write_text("\n".join(lines[:-1]))  # a run that goes on, or was killed
    assert "did not finish" in message(compared[0])
    logs.write_text("\n".join(lines)[:-20])
    assert "run the localization again" in message(compared[0])
    assert not (tmp_path / "r.html").exists()
    monkeypatch.setattr("hloc_reduce.report.find_spec", lambda name: None)
    assert "pip install" in message(compared[0])


@pytest.fixture
def browser():
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium (Debian: apt-get install chromium)")
    with sync_api.sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])


@pytest.mark.parametrize("width", [1200, 390])
def test_in_a_browser(compared, tmp_path, show, browser, width):
    show(*compared)
    output = tmp_path / "r.html"
    page = browser.new_page(viewport={"width": width, "height": 800})
    errors, requests = [], []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda said: said.type == "error" and errors.append(said.text))
    page.on("request", lambda request: requests.append(request.url))
    page.goto(output.as_uri())

    # nothing is wider than the screen, and all pictures are there
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.evaluate("document.querySelectorAll('img').forEach(i => i.loading = 'eager')")
    page.wait_for_function("[...document.images].every(i => i.complete && i.naturalWidth > 300)")
    assert page.locator("img").count() == 6 and page.locator(".charts svg").count() == 8

    # a click on the head sorts, another one the other way round
    def column(number):
        cells = page.locator(f"#table tbody tr:not([hidden]) td:nth-child({number})")
        return cells.all_inner_texts()

    head = page.get_by_role("button", name="inliers", exact=True)
    head.click()
    up = [int(text) for text in column(4)]
    head.click()
    down = [int(text) for text in column(4)]
    assert len(up) == 6 and up == sorted(up) and down == sorted(up, reverse=True)
    page.select_option("#only", "colmap_sift")
    page.fill("#name", "GREY")
    assert column(1) == ["query/day/grey.png"] and page.inner_text("#count") == "1 of 6"
    page.fill("#name", "")

    # the map is drawn, and turns with the mouse
    view = page.locator("#view")
    view.scroll_into_view_if_needed()
    page.wait_for_function("document.getElementById('view').dataset.azimuth !== undefined")
    before, azimuth = view.screenshot(), view.get_attribute("data-azimuth")
    box = view.bounding_box()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] / 2 + 80, box["y"] + box["height"] / 2 + 30, steps=4)
    page.mouse.up()
    page.wait_for_function(f"document.getElementById('view').dataset.azimuth !== '{azimuth}'")
    turned = view.screenshot()
    assert turned != before
    colours = page.evaluate(
        "(c => new Set(new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height)"
        ".data.buffer)).size)(document.getElementById('view'))"
    )
    assert colours > 20
    page.mouse.wheel(0, -300)
    page.wait_for_timeout(200)
    assert view.screenshot() != turned
    page.click("#reset")
    page.wait_for_timeout(200)
    reset = view.screenshot()
    page.locator("#table tbody tr:not([hidden])", has_text="query/day/a.png").click()
    page.wait_for_timeout(200)
    assert page.locator("#table tr.chosen").count() == 2 and view.screenshot() != reset
    page.select_option("#scene", "colmap_sift_sv32")

    assert errors == []
    assert all(url == output.as_uri() or url.startswith("data:") for url in requests)
