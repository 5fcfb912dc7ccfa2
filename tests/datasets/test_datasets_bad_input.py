"""Hostile files of data sets are read or refused."""

import pytest
from hostile import check_text

from hloc_reduce.datasets import phototour, scans

# what is read: its file, the lines of a sound one, and the parser of its path
TEXTS = {
    "transformation": (
        "t.txt",
        ["before", *[""] * 6, "1 0 0 5", "0 1 0 6", "0 0 1 7", "0 0 0 1"],
        scans.read_transformation,
    ),
    "points of PhotoTour": (
        "info.txt",
        ["0 0", "0 0", "1 0", "1 0"],
        lambda path: phototour.read_points(path.parent),
    ),
    "pairs of PhotoTour": (
        phototour.PREFERRED_PAIRS,
        ["0 0 0 1 0 0 0", "0 0 0 2 1 0 0"],
        lambda path: phototour.read_pairs(path.parent),
    ),
}


@pytest.mark.parametrize("kind", TEXTS)
def test_text_files_are_read_or_refused(kind, tmp_path):
    (tmp_path / "patches0000.bmp").touch()  # beside the points
    name, lines, read = TEXTS[kind]
    check_text(tmp_path / name, lines, read)
