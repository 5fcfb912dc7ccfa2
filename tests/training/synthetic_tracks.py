"""Tracks without photos, and a short recipe that learns from them."""

import numpy as np
import torch

from hloc_reduce.evaluation.ranking import nearest_neighbor_ap
from hloc_reduce.training import describers, sv
from hloc_reduce.training.tracks import Tracks

SMALL = {"hidden": [64], "distance_weight": 0.0, "steps": 300, "batch_size": 100, "lr": 3e-3}
RECIPE = {**sv.RECIPES["best"], **SMALL}


def noisy_tracks(number=400, views=4, seed=0):
    """Points told apart by 8 of 128 numbers, the others being louder noise."""
    generator = np.random.default_rng(seed)
    signal = np.zeros((number, 128))
    signal[:, :8] = generator.standard_normal((number, 8))
    track = np.repeat(np.arange(number), views)
    noise = generator.standard_normal((len(track), 2, describers.VARIANTS, 128))
    noise[..., :8] = 0
    descriptors = signal[track, None, None] + 0.3 * noise
    descriptors /= np.linalg.norm(descriptors, axis=-1, keepdims=True)
    xy = np.zeros((len(track), 2), np.float32)
    image = np.tile(np.arange(views), number)
    return Tracks(descriptors.astype(np.float16), track, image, xy, np.ones(len(track), bool))


def with_noise_of(factor):
    """The same, with the noise scaled."""
    data = noisy_tracks()
    data.descriptors[..., 8:] *= factor
    data.descriptors /= np.linalg.norm(data.descriptors.astype(np.float32), axis=-1)[..., None]
    return data


def photos(data):
    """Their descriptors in the photos, unchanged."""
    return torch.from_numpy(data.descriptors[:, 0, 0]).float()


def held_out_precision(mlp=None):
    views = photos(noisy_tracks(seed=7))
    embedded = mlp(views) if mlp else views
    return nearest_neighbor_ap(embedded[0::4], embedded[1::4])
