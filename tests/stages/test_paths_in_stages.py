"""Every stage takes strings for paths, and names of photos in any script."""

import shutil
from pathlib import Path

import pycolmap
import pytest

from hloc_reduce import (
    aggregate_features,
    extract_features,
    localize_sfm,
    match_features,
    pairs_from_covisibility,
    pairs_from_exhaustive,
    pairs_from_retrieval,
    reconstruction,
    storage,
    triangulation,
)
from hloc_reduce.confs import features as features_confs
from hloc_reduce.evaluation.poses import pose_error
from hloc_reduce.localization import intrinsics
from hloc_reduce.utils import parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.h5 import list_h5_names

CONF = extract_features.confs["colmap_sift_sv16"]
VLAD = aggregate_features.confs["vlad"]
MATCHER = match_features.confs["NN-ratio"]


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
    listed = tmp_path / "db.txt"
    listed.write_text("\n".join(db))
    pairs, retrieval, poses = (out / f"{name}.txt" for name in ("pairs", "loc", "poses"))
    sfm = out / "sfm"
    return [
        (extract_features, dict(conf=CONF, image_dir=images, export_dir=out)),
        (extract_features, dict(conf=CONF, image_dir=images, feature_path=local)),
        (storage, dict(features=local, output=out / "bytes.h5", storage="uint8")),
        (aggregate_features, dict(conf=VLAD, features=local, vocabulary_images=db)),
        (pairs_from_exhaustive, dict(output=out / "all.txt", features=local)),
        (pairs_from_covisibility, dict(model=model, output=pairs, num_matched=3)),
        (match_features, dict(conf=MATCHER, pairs=pairs, **both)),
        (
            triangulation,
            dict(sfm_dir=sfm, reference_model=model, image_dir=images, pairs=pairs, **both),
        ),
        (
            reconstruction,
            dict(sfm_dir=out / "new", image_dir=images, pairs=pairs, image_list=listed, **both)
            | dict(accept_partial=True),
        ),
        (
            pairs_from_retrieval,
            dict(descriptors=vlad, output=retrieval, num_matched=4, query_prefix="query/")
            | dict(db_list=listed, db_descriptors=vlad),
        ),
        (match_features, dict(conf=MATCHER, pairs=retrieval, features_ref=local, **query)),
        (
            localize_sfm,
            dict(reference_sfm=sfm, queries=queries, retrieval=retrieval, results=poses, **query),
        ),
    ]


def described(result):
    """Return what a stage returned, a COLMAP model by its summary."""
    return result.summary() if hasattr(result, "summary") else result


def test_every_stage_takes_strings_for_paths(chain, tmp_path):
    out = tmp_path / "out"
    expected = [described(stage.main(**arguments)) for stage, arguments in chain]
    written = {path.relative_to(out) for path in out.rglob("*")}
    texts = {path.name: path.read_text() for path in out.glob("*.txt")}
    shutil.rmtree(out)
    for (stage, arguments), result in zip(chain, expected, strict=True):
        assert described(stage.main(**strings(arguments))) == result, stage.__name__
    assert {path.relative_to(out) for path in out.rglob("*")} == written
    assert {path.name: path.read_text() for path in out.glob("*.txt")} == texts
    assert expected[-1]["query/day/a.png"]["localized"]


def test_features_are_a_name_as_in_hloc(chain, tmp_path):
    """Unless there is such a file."""
    out = tmp_path / "out"
    for stage, arguments in chain:
        if stage in (extract_features, pairs_from_exhaustive):
            stage.main(**arguments)
    matches = match_features.main(MATCHER, str(out / "all.txt"), CONF["output"], str(out))
    assert matches == out / f"{CONF['output']}_{MATCHER['output']}_all.h5"
    with pytest.raises(InputError, match="There is no feature file missing.h5"):
        match_features.main(MATCHER, str(out / "all.txt"), "missing.h5")


def test_names_of_any_kind_of_letters_and_dots_are_localized(plane):
    """The same letter in both of Unicode's forms makes two names, as it does on a disk."""
    reference = pycolmap.Reconstruction(plane / "model")
    renamed = ["caf\u00e9.png", "cafe\u0301.png", "dir.v2/a..b.png", "\u6771/.hidden.png"]
    query = "q\\..\\\U0001f5fc.png"
    images = sorted(reference.images.values(), key=lambda image: image.name)
    for image, name in zip(images, [*renamed, query], strict=True):
        (plane / "images" / name).parent.mkdir(exist_ok=True)
        (plane / "images" / image.name).rename(plane / "images" / name)
        image.name = name
    pose = reference.find_image_with_name(query).cam_from_world()
    reference.deregister_frame(reference.find_image_with_name(query).frame_id)
    reference.write(plane / "model")
    for name in ("rigs.bin", "frames.bin"):
        (plane / "model" / name).unlink()
    every, pairs, queries = (plane / f"{name}.txt" for name in ("every", "pairs", "queries"))
    parsers.write_pairs([(query, name) for name in renamed], pairs)
    camera = next(iter(reference.cameras.values()))
    intrinsics.write_queries({query: (camera, "list")}, queries)
    assert parsers.parse_query_list(queries)[0][0] == query
    conf = features_confs.confs["colmap_sift"]
    features = extract_features.main(conf, plane / "images", plane)
    assert sorted(list_h5_names(features)) == sorted([*renamed, query])
    found = aggregate_features.main(VLAD, features, renamed)
    retrieved = pairs_from_retrieval.main(found, plane / "retrieved.txt", 4, query_list=[query])
    assert set(parsers.parse_retrieval(retrieved)[query]) == set(renamed)
    of_map = [(name, other) for i, name in enumerate(renamed) for other in renamed[:i]]
    parsers.write_pairs(of_map, plane / "map_pairs.txt")
    parsers.write_pairs(of_map + [(query, name) for name in renamed], every)
    matches = match_features.main(MATCHER, every, features, matches=plane / "m.h5")
    images, model = plane / "images", plane / "model"
    map_pairs = plane / "map_pairs.txt"
    triangulation.main(plane / "sfm", model, images, map_pairs, features, matches)
    results = plane / "poses.txt"
    found = localize_sfm.main(plane / "sfm", queries, pairs, features, matches, results)
    assert found[query]["localized"]
    ((name, estimate),) = parsers.parse_poses(results).items()
    assert name == query and pose_error(estimate, pose)[0] < 0.05
