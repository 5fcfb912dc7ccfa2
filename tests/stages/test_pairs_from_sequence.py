"""Pairs of neighbours in a sequence, and of frames that see the same again."""

import h5py
import numpy as np
import pytest
from command import refused
from command import run as run_command

from hloc_reduce import pairs_from_sequence
from hloc_reduce.utils.cli import InputError
from hloc_reduce.utils.parsers import parse_pairs


def write(path, angles):
    """Write global descriptors of frames 0.jpg, 1.jpg, ... that look in directions, in degrees."""
    with h5py.File(path, "w") as file:
        for number, angle in enumerate(np.radians(angles)):
            vector = [0, 0] if np.isnan(angle) else [np.cos(angle), np.sin(angle)]
            file[f"{number}.jpg/global_descriptor"] = np.array(vector, np.float32)
    return path


def steps(pairs):
    """Return the numbers of the frames of pairs."""
    return {tuple(int(name.removesuffix(".jpg")) for name in pair) for pair in parse_pairs(pairs)}


def test_neighbours_by_number_and_by_powers_of_two(tmp_path):
    descriptors = write(tmp_path / "global.h5", range(40))
    found = steps(pairs_from_sequence.main(descriptors, tmp_path / "pairs.txt", 0, overlap=6))
    expected = {(i, i + step) for step in (1, 2, 3, 4, 5, 6, 8, 16, 32) for i in range(40 - step)}
    assert found == expected  # "10.jpg" comes after "9.jpg"
    every = steps(pairs_from_sequence.main(descriptors, tmp_path / "all.txt", 0, overlap=10**5))
    assert len(every) == 40 * 39 / 2  # without ado: 2 ** 10**5 is a large number


@pytest.mark.parametrize("block", [256, 3])
def test_a_turn_is_closed(tmp_path, monkeypatch, block):
    """Frames 0 to 35 turn once around by 10 degrees each, 36 to 39 see 0 to 3 again."""
    monkeypatch.setattr(pairs_from_sequence, "FRAMES_PER_BLOCK", block)
    descriptors = write(tmp_path / "global.h5", [10 * i for i in range(40)])
    plain = steps(pairs_from_sequence.main(descriptors, tmp_path / "plain.txt", 0, 2))
    found = steps(pairs_from_sequence.main(descriptors, tmp_path / "pairs.txt", 1, 2))
    assert {(i, i + 36) for i in range(4)} <= found - plain
    assert found > plain and all(j - i > 2 for i, j in found - plain)
    again = steps(pairs_from_sequence.main(descriptors, tmp_path / "pairs.txt", 1, 2))
    assert again == found


def test_frames_without_features_close_no_loop(tmp_path):
    descriptors = write(tmp_path / "global.h5", [0, 90, 180, np.nan, 270, 45])
    found = steps(pairs_from_sequence.main(descriptors, tmp_path / "pairs.txt", 9, 1))
    assert {pair for pair in found if 3 in pair} == {(2, 3), (3, 4)}
    assert len(found) == 10 + 2  # all pairs of the other five, and its own


def test_wrong_input(tmp_path, monkeypatch, caplog):
    descriptors, output = write(tmp_path / "global.h5", [0, 1, 2]), tmp_path / "pairs.txt"
    for arguments, message in (
        ({"image_list": ["0.jpg"]}, "a sequence has two frames or more, not 1"),
        ({"image_list": ["0.jpg", "7.jpg"]}, "7.jpg is not in"),
        ({"num_matched": -1}, "num_matched is -1: at least 0"),
        ({"overlap": 0}, "overlap is 0: at least 1"),
    ):
        with pytest.raises(InputError, match=message):
            pairs_from_sequence.main(descriptors, output, **arguments)
    given = ("--descriptors", descriptors, "--output", output)
    run_command(monkeypatch, pairs_from_sequence, *given, "--overlap", 1)
    assert steps(output) == {(0, 1), (1, 2), (0, 2)}
    none = ("--descriptors", tmp_path / "no.h5", "--output", output)
    assert "no.h5" in refused(monkeypatch, caplog, pairs_from_sequence, *none)
