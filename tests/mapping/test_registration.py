"""What is said of the images that are in a model of photos alone."""

import json

import pytest

from hloc_reduce.mapping import registration
from hloc_reduce.utils.cli import InputError


@pytest.mark.parametrize("number", [8, 14, 16])
@pytest.mark.parametrize("spread", [1.02, 1.18, 1.36])
def test_focal_lengths_that_differ_are_doubted_however_many_are_missing(
    number, spread, tmp_path, caplog
):
    """Of 16 frames 8 were in a map, with focal lengths of 292 to 397 pixels."""
    state = {
        "images": 16,
        "missing": [f"{i}.jpg" for i in range(number, 16)],
        "parts": [[f"{i}.jpg" for i in range(number)]],
        "unmatched": [],
        "implausible": {},
        "alike": True,
        "spread": spread,
    }
    (tmp_path / registration.REGISTRATION).write_text(json.dumps(state))
    if spread > 1.2:
        with pytest.raises(InputError, match=r"factor of 1\.36.* --accept_partial"):
            registration.check(tmp_path, accept_partial=False)
    doubtful = registration.check(tmp_path, accept_partial=spread > 1.2)
    assert doubtful == (spread if spread > 1.1 else 1)
    registration.warn(doubtful)
    assert (f"differ by a factor of {spread}" in caplog.text) == (spread > 1.1)
    assert ("photos are in the map" in caplog.text) == (number == 8)
