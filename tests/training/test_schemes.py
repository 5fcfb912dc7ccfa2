"""What each scheme learns from points told apart by 8 of 128 numbers."""

import numpy as np
import pytest
import torch
from synthetic_tracks import RECIPE, SMALL, held_out_precision, noisy_tracks, photos, with_noise_of

from hloc_reduce.evaluation.ranking import nearest_neighbor_ap
from hloc_reduce.training import __main__ as training
from hloc_reduce.training import nested, pca, ss, steady, sv, us
from hloc_reduce.training.losses import distance_loss
from hloc_reduce.training.sampling import PairSampler
from hloc_reduce.utils.cli import InputError


def test_supervised_learns_what_tells_points_apart(tmp_path):
    mlp = sv.train([noisy_tracks()], 8, RECIPE, 0, tmp_path / "c")
    assert held_out_precision(mlp) > held_out_precision() + 0.1


def darkened_tracks(number=300):
    """Of three loud numbers, the first jumps in the variants."""
    generator = np.random.default_rng(0)
    data = noisy_tracks(number)
    descriptors = np.zeros(data.descriptors.shape, np.float32)
    descriptors[..., :3] = generator.standard_normal((len(data.track), 1, 1, 3)) * [9, 3, 2]
    descriptors[:, :, 1:, 0] += 12 * generator.standard_normal((len(data.track), 2, 3))
    data.descriptors = descriptors.astype(np.float16)
    return data


@pytest.mark.parametrize("added", [{"pca_share": 0.6}, {"ridge": 0.1, "steady_share": 0.6}])
def test_the_weighted_mean_of_the_trained_layer_and_its_axes(tmp_path, added):
    recipe = {**RECIPE, **added, "hidden": [], "steps": 20, "temperature": 0.04}
    data = [darkened_tracks()]
    mean = sv.train(data, 3, recipe, 0, tmp_path / "c")
    for key in ("pca_share", "steady_share"):
        recipe.pop(key, None)
    trained = sv.train(data, 3, recipe, 0, tmp_path / "d")
    begun = sv.train(data, 3, {**recipe, "steps": 1, "lr": 0}, 0, tmp_path / "e")
    axes = steady.train(data, 3, 0.1) if "ridge" in added else pca.train(data, 3, {}, 0)
    torch.testing.assert_close(begun.state_dict(), axes.state_dict())
    a, b = (
        {key: value / mlp.linears[0].weight.norm() for key, value in mlp.state_dict().items()}
        for mlp in (trained, axes)
    )
    for key, value in mean.state_dict().items():
        assert (a[key] - b[key]).norm() > 0.001
        torch.testing.assert_close(value, 0.4 * a[key] + 0.6 * b[key])


def test_steady_axes_leave_out_what_darkness_changes():
    """They come in order: the first of them are those of fewer dimensions."""
    data = darkened_tracks()
    one, two = (steady.train([data], dim, 0.3) for dim in (1, 2))
    (weight,) = (linear.weight.detach() for linear in two.linears)
    torch.testing.assert_close(weight.norm(dim=1), torch.ones(2))
    assert weight[0, 1] > 0.99 and weight[1, 2] > 0.99
    torch.testing.assert_close(one.linears[0].weight, two.linears[0].weight[:1])
    (principal,) = (linear.weight.detach() for linear in pca.train([data], 1, {}, 0).linears)
    assert principal[0, 0].abs() > 0.99
    centred = two.linears[0](photos(data)).mean(dim=0)
    torch.testing.assert_close(centred, torch.zeros(2), atol=0.01, rtol=0)


def test_maps_have_equal_weight_in_steady_axes():
    """However often the observations of a map are repeated."""
    small, large = darkened_tracks(), with_noise_of(0.3)
    larger = large.only(np.repeat(np.arange(len(large.track)), 5))
    once, often = (steady.train([small, other], 16, 0.01).linears[0] for other in (large, larger))
    torch.testing.assert_close(once.weight, often.weight, atol=1e-3, rtol=0)
    torch.testing.assert_close(once.bias, often.bias, atol=1e-3, rtol=0)


def test_recipes_of_the_descriptors_of_networks():
    """Axes that the layer begins with, and their weight, for the bases that gain by them."""
    of_aliked = {"ridge": 0.2, "steady_share": 0.6, "steps": 200}
    expected = {
        ("sv", "best", "aliked"): of_aliked,
        ("nested", "best", "aliked"): of_aliked,
        ("sv", "best", "xfeat"): {"pca_share": 0.6, "steps": 1000},
    }
    others = [(scheme, "best", "aliked") for scheme in ("us", "ss")]
    others += [(scheme, "tune", "aliked") for scheme in ("sv", "nested")]
    others += [("sv", "tune", "xfeat"), ("nested", "best", "xfeat")]
    others += [("sv", "best", "edgepoint2_m64")]
    for scheme, recipe, base in [*expected, *others]:
        name = f"{base}_nested" if scheme == "nested" else f"{base}_sv32"
        found = training.complete_recipe(scheme, recipe, base, name)
        chosen = ("ridge", "steady_share", "pca_share", "steps")
        found = {key: found[key] for key in chosen if key in found}
        assert found == expected.get((scheme, recipe, base), {"steps": 1000})
    for recipe, base in [("paper", "aliked"), ("best", "sift")]:
        found = training.complete_recipe("sv", recipe, base, f"{base}_sv32")
        assert not {"ridge", "steady_share", "pca_share"} & found.keys()


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


def test_distance_loss_keeps_distances(tmp_path):
    data, values = with_noise_of(0.1), {}
    for weight in (0.0, 1e5):
        recipe = {**RECIPE, "distance_weight": weight}
        mlp = sv.train([data], 8, recipe, 0, tmp_path / str(weight))
        with torch.no_grad():
            values[weight] = distance_loss(photos(data), mlp(photos(data))).item()
    assert values[1e5] < 0.7 * values[0.0]


def test_nested_prefixes_are_good_descriptors(tmp_path):
    recipe = {**nested.RECIPES["best"], **SMALL, "prefixes": [16, 8]}
    mlp = nested.train([noisy_tracks()], 16, recipe, 0, tmp_path / "c")
    cut = lambda rows: torch.nn.functional.normalize(mlp(rows)[:, :8], dim=1)  # noqa: E731
    for project in (mlp, cut):
        assert held_out_precision(project) > held_out_precision() + 0.1


def test_auto_encoder_recovers_what_has_few_dimensions(tmp_path):
    """Descriptors on a plane of 8 of 128 dimensions fit through 8 numbers, not through 2."""
    data = with_noise_of(0)
    mlp = us.train([data], 8, {**us.RECIPES["best"], **SMALL}, 0, tmp_path / "c")
    with torch.no_grad():
        kept = mlp(photos(data))
    similarity, embedded = (rows @ rows.T for rows in (photos(data), kept))
    assert np.corrcoef(similarity.flatten(), embedded.flatten())[0, 1] > 0.9


@pytest.mark.parametrize(
    ("name", "changes"),
    [("paper", {"lr": 3e-2, "cluster_epochs": 6, "batch_size": 100}), ("best", {"per_cell": 200})],
)
def test_self_supervised_tells_clusters_apart(name, changes, tmp_path):
    pytest.importorskip("faiss")
    recipe = {**ss.RECIPES[name], **SMALL, "lr": 1e-2, **changes}
    data = with_noise_of(0.3)
    mlp = ss.train([data], 8, recipe, 0, tmp_path / "c")
    with torch.no_grad():
        embedded = mlp(photos(data))
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


@pytest.mark.parametrize("scheme", [us, ss])
def test_a_last_batch_of_one_is_left_out(scheme, tmp_path):
    """40 observations: a batch normalization learns nothing from the fortieth alone."""
    if scheme is ss:
        pytest.importorskip("faiss")
    recipe = {**scheme.RECIPES["paper"], **SMALL, "batch_size": 39, "epochs": 2}
    del recipe["steps"]
    scheme.train([noisy_tracks(10)], 8, recipe, 0, tmp_path / "c")


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


def test_too_few_observations():
    with pytest.raises(InputError, match="too few"):
        pca.train([noisy_tracks(2)], 64, {}, 0)
    with pytest.raises(InputError, match="8 observations are too few for 64"):
        steady.train([noisy_tracks(2)], 64, 0.01)
