"""Maps and pipelines take strings for paths, as hloc does."""

import pytest

from hloc_reduce import Localizer, localize_inloc, maps, report
from pipelines import aachen, batch, compare, inloc, localize

pytestmark = pytest.mark.check

FEATURE = "colmap_sift_sv16"


def test_maps(aachen_layout, tmp_path):
    images, model = aachen_layout / "images_upright", aachen_layout / "3D-models/aachen_v_1_1"
    built = maps.main(str(tmp_path / "map"), str(images), str(model), FEATURE, num_covis=3)
    assert built.folder == tmp_path / "map" and maps.Map(str(tmp_path / "map")).id == built.id
    pose, _ = Localizer(str(built.folder)).localize(str(images / "query/day/a.png"))
    summary = localize.main(
        localize.open_map(str(tmp_path), model_or_map=str(built.folder)),
        str(images / "query/day"),
        str(tmp_path / "queries"),
    )
    assert pose is not None and summary["queries_localized"] == 1


def test_aachen_report_and_compare(aachen_layout, tmp_path):
    truth = str(aachen_layout / "queries/ground_truth_poses.txt")
    folder = str(tmp_path / "compared" / FEATURE)
    summary = aachen.main(str(aachen_layout), folder, FEATURE, ground_truth=truth)
    assert summary["queries_localized"] == 2
    report.main([folder], str(tmp_path / "r.html"), pictures_dir=str(tmp_path / "pictures"))
    assert (tmp_path / "r.html").is_file() and (tmp_path / "pictures").is_dir()
    given = (str(aachen_layout), [FEATURE], str(tmp_path / "compared"), str(tmp_path / "c.html"))
    assert compare.main(*given, ground_truth=truth) == {} and (tmp_path / "c.html").is_file()


def test_inloc(inloc_layout, tmp_path):
    assert inloc.main(str(inloc_layout), str(tmp_path / "i"), FEATURE)["queries_localized"] == 2
    files = {
        "dataset_dir": inloc_layout,
        "retrieval": next((tmp_path / "i").glob("pairs*.txt")),
        "features": next((tmp_path / "i").glob("feats-*16.h5")),
        "matches": next((tmp_path / "i").glob("*_matches*.h5")),
        "results": tmp_path / "poses.txt",
        "points": tmp_path / "points.h5",
    }
    expected = localize_inloc.main(**files)
    strings = {key: str(path) for key, path in files.items()}
    assert localize_inloc.main(**strings, overwrite=True) == expected


def test_batch(aachen_layout, tmp_path):
    jobs = tmp_path / "jobs.yaml"
    jobs.write_text(f"jobs: [{{dataset: {aachen_layout}, feature: {FEATURE}}}]")
    assert batch.dry_run(str(jobs), str(tmp_path / "b")) == []
    rows = batch.main(str(jobs), str(tmp_path / "b"))
    assert not any(row["error"] for row in rows)
