"""Hostile names do not lead a report out of its folder."""

from hloc_reduce import report


def test_nothing_is_written_outside_the_folder_of_pictures(tmp_path):
    """Reports name pictures after queries, whose names may come from a file that was changed."""
    folder = tmp_path / "pictures"
    shown = {"label": "../../run", "jpeg": b""}
    queries = ["../../a.jpg", "/etc/x.jpg", "..", "a/b.jpg", "a\0b.jpg"]
    drawn = [{"query": name, "drawn": [{**shown, "jpeg": b"AAAA"}]} for name in queries]
    report._write_pictures(folder, {}, drawn)
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert written and {path.parent for path in written} == {folder}
