"""Answers that are kept, by what functions are given."""

from threading import Thread

import numpy as np
import pytest

from lnocl.core.scene.remembered import LEAST, remembered
from lnocl.core.scene.shifting import MovablePsf


def counted(most):
    """Return a function that doubles what it gets, and what it was asked for."""
    asked = []

    @remembered(most)
    def double(values, *, times=2.0):
        asked.append(values)
        return values * times

    return double, asked


def test_equal_values_are_asked_once_and_others_again():
    double, asked = counted(2**20)
    values = np.arange(6.0).reshape(2, 3)
    first, again = double(values), double(values.copy())
    assert again is first
    for other in (
        np.nextafter(values, 9.0),
        values.reshape(3, 2),
        values.astype(np.float32),
        values.T,
    ):
        double(other)
    double(values, times=3.0)
    assert len(asked) == 6
    np.testing.assert_array_equal(double(values[:, ::-1]), 2 * values[:, ::-1])


def test_an_answer_cannot_be_written_to():
    double, _ = counted(2**20)
    with pytest.raises(ValueError, match="read-only"):
        double(np.ones(3))[0] = 5.0


def test_oldest_results_are_dropped_from_a_full_cache():
    double, asked = counted(2 * (LEAST + 8 * 1000) + 1)
    one, two, three = (np.full(1000, float(k)) for k in range(3))
    double(one)
    double(two)
    double(one)  # which is newer now
    double(three)
    double(one)
    assert len(asked) == 3
    double(two)
    assert len(asked) == 4
    double(np.zeros(10**5))  # larger than all that is kept
    double(np.zeros(10**5))
    assert len(asked) == 6


def test_cached_objects_are_compared_by_their_contents():
    asked = []

    @remembered(2**20)
    def total(psf):
        asked.append(psf)
        return float(psf.at(3, 3).values.sum())

    psf = np.full((3, 3), 1 / 9)
    for each, grid in ((psf, (8, 8)), (psf.copy(), (8, 8)), (2 * psf, (8, 8)), (psf, (9, 8))):
        total(MovablePsf(each, grid))
    assert len(asked) == 3


def test_cache_returns_correct_results_in_several_threads():
    double, _ = counted(4 * LEAST)
    wrong = []

    def ask(seed):
        for k in np.random.default_rng(seed).integers(0, 9, 300):
            if not (double(np.full(4, float(k))) == 2.0 * k).all():
                wrong.append(k)

    threads = [Thread(target=ask, args=(seed,)) for seed in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert not wrong
