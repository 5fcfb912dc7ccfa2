"""Global descriptors by VLAD."""

import h5py
import numpy as np
import pytest
from command import outcome

from hloc_reduce import Localizer, aggregate_features, compact, maps
from hloc_reduce.retrieval.ranking import read_global
from hloc_reduce.retrieval.vlad import VLAD
from hloc_reduce.utils.cli import InputError
from pipelines import localize

PIPELINE = localize

CONF = {"output": "vlad", "model": {"name": "vlad", "num_words": 4, "max_samples": 1000}}


def test_vlad_by_hand():
    model = VLAD({})
    model.vocabulary = np.float32([[0.0, 0.0], [1.0, 0.0]])
    local = np.float32([[0.0, 0.3], [0.0, 0.1], [1.0, 0.2]]).T
    vlad = model.describe({"descriptors": local})
    # each word's sum of residuals has length one before the whole has
    np.testing.assert_allclose(vlad, np.array([0.0, 1.0, 0.0, 1.0]) / 2**0.5, rtol=1e-6)
    nothing = model.describe({"descriptors": np.zeros((2, 0), np.float32)})
    assert nothing.tolist() == [0] * 4


@pytest.fixture
def features(tmp_path):
    """Images 0-3 of one place, 4-7 of another, told apart by their local descriptors."""
    generator = np.random.default_rng(0)
    path = tmp_path / "feats.h5"
    with h5py.File(path, "w") as file:
        for i in range(8):
            centre = np.eye(16)[:4] if i < 4 else np.eye(16)[4:8]
            local = centre[generator.integers(4, size=50)] + generator.normal(0, 0.05, (50, 16))
            local /= np.linalg.norm(local, axis=1, keepdims=True)
            file[f"db/{i}.jpg/descriptors"] = local.T.astype(np.float16)
        file["db/blank.jpg/descriptors"] = np.zeros((16, 0), np.float16)
    return path


def test_similar_places_have_similar_descriptors(features, tmp_path, monkeypatch):
    names = [f"db/{i}.jpg" for i in range(8)]
    monkeypatch.setattr(aggregate_features.parallel, "cores", lambda: 1)
    output = aggregate_features.main(CONF, features, names)
    assert output == tmp_path / "vlad_feats.h5"
    with h5py.File(output) as file:
        rows = np.stack([file[name]["global_descriptor"][()] for name in names]).astype(float)
        assert not file["db/blank.jpg/global_descriptor"][()].any()
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-3)
    similarity = rows @ rows.T
    assert similarity[:4, :4].min() > similarity[:4, 4:].max()
    monkeypatch.setattr(aggregate_features.parallel, "cores", lambda: 3)  # the same by any number
    aggregate_features.main(CONF, features, names, overwrite=True)
    with h5py.File(output) as file:
        again = np.stack([file[name]["global_descriptor"][()] for name in names])
    np.testing.assert_array_equal(rows.astype(np.float16), again)


def test_new_images_use_the_old_vocabulary(features):
    output = aggregate_features.main(CONF, features, ["db/0.jpg", "db/4.jpg"])
    with h5py.File(output) as file:
        before = file["db/1.jpg/global_descriptor"][()]
    with h5py.File(features, "a") as file:
        file["query/1.jpg/descriptors"] = file["db/1.jpg/descriptors"][()]
    aggregate_features.main(CONF, features, ["db/0.jpg", "db/4.jpg"])
    with h5py.File(output) as file:
        np.testing.assert_array_equal(file["query/1.jpg/global_descriptor"][()], before)


def test_no_features_no_vocabulary(features):
    with pytest.raises(InputError, match="No image for the vocabulary"):
        aggregate_features.main(CONF, features, ["db/blank.jpg"])


def test_descriptors_by_a_stale_vocabulary_are_replaced(features):
    output = aggregate_features.main(CONF, features, ["db/0.jpg", "db/4.jpg"])
    vocabulary = aggregate_features.vocabulary_of(output)
    before = output.read_bytes(), vocabulary.read_bytes()
    aggregate_features.main(CONF, features, ["db/0.jpg", "db/4.jpg"])
    assert (output.read_bytes(), vocabulary.read_bytes()) == before
    aggregate_features.main(CONF, features, ["db/1.jpg"])
    assert output.read_bytes() != before[0] and vocabulary.read_bytes() != before[1]


def test_more_words_in_maps(place, run, tmp_path):
    """In the folder of a map, in files and in memory, and in a compact map."""
    build, images, outputs = place
    photos = images / "query/day"
    given = ("--feature", "colmap_sift_sv32", "--retrieval", "vlad256")
    run(*build, *given, "--query_images", photos)
    _, rows = outcome(outputs / "queries-day")
    assert rows["a.png"]["status"] == "localized"
    built = maps.Map(outputs / "map")
    assert read_global(built.descriptors, built.names()).shape == (4, 256 * 32)
    compact.main(tmp_path / "place.hlm", built.folder)
    for path in (built.folder, tmp_path / "place.hlm"):
        pose, info = Localizer(path).localize(photos / "a.png")
        assert pose is not None and info["retrieved"][0] == rows["a.png"]["retrieved"]
