import pytest

from hloc_reduce.evaluation import published
from hloc_reduce.utils.parsers import parse_query_lists


def test_published_numbers():
    assert published.hpatches()["sift_sv64"].keys() == {"matching", "verification", "retrieval"}
    assert len(published.hpatches()) == len(published.localization()) == 68
    assert published.localization()["sift"]["aachen_day_0.25m_2deg"] == 88.1


def test_small_maps():
    found = {row["method"]: row for row in published.small_maps()}
    assert found["R-SCoRe"]["night_0.25m_2deg"] == "64.3" and found["R-SCoRe"]["mb"] == "47"
    assert all(row["counted"] and row["source"] for row in found.values())
    assert found["D-PQED"]["counted"] == "descriptors alone"


def numbered(folder, number):
    return [f"{folder}/{i}.jpg" for i in range(number)]


DAY, NIGHT = numbered("query/day/milestone", 824), numbered("query/night/nexus5x", 191)
PHOTOS = numbered("query/iphone7", 329)


@pytest.mark.parametrize(
    "lists, expected",
    [
        ({"day_time_queries": DAY, "night_time_queries": NIGHT}, "Aachen Day-Night v1.1"),
        ({"day_time_queries": DAY, "night_time_queries": NIGHT[:98]}, None),  # v1.0
        ({"day_time_queries": DAY}, None),
        ({"day_time_queries": numbered("query", 824), "night_time_queries": NIGHT}, None),
        ({"DUC1": PHOTOS[:198], "DUC2": PHOTOS[198:]}, "InLoc"),
        ({"DUC1": PHOTOS[:8], "DUC2": PHOTOS[8:16]}, None),
        ({"query": PHOTOS}, None),
        ({}, None),
    ],
)
def test_a_data_set_is_known_by_its_queries(lists, expected):
    assert published.dataset(lists) == expected


def test_real_lists_are_told_apart(herz_jesus):
    found = {}
    for folder in (herz_jesus / "queries", herz_jesus.parents[1] / "aachen_v1.1"):
        queries = parse_query_lists(folder / "*_time_queries_with_intrinsics.txt")
        lists = {name: [query for query, _ in part] for name, part in queries.items()}
        found[folder.name] = published.dataset(lists)
    assert found == {"queries": None, "aachen_v1.1": "Aachen Day-Night v1.1"}
