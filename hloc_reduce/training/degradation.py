"""Photos as a bad camera takes them, perhaps in the dark: many at a time, on any device."""

import cv2
import numpy as np
import torch
from torch.nn.functional import conv2d, pad

KEPT = 0.25  # share of views that are not degraded
KERNEL = 13  # pixels, the side of a blur
MAX_LAMPS = 5  # in a view
# Quantization of JPEG's luminance, ITU-T T.81, table K.1
QUANTIZATION = """
    16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62
    18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101
    72 92 95 98 112 100 103 99"""


def degrade(views: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """Return views (V, 1, S, S) in [0, 1] as a bad camera takes them, perhaps in the dark.

    S is a multiple of 8. Lamps, blur by focus or motion, exposure, shot and read noise in linear
    light; tone curve, 8 bits, JPEG. Each may be absent.
    """
    number, device = len(views), views.device

    def column(values: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32)).to(device)[:, None, None, None]

    def log_uniform(least: np.ndarray | float, most: np.ndarray | float) -> np.ndarray:
        return np.exp(rng.uniform(np.log(least), np.log(most), number))

    kept, dark = rng.random(number) < KEPT, rng.random(number) < 0.5
    linear = views**2.2
    lit = dark & (rng.random(number) < 0.3)
    median = linear.flatten(1).median(dim=1).values[:, None, None, None]
    linear = linear + _lamps(rng, lit, views.shape[-1], device) * median
    linear = _blurred(linear, _kernels(rng, number)).clamp(min=0)
    # in units of the contrast, as networks normalize it
    read = log_uniform(np.where(dark, 0.02, 0.005), np.where(dark, 0.6, 0.06))
    deviation = column(read) * linear.std(dim=(1, 2, 3), keepdim=True)
    shot = column(log_uniform(0.003, 0.06))
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    noise = torch.randn(views.shape, generator=generator, device=device)
    linear = linear + noise * (deviation**2 + shot**2 * linear).sqrt()
    exposure = np.where(dark, rng.uniform(0.002, 0.5, number), np.exp(rng.normal(0, 0.4, number)))
    tone = np.exp(rng.normal(0, 0.15, number)) / 2.2
    exposed = (linear * column(exposure)).clamp(0, 1)
    levels = (exposed ** column(tone) * 255).round()
    quality, compressed = column(rng.integers(40, 96, number)), rng.random(number) < 0.6
    levels = torch.where(column(compressed) > 0, _jpeg(levels, quality), levels)
    return torch.where(column(kept) > 0, views, levels / 255)


def _lamps(
    rng: np.random.Generator, lit: np.ndarray, side: int, device: torch.device
) -> torch.Tensor:
    """Return the light (V, 1, side, side) of lamps with their glow, 0 in views not lit (V,)."""
    shape = len(lit), MAX_LAMPS
    on = lit[:, None] & (np.arange(MAX_LAMPS) < rng.integers(1, MAX_LAMPS + 1, (len(lit), 1)))
    centres = rng.uniform(0, side, (2, *shape))
    power = on * rng.uniform(10, 60, shape) * rng.integers(2, 9, shape) ** 2 / 2
    # a spot and its glow: standard deviations, and their shares of the light
    sigmas = np.stack([rng.uniform(2, 4.5, shape), rng.uniform(8, 25, shape)])
    shares = np.stack([np.ones(shape), rng.uniform(0.05, 0.4, shape)])
    places = (np.arange(side) - centres[:, None, :, :, None]) / sigmas[..., None]
    profiles = np.exp(-(places**2) / 2)
    profiles[1] *= (power * shares / sigmas**2)[..., None]
    # (2, V, lamps and glows, side)
    profiles = profiles.swapaxes(1, 2).reshape(2, len(lit), -1, side).astype(np.float32)
    columns, rows = torch.from_numpy(profiles).to(device)
    return (rows.mT @ columns)[:, None]


def _kernels(rng: np.random.Generator, number: int) -> np.ndarray:
    """Draw blurs (V, KERNEL, KERNEL) float32: by focus, by a straight motion, or none."""
    offsets = np.arange(KERNEL) - KERNEL // 2
    kernels = np.zeros((number, KERNEL, KERNEL), np.float32)
    for kernel in kernels:
        if rng.random() < 0.5:
            profile = np.exp(-((offsets / rng.uniform(0.3, 2.0)) ** 2) / 2)
            kernel[:] = np.outer(profile, profile)
        elif rng.random() < 0.3:
            angle, reach = rng.uniform(0, np.pi), rng.integers(2, 5)
            end = np.round(reach * np.array([np.cos(angle), np.sin(angle)])).astype(int)
            first, last = ((KERNEL // 2 + sign * end).tolist() for sign in (-1, 1))
            cv2.line(kernel, first, last, 1.0)
        else:
            kernel[KERNEL // 2, KERNEL // 2] = 1
    return kernels / kernels.sum(axis=(1, 2), keepdims=True)


def _blurred(views: torch.Tensor, kernels: np.ndarray) -> torch.Tensor:
    """Convolve each view (V, 1, H, W) with its kernel."""
    padded = pad(views, (KERNEL // 2,) * 4, mode="reflect")
    weights = torch.from_numpy(kernels)[:, None].to(views.device)
    return conv2d(padded.transpose(0, 1), weights, groups=len(views)).transpose(0, 1)


def _jpeg(levels: torch.Tensor, quality: torch.Tensor) -> torch.Tensor:
    """Round levels (V, 1, H, W) in [0, 255] as JPEG of a quality (V, 1, 1, 1) in [1, 100] does."""
    frequency, pixel = np.mgrid[:8, :8]
    cosines = np.cos(np.pi / 8 * (pixel + 0.5) * frequency) / np.where(frequency, 2, 8**0.5)
    basis = torch.from_numpy(cosines).to(levels)
    scale = torch.where(quality < 50, (5000 / quality).floor(), 200 - 2 * quality) / 100
    steps = torch.tensor([int(step) for step in QUANTIZATION.split()]).to(levels).view(8, 8)
    steps = (steps * scale + 0.5).floor().clamp(1, 255)[:, :, None]  # (V, 1, 1, 8, 8)
    number, _, height, width = levels.shape
    blocks = levels.view(number, height // 8, 8, width // 8, 8).transpose(2, 3) - 128
    blocks = (basis @ blocks @ basis.T / steps).round() * steps
    blocks = (basis.T @ blocks @ basis + 128).round().clamp(0, 255)
    return blocks.transpose(2, 3).reshape(levels.shape)
