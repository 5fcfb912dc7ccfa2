"""Photos whose poses contradict their matches."""

import pycolmap
import pytest
from row_of_photos import row

from hloc_reduce.mapping.checks import Inputs, misplaced
from hloc_reduce.mapping.findings import names_in
from hloc_reduce.mapping.plausibility import keep_plausible


@pytest.mark.parametrize(("turned", "worst"), [({}, []), ({2: 0.1}, []), ({2: 5.0}, ["2.jpg"])])
def test_the_pose_that_contradicts_most_matches(turned, worst):
    model, verified = row(turned)
    assert sorted(names_in(misplaced.find(Inputs(model, verified)))) == worst


def test_few_matches_are_no_evidence():
    model, verified = row({2: 5.0})
    few = {pair: rows[:14] for pair, rows in verified.items()}
    for matches in (few, {}, None):
        assert misplaced.find(Inputs(model, matches)) == []


def test_groups_that_contradict_each_other():
    """Each agrees with itself, and all of its photos with most of their matches."""
    model, verified = row({3: 5.0, 4: 5.0, 5: 5.0})
    across = {(f"{i}.jpg", f"{j}.jpg") for i in (3, 4, 5) for j in (0, 1, 2)}
    verified = {pair: rows[:20] if pair in across else rows for pair, rows in verified.items()}
    assert names_in(misplaced.find(Inputs(model, verified))) in (
        {"0.jpg", "1.jpg", "2.jpg"},
        {"3.jpg", "4.jpg", "5.jpg"},
    )


def test_misplaced_photos_are_left_out_of_a_map():
    """Two sides of a castle were joined by a few wrong matches, the second one bent."""
    model, verified = row({1: 5.0, 4: -8.0})
    given = {1: pycolmap.Camera(model.cameras[1].todict())}
    (kept,), (dropped,) = keep_plausible([Inputs(model, verified, cameras=given)])
    assert dropped.names == ("1.jpg", "4.jpg") and dropped.kind == "misplaced"
    assert kept.num_reg_images() == 4
