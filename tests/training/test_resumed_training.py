"""A training that was interrupted, at a checkpoint or between, ends as an undisturbed one does."""

import pytest
import torch
from interruption import interrupted
from synthetic_tracks import RECIPE, SMALL, noisy_tracks

from hloc_reduce.training import loop, ss, sv


def assert_equal(network, other):
    for key, value in network.state_dict().items():
        assert torch.equal(value, other.state_dict()[key]), key


CLUSTERED = {**ss.RECIPES["paper"], **SMALL, "cluster_epochs": 2, "per_cluster": 8}
FROM_AXES = {**RECIPE, "hidden": [], "ridge": 0.1, "steady_share": 0.6}


@pytest.mark.parametrize(
    ("scheme", "recipe"),
    [(sv, RECIPE), (sv, FROM_AXES), (ss, CLUSTERED)],
    ids=["sv", "from axes", "ss"],
)
def test_training_goes_on_after_a_kill(scheme, recipe, tmp_path, monkeypatch):
    if scheme is ss:
        pytest.importorskip("faiss")
    monkeypatch.setattr(loop, "CHECKPOINT_STEPS", 20)
    given = [noisy_tracks()], 8, {**recipe, "steps": 60}, 0
    whole = scheme.train(*given, tmp_path / "whole")
    steps = interrupted(monkeypatch, torch.optim.Adam, "step", 47)
    with pytest.raises(KeyboardInterrupt):
        scheme.train(*given, tmp_path / "killed")
    checkpoint = torch.load(tmp_path / "killed", weights_only=True)
    assert checkpoint["step"] == 40
    assert_equal(whole, scheme.train(*given, tmp_path / "killed"))
    assert len(steps) == 47 + 20
    torch.save(checkpoint, tmp_path / "killed")
    assert_equal(whole, scheme.train(*given, tmp_path / "killed", "other data"))
    assert len(steps) == 47 + 20 + 60  # from the beginning


def test_clusters_of_finished_maps_are_kept(tmp_path, monkeypatch):
    pytest.importorskip("faiss")
    recipe = {**ss.RECIPES["best"], **SMALL, "steps": 2, "per_cluster": 8, "per_cell": 1600}
    maps = [noisy_tracks(), noisy_tracks(seed=1)]
    whole = ss.train(maps, 8, recipe, 0, tmp_path / "whole")
    clusterings = interrupted(monkeypatch, ss, "cluster", 4)  # two a map, one of them in a cell
    with pytest.raises(KeyboardInterrupt):
        ss.train(maps, 8, recipe, 0, tmp_path / "c")
    assert len(clusterings) == 4
    assert_equal(whole, ss.train(maps, 8, recipe, 0, tmp_path / "c"))
    assert len(clusterings) == 6
    ss.train(maps, 8, recipe, 0, tmp_path / "c", "other data")
    assert len(clusterings) == 10


def test_clusters_of_the_projected_are_kept(tmp_path, monkeypatch):
    """Interrupted in the first step after the second clustering, long before a checkpoint."""
    pytest.importorskip("faiss")
    short = {"steps": 6, "cluster_epochs": 1, "batch_size": 800, "per_cluster": 8}
    recipe = {**ss.RECIPES["paper"], **SMALL, **short}
    whole = ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "whole")
    clusterings = interrupted(monkeypatch, ss, "cluster")
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        interrupted(stopped, torch.optim.Adam, "step", 3)  # of two an epoch
        ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "c")
    assert len(clusterings) == 2
    assert_equal(whole, ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "c"))
    assert len(clusterings) == 3
