"""What the benchmarks of the documentation say to those who lack a run, or hloc."""

import json
import runpy
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hloc_reduce.maps.numpy_engine import NumpyEngine
from hloc_reduce.training import levels
from hloc_reduce.utils.cli import InputError

ROOT = Path(__file__).parents[1]
SUMMARY = {
    "feature": "sift",
    "bytes_per_keypoint": {"descriptor": 256, "keypoints": 6000, "images": 6},
    "map_images": 3,
    "queries": 3,
    "map_points3D": 3871,
    "seconds": {"extract_features": 3.0, "match_features": 1.1},
    "lists": {"night_time": {"localized": 2, "queries": 3, "mean_inliers": 51.6}},
}


def table(*paths):
    command = [sys.executable, ROOT / "benchmarks/summaries.py", *paths]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=60)


def test_what_is_no_finished_run_is_left_out(tmp_path):
    run, report = tmp_path / "sift", tmp_path / "report.html"
    run.mkdir()
    (run / "summary.json").write_text(json.dumps(SUMMARY))
    report.write_text("<html>")
    shown = table(run, report)
    assert shown.returncode == 0 and f"Left out, no finished runs: {report}." in shown.stderr
    assert shown.stdout.splitlines()[2:] == [
        "| sift | 256 | night | 2 of 3 |  |  | 52 | 1,000 | 3,871 | 0.50 | 4 |"
    ]
    old = {**SUMMARY, "bytes_per_keypoint": {"descriptor": 256, "keypoints": 6000}}
    (run / "summary.json").write_text(json.dumps(old))
    assert "| 52 |  | 3,871 |" in table(run).stdout
    alone = table(report)
    assert alone.returncode == 2 and f"no summary.json in {report}" in alone.stderr


def test_recall_in_centimetres_counts_localized_queries_only(tmp_path):
    rows = [
        ("a.jpg", "night_time", "localized", 0.004, 0.1),
        ("b.jpg", "night_time", "localized", 0.03, 0.1),
        ("c.jpg", "night_time", "localized", 0.001, 2.5),  # turned too far
        ("d.jpg", "night_time", "fallback", 0.001, 0.1),
        ("e.jpg", "day_time", "failed", "", ""),
    ]
    header = ("query", "list", "status", "position_error_m", "rotation_error_deg")
    lines = [",".join(map(str, row)) for row in (header, *rows)]
    (tmp_path / "queries.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "summary.json").write_text(json.dumps(SUMMARY))
    shown = table(tmp_path, "--centimetres", "1", "5")
    assert "| 25.0 / 50.0 |" in shown.stdout.splitlines()[2]


def test_all_places_together(tmp_path):
    errors = {"town": (0.004, 0.03), "mill": (0.2, 0.004)}
    more = {"bytes_per_keypoint": {"descriptor": 256, "keypoints": 1000, "images": 4}}
    for place, summary in (("town", SUMMARY), ("mill", {**SUMMARY, **more, "map_points3D": 129})):
        folder = tmp_path / place / "sift"
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text(json.dumps(summary | {"dataset": place}))
        lines = [f"{i},night_time,localized,{error},0.1" for i, error in enumerate(errors[place])]
        header = "query,list,status,position_error_m,rotation_error_deg"
        (folder / "queries.csv").write_text("\n".join([header, *lines]))
    shown = table(*tmp_path.glob("*/*"), "--places", "--centimetres", "1", "5").stdout.splitlines()
    assert shown[0].endswith("| keypoints | points | localized | recall [%] |")
    # 7,000 keypoints of 10 photos; two of four queries are within a centimetre, three within five
    assert shown[2].endswith("| 700 | 4,000 | 4 of 6 | 50.0 / 75.0 |")
    old = {**SUMMARY, "bytes_per_keypoint": {"descriptor": 256, "keypoints": 6000}}
    (tmp_path / "town/sift/summary.json").write_text(json.dumps(old | {"dataset": "town"}))
    shown = table(*tmp_path.glob("*/*"), "--places", "--centimetres", "1", "5").stdout.splitlines()
    assert shown[2].endswith("|  | 4,000 | 4 of 6 | 50.0 / 75.0 |")


def test_places_are_columns(tmp_path):
    for place, feature in (("town", "sift"), ("mill", "sift"), ("town", "sift+uint8")):
        (tmp_path / place / feature).mkdir(parents=True)
        summary = SUMMARY | {"dataset": f"datasets/{place}"}
        (tmp_path / place / feature / "summary.json").write_text(json.dumps(summary))
    shown = table(*sorted(tmp_path.glob("*/*")), "--places").stdout.splitlines()
    assert shown[0] == "| bytes | feature | mill, night | town, night |"
    assert shown[2:] == [
        "| 256 | sift | 52 (2 of 3) | 52 (2 of 3) |",
        "| 256 | sift+uint8 |  | 52 (2 of 3) |",
    ]


def test_without_hloc_the_comparison_says_what_to_install(monkeypatch):
    monkeypatch.setattr("hloc_reduce.utils.hloc.is_installed", lambda: False)
    stages_of = runpy.run_path(str(ROOT / "benchmarks/against_hloc.py"))["stages_of"]
    with pytest.raises(InputError, match="hloc is not installed: pip install"):
        stages_of("hloc")


def test_recall_of_neighbours():
    """Image 0 shares two points with image 1 and one with image 2; image 3 is alone."""
    benchmark = runpy.run_path(str(ROOT / "benchmarks/retrieval.py"))
    shown = [np.array(points) for points in ([7, 8, 9, 20], [7, 8], [9], [5])]
    common = benchmark["common_points"](shown)
    expected = [[0, 2, 1, 0], [2, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]]
    np.testing.assert_array_equal(common, expected)
    recall = benchmark["recall"]
    assert recall(common, common, 1) == recall(common, common, 2) == 1
    alike = common.copy()
    alike[0] = [9, 0, 1, 2]  # retrieves 3, then 2
    assert recall(alike, common, 1) == pytest.approx(2 / 3)
    assert recall(alike, common, 2) == pytest.approx((1 / 2 + 1 + 1) / 3)


def test_matching_at_once_gives_each_keypoint_one_point():
    """Which each image has that shows it."""
    at_once = runpy.run_path(str(ROOT / "benchmarks/compact_matching.py"))["at_once"]
    points = np.eye(4, 8, dtype=np.float32)
    visible = {"a": np.array([0, 2]), "b": np.array([1, 2, 3]), "c": np.array([], int)}
    compact = SimpleNamespace(visible=visible.get, descriptors=lambda rows, unbiased: points[rows])
    extract = SimpleNamespace(rotation_invariant=True)
    engine = NumpyEngine(extract, {"name": "nearest_neighbor"}, points)
    query = points[[2, 3, 0]]
    found = at_once(SimpleNamespace(engine=engine, reference=compact))(query, ["a", "b", "c"])
    pairs = {name: sorted(map(tuple, part.tolist())) for name, part in found.items()}
    assert pairs == {"a": [(0, 1), (2, 0)], "b": [(0, 1), (1, 2)], "c": []}


@pytest.fixture
def repeatability(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return runpy.run_path(str(ROOT / "benchmarks/repeatability.py"))


def test_changes_of_photos_say_where_pixels_go(repeatability):
    """A spot is found where the matrix puts it."""
    y, x = np.mgrid[:300, :400]
    for place in ((120.0, 90.0), (300.0, 200.0)):
        spot = 250 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 200)
        photo = np.repeat(spot.round().astype(np.uint8)[..., None], 3, axis=2)
        for name, change in repeatability["CHANGES"].items():
            changed, matrix = change(photo, np.random.default_rng(0))
            weight = np.maximum(changed.mean(axis=2) - 0.3 * changed.max(), 0)
            rows, columns = np.indices(weight.shape)
            found = [(weight * axis).sum() / weight.sum() for axis in (columns, rows)]
            np.testing.assert_allclose(found, matrix @ [*place, 1], atol=0.3, err_msg=name)


def test_repeated_keypoints_and_right_matches(repeatability):
    keypoints = np.array([[50, 50], [100, 50], [50, 100], [100, 100], [2, 2]], np.float32)
    descriptors = np.eye(5, dtype=np.float32)
    one = {"keypoints": keypoints, "descriptors": descriptors, "scores": np.arange(5.0)}
    moved = keypoints + np.array([[0.5, 0], [2, 0], [0, 9], [0, 0], [0, 0]], np.float32)
    other = {"keypoints": moved, "descriptors": descriptors[:, [0, 1, 3, 2, 4]]}
    photos = (np.zeros((200, 200, 3)),) * 2
    found = repeatability["compare"](one, other, photos, np.eye(2, 3))
    assert found.number == found.expected == 4  # the last one is near the sides
    assert sorted(found.errors.tolist()) == [0, 0.5, 2]  # the third one moved too far
    assert (found.right, found.matched) == (2, 4)
    assert found.again.tolist() == [True, True, False, True]
    assert repeatability["describe"]([found])[1:3] == ["50.0", "0.50"]
    assert repeatability["rank"]([found]) == ["0.333", "0.333"]
    nowhere = {key: value[..., :0] for key, value in other.items()}
    nowhere["keypoints"] = keypoints[:0]
    assert repeatability["compare"](one, nowhere, photos, np.eye(2, 3)).expected == 0


@pytest.fixture
def quantizers(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return runpy.run_path(str(ROOT / "benchmarks/quantizers.py"))


@pytest.mark.parametrize(
    ("name", "size"), [("pq", 8), ("opq", 8), ("rq", 6), ("itq", 8), ("tcq", 8)]
)
def test_quantizers_lose_less_with_more_bytes(name, size, quantizers):
    """What a code of more bytes stands for is nearer to what it codes than its signs are."""
    pytest.importorskip("faiss")
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=(1500, 32)).astype(np.float32)
    numbers /= np.linalg.norm(numbers, axis=1, keepdims=True)
    fitted, others = numbers[:1200], torch.from_numpy(numbers[1200:])
    code, signs = (
        quantizers["QUANTIZERS"][kind](fitted, number)
        for kind, number in ((name, size), ("signs", 4))
    )
    assert quantizers["fits"](name, 32, size) and quantizers["fits"]("signs", 32, 4)
    coded, cosine = code(others), torch.nn.functional.cosine_similarity
    assert coded.shape == others.shape
    assert cosine(coded, others).mean() > cosine(signs(others), others).mean() > 0.75


@pytest.mark.parametrize(("bits", "dim"), [(1, 8), (2, 5), (4, 2)])
def test_a_trellis_finds_the_best_code(bits, dim, quantizers):
    """Of all codes, tried one by one, with 16 levels of a number."""
    generator = torch.Generator().manual_seed(0)
    numbers, table = (torch.randn(size, generator=generator) for size in ((50, dim), (dim, 16)))
    windows = torch.cartesian_prod(*[torch.arange(2**bits)] * dim)
    for i in range(1, dim):
        windows[:, i] |= windows[:, i - 1] << bits & 15
    errors = torch.cdist(numbers, table.gather(1, windows.T).T)
    found = quantizers["_path"](numbers, table, bits)
    assert torch.equal(found, windows[errors.argmin(1)])


def test_a_fitted_trellis_loses_less_than_levels(quantizers):
    generator = torch.Generator().manual_seed(0)
    numbers = torch.nn.functional.normalize(torch.randn(6000, 16, generator=generator))
    fitted, others = numbers[:5000], numbers[5000:]
    table = levels.fit(fitted, 2).numpy()
    coded = quantizers["stored"](others, "uint2", table)
    code = quantizers["trellis"](fitted.numpy(), 4)
    cosine = torch.nn.functional.cosine_similarity
    assert cosine(code(others), others).mean() > cosine(coded, others).mean()


@pytest.mark.parametrize("script", ["rate.py", "quantizers.py"])
def test_a_missing_folder_is_said_before_the_table(script, tmp_path):
    """And with the option that names it."""
    for folder in ("images", "sparse"):
        (tmp_path / folder).mkdir()
    there = f"{tmp_path}/images:{tmp_path}/sparse"
    command = [sys.executable, ROOT / "benchmarks" / script, "--map", there, "--fit", "x:y"]
    said = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120)
    assert said.returncode == 2 and "--fit x:y: there is no folder" in said.stderr
    assert not said.stdout
