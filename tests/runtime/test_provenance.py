"""Provenance notices changed inputs."""

from hloc_reduce.runtime import provenance


def test_stamps_notice_changes(tmp_path):
    source, file = tmp_path / "source", tmp_path / "stamp.json"
    source.write_text("a")
    made_from = provenance.of_inputs({"x": (1, 2)}, [source])
    assert not provenance.is_current(file, made_from)
    provenance.write(file, made_from)
    assert provenance.is_current(file, made_from)
    assert not provenance.is_current(file, provenance.of_inputs({"x": (1, 3)}, [source]))
    source.write_text("ab")
    assert not provenance.is_current(file, provenance.of_inputs({"x": (1, 2)}, [source]))
