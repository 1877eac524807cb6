"""Amounts and places by least squares, beside NumPy's and the truth."""

import numpy as np
import pytest

from lnocl.core.scene.shifting import ENDLESS, MovablePsf
from lnocl.detection.fitting import amounts, fit

SHAPE = (25, 27)


def lopsided(x, y, shape=SHAPE):
    """Return a PSF without symmetry at a place, of unit sum, and wide enough for its pixels."""
    rows, columns = np.indices(shape)
    parts = ((1.0, 0.0, 0.0, 1.5), (0.3, 1.2, -0.8, 1.8))
    light = sum(
        share * np.exp(-((columns - x - dx) ** 2 + (rows - y - dy) ** 2) / (2 * sigma**2))
        for share, dx, dy, sigma in parts
    )
    return light / (2 * np.pi * (1.5**2 + 0.3 * 1.8**2))


MOVABLE = MovablePsf(lopsided(12, 12, (25, 25)), ENDLESS)


def star(x, y):
    return MOVABLE.with_slopes(x, y).add_to(np.zeros((3, *SHAPE)), (0, 0), ENDLESS)


def test_amounts_match_weighted_least_squares_and_are_zero_for_dark_images():
    rng = np.random.default_rng(4)
    parts, light = rng.normal(size=(3, *SHAPE)), rng.normal(size=SHAPE)
    weights = rng.uniform(0.1, 2.0, SHAPE) * (rng.random(SHAPE) > 0.2)
    parts[2] *= 1e6  # units do not matter
    matrix = parts.reshape(3, -1) * weights.ravel()
    expected = np.linalg.solve(matrix @ parts.reshape(3, -1).T, matrix @ light.ravel())
    found = amounts([*parts, np.zeros(SHAPE)], light, weights)
    np.testing.assert_allclose(found, [*expected, 0.0], rtol=1e-10)


@pytest.mark.parametrize("level", [0.0, 7.0])
def test_fluxes_and_places_are_those_that_made_the_image(level):
    places, fluxes = np.array([(11.3, 10.8), (15.1, 13.4)]), np.array([500.0, 200.0])
    light = level + sum(flux * lopsided(*place) for flux, place in zip(fluxes, places, strict=True))
    weights = np.ones(SHAPE)
    weights[10, 12] = light[10, 12] = 0.0  # a bad pixel
    start = places + np.array([(0.6, -0.5), (-0.4, 0.7)])
    found, found_fluxes = fit(star, start, np.zeros(2), light, weights, [np.ones(SHAPE)])
    np.testing.assert_allclose(found, places, atol=1e-4)
    np.testing.assert_allclose(found_fluxes, fluxes, rtol=1e-4)


def test_places_err_by_as_much_as_the_noise_says():
    rng, place, errors = np.random.default_rng(6), np.array([(12.2, 11.6)]), []
    clean = 1000.0 * lopsided(*place[0])
    _, along_x, along_y = 1000.0 * star(*place[0])
    stated = np.array([np.sum(along_x**2), np.sum(along_y**2)]) ** -0.5
    for _ in range(60):
        light = clean + rng.normal(size=SHAPE)
        found, _ = fit(star, place + 0.2, np.array([900.0]), light, np.ones(SHAPE), n_steps=4)
        errors.append((found[0] - place[0]) / stated)
    assert np.std(errors) == pytest.approx(1.0, abs=0.2)
    assert abs(np.mean(errors)) < 0.3
