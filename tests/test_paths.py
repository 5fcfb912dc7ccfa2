"""Strings are taken for paths, as by hloc: every stage does the same with them."""

import inspect
import shutil
from pathlib import Path

import numpy as np
import pytest

from hloc_reduce import (
    Localizer,
    aggregate_features,
    extract_features,
    localize_inloc,
    localize_sfm,
    maps,
    match_features,
    pairs_from_covisibility,
    pairs_from_exhaustive,
    pairs_from_retrieval,
    reconstruction,
    report,
    storage,
    triangulation,
)
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import patch_tracks, tracks
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.paths import strings_as_paths
from pipelines import aachen, batch, compare, inloc, localize

FEATURE = "colmap_sift_sv16"
CONF = extract_features.confs[FEATURE]
MATCHER = match_features.confs["NN-ratio"]


def test_strings_are_taken_where_paths_are_expected():
    @strings_as_paths
    def function(a: Path, b: Path | None = None, c: Path | str = "c", *, d: str = "d", e: int = 1):
        """Say what it was given."""
        return a, b, c, d, e

    assert function("a") == (Path("a"), None, "c", "d", 1)
    assert function("a", b="b", d="x", e=2) == (Path("a"), Path("b"), "c", "x", 2)
    assert function(Path("a"), None, Path("c")) == (Path("a"), None, Path("c"), "d", 1)
    assert inspect.signature(function).parameters["b"].annotation == Path | None
    assert function.__name__ == "function" and function.__doc__ == "Say what it was given."
    with pytest.raises(TypeError, match="missing a required argument: 'a'"):
        function(b="b")


def strings(path):
    """Return the paths of a dict as strings."""
    return {key: str(value) if isinstance(value, Path) else value for key, value in path.items()}


@pytest.fixture
def chain(aachen_layout, tmp_path):
    """The arguments of each stage, which takes what those before it made."""
    images, model = aachen_layout / "images_upright", aachen_layout / "3D-models/aachen_v_1_1"
    out = tmp_path / "out"
    local, vlad = out / f"{CONF['output']}.h5", out / f"global-feats-vlad_{CONF['output']}.h5"
    both = {"features": local, "matches": out / "matches.h5"}
    query = {"features": local, "matches": out / "query-matches.h5"}
    queries = aachen_layout / "queries/*_time_queries_with_intrinsics.txt"
    db = sorted(path.relative_to(images).as_posix() for path in (images / "db").iterdir())
    (tmp_path / "db.txt").write_text("\n".join(db))
    return {
        "extract_features": (
            extract_features,
            {"conf": CONF, "image_dir": images, "export_dir": out},
        ),
        "extract_features again": (
            extract_features,
            {"conf": CONF, "image_dir": images, "feature_path": local},
        ),
        "storage": (storage, {"features": local, "output": out / "bytes.h5", "storage": "uint8"}),
        "aggregate_features": (
            aggregate_features,
            {"conf": aggregate_features.confs["vlad"], "features": local, "vocabulary_images": db},
        ),
        "pairs_from_exhaustive": (
            pairs_from_exhaustive,
            {"output": out / "all.txt", "features": local},
        ),
        "pairs_from_covisibility": (
            pairs_from_covisibility,
            {"model": model, "output": out / "pairs.txt", "num_matched": 3},
        ),
        "match_features": (
            match_features,
            {"conf": MATCHER, "pairs": out / "pairs.txt", **both},
        ),
        "triangulation": (
            triangulation,
            {
                "sfm_dir": out / "sfm",
                "reference_model": model,
                "image_dir": images,
                "pairs": out / "pairs.txt",
                **both,
            },
        ),
        "reconstruction": (
            reconstruction,
            {
                "sfm_dir": out / "reconstructed",
                "image_dir": images,
                "pairs": out / "pairs.txt",
                "image_list": tmp_path / "db.txt",
                **both,
            },
        ),
        "pairs_from_retrieval": (
            pairs_from_retrieval,
            {
                "descriptors": vlad,
                "output": out / "loc.txt",
                "num_matched": 4,
                "query_prefix": "query/",
                "db_list": tmp_path / "db.txt",
                "db_descriptors": vlad,
            },
        ),
        "match_features again": (
            match_features,
            {"conf": MATCHER, "pairs": out / "loc.txt", **query, "features_ref": local},
        ),
        "localize_sfm": (
            localize_sfm,
            {
                "reference_sfm": out / "sfm",
                "queries": queries,
                "retrieval": out / "loc.txt",
                "results": out / "poses.txt",
                **query,
            },
        ),
    }


def described(result):
    """Return what a stage returned, a COLMAP model by its summary."""
    return result.summary() if hasattr(result, "summary") else result


def test_stages(chain, tmp_path):
    out = tmp_path / "out"
    expected = {}
    for name, (stage, arguments) in chain.items():
        expected[name] = described(stage.main(**arguments))
    written = {path.relative_to(out) for path in out.rglob("*")}
    texts = {path.name: path.read_text() for path in out.glob("*.txt")}
    shutil.rmtree(out)
    for name, (stage, arguments) in chain.items():
        assert described(stage.main(**strings(arguments))) == expected[name], name
    assert {path.relative_to(out) for path in out.rglob("*")} == written
    assert {path.name: path.read_text() for path in out.glob("*.txt")} == texts
    assert expected["localize_sfm"]["query/day/a.png"]["localized"]


def test_features_are_a_name_as_in_hloc(chain, tmp_path):
    """Unless there is such a file."""
    out = tmp_path / "out"
    for name in ("extract_features", "pairs_from_exhaustive"):
        stage, arguments = chain[name]
        stage.main(**arguments)
    matches = match_features.main(MATCHER, str(out / "all.txt"), CONF["output"], str(out))
    assert matches == out / f"{CONF['output']}_{MATCHER['output']}_all.h5"
    with pytest.raises(InputError, match="There is no feature file missing.h5"):
        match_features.main(MATCHER, str(out / "all.txt"), "missing.h5")


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


def test_pipelines(aachen_layout, inloc_layout, tmp_path):
    truth = str(aachen_layout / "queries/ground_truth_poses.txt")
    folder = str(tmp_path / "a")
    summary = aachen.main(str(aachen_layout), folder, FEATURE, ground_truth=truth)
    assert summary["queries_localized"] == 2
    report.main([folder], str(tmp_path / "r.html"), pictures_dir=str(tmp_path / "pictures"))
    assert (tmp_path / "r.html").is_file() and (tmp_path / "pictures").is_dir()
    (tmp_path / "compared").mkdir()
    shutil.move(folder, tmp_path / "compared" / FEATURE)
    given = (str(aachen_layout), [FEATURE], str(tmp_path / "compared"), str(tmp_path / "c.html"))
    assert compare.main(*given, ground_truth=truth) == {} and (tmp_path / "c.html").is_file()
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
    assert localize_inloc.main(**strings(files), overwrite=True) == expected
    jobs = tmp_path / "jobs.yaml"
    jobs.write_text(f"jobs: [{{dataset: {aachen_layout}, feature: {FEATURE}}}]")
    assert batch.dry_run(str(jobs), str(tmp_path / "b")) == []
    rows = batch.main(str(jobs), str(tmp_path / "b"))
    assert not any(row["error"] for row in rows)


def test_training(plane, tmp_path):
    place = str(plane / "images"), str(plane / "model")
    found = [tracks.load(tracks.main(*place, out)) for out in (plane / "a", str(plane / "b"))]
    assert np.array_equal(found[0].track, found[1].track)
    out = str(tmp_path / "weights"), str(tmp_path / "cache")
    (path,) = training.main({"plane": place}, [], "sift", "pca", [16], *out)
    assert path == tmp_path / "weights/sift_pca16.safetensors" and path.is_file()
    with pytest.raises(InputError, match="not a PhotoTour sequence"):
        patch_tracks.main(str(tmp_path), str(tmp_path / "cache"))
    with pytest.raises(InputError, match="not a PhotoTour sequence"):
        training.main({}, [str(tmp_path)], "sift", "pca", [16], *out)
