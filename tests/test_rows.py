"""Arithmetic by columns says what numpy says along rows."""

import numpy as np
import pytest

from lidarflow import rows


@pytest.fixture
def vectors():
    return np.random.default_rng(3).normal(size=(501, 3))


def test_lengths_are_euclidean(vectors):
    np.testing.assert_allclose(rows.lengths(vectors), np.linalg.norm(vectors, axis=1), rtol=1e-14)
    assert rows.lengths(np.empty((0, 3))).shape == (0,)


def test_one_number_that_is_not_finite_makes_a_vector_not_finite(vectors):
    vectors[3, 0], vectors[5, 1], vectors[7, 2] = np.nan, np.inf, -np.inf
    assert np.flatnonzero(~rows.are_finite(vectors)).tolist() == [3, 5, 7]


def test_what_is_not_finite_becomes_a_gap_as_a_whole(vectors):
    assert rows.whole_or_nan(vectors) is vectors
    vectors[[3, 5]] = np.nan
    assert rows.whole_or_nan(vectors) is vectors
    vectors[7, 2], vectors[9, 0], vectors[11] = np.nan, np.inf, (1.0, -np.inf, np.nan)
    given = vectors.copy()
    found = rows.whole_or_nan(vectors)
    gaps = np.isin(np.arange(len(vectors)), [3, 5, 7, 9, 11])
    assert np.isnan(found[gaps]).all()
    np.testing.assert_array_equal(found[~gaps], given[~gaps])
    np.testing.assert_array_equal(vectors, given)


def test_mean_is_that_of_every_column(vectors):
    np.testing.assert_allclose(rows.mean(vectors), vectors.mean(axis=0), atol=1e-15)


@pytest.mark.parametrize("count", [1, 2, 3, 10, 11])
def test_median_is_that_of_numpy(vectors, count):
    values = vectors[:count, 0]
    assert rows.median(values) == np.median(values)


def test_numbers_lose_their_gaps_and_keep_their_order():
    numbers = np.array([7, 2, 2, 9, 0], np.int32)
    found = rows.without_gaps(numbers)
    assert found.tolist() == [2, 1, 1, 3, 0] and found.dtype == np.int32
    assert rows.without_gaps(np.empty(0, np.int32)).shape == (0,)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 15, 16, 17, 1000])
def test_rows_are_thinned_evenly(count):
    """To so many, to so many at most, and to so many at least; the last two in steps of one size."""
    numbers = np.arange(count)
    spread, sparse, few = rows.spread(numbers, 8), rows.sparse(numbers, 8), numbers[rows.every_few(count, 8)]
    assert len(spread) == min(count, 8) and np.array_equal(spread[-1:], numbers[-1:])
    assert min(count, 5) <= len(sparse) <= 8 and min(count, 8) <= len(few) < 16
    for chosen in (spread, sparse, few):
        sizes = np.unique(np.diff(chosen))
        assert len(sizes) <= (2 if chosen is spread else 1)
        assert np.array_equal(chosen[:1], numbers[:1])
