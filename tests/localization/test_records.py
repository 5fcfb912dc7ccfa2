"""Records of queries."""

from hloc_reduce.localization.records import pose_of


def test_records_of_failed_queries_have_no_pose():
    assert pose_of({"qvec": None, "tvec": None}) is None
