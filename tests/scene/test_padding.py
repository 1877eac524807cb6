"""The pad that a source running over the edge of the images needs."""

import logging

import numpy as np
import pytest

import lnocl
from lnocl.scene.padding import recommend_pad
from lnocl.scene.scene import Scene

Y, X = np.indices((41, 41)) - 20
SIGMA = 3.0
GAUSSIAN = np.exp(-(X**2 + Y**2) / (2 * SIGMA**2))


def observe(psfs=GAUSSIAN, shape=(64, 64)):
    return lnocl.Observation(np.ones((len(psfs) if psfs.ndim == 3 else 1, *shape)), psfs)


def test_it_is_the_radius_of_nine_tenths_of_the_light():
    # Of a Gaussian 1 - exp(-r^2 / 2 sigma^2) lies within r; whole pixels round it up.
    assert recommend_pad(observe()) == int(np.ceil(SIGMA * np.sqrt(2 * np.log(10))))
    light = GAUSSIAN / GAUSSIAN.sum()
    radius = recommend_pad(observe())
    assert light[np.hypot(X, Y) <= radius].sum() >= 0.9
    assert light[np.hypot(X, Y) <= radius - 1].sum() < 0.9


def test_the_widest_psf_counts():
    wide = np.exp(-(X**2 + Y**2) / (2 * 5.0**2))
    assert recommend_pad(observe(np.array([GAUSSIAN, wide]))) == recommend_pad(observe(wide)) > 7


def test_at_most_half_the_shorter_side_and_at_least_one():
    assert recommend_pad(observe(shape=(8, 200))) == 4
    assert recommend_pad(observe(np.ones((1, 1)))) == 1
    assert recommend_pad(observe(shape=(1, 64))) == 1


@pytest.mark.parametrize("engine", ["numpy", pytest.param("opencl", marks=pytest.mark.exhaustive)])
def test_auto_is_that_pad_and_is_announced(engine, caplog):
    observation = observe()
    with caplog.at_level(logging.INFO, "lnocl"):
        found = lnocl.deconvolve(observation, pad="auto", n_iter=2, engine=engine)
    assert "pad: 7 pixels, by the PSFs" in caplog.messages
    expected = lnocl.deconvolve(observation, pad=7, n_iter=2, engine=engine)
    np.testing.assert_array_equal(found.extended, expected.extended)
    assert Scene(observation, pad="auto").grid == (128, 128)


def test_source_that_runs_over_the_edge_is_found_with_it():
    """A slope of light, bright at one edge: periodic, its end leaks into its beginning."""
    rng = np.random.default_rng(0)
    sky = np.broadcast_to(np.linspace(0.0, 400.0, 64), (64, 64))
    blurred = np.array([np.convolve(np.pad(row, 20, "edge"), GAUSSIAN[20], "valid") for row in sky])
    observation = lnocl.Observation(
        rng.poisson(blurred / GAUSSIAN[20].sum() + 20), GAUSSIAN, background=20.0
    )
    errors = {}
    for pad in (0, "auto"):
        found = lnocl.deconvolve(observation, pad=pad, n_iter=30, engine="numpy").extended
        errors[pad] = np.sqrt(np.mean((found - sky)[10:-10, -10:] ** 2))
    assert errors["auto"] < errors[0] / 8  # measured a twentieth
