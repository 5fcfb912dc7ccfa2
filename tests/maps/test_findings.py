"""What may be wrong with a map: one list, from a check to whoever localizes in the map."""

import json

import pycolmap
import pytest
from command import outcome

from hloc_reduce import Localizer, check, maps
from hloc_reduce.mapping.checks import CHECKS, Check, Inputs
from hloc_reduce.mapping.findings import Finding, merged, names_in, staying, without
from pipelines import localize

PIPELINE = localize
DIM = Finding(
    "dim",
    "These photos are dim: {names}. Take them again by day.",
    names=("3.png", "1.png"),
    values={"3.png": 0.1, "1.png": 0.2},
    verdict="warn",
    doubt="photos that are dim",
)


@pytest.fixture
def toy(monkeypatch):
    """Registers a check that finds one thing, with a verdict."""

    def register(verdict):
        found = Finding(DIM.kind, DIM.text, DIM.names, DIM.values, verdict, DIM.doubt)
        monkeypatch.setitem(CHECKS, "dim", Check(lambda inputs: [found] if inputs.names else []))

    return register


def test_a_new_check_is_seen_everywhere(toy, plane, tmp_path, run, caplog, capsys):
    """It is one function and one line in a table."""
    toy("warn")
    images, outputs = plane / "images", tmp_path / "outputs"
    given = "--map", plane / "model", "--map_images", images, "--outputs", outputs
    run(*given, "--query_images", images)
    said = "These photos are dim: 3.png, 1.png. Take them again by day."
    assert caplog.messages.count(said) == 1
    built = maps.Map(outputs / "map")
    assert built.findings == [DIM] and built.doubts == ["photos that are dim"]
    assert json.loads((built.folder / "map.json").read_text())["findings"] == [DIM.to_json()]
    assert outcome(outputs / "queries-images")[0]["map_doubts"] == ["photos that are dim"]
    assert "it has photos that are dim." in caplog.text
    assert Localizer(built.folder).doubts == ["photos that are dim"]
    caplog.clear()
    run(*given)  # opens it
    assert caplog.messages.count(said) == 1
    found, _ = check.main(built.sfm)
    assert found == [DIM]


@pytest.mark.parametrize("verdict", ["refuse", "warn", "drop"])
def test_verdicts(verdict, toy, plane, tmp_path, run, refused, caplog):
    """Photos that were found too late to be dropped stay, with a warning."""
    toy(verdict)
    outputs = tmp_path / "outputs"
    given = "--map_images", plane / "images", "--outputs", outputs, "--camera_mode", "single"
    if verdict == "refuse":
        message = refused(*given)
        assert "are dim: 3.png, 1.png." in message and message.endswith("--accept_partial.")
        assert not (outputs / "map/map.json").exists()
        given += ("--accept_partial",)
    run(*given)
    (found,) = maps.Map(outputs / "map").findings
    assert found.verdict == ("refuse" if verdict == "refuse" else "warn")
    assert found.message in caplog.messages
    assert maps.Map(outputs / "map").doubts == ["photos that are dim"]


def test_findings_are_json_values():
    content = json.loads(json.dumps(DIM.to_json(), allow_nan=False))
    assert Finding.from_json(content) == DIM


@pytest.mark.parametrize(
    "wrong", [{"verdict": "perhaps"}, {"values": {"a": "b"}}, {"names": None}, {"values": [1]}]
)
def test_wrong_findings_are_noticed(wrong):
    with pytest.raises((TypeError, ValueError)):
        Finding.from_json(DIM.to_json() | wrong)
    with pytest.raises(KeyError):
        Finding.from_json({})


def test_photos_leave_findings():
    whole = Finding("bent", "The map is bent.", values={"by": 0.1})
    (rest, same) = without([DIM, whole], {"3.png"})
    assert rest.names == ("1.png",) and rest.values == {"1.png": 0.2} and same == whole
    assert "are dim: 1.png." in rest.message
    assert without([DIM, whole], names_in([DIM])) == [whole]


def test_findings_that_say_the_same_are_one():
    other = Finding(DIM.kind, DIM.text, ("2.png", "3.png"), {"2.png": 0.3}, "warn", DIM.doubt)
    (found,) = merged([DIM, other])
    assert found.names == ("3.png", "1.png", "2.png") and len(found.values) == 3
    assert merged([DIM, Finding("other", DIM.text)])[1].kind == "other"


def test_only_photos_that_stay_are_doubted():
    dropped = Finding(DIM.kind, DIM.text, DIM.names, DIM.values, "drop", DIM.doubt)
    assert staying([dropped]) == [DIM]


def test_the_table_knows_the_kinds_and_what_they_need():
    """Without what a check needs, it finds nothing."""
    for kind, one in CHECKS.items():
        assert {*one.needs} <= {*Inputs.__dataclass_fields__} and kind.isidentifier()
        if one.needs:
            assert one.find(Inputs(pycolmap.Reconstruction())) == []
