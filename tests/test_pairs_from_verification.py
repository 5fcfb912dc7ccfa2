"""Further pairs by verified matches: what is refused."""

import cv2
import numpy as np
import pytest

from hloc_reduce import pairs_from_verification
from hloc_reduce.utils.cli import InputError


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
