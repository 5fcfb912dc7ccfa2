"""Names that are time stamps."""

from decimal import Decimal

from hloc_reduce.utils.time_stamps import in_order, name_of, time_stamps


def test_names_of_times_are_sorted_as_these():
    times = [0, 0.04, 9.9996, 12.345, 100, 9999.999, 10000.5]
    names = [name_of(seconds) for seconds in times]
    assert names[3] == "0012.345.jpg" and sorted(names[:-1]) == names[:-1]
    assert [*time_stamps(names).values()][-2:] == [Decimal("9999.999"), Decimal("10000.5")]
    assert in_order(names) == names


def test_all_digits_are_kept():
    found = time_stamps(["cam/1305031102.175304.png", "cam/1403636579763555584.png"])
    assert [*map(str, found.values())] == ["1305031102.175304", "1403636579763555584"]


def test_names_that_are_no_time_stamps():
    assert time_stamps(["1.jpg", "IMG_2.jpg"]) is None
    assert time_stamps(["left/1.jpg", "right/1.0.jpg"]) is None
    assert time_stamps(["-1.jpg"]) is time_stamps(["1e3.jpg"]) is None


def test_numbers_are_in_order_and_other_names_as_they_are_sorted():
    assert in_order(["10.jpg", "9.jpg", "1.5.jpg"]) == ["1.5.jpg", "9.jpg", "10.jpg"]
    assert in_order(["b/2.jpg", "a/10.jpg", "a/9.jpg"]) == ["a/9.jpg", "a/10.jpg", "b/2.jpg"]
    assert in_order(["f10.jpg", "f9.jpg"]) == ["f10.jpg", "f9.jpg"]
