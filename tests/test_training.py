import hashlib
import json
import re

import numpy as np
import pytest
import torch

from hloc_reduce import projections
from hloc_reduce.evaluation.ranking import nearest_neighbor_ap
from hloc_reduce.projections import network
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import loop, nested, pca, ss, sv, tracks, us
from hloc_reduce.training.losses import distance_loss, triplet_loss
from hloc_reduce.training.sampling import DescriptorSampler, PairSampler
from hloc_reduce.training.tracks import Tracks
from hloc_reduce.utils.cli import InputError

SMALL = {"hidden": [64], "distance_weight": 0.0, "steps": 300, "batch_size": 100, "lr": 3e-3}
RECIPE = {**sv.RECIPES["best"], **SMALL}


def noisy_tracks(number=400, views=4, seed=0):
    """Points told apart by 8 of 128 numbers, the others being louder noise."""
    generator = np.random.default_rng(seed)
    signal = np.zeros((number, 128))
    signal[:, :8] = generator.standard_normal((number, 8))
    track = np.repeat(np.arange(number), views)
    noise = generator.standard_normal((len(track), 2, tracks.VARIANTS, 128))
    noise[..., :8] = 0
    descriptors = signal[track, None, None] + 0.3 * noise
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
    xy = np.zeros((len(track), 2), np.float32)
    image = np.tile(np.arange(views), number)
    return Tracks(descriptors.astype(np.float16), track, image, xy, np.ones(len(track), bool))


def held_out_precision(mlp):
    held_out = noisy_tracks(seed=7)
    views = torch.from_numpy(held_out.descriptors[:, 0, 0]).float()
    embedded = mlp(views) if mlp else views
    return nearest_neighbor_ap(embedded[0::4], embedded[1::4])


def test_sampler_draws_matches():
    data = noisy_tracks()
    data.descriptors[:] = 0
    data.descriptors[:, 0, :, 0] = data.track[:, None]  # exact in float16
    data.descriptors[:, 1, :, 0] = data.track[:, None] + 500
    data.descriptors[..., 1] = data.image[:, None, None]
    sampler = PairSampler([data], 0.5, True, None, 0)
    anchors, positives = sampler.batch(3, 64)
    assert (anchors[:, 0] == positives[:, 0]).all() and (anchors[:, 1] != positives[:, 1]).all()
    assert (anchors[:, 0] >= 500).any() and (anchors[:, 0] < 500).any()
    assert len(anchors[:, 0].unique()) == len(anchors) > 40
    assert (sampler.batch(3, 64)[0] == anchors).all()
    assert not torch.equal(sampler.batch(4, 64)[0][:40], anchors[:40])


def test_sampler_without_augmentation_draws_photos_only():
    data = noisy_tracks()
    data.descriptors[:] = 1
    data.descriptors[:, 0, 0] = 0
    anchors, positives = PairSampler([data], 0.0, False, None, 0).batch(0, 64)
    assert not anchors.any() and not positives.any()


def test_sampler_leaves_out_what_has_no_match():
    """A second observation in the same image is no match, nor is a point seen once."""
    data = noisy_tracks(number=3, views=2)
    data.image[:] = [0, 0, 0, 1, 0, 1]
    data.descriptors[..., 0] = data.track[:, None, None]
    anchors, _ = PairSampler([data], 0.5, True, None, 0).batch(0, 500)
    assert sorted(anchors[:, 0].tolist()) == [1, 2]


def test_sampler_balances_maps():
    large, small = noisy_tracks(900), noisy_tracks(100)
    large.descriptors[..., 0], small.descriptors[..., 0] = 0, 1
    counts = {
        balanced: PairSampler([large, small], 0.0, balanced, None, 0).batch(0, 64)[0][:, 0].mean()
        for balanced in (False, True)
    }
    assert counts[False] < 0.2 < counts[True] < 0.35


def test_sampler_draws_a_batch_from_few_maps():
    maps = [noisy_tracks(200) for _ in range(5)]
    for number, data in enumerate(maps):
        data.descriptors[..., 0] = number
    sampler = PairSampler(maps, 0.0, True, 2, 0)
    drawn = [set(sampler.batch(number, 64)[0][:, 0].tolist()) for number in range(20)]
    assert max(map(len, drawn)) == 2 and set.union(*drawn) == {0, 1, 2, 3, 4}


def test_triplet_loss_by_hand():
    anchors = torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    positives = torch.tensor([[0.0, 1.0], [0.0, -1.0]])
    # d(a0, p0) = sqrt 2, d(a1, p1) = 2; d(a0, p1) = sqrt 2; a1 = p0 counts as the same patch
    expected = (1 + 2**0.5 - 2**0.5 + 1 + 2 - 2**0.5) / 2
    assert triplet_loss(anchors, positives, 1.0).item() == pytest.approx(expected, abs=1e-3)


def test_supervised_learns_what_tells_points_apart(tmp_path):
    mlp = sv.train([noisy_tracks()], 8, RECIPE, 0, tmp_path / "c")
    assert held_out_precision(mlp) > held_out_precision(None) + 0.1


def test_paper_recipe_is_the_papers(tmp_path, monkeypatch):
    """Sec. III-D: two hidden layers, 10 epochs of batches of 1,024, Adam from 0.001 to 0."""
    numbers, rates = [], []
    batch, step = PairSampler.batch, torch.optim.Adam.step

    def counted(self, number, size):
        assert size == 1024 and self.augment == 0
        numbers.append(number)
        return batch(self, number, size)

    def observed(self, *arguments):
        rates.append(self.param_groups[0]["lr"])
        return step(self, *arguments)

    monkeypatch.setattr(PairSampler, "batch", counted)
    monkeypatch.setattr(torch.optim.Adam, "step", observed)
    recipe = training.complete_recipe("sv", "paper", "sift", "sift_sv64")
    mlp = sv.train([noisy_tracks()], 16, recipe, 0, tmp_path / "c")
    assert mlp.sizes == (128, 512, 512, 16)
    assert numbers == list(range(20))  # 1,600 observations are two batches an epoch
    np.testing.assert_allclose(rates, 1e-3 * (1 - np.arange(20) / 20))


def test_training_goes_on_after_a_kill_as_if_nothing_had_been(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "CHECKPOINT_STEPS", 20)
    recipe = {**RECIPE, "steps": 60}
    whole = sv.train([noisy_tracks()], 8, recipe, 0, tmp_path / "whole")
    batch = PairSampler.batch

    def killed(self, number, size):
        if number == 47:
            raise KeyboardInterrupt
        return batch(self, number, size)

    monkeypatch.setattr(PairSampler, "batch", killed)
    with pytest.raises(KeyboardInterrupt):
        sv.train([noisy_tracks()], 8, recipe, 0, tmp_path / "killed")
    monkeypatch.setattr(PairSampler, "batch", batch)
    checkpoint = torch.load(tmp_path / "killed", weights_only=True)
    assert checkpoint["step"] == 40
    other = sv.train([noisy_tracks()], 8, recipe, 0, tmp_path / "killed", "other data")
    assert torch.equal(other.linears[0].weight, whole.linears[0].weight)  # from the beginning
    torch.save({**checkpoint, "step": 40}, tmp_path / "killed")
    resumed = sv.train([noisy_tracks()], 8, recipe, 0, tmp_path / "killed")
    for key, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[key]), key


def test_distance_loss_by_hand():
    descriptors = torch.eye(3)
    embedded = torch.tensor([[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])
    # sqrt 2 becomes 0, 2 and 2, each of them twice
    expected = (2 * (2 + 2 * (2 - 2**0.5) ** 2)) ** 0.5 / 6
    assert distance_loss(descriptors, embedded).item() == pytest.approx(expected, abs=1e-3)
    assert distance_loss(descriptors, descriptors).item() == pytest.approx(0, abs=1e-6)


def test_distance_loss_keeps_distances(tmp_path):
    data = noisy_tracks()
    data.descriptors[..., 8:] *= 0.1
    data.descriptors /= np.linalg.norm(data.descriptors.astype(np.float32), axis=-1)[..., None]
    plain = torch.from_numpy(data.descriptors[:, 0, 0]).float()
    values = {}
    for weight in (0.0, 1e5):
        recipe = {**RECIPE, "distance_weight": weight}
        mlp = sv.train([data], 8, recipe, 0, tmp_path / str(weight))
        with torch.no_grad():
            values[weight] = distance_loss(plain, mlp(plain)).item()
    assert values[1e5] < 0.7 * values[0.0]


def test_nested_prefixes_are_good_descriptors(tmp_path):
    recipe = {**nested.RECIPES["best"], **SMALL, "prefixes": [16, 8]}
    mlp = nested.train([noisy_tracks()], 16, recipe, 0, tmp_path / "c")
    cut = lambda rows: torch.nn.functional.normalize(mlp(rows)[:, :8], dim=1)  # noqa: E731
    assert held_out_precision(mlp) > held_out_precision(None) + 0.1
    assert held_out_precision(cut) > held_out_precision(None) + 0.1


def test_auto_encoder_recovers_what_has_few_dimensions(tmp_path):
    """Descriptors on a plane of 8 of 128 dimensions fit through 8 numbers, not through 2."""
    data = noisy_tracks()
    data.descriptors[..., 8:] = 0
    data.descriptors /= np.linalg.norm(data.descriptors.astype(np.float32), axis=-1)[..., None]
    recipe = {**us.RECIPES["best"], **SMALL}
    plain = torch.from_numpy(data.descriptors[:, 0, 0]).float()
    mlp = us.train([data], 8, recipe, 0, tmp_path / "c")
    with torch.no_grad():
        kept = mlp(plain)
    similarity, embedded = (rows @ rows.T for rows in (plain, kept))
    assert np.corrcoef(similarity.flatten(), embedded.flatten())[0, 1] > 0.9


@pytest.mark.parametrize(
    ("name", "changes"),
    [("paper", {"lr": 3e-2, "cluster_epochs": 6, "batch_size": 100}), ("best", {"per_cell": 200})],
)
def test_self_supervised_tells_clusters_apart(name, changes, tmp_path):
    pytest.importorskip("faiss")
    recipe = {**ss.RECIPES[name], **SMALL, "lr": 1e-2, **changes}
    data = noisy_tracks()
    data.descriptors[..., 8:] *= 0.3
    data.descriptors /= np.linalg.norm(data.descriptors.astype(np.float32), axis=-1)[..., None]
    mlp = ss.train([data], 8, recipe, 0, tmp_path / "c")
    views = torch.from_numpy(data.descriptors[:, 0, 0]).float()
    with torch.no_grad():
        embedded = mlp(views)
    assert nearest_neighbor_ap(embedded[0::4], embedded[1::4]) > 0.9
    again = ss.train([data], 8, recipe, 0, tmp_path / "again")
    assert torch.equal(mlp.linears[0].weight, again.linears[0].weight)


def test_clusters_within_cells():
    """Twelve far groups of near points: the cells keep them together, the clusters apart."""
    pytest.importorskip("faiss")
    generator = np.random.default_rng(0)
    group = np.repeat(np.arange(12), 40)
    centres = generator.standard_normal((12, 16))
    descriptors = centres[group] + 0.01 * generator.standard_normal((480, 16))
    labels = ss.cluster_in_cells(descriptors.astype(np.float32), 10, 160, 10, seed=0)
    assert set(labels) <= set(range(60)) and len(set(labels)) > 36
    for label in set(labels):
        assert len(set(group[labels == label])) == 1


def test_self_supervised_goes_on_with_the_same_clusters(tmp_path, monkeypatch):
    pytest.importorskip("faiss")
    monkeypatch.setattr(loop, "CHECKPOINT_STEPS", 20)
    recipe = {**ss.RECIPES["paper"], **SMALL, "steps": 60, "cluster_epochs": 2, "per_cluster": 8}
    whole = ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "whole")
    views = DescriptorSampler.views

    def killed(self, *arguments):
        killed.calls += 1
        if killed.calls == 47:
            raise KeyboardInterrupt
        return views(self, *arguments)

    killed.calls = 0
    monkeypatch.setattr(DescriptorSampler, "views", killed)
    with pytest.raises(KeyboardInterrupt):
        ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "killed")
    monkeypatch.setattr(DescriptorSampler, "views", views)
    assert torch.load(tmp_path / "killed", weights_only=True)["step"] == 40
    resumed = ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "killed")
    for key, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[key]), key


def interrupted(monkeypatch, owner, name, number):
    """Have a signal come at a call of a function; return the list of its calls."""
    calls, function = [], getattr(owner, name)

    def counted(*arguments):
        calls.append(arguments)
        if len(calls) == number:
            raise KeyboardInterrupt
        return function(*arguments)

    monkeypatch.setattr(owner, name, counted)
    return calls


def assert_equal(network, other):
    for key, value in network.state_dict().items():
        assert torch.equal(value, other.state_dict()[key]), key


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
    clusterings = interrupted(monkeypatch, ss, "cluster", None)
    with monkeypatch.context() as stopped, pytest.raises(KeyboardInterrupt):
        interrupted(stopped, torch.optim.Adam, "step", 3)  # of two an epoch
        ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "c")
    assert len(clusterings) == 2
    assert_equal(whole, ss.train([noisy_tracks()], 8, recipe, 0, tmp_path / "c"))
    assert len(clusterings) == 3


def test_an_epoch_goes_once_through_all_descriptors():
    data = [noisy_tracks(30), noisy_tracks(20, seed=1)]
    sampler = DescriptorSampler(data, 0.0, mirror=False, balanced=False, seed=0)
    first = np.concatenate([sampler.indices(number, 64) for number in range(4)])
    assert sorted(first) == list(range(200))
    second = np.concatenate([sampler.indices(number, 64) for number in range(4, 8)])
    assert sorted(second) == list(range(200)) and (first != second).any()
    seen, plain = sampler.batch(0, 64)
    assert torch.equal(seen, plain)
    both = np.concatenate([part.descriptors[:, 0, 0] for part in data])
    np.testing.assert_array_equal(plain.numpy(), both[sampler.indices(0, 64)])


@pytest.mark.parametrize(("scheme", "batch_size"), [(us, 39), (ss, 39)])
def test_a_last_batch_of_one_is_left_out(scheme, batch_size, tmp_path):
    """40 observations: a batch normalization learns nothing from the fortieth alone."""
    if scheme is ss:
        pytest.importorskip("faiss")
    recipe = {**scheme.RECIPES["paper"], **SMALL, "batch_size": batch_size, "epochs": 2}
    recipe.pop("steps", None)
    scheme.train([noisy_tracks(10)], 8, {"distance_weight": 0.0, **recipe}, 0, tmp_path / "c")


def test_the_papers_hyper_parameters():
    """Sec. III-D; those of the classification layer are of the authors' code."""
    recipe = training.complete_recipe("us", "paper", "hardnet", "hardnet_us64")
    assert recipe["distance_weight"] == 0.1 and recipe["hidden"] == [96]
    assert (recipe["epochs"], recipe["lr"], recipe["batch_size"]) == (5, 0.001, 1024)
    recipe = training.complete_recipe("ss", "paper", "sift", "sift_ss64")
    assert recipe["hidden"] == [512, 512] and not recipe["distance_weight"]
    assert (recipe["epochs"], recipe["lr"], recipe["batch_size"]) == (200, 0.001, 256)
    assert recipe["cluster_epochs"] == 10 and recipe["final_lr"] == 1
    assert int(450_092 / recipe["per_cluster"]) == 100_000
    assert (recipe["margin"], recipe["scale"]) == (0.1, 1)


def test_pca_keeps_the_variance():
    generator = np.random.default_rng(0)
    data = noisy_tracks()
    low = generator.standard_normal((len(data.track), 4)) @ generator.standard_normal((4, 128))
    data.descriptors[:, 0, 0] = low + 3
    mlp = pca.train([data], 4, {}, 0)
    centred = low.astype(np.float16) - low.mean(0)
    projected = mlp.linears[0](torch.from_numpy(data.descriptors[:, 0, 0]).float())
    distances = torch.pdist(projected).detach()
    torch.testing.assert_close(
        distances, torch.pdist(torch.from_numpy(centred).float()), rtol=0.05, atol=0.05
    )


def test_photometric_variants_are_images():
    image = np.linspace(0, 1, 40 * 50, dtype=np.float32).reshape(40, 50)
    generator = np.random.default_rng(0)
    views = [tracks.photometric_variant(image, generator) for _ in range(30)]
    assert all(view.dtype == np.float32 and view.shape == (40, 50) for view in views)
    assert min(view.max() for view in views) < 0.2 and max(view.mean() for view in views) > 0.4
    assert all(view.min() >= 0 and view.max() <= 1 for view in views)


def test_nearest_neighbor_ap_by_hand():
    """Ranked: hit, miss, hit; the fourth misses: (1 + 2/3) / 4."""
    angles = torch.tensor([0.0, 1.0, 2.0, 3.0])
    shifted = torch.tensor([0.01, 1.95, 2.2, 1.1])
    unit = [torch.stack([a.cos(), a.sin()], 1) for a in (angles, shifted)]
    # nearest: 0 -> 0 (.01), 1 -> 3 (.1), 2 -> 1 (.05), 3 -> 2 (.8)
    assert nearest_neighbor_ap(*unit) == pytest.approx(1 / 4)
    assert nearest_neighbor_ap(unit[0], unit[0]) == pytest.approx(1)
    angles = torch.tensor([0.0, 1.0, 2.0, 4.0])
    shifted = torch.tensor([0.01, 1.3, 2.2, 1.1])
    unit = [torch.stack([a.cos(), a.sin()], 1) for a in (angles, shifted)]
    # nearest: 0 -> 0 (.01), 1 -> 3 (.1), 2 -> 2 (.2), 3 -> 2 (1.8)
    assert nearest_neighbor_ap(*unit) == pytest.approx((1 + 2 / 3) / 4)
    # a fifth descriptor in the way of the first: miss, miss, hit, miss
    distracted = torch.cat([unit[1], unit[0][:1]])
    assert nearest_neighbor_ap(unit[0], distracted) == pytest.approx(1 / 3 / 4)


def test_a_map_is_trained_on(scene, tmp_path, monkeypatch):
    """From images with poses to a projection: the stages fit together."""
    monkeypatch.setattr(training, "SCHEMES", {"pca": pca})
    (tmp_path / "tracks.safetensors").touch()
    monkeypatch.setattr(tracks, "main", lambda *_: tmp_path / "tracks.safetensors")
    monkeypatch.setattr(tracks, "load", lambda _: noisy_tracks())
    (path,) = training.main(
        {"place": (scene.images, scene.model)}, [], "sift", "pca", [16], tmp_path / "out", tmp_path
    )
    projection = projections.load(path)
    assert projection.sizes == (128, 16)
    assert projection.metadata["training_data"] == {
        "place": {"points": 400, "observations": 1600, "sha256": hashlib.sha256(b"").hexdigest()}
    }
    assert json.dumps(projection.metadata["versions"])
    written = path.stat().st_mtime_ns
    arguments = (
        {"place": (scene.images, scene.model)},
        [],
        "sift",
        "pca",
        [16, 8],
        tmp_path / "out",
    )
    assert len(training.main(*arguments, tmp_path)) == 2
    assert path.stat().st_mtime_ns == written


def test_a_projection_of_another_training_is_not_replaced(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(tracks, "main", lambda *_: tmp_path / "tracks.safetensors")
    monkeypatch.setattr(tracks, "load", lambda _: noisy_tracks())
    (tmp_path / "tracks.safetensors").touch()
    place = scene.images, scene.model
    others = [], "sift", "pca", [16], tmp_path, tmp_path
    (path,) = training.main({"a": place}, *others)
    written = path.read_bytes()
    with pytest.raises(InputError, match="exists, trained with another training_data. Choose"):
        training.main({"b": place}, *others)
    assert path.read_bytes() == written


def test_nested_is_trained_once(scene, tmp_path, monkeypatch):
    recipe = {**nested.RECIPES["best"], "steps": 2, "batch_size": 16}
    monkeypatch.setitem(nested.RECIPES, "best", recipe)
    monkeypatch.setattr(tracks, "main", lambda *_: tmp_path / "tracks.safetensors")
    monkeypatch.setattr(tracks, "load", lambda _: noisy_tracks())
    (tmp_path / "tracks.safetensors").touch()
    arguments = {"a": (scene.images, scene.model)}, [], "sift", "nested", [], tmp_path, tmp_path
    (path,) = training.main(*arguments)
    written = path.stat().st_mtime_ns
    assert training.main(*arguments) == [path] and path.stat().st_mtime_ns == written


def test_tuning_begins_with_what_ships(scene, tmp_path, monkeypatch):
    """Without a step of learning the weights are those that ship; with some they are better."""
    monkeypatch.setattr(tracks, "main", lambda *_: tmp_path / "tracks.safetensors")
    monkeypatch.setattr(tracks, "load", lambda _: noisy_tracks())
    (tmp_path / "tracks.safetensors").touch()
    shipped, _ = network.read("sift_sv16")
    others = [], "sift", "sv", [16]
    for scheme, steps, lr in ((sv, 1, 0.0), (sv, 60, 1e-3)):
        recipe = {**scheme.RECIPES["tune"], "steps": steps, "lr": lr, "batch_size": 100}
        monkeypatch.setitem(scheme.RECIPES, "tune", recipe)
        output = tmp_path / str(steps)
        place = {"a": (scene.images, scene.model)}
        (path,) = training.main(place, *others, output, tmp_path, "tune")
        tuned, metadata = network.read(path)
        assert metadata["recipe"]["begin_with"] == "sift_sv16" and metadata["recipe"]["lr"] == lr
        same = torch.equal(tuned.linears[0].weight, shipped.linears[0].weight)
        assert same == (steps == 1)
    assert held_out_precision(tuned) > 3 * held_out_precision(shipped.eval())


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--scheme", "us"), "Unknown recipe of us 'tune'"),
        (("--dim", 48), "sift_sv48 does not ship"),
        (("--scheme", "nested", "--descriptor", "hardnet"), "hardnet_nested does not ship"),
    ],
)
def test_what_cannot_be_tuned(scene, tmp_path, monkeypatch, arguments, message):
    monkeypatch.setattr(training, "check_weights", lambda name: None)
    place = ("--map", f"{scene.images}:{scene.model}", "--cache", tmp_path / "cache")
    with pytest.raises(InputError, match=message):
        run(monkeypatch, *place, "--recipe", "tune", *arguments)
    assert not (tmp_path / "cache").exists()


def run(monkeypatch, *arguments):
    """Run the command line."""
    monkeypatch.setattr("sys.argv", ["training", *map(str, arguments)])
    training._main()


def test_a_sequence_is_called_otherwise_than_a_map(tmp_path, monkeypatch):
    for folder in ("a/liberty", "b/liberty/images", "b/liberty/sparse"):
        (tmp_path / folder).mkdir(parents=True)
    place = f"{tmp_path}/b/liberty/images:{tmp_path}/b/liberty/sparse"
    with pytest.raises(InputError, match="called liberty"):
        run(monkeypatch, "--map", place, "--phototour", tmp_path / "a/liberty")
    with pytest.raises(InputError, match="--seed -1"):
        run(monkeypatch, "--map", place, "--seed", -1)


def test_the_command_for_what_does_not_ship_is_one(tmp_path, monkeypatch):
    """The line that the message prints trains, when there is a map; here the map is not there."""
    monkeypatch.setattr(training, "check_weights", lambda name: None)
    with pytest.raises(InputError) as error:
        projections.load("hardnet_us24")
    command = re.search("python -m hloc_reduce.training ([^']*)", str(error.value))[1]
    with pytest.raises(InputError, match="there is no folder IMAGES"):
        run(monkeypatch, *command.split())


def test_too_few_observations_for_pca():
    with pytest.raises(InputError, match="too few"):
        pca.train([noisy_tracks(2)], 64, {}, 0)


def test_maps_are_parsed(tmp_path):
    images, model = tmp_path / "place/images", tmp_path / "place/sparse"
    images.mkdir(parents=True)
    with pytest.raises(InputError, match="no folder"):
        training.parse_maps([f"{images}:{model}"])
    model.mkdir()
    assert training.parse_maps([f"{images}:{model}"]) == {"place": (images, model)}
    with pytest.raises(InputError, match="images:model"):
        training.parse_maps([str(images)])
    with pytest.raises(InputError, match="another map"):
        training.parse_maps([f"{images}:{model}"] * 2)
