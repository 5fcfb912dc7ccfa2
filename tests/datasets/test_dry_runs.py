"""Places with the names of real ones: the documented commands localize in them."""

import shutil
from pathlib import Path

import pytest
from command import outcome

from benchmarks import dry_runs
from hloc_reduce import pairs_from_covisibility
from hloc_reduce.datasets.aachen_v1 import AachenV1
from hloc_reduce.datasets.cambridge import Cambridge
from hloc_reduce.datasets.cambridge_nvm import CambridgeNvm
from hloc_reduce.datasets.layouts import open_model_place
from hloc_reduce.datasets.sevenscenes import SevenScenes
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_pairs
from pipelines import aachen
from pipelines.common.retrieval import check_retrieval

PIPELINE = aachen
LAYOUTS = {"aachen": AachenV1, "cambridge": Cambridge, "7scenes": SevenScenes}
QUICK = ("--feature", "colmap_sift_sv32", "--num_covis", 4, "--num_loc", 5)


def dense_vlad(root: Path) -> Path:
    return root.parent / f"7scenes_densevlad_retrieval_top_10/{root.name}_top10.txt"


def options(root: Path) -> tuple:
    """Return what the documented command says of a place."""
    if root.name == "aachen":  # whose true poses are not public
        return "--ground_truth", root / "ground_truth_poses.txt"
    return ("--retrieval", dense_vlad(root)) if dense_vlad(root).is_file() else ()


def localize(run, root: Path, outputs: Path) -> None:
    """Run the documented command. All queries are where they are, also those of the same names."""
    run("--dataset", root, "--outputs", outputs, *QUICK, *options(root))
    place, (summary, rows) = open_model_place(root), outcome(outputs)
    assert summary["map_images"] == len(place.map_names())
    assert list(rows) == place.query_names()
    lists = summary["lists"]
    assert {name: one["queries"] for name, one in lists.items()} == {
        name: len(listed) for name, listed in place.query_lists().items()
    }
    far = [name for name, row in rows.items() if float(row["position_error_m"]) > 0.05]
    lost = [name for name, row in rows.items() if row["status"] != "localized"]
    assert len({*far, *lost}) <= 0.01 * len(rows)
    poses = outputs / summary["poses"]
    assert poses.name.startswith(f"{place.results}_hloc_colmap_sift_sv32+NN-ratio_")
    named = [line.split()[0] for line in poses.read_text().splitlines()]
    is_base = root.name == "aachen"  # as the benchmark wants them
    assert named == [name.rpartition("/")[2] if is_base else name for name in rows]
    assert len({*named}) == len(rows)


@pytest.mark.parametrize(
    ("name", "share"),
    [("aachen", 0.003), ("cambridge/ShopFacade", 0.05), ("7scenes/stairs", 0.006)],
)
def test_a_part_of_a_place(name, share, run, tmp_path):
    root = dry_runs.main(tmp_path, name, share)
    place = open_model_place(root)
    assert type(place) is LAYOUTS[name.partition("/")[0]]
    localize(run, root, tmp_path / "outputs")
    if type(place) is Cambridge:  # as it is downloaded
        shutil.rmtree(Cambridge.folder(root))
        assert type(open_model_place(root)) is CambridgeNvm
        localize(run, root, tmp_path / "without")


def test_what_exists_is_kept(tmp_path):
    (tmp_path / "aachen").mkdir()
    for name, share, message in (
        ("aachen", 1, "aachen exists: delete it"),
        ("cambridge/Street", 1, "Unknown place"),
        ("7scenes/chess", 1.5, "--share 1.5: above 0, at most 1"),
    ):
        with pytest.raises(InputError, match=message):
            dry_runs.main(tmp_path, name, share)
    assert not [*(tmp_path / "aachen").iterdir()]


@pytest.mark.check
@pytest.mark.parametrize("name", ["aachen", "cambridge/ShopFacade"])
def test_a_whole_place(name, run, tmp_path):
    localize(run, dry_runs.main(tmp_path, name), tmp_path / "outputs")


@pytest.mark.check
@pytest.mark.parametrize("name", [name for name in dry_runs.PLACES if name != "aachen"])
def test_scenes_of_the_real_sizes(name, tmp_path, monkeypatch):
    """Their photos are empty files: none is read."""
    monkeypatch.setattr(dry_runs, "write_photos", touch)
    root = dry_runs.main(tmp_path, name)
    _, number, _, num_queries = {**dry_runs.CAMBRIDGE, **dry_runs.SEVENSCENES}[root.name]
    for layout in (LAYOUTS[name.partition("/")[0]], CambridgeNvm):
        if not layout.recognizes(root):
            continue
        place = layout(root)
        map_names, queries = place.map_names(), place.query_names()
        assert (len({*map_names}), len({*queries})) == (number, num_queries)
        assert not {*map_names} & {*queries} and len(place.true_poses()) == num_queries
        place.check(map_names)
        assert all((root / name).is_file() for name in (*map_names, *queries))
        pairs = tmp_path / "pairs.txt"
        pairs_from_covisibility.main(place.reference(tmp_path / layout.__name__), pairs, 20)
        paired = [*parse_pairs(pairs)]
        assert {name for pair in paired for name in pair} == {*map_names}
        if layout is SevenScenes:
            used = check_retrieval(str(dense_vlad(root)), pairs, 10, queries, map_names)
            assert {*used} <= {*map_names} and len(used) > 0.9 * number


def touch(wall, photos: list[dry_runs.Photo], root: Path) -> None:
    for photo in photos:
        path = root / photo.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
