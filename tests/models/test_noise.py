"""Noise of photos, and what is done about it before a network sees them."""

import cv2
import numpy as np
import pytest

from hloc_reduce.networks.noise import NOISY, reduce_noise, relative_noise


@pytest.mark.parametrize("sigma", [0.0, 0.02, 0.1])
def test_noise_is_measured_in_units_of_the_contrast(textured, sigma):
    clean = cv2.resize(textured, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC) / 255
    noisy = clean + sigma * np.random.default_rng(0).standard_normal(clean.shape)
    found = relative_noise(noisy.astype(np.float32))
    assert found == pytest.approx(sigma / noisy.std(), rel=0.15, abs=0.02)
    dark = relative_noise((0.2 * noisy + 0.1).astype(np.float32))
    assert dark == pytest.approx(found, rel=0.05)


def test_a_lamp_in_a_dark_photo_hides_neither_noise_nor_contrast(textured):
    noise = np.random.default_rng(0).standard_normal(textured.shape)
    photo = (textured / 2550 + 0.02 * noise).clip(0, 1).astype(np.float32)
    found, lit = relative_noise(photo), photo.copy()
    lit[20:50, 20:50] = 1
    assert relative_noise(lit) == pytest.approx(found, rel=0.2)
    plain, lamp = (reduce_noise(image[None])[0] for image in (photo, lit))
    assert lamp.std() == pytest.approx(plain.std(), rel=0.2)
    assert lit.std() > 2 * photo.std()


@pytest.mark.parametrize("sky", [0, 3, 8])
def test_a_dark_sky_makes_no_photo_noisy(textured, sky):
    """Half of the photo and more is nearly black, and all that is lit is above the median."""
    photo = np.full((600, 320), sky / 255, np.float32)
    photo[360:] = 0.7 * textured / 255
    photo += np.random.default_rng(0).normal(0, 1 / 255, photo.shape)
    image = photo.clip(0, 1).astype(np.float32)[None]
    found, blur = reduce_noise(image)
    assert found is image and blur == 0


def test_only_noisy_photos_are_blurred(textured):
    clean = textured[None].astype(np.float32) / 255
    assert reduce_noise(clean)[0] is clean
    noise = np.random.default_rng(0).standard_normal((3, 240, 320))
    noisy = (clean / 10 + 0.1 + 0.02 * noise).clip(0, 1).astype(np.float32)
    blurred, blur = reduce_noise(noisy)
    assert 0.5 < blur < 3
    assert blurred.shape == noisy.shape and blurred.dtype == noisy.dtype
    assert relative_noise(blurred.mean(axis=0)) < NOISY / 2 < relative_noise(noisy.mean(axis=0))
    for shape in ((3, 64, 64), (3, 20, 500), (1, 1, 1)):
        image = np.full(shape, 0.5, np.float32)
        assert reduce_noise(image)[0] is image


def test_little_noise_is_blurred_little(monkeypatch):
    """A blur costs accuracy, which only much noise is worth."""
    image, blurs = np.full((1, 64, 64), 0.5, np.float32), []
    for value in (0.07, 0.1, 0.2, 0.5, 0.9):
        monkeypatch.setattr("hloc_reduce.networks.noise.relative_noise", lambda _, v=value: v)
        blurs.append(reduce_noise(image)[1])
    assert blurs == sorted(blurs) and blurs[0] == 0
    assert 0 < blurs[1] < 0.6 and 1.9 < blurs[3] < 2.1
