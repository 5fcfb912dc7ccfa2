"""The best products of integers: compiled code, NumPy and the definition agree."""

import platform
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from hloc_reduce.matchers import integers
from hloc_reduce.utils import best_two
from hloc_reduce.utils.codes import INTEGER_SCALE, MIN_MEAN_NORM, to_integers

LOWEST = np.iinfo(np.int32).min
compiled = pytest.mark.skipif(
    not best_two.instructions(), reason="integer matching was not compiled: no C++ compiler?"
)


def by_definition(rows0, rows1):
    products = rows0.astype(np.int64) @ rows1.astype(np.int64).T
    index = products.argmax(axis=1)
    descending = np.sort(products, axis=1)[:, ::-1]
    second = descending[:, 1] if len(rows1) > 1 else np.full(len(rows0), LOWEST)
    return index, descending[:, 0], second


def draw(number, dim, kind, seed):
    """Rows that are random; of few values, so that many products tie; all equal; or extreme."""
    generator = np.random.default_rng(seed)
    if kind == "extreme":  # the longest rows that there are
        rows = np.zeros((number, dim), np.int16)
        rows[np.arange(number), generator.integers(0, dim, number)] = INTEGER_SCALE / MIN_MEAN_NORM
        return rows * generator.choice([-1, 1], (number, 1)).astype(np.int16)
    if kind == "equal":
        return np.full((number, dim), -3, np.int16)
    low, high = {"random": (-350, 350), "ties": (-1, 2)}[kind]
    return generator.integers(low, high, (number, dim)).astype(np.int16)


SIZES = [(0, 1), (1, 1), (1, 2), (2, 1), (3, 2), (4, 15), (5, 16), (7, 17), (33, 100)]
DIMS = [1, 2, 3, 16, 17, 31, 64, 128]
KINDS = ["random", "ties", "equal", "extreme"]


@compiled
@pytest.mark.parametrize("instruction_set", best_two.instructions())
@pytest.mark.parametrize("kind", KINDS)
def test_each_instruction_set_agrees_with_the_definition(kind, instruction_set):
    for number0, number1 in SIZES:
        for dim in DIMS:
            rows0, rows1 = draw(number0, dim, kind, 0), draw(number1, dim, kind, 1)
            found = best_two.best_two(rows0, rows1, instruction_set)
            for values, right in zip(found, by_definition(rows0, rows1), strict=True):
                assert values.dtype == np.int32
                np.testing.assert_array_equal(values, right)


@compiled
@pytest.mark.parametrize("instruction_set", best_two.instructions())
@pytest.mark.parametrize("kind", KINDS)
def test_the_best_rows_of_both_sides_agree_with_the_definition(kind, instruction_set):
    for number0, number1 in SIZES[1:]:
        for dim in DIMS:
            rows0, rows1 = draw(number0, dim, kind, 0), draw(number1, dim, kind, 1)
            index, best, back = best_two.best_both(rows0, rows1, instruction_set)
            right, highest, _ = by_definition(rows0, rows1)
            assert index.tolist() == right.tolist() and best.tolist() == highest.tolist()
            assert back.tolist() == by_definition(rows1, rows0)[0].tolist()


@pytest.mark.check
@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64") or not shutil.which("c++"),
    reason="needs a C++ compiler on x86-64",
)
def test_the_code_for_compilers_without_vector_types(tmp_path, monkeypatch):
    """Such as MSVC's, as far as another compiler can tell."""
    source, library = Path(best_two.__file__).with_suffix(".cpp"), tmp_path / "best_two.so"
    flags = "-shared -fPIC -O3 -std=c++17 -DWITHOUT_VECTOR_TYPES -mavx2 -Wall -Wextra -Werror"
    subprocess.run(["c++", *flags.split(), source, "-o", library], check=True)
    monkeypatch.setattr(best_two, "_library", lambda: best_two._load(library))
    monkeypatch.setattr(best_two, "_numbers", best_two._numbers.__wrapped__)
    assert best_two.instructions() in (["AVX2", "plain"], ["plain"])
    for instruction_set in best_two.instructions():
        for kind in KINDS:
            test_each_instruction_set_agrees_with_the_definition(kind, instruction_set)
            test_the_best_rows_of_both_sides_agree_with_the_definition(kind, instruction_set)


@pytest.mark.parametrize("kind", KINDS)
def test_numpy_agrees_with_the_definition(kind, monkeypatch):
    """Whatever the machine; in blocks of a few rows."""
    monkeypatch.setattr(integers, "TILE_PRODUCTS", 100)
    for number0, number1 in SIZES[1:]:
        for dim in DIMS:
            rows0, rows1 = draw(number0, dim, kind, 0), draw(number1, dim, kind, 1)
            index, best, second = integers.best_two_of_blocks(rows0, rows1)
            right = by_definition(rows0, rows1)
            assert index.tolist() == right[0].tolist()
            assert best.tolist() == right[1].tolist()
            if number1 > 1:
                assert second.tolist() == right[2].tolist()


@compiled
def test_rows_that_are_not_contiguous():
    rows0, rows1 = draw(20, 40, "random", 0)[::2, ::2], draw(40, 20, "random", 1).T[:, ::2]
    found = best_two.best_two(rows0, rows1)
    for values, right in zip(found, by_definition(rows0, rows1), strict=True):
        np.testing.assert_array_equal(values, right)


def test_integers_are_close_and_their_products_fit():
    for dim in (1, 16, 128):
        vectors = np.random.default_rng(dim).standard_normal((1000, dim)).astype(np.float32)
        vectors[0] = 1  # the worst: each number is rounded in the same direction
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        integers = to_integers(vectors)
        assert integers.dtype == np.int16
        np.testing.assert_allclose(integers / INTEGER_SCALE, vectors, atol=0.51 / INTEGER_SCALE)
        assert (integers.astype(np.int64) ** 2).sum(axis=1).max() < MIN_MEAN_NORM**2 * 2**30
