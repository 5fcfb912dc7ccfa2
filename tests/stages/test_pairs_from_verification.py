"""Further pairs by verified matches: what is refused, and what counts as verified."""

from itertools import combinations

import cv2
import h5py
import numpy as np
import pytest

from hloc_reduce import pairs_from_verification
from hloc_reduce.runtime import provenance
from hloc_reduce.runtime.group_writer import GroupWriter
from hloc_reduce.utils import parsers
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


def test_a_logo_connects_no_photos(tmp_path):
    """Two places, each a wall that a camera passes by, with the same logo burnt into all photos."""
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
    pairs_from_verification.main(tmp_path / "more.txt", tmp_path, tmp_path / "pairs.txt", *files, 2)
    verified = provenance.read(tmp_path / "matches_verified.json")["pairs"]
    for a, b in every:
        number = verified["\t".join(sorted((a, b)))]
        assert number == (60 if a[0] == b[0] else 0)
