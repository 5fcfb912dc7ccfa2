"""What is said of the images that are in a model of photos alone."""

from dataclasses import replace

import pycolmap
import pytest

from hloc_reduce.mapping import mapper, registration
from hloc_reduce.mapping.checks import Inputs, run
from hloc_reduce.mapping.findings import Finding, check_accepted
from hloc_reduce.mapping.registration import Registration
from hloc_reduce.utils import colmap
from hloc_reduce.utils.cli import InputError


def judged(number, images, left_out=(), **changed):
    """Judge the registration of the first ones of some images."""
    known = {
        "images": images,
        "missing": [f"{i}.jpg" for i in range(number, images)],
        "parts": [[f"{i}.jpg" for i in range(number)]],
        "unmatched": [],
        "dropped": [],
        "alike": False,
    }
    registered = Registration(**known | changed, left_out=left_out)
    return run(Inputs(None, registration=registered), ["partial", "focal_lengths"])


def test_a_registration_is_written_and_read(tmp_path):
    dropped = [Finding("few_points", "few: {names}", ("b",), {"b": 7.0}, "drop")]
    known = Registration(3, [["a", "c"]], ["b"], [], dropped, True, 1.2, 4)
    known.write(tmp_path)
    file = tmp_path / registration.REGISTRATION
    assert registration.read(tmp_path, {"x"}) == replace(known, left_out={"x"}, file=file)


@pytest.mark.parametrize("number", [8, 14, 16])
@pytest.mark.parametrize("spread", [1.02, 1.18, 1.36])
def test_focal_lengths_that_differ_are_doubted_however_many_are_missing(number, spread):
    """Of 16 frames 8 were in a map, with focal lengths of 292 to 397 pixels."""
    found = {one.kind: one for one in judged(number, 16, alike=True, spread=spread)}
    assert ("partial" in found) == (number < 16)
    assert ("focal_lengths" in found) == (spread > 1.1)
    if spread > 1.1:
        assert f"differ by a factor of {spread}" in found["focal_lengths"].message
        assert found["focal_lengths"].verdict == ("refuse" if spread > 1.2 else "warn")
    assert "focal_lengths" not in {one.kind for one in judged(number, 16, spread=spread)}


def test_all_that_is_refused_is_said_at_once(caplog):
    """Because one option accepts it all."""
    found = judged(4, 16, alike=True, spread=1.5)
    found.append(Finding("other", "Another thing is doubtful."))
    with pytest.raises(
        InputError, match=r"^Only 4 of 16 photos .* by a factor of 1\.50\. .* --accept_partial\.$"
    ):
        check_accepted(found, False)
    assert caplog.messages == ["Another thing is doubtful."]  # may be why
    check_accepted(found, True)
    check_accepted(found[2:], False)


@pytest.mark.parametrize(("number", "images"), [(4, 13), (7, 13)])
def test_photos_that_are_left_out_are_not_blamed_for_others(number, images):
    """Two of 15 photos of a facade were blamed although 9 others were missing, too."""
    refused, *others = judged(number, images, ["a.jpg", "b.jpg"])
    assert refused.verdict == "refuse" and all(one.verdict == "warn" for one in others)
    assert refused.message.startswith(f"Only {number} of 15 photos are in the map")
    assert ("2 more are left out" in refused.message) == (number == 4)
    assert ("Left out: a.jpg, b.jpg" in refused.message) == (number == 7)


def test_fewer_than_half_are_refused():
    (refused,) = judged(3, 3, ["d.jpg", "c.jpg", "b.jpg", "a.jpg"])
    assert refused.verdict == "refuse" and refused.doubt == "fewer than half of its photos"
    assert "Only 3 of 7 photos are in the map. Left out: a.jpg, b.jpg" in refused.message
    assert judged(3, 3, ["c.jpg", "b.jpg", "a.jpg"]) == []


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
