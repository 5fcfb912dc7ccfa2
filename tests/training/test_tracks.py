"""Training data from photos with poses: a textured plane seen by five cameras."""

import shutil
from concurrent.futures import ThreadPoolExecutor

import cv2
import h5py
import numpy as np
import pycolmap
import pytest
import torch
from interruption import interrupted

from hloc_reduce.confs import features
from hloc_reduce.runtime.outputs import Lock
from hloc_reduce.training import describers, tracks
from hloc_reduce.training.completion import Completion
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.colmap import detect_dog, point3D_ids


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """Where the tracks of `tracked` are kept."""
    return tmp_path_factory.mktemp("kept") / "plane"


@pytest.fixture
def tracked(plane, kept):
    """The plane with its tracks in `out`, computed once; not to be changed."""
    if not kept.exists():
        tracks.main(plane / "images", plane / "model", plane / "out")
        # the tracks are those of the folders that they were computed from
        (plane / "out/source.json").unlink()
        shutil.copytree(plane, kept)
    return kept


def test_tracks_of_a_plane(tracked):
    data = tracks.load(tracked / "out/tracks_sift.safetensors")
    assert data.num_tracks > 100
    assert data.descriptors.shape == (len(data.track), 2, describers.VARIANTS, 128)
    assert (np.diff(data.track) >= 0).all() and data.track[0] == 0
    # the photo's descriptors are those of the feature file, found again by their places
    with h5py.File(tracked / "out/feats-dog-sift.h5") as file:
        for number in range(5):
            group = file[f"{number}.png"]
            stored = group["descriptors"][()].T.astype(np.float32)
            keypoints = group["keypoints"][()]
            mine = np.flatnonzero(data.image == number)
            for i in mine[:20]:
                near = np.abs(keypoints - data.xy[i]).max(axis=1) < 1e-4
                best = (stored[near] @ data.descriptors[i, 0, 0].astype(np.float32)).max()
                assert best > 0.999
    photos = data.descriptors[:, 0, 0].astype(np.float32)
    follows = np.flatnonzero(np.diff(data.track) == 0)
    similarity = (photos[follows] * photos[follows + 1]).sum(1)
    assert np.median(similarity) > 0.9
    mirrored = data.descriptors[:, 1, 0].astype(np.float32)
    similarity = (mirrored[follows] * mirrored[follows + 1]).sum(1)
    assert np.median(similarity) > 0.9
    assert np.median((mirrored * photos).sum(1)) < 0.9
    # the gradients along the keypoint's orientation stay so, those across it change sign
    bins = mirrored.reshape(-1, 8, 4, 4).sum((2, 3))[:, [0, 7, 6, 5, 4, 3, 2, 1]]
    np.testing.assert_allclose(bins, photos.reshape(-1, 8, 4, 4).sum((2, 3)), atol=0.02)
    # what descriptors matched is what the triangulated model has
    model = pycolmap.Reconstruction(tracked / "out/sfm_sift")
    assert data.matched.sum() == model.compute_num_observations()
    assert data.only(data.matched).num_tracks == model.num_points3D()


def test_colmaps_sift_is_mirrored_by_hand(textured):
    """It is what COLMAP finds in the mirrored photo, oriented alike."""
    photo = textured.astype(np.float32) / 255
    options = {"first_octave": 0, "peak_threshold": 0.01}
    keypoints, descriptors = detect_dog(photo, options)
    others, mirrored = detect_dog(np.ascontiguousarray(photo[::-1]), options)
    others[:, 1], others[:, 3] = len(photo) - 1 - others[:, 1], -others[:, 3]
    compared = [
        describers.mirror_colmap_sift(descriptors[i]) @ mirrored[j]
        for i, keypoint in enumerate(keypoints)
        for j in np.flatnonzero(np.abs(others[:, :2] - keypoint[:2]).max(1) < 0.1)
        if abs((others[j, 3] - keypoint[3] + 180) % 360 - 180) < 1
        and abs(others[j, 2] / keypoint[2] - 1) < 0.01
    ]
    assert len(compared) > len(keypoints) / 2 and np.median(compared) > 0.999


def test_tracks_of_colmaps_sift(plane):
    data = tracks.load(tracks.main(plane / "images", plane / "model", plane / "out", "colmap_sift"))
    assert data.num_tracks > 100 and not data.matched.all()
    photos, mirrored = data.descriptors[:, 0], data.descriptors[:, 1]
    assert (describers.mirror_colmap_sift(photos) == mirrored).all()
    assert not (plane / "out/feats-dog-sift.h5").exists()


def test_tracks_are_computed_once_and_the_same(tracked, tmp_path):
    path = tracked / "out/tracks_sift.safetensors"
    content, time = path.read_bytes(), path.stat().st_mtime_ns
    assert tracks.main(tracked / "images", tracked / "model", tracked / "out") == path
    assert path.stat().st_mtime_ns == time
    again = tracks.main(tracked / "images", tracked / "model", tmp_path / "again")
    assert again.read_bytes() == content


@pytest.fixture
def undescribed(tracked, tmp_path):
    """The arguments of `tracks.main` for the plane, whose points are triangulated already."""
    shutil.copytree(tracked / "out", tmp_path / "out", ignore=shutil.ignore_patterns("tracks_*"))
    return tracked / "images", tracked / "model", tmp_path / "out"


def test_description_goes_on_after_an_interruption(tracked, undescribed, monkeypatch):
    """What was described is not described again, and the file is that of an undisturbed run."""
    described = interrupted(monkeypatch, describers.PatchDescriber, "__call__", 3, 5)
    for number in (3, 5):
        with pytest.raises(KeyboardInterrupt):
            tracks.main(*undescribed)
        assert len(described) == number
    path = tracks.main(*undescribed)
    assert len(described) == 5 + 2  # five photos, and those that were interrupted
    assert path.read_bytes() == (tracked / "out" / path.name).read_bytes()
    assert not list(path.parent.glob("*.parts*"))


def test_what_was_described_with_another_seed_is_not_used(undescribed, tmp_path, monkeypatch):
    monkeypatch.setattr(describers, "VARIANTS", 2)
    *folders, output = undescribed
    shutil.copytree(output, tmp_path / "whole")
    described = interrupted(monkeypatch, describers.PatchDescriber, "__call__", 4)
    with pytest.raises(KeyboardInterrupt):
        tracks.main(*undescribed)
    path = tracks.main(*undescribed, seed=1)
    assert len(described) == 4 + 5
    whole = tracks.main(*folders, tmp_path / "whole", seed=1)
    assert path.read_bytes() == whole.read_bytes()


def test_of_two_trainings_at_once_one_waits(tracked, undescribed, caplog):
    *_, output = undescribed
    with ThreadPoolExecutor() as executor, caplog.at_level("INFO", "hloc_reduce"):
        with Lock(output):
            other = executor.submit(tracks.main, *undescribed)
            with pytest.raises(TimeoutError):
                other.result(timeout=0.5)
            assert f"Another run is at work in {output}" in caplog.text
            assert not (output / "tracks_sift.safetensors").exists()
        path = other.result(timeout=60)
    assert path.read_bytes() == (tracked / "out" / path.name).read_bytes()


def test_a_map_without_tracks_is_refused(plane):
    for path in (plane / "images").iterdir():
        cv2.imwrite(str(path), np.full((360, 480), 100, np.uint8))
    with pytest.raises(InputError, match="The map is empty"):
        tracks.main(plane / "images", plane / "model", plane / "out")


def test_hidden_observations_are_found_again_by_geometry(tracked):
    reconstruction = pycolmap.Reconstruction(tracked / "out/sfm_sift")
    images = {image.name: image for image in reconstruction.images.values()}
    keypoints, observed = {}, {}
    with h5py.File(tracked / "out/feats-dog-sift.h5") as file:
        for name in images:
            columns = [file[name][key][()] for key in ("keypoints", "scales", "oris")]
            keypoints[name] = np.column_stack(columns).astype(float)
            keypoints[name][:, :2] += 0.5
            observed[name] = point3D_ids(images[name])
    generator = np.random.default_rng(0)
    hidden = {name: ids.copy() for name, ids in observed.items()}
    for ids in hidden.values():
        ids[generator.random(len(ids)) < 0.2] = -1
    find = Completion(reconstruction, keypoints, hidden)
    completed = {name: find(name) for name in images}
    truth, found = (
        np.concatenate(
            [points[name][(hidden[name] < 0) & (observed[name] >= 0)] for name in images]
        )
        for points in (observed, completed)
    )
    assert len(truth) > 300
    assert (found == truth).mean() > 0.8
    assert ((found != truth) & (found >= 0)).mean() < 0.05
    for name in images:  # what was known stays
        kept = hidden[name] >= 0
        assert (completed[name][kept] == hidden[name][kept]).all()


class Extractor(torch.nn.Module):
    """Finds three keypoints near (1, 2), the last one most alike, and none near (50, 60)."""

    descriptor = "test"

    def forward(self, data):
        assert data["image"].shape[1] == 3
        return {
            "keypoints": torch.tensor([[[200.0, 3], [1, 2], [2, 2], [1, 3]]]),
            "descriptors": torch.eye(256)[None, :, 7:11] + torch.eye(256)[None, :, [9, 9, 9, 0]],
        }


def test_keypoints_are_found_anew_in_variants(monkeypatch):
    monkeypatch.setattr(describers.extractors, "load", lambda _: Extractor())
    describe = describers.FeatureDescriber({"name": "test"})
    known = np.eye(256, dtype=np.float16)[:2]
    keypoints = np.array([[1, 2], [50, 60]], np.float32)
    described = describe(torch.rand(1, 3, 80, 90), keypoints, known, np.random.default_rng(0))
    assert described.shape == (2, 2, describers.VARIANTS, 256) and described.dtype == np.float16
    assert (described[:, :, 0] == known[:, None]).all()
    assert (described[0, :, 1:] == np.eye(256)[10] + np.eye(256)[0]).all()
    assert (described[1, :, 1:] == known[1]).all()


def test_tracks_of_an_extractor(plane, monkeypatch):
    """Its own keypoints; without scales and orientations nothing is completed."""
    monkeypatch.setattr(describers, "VARIANTS", 2)
    conf = features.feature("plain", {"name": "dog", "max_keypoints": 300})
    path = tracks.main(plane / "images", plane / "model", plane / "out", "plain", conf=conf)
    data = tracks.load(path)
    assert path.name == "tracks_plain.safetensors" and data.descriptors.shape[-1] == 128
    assert not data.matched.all()
    # in a variant most are found again, under another light
    photos, variants = data.descriptors[:, 0, 0], data.descriptors[:, 0, 1]
    changed = (photos != variants).any(axis=1)
    assert 0.3 < changed.mean() < 1
    cosine = (photos.astype(np.float32) * variants.astype(np.float32)).sum(1)
    assert np.median(cosine[changed]) > 0.8
    with h5py.File(plane / "out/feats-dog-plain.h5", "a") as file:
        for name in file:
            del file[name]["oris"]
    shutil.rmtree(plane / "out/sfm_plain")
    monkeypatch.setattr(describers, "VARIANTS", 1)
    tracks.main(plane / "images", plane / "model", plane / "out", "plain", conf=conf)
    assert tracks.load(path).matched.all()


def test_photometric_variants_are_images():
    image = np.linspace(0, 1, 40 * 50, dtype=np.float32).reshape(40, 50)
    generator = np.random.default_rng(0)
    views = [describers.photometric_variant(image, generator) for _ in range(30)]
    assert all(view.dtype == np.float32 and view.shape == (40, 50) for view in views)
    assert min(view.max() for view in views) < 0.2 and max(view.mean() for view in views) > 0.4
    assert all(view.min() >= 0 and view.max() <= 1 for view in views)
