import numpy as np
import torch
from synthetic_tracks import noisy_tracks

from hloc_reduce.training.sampling import DescriptorSampler, PairSampler


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
