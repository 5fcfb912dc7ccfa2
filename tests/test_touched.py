"""How much of a compact map is read: little, however large the file is."""

import os
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from benchmarks import compact_scale
from hloc_reduce.confs import features as features_confs
from hloc_reduce.hlm import signs, writer
from hloc_reduce.hlm.images import Images
from hloc_reduce.hlm.reader import CompactMap
from hloc_reduce.localization import intrinsics
from hloc_reduce.retrieval.vlad import VOCABULARY

FEATURE, DIM = "colmap_sift_sv64", 64
SEEN, STEP = 250, 50  # points that an image shows; those that the next one does not show
CAMERA = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
PAGES = 1e6  # bytes around places that are read which the system may map, too


class Row:
    """The points of a number of images in a row, as `writer.Content`."""

    def __init__(self, images):
        self.number = (images - 1) * STEP + SEEN

    def __len__(self):
        return self.number

    def xyz(self, part):
        x = np.arange(self.number)[part] / STEP
        return np.stack([x, np.sin(x), np.full(len(x), 5.0)], axis=1)

    def descriptors(self, part):
        ids = np.arange(1, self.number + 1)[part, None]
        found = np.sin(ids * np.arange(1, DIM + 1)).astype(np.float32)
        return found / np.linalg.norm(found, axis=1, keepdims=True)

    def visible(self, image):
        return np.arange(SEEN) + image * STEP


def signs_of(number):
    return np.random.default_rng(0).integers(256, size=(number, 128)).astype(np.uint8)


def written(path, number):
    """Write a map of a number of images, in float16: 6 kB an image."""
    names = [f"camera/{i:06}.jpg" for i in range(number)]
    centers = np.stack([np.arange(number), np.zeros(number), np.zeros(number)], axis=1)
    unturned = np.tile([0.0, 0.0, 0.0, 1.0], (number, 1))
    images = Images(names, unturned, centers, [CAMERA], np.zeros(number, int))
    source = writer.Source(
        pycolmap.Reconstruction(),
        FEATURE,
        features_confs.get(FEATURE)[1],
        "NN-mutual",
        Path(),
        VOCABULARY,
        intrinsics.of_cameras([CAMERA]),
    )
    with path.open("wb") as file:
        parts = writer.write(file, Row(number), images, source, signs_of(number), 64 * DIM, 0.001)
        file.flush()
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)  # the system forgets it
    assert sum(parts.values()) == path.stat().st_size > 6000 * number
    return path


def touched(path):
    """Return the resident size of the mapping of a file in bytes."""
    return 1e6 * compact_scale.touched(path)


def use(found, image):
    """Use what a query needs of an image, and check it."""
    name = f"camera/{image:06}.jpg"
    points = found.visible(name)
    assert points.tolist() == list(range(image * STEP, image * STEP + SEEN))
    expected = Row(len(found.names))
    some = slice(image * STEP, image * STEP + SEEN)
    np.testing.assert_allclose(found.descriptors(points), expected.descriptors(some), atol=1e-3)
    _, xyz = found.lift(name, np.arange(SEEN))
    np.testing.assert_allclose(xyz, expected.xyz(some), atol=6e-4)
    np.testing.assert_allclose(found.pose(name).translation, [-image, 0, 0], atol=1e-4)
    assert found.camera(name).params.tolist() == CAMERA.params.tolist()


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="needs /proc/self/smaps")
def test_a_query_touches_what_its_images_need(tmp_path):
    """Opening touches the header, and an image about 40 kB and what is around, wherever it is."""
    path = written(tmp_path / "a.hlm", 4000)
    found = CompactMap(path)
    assert touched(path) < PAGES
    for image in (3, 2000, 3990):
        before = touched(path)
        use(found, image)
        assert 1000 < touched(path) - before < 4 * PAGES
    assert touched(path) < 0.3 * path.stat().st_size
    assert len(found.names) == 4000 and found.names[-1] == "camera/003999.jpg"


def test_retrieval_of_many_images(tmp_path, monkeypatch):
    """The first signs of all images are read, all signs of few, and the same images are found."""
    number = 6000
    whole = CompactMap(written(tmp_path / "a.hlm", number))
    monkeypatch.setattr(signs, "FEW", 1000)
    found = CompactMap(written(tmp_path / "b.hlm", number))
    descriptors = whole.global_descriptors()
    generator = np.random.default_rng(1)
    for image in (0, 7, 1500, 2999):
        noise = generator.standard_normal(64 * DIM).astype(np.float32) / 64
        query = descriptors[image] + 2 * noise
        rows, similarity = whole.retrieve(query, 5)
        assert rows[0] == image and (np.diff(similarity) <= 0).all()
        some, same = found.retrieve(query, 5)
        assert some[0] == image and same[0] == pytest.approx(similarity[0], rel=1e-5)
    np.testing.assert_array_equal(found.global_descriptors(), descriptors)
    use(found, 1234)
