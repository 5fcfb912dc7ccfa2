"""Operations on arrays equal NumPy's slow ones."""

import numpy as np
import pytest

from hloc_reduce.utils.arrays import distinct


@pytest.mark.parametrize("length", [0, 1, 2, 500])
def test_distinct_values(length):
    generator = np.random.default_rng(length)
    numbers = generator.integers(-50, 50, length)
    places = numbers - 1j * generator.integers(0, 3, length)
    for values in numbers, places, np.full(length, 7):
        found = distinct(values)
        np.testing.assert_array_equal(found, np.unique(values))
        assert found.dtype == values.dtype
