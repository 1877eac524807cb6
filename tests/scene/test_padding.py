"""The pad that a source running over the edge of the images needs."""

import logging

import numpy as np
import pytest
from scenes import paper

import lnocl
from lnocl.core.scene.padding import choose_pad, recommend_pad
from lnocl.core.scene.scene import Scene

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
    observation = lnocl.Observation(np.random.default_rng(0).poisson(9.0, (64, 64)), GAUSSIAN)
    with caplog.at_level(logging.DEBUG, "lnocl"):
        found = paper(observation, pad="auto", n_iter=2, engine=engine)
    words = "pad chosen: 7 pixels, as light runs over the edge of the images"
    assert words in caplog.messages
    expected = paper(observation, pad=7, n_iter=2, engine=engine)
    np.testing.assert_array_equal(found.extended, expected.extended)
    assert Scene(observation, pad="auto").grid == (80, 80)


def test_auto_is_no_pad_where_no_light_runs_over_the_edge(caplog):
    """Of noise alone, and of a star in the middle: fresh images, none over."""
    for seed in range(100):
        images = np.random.default_rng(seed).poisson(20.0, (2, 60, 64)).astype(float)
        images[:, 30:33, 30:33] += 500.0
        images[:, 0, seed % 60 : seed % 60 + 3] = np.nan if seed % 2 else 20.0
        mask = np.isnan(images)
        observation = lnocl.Observation(np.ma.masked_array(images, mask), GAUSSIAN, background=20.0)
        assert choose_pad(observation) == 0
    with caplog.at_level(logging.DEBUG, "lnocl"):
        assert Scene(observation, pad="auto").grid == (64, 64)
    words = "pad chosen: 0 pixels, as no light runs over the edge of the images"
    assert words in caplog.messages


def test_auto_makes_room_for_offsets():
    images = np.random.default_rng(3).poisson(20.0, (2, 64, 64))
    given = {"background": 20.0, "offsets": [(0.0, 0.0), (1.3, -2.4)]}
    assert choose_pad(lnocl.Observation(images, GAUSSIAN, **given)) == 3


@pytest.mark.parametrize("edge", [np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]])
def test_light_at_any_edge_of_any_image_is_found(edge):
    images = np.random.default_rng(1).poisson(20.0, (2, 60, 70)).astype(float)
    images[1][edge][-9:] += 30.0
    level = np.full((2, 60, 70), 20.0)
    for background in (20.0, level):
        observation = lnocl.Observation(images, GAUSSIAN, background=background)
        assert choose_pad(observation) == recommend_pad(observation) == 7
    level[1][edge][-9:] += 30.0
    assert choose_pad(lnocl.Observation(images, GAUSSIAN, background=level)) == 0


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
        found = paper(observation, pad=pad, n_iter=30, engine="numpy").extended
        errors[pad] = np.sqrt(np.mean((found - sky)[10:-10, -10:] ** 2))
    assert errors["auto"] < errors[0] / 8  # measured a twentieth


def test_where_light_runs_over_an_edge_it_is_no_less_than_the_offsets():
    images = np.full((2, 64, 64), 90.0)
    images[:, 0, 20:40] += 900.0
    offsets = np.array([(0.0, 0.0), (19.4, -3.0)])
    given = lnocl.Observation(images, GAUSSIAN, background=90.0, offsets=offsets)
    assert choose_pad(given) == 20 > recommend_pad(given)
