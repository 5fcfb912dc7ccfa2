"""What is said of the images that are in a model of photos alone."""

import json

import pycolmap
import pytest

from hloc_reduce.mapping import mapper, registration
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError


def register(folder, number, images, **changed):
    """Write that the first ones of some images are in a model."""
    state = {
        "images": images,
        "missing": [f"{i}.jpg" for i in range(number, images)],
        "parts": [[f"{i}.jpg" for i in range(number)]],
        "unmatched": [],
        "implausible": {},
        "alike": False,
        "spread": 1.0,
    }
    (folder / registration.REGISTRATION).write_text(json.dumps(state | changed))


def test_doubts_are_refused(tmp_path):
    register(tmp_path, 16, 16)
    with pytest.raises(InputError, match=r"^One\. Two\. To use .* --accept_partial\.$"):
        registration.check(tmp_path, False, doubts=["One.", "Two."])
    registration.check(tmp_path, True, doubts=["One."])
    register(tmp_path, 4, 16, alike=True, spread=1.5)
    message = r"Only 4 of 16 photos .* by a factor of 1\.50\. .* One\. To use"
    with pytest.raises(InputError, match=message):
        registration.check(tmp_path, False, doubts=["One."])


@pytest.mark.parametrize("number", [8, 14, 16])
@pytest.mark.parametrize("spread", [1.02, 1.18, 1.36])
def test_focal_lengths_that_differ_are_doubted_however_many_are_missing(
    number, spread, tmp_path, caplog
):
    """Of 16 frames 8 were in a map, with focal lengths of 292 to 397 pixels."""
    register(tmp_path, number, 16, alike=True, spread=spread)
    if spread > 1.2:
        with pytest.raises(InputError, match=r"factor of 1\.36.* --accept_partial"):
            registration.check(tmp_path, accept_partial=False)
    doubtful = registration.check(tmp_path, accept_partial=spread > 1.2)
    assert doubtful == (spread if spread > 1.1 else 1)
    registration.warn(doubtful)
    assert (f"differ by a factor of {spread}" in caplog.text) == (spread > 1.1)
    assert ("photos are in the map" in caplog.text) == (number == 8)


def test_all_that_is_refused_is_said_at_once(tmp_path):
    """Because one option accepts it all."""
    register(tmp_path, 4, 16, alike=True, spread=1.5)
    with pytest.raises(
        InputError, match=r"Only 4 of 16 photos .* by a factor of 1\.50\. .*partial"
    ):
        registration.check(tmp_path, False)


@pytest.mark.parametrize(("number", "images"), [(4, 13), (7, 13)])
def test_photos_that_are_left_out_are_not_blamed_for_others(number, images, tmp_path):
    """Two of 15 photos of a facade were blamed although 9 others were missing, too."""
    register(tmp_path, number, images)
    with pytest.raises(InputError, match=f"Only {number} of 15 photos are in the map") as error:
        registration.check(tmp_path, False, left_out=["a.jpg", "b.jpg"])
    assert ("2 more are left out" in str(error.value)) == (number == 4)
    assert ("Left out: a.jpg, b.jpg" in str(error.value)) == (number == 7)


@pytest.mark.parametrize("known", [True, False])
def test_only_the_first_attempt_registers_images_without_points(known, monkeypatch):
    """It takes long, and older versions of COLMAP do not know it."""
    if not known:
        monkeypatch.setattr(mapper, "FALLBACK", "registration_by_magic")
    elif int(pycolmap.__version__.split(".")[0]) < 4:
        pytest.skip("this pycolmap does not register images without points")
    first, *later = mapper.attempts_for(10)
    assert first == {} and len(later) == 7 and len(mapper.attempts_for(31)) == 2
    for changed in later:
        assert changed.get(mapper.FALLBACK) is (False if known else None)
        colmap.mapper_options(changed)
