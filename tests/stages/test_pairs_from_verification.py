"""Further pairs by verified matches: what is refused, and what counts as verified."""

from itertools import combinations

import cv2
import h5py
import numpy as np
import pycolmap
import pytest

from hloc_reduce import pairs_from_verification
from hloc_reduce.mapping import database
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.triangulation import read_matches
from hloc_reduce.utils import colmap, parsers
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.match_files import names_to_pair


def test_a_pair_of_an_image_that_is_not_listed_is_refused(tmp_path):
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((8, 8), np.uint8))
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("a.png c.png\n")
    files = [tmp_path / name for name in ("features.h5", "matches.h5", "global.h5")]
    for file in files:
        file.write_bytes(b"")
    with pytest.raises(InputError, match="pairs.txt: c.png is not in the list of images"):
        pairs_from_verification.main(
            tmp_path / "more.txt", tmp_path, pairs, *files, 2, 2, image_list=["a.png", "b.png"]
        )


@pytest.fixture
def walls(tmp_path):
    """Photos of two walls that a camera passes by, all with a logo: pairs, and files of these."""
    generator = np.random.default_rng(0)
    logo = generator.uniform([700, 500], [800, 560], (40, 2))
    walls = [generator.uniform([200, 50], [900, 450], (60, 2)) for _ in range(2)]
    names = [f"{place}{i}.png" for place in "ab" for i in range(4)]
    files = [tmp_path / name for name in ("features.h5", "matches.h5", "global.h5")]
    with GroupWriter(files[0], {}) as writer:
        for name in names:
            cv2.imwrite(str(tmp_path / name), np.zeros((750, 1000), np.uint8))
            wall = walls["ab".index(name[0])] + [40 * int(name[1]), 0]
            writer.add(name, {"keypoints": np.concatenate([wall, logo]).astype(np.float32)})
    every = list(combinations(names, 2))
    with GroupWriter(files[1], {}) as writer:
        for a, b in every:
            first = 0 if a[0] == b[0] else 60  # the wall, then the logo
            matches0 = np.where(np.arange(100) >= first, np.arange(100), -1).astype(np.int32)
            writer.add(names_to_pair(a, b), {"matches0": matches0})
    with h5py.File(files[2], "w") as file:
        for name in names:
            file[f"{name}/global_descriptor"] = np.eye(2, dtype=np.float32)["ab".index(name[0])]
    parsers.write_pairs(every, tmp_path / "pairs.txt")
    return every, files


def test_a_logo_connects_no_photos(walls, tmp_path):
    every, files = walls
    pairs_from_verification.main(tmp_path / "more.txt", tmp_path, tmp_path / "pairs.txt", *files, 2)
    verified = colmap.count_verified(tmp_path / "matches_verified.db")
    for a, b in every:
        number = verified.get((a, b)) or verified.get((b, a)) or 0
        assert number == (60 if a[0] == b[0] else 0)


def test_pairs_are_verified_once(walls, tmp_path, monkeypatch):
    """Also those of the map that is reconstructed from them; but not those that have changed."""
    every, (features, matches, _) = walls
    asked, verify = [], colmap.verify_matches

    def spy(database, pairs, verbose=False):
        asked.append([*pairs])
        verify(database, asked[-1], verbose)

    monkeypatch.setattr(colmap, "verify_matches", spy)
    auto = pycolmap.CameraMode.AUTO

    def write(name, known, mode=auto, change=None):
        asked.clear()
        names = sorted({name for pair in every for name in pair})
        keypoints, _, found = read_matches(names, tmp_path / "pairs.txt", features, matches, None)
        if change:
            change(keypoints, found)
        path = tmp_path / f"{name}.db"
        database.write(path, tmp_path, keypoints, found, mode, known=known)
        return path

    known = write("known", tmp_path / "missing.db")
    assert asked == [every]
    again = write("again", known)
    assert not asked
    expected, found = colmap.read_verified(known), colmap.read_verified(again)
    assert expected.keys() == found.keys() and expected
    assert all(np.array_equal(found[pair], rows) for pair, rows in expected.items())

    def fewer(keypoints, found):
        found[every[0]] = found[every[0]][1:]

    def moved(keypoints, found):
        keypoints["a0.png"][0, 0] += 1

    def wrong(keypoints, found):
        found[every[0]] = np.random.default_rng(0).permutation(60)[:40].reshape(20, 2)

    unverified = write("wrong", tmp_path / "missing.db", change=wrong)
    assert every[0] not in colmap.read_verified(unverified)
    write("wrong again", unverified, change=wrong)
    assert not asked
    of_first = [pair for pair in every if "a0.png" in pair]
    for change, expected in ((fewer, every[:1]), (moved, of_first)):
        write(change.__name__, known, change=change)
        assert asked == [expected]
    write("lens", known, pycolmap.CameraMode.SINGLE)  # the cameras have the same parameters
    assert not asked
    with colmap.open_database(known) as opened:
        camera = opened.read_all_cameras()[0]
        camera.params = [2 * camera.params[0], *camera.params[1:]]
        opened.update_camera(camera)
    write("zoom", known)
    assert asked == [of_first]
