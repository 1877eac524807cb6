"""Levels of the background that are fitted with a reconstruction."""

from types import SimpleNamespace

import numpy as np
import pytest

import lnocl
from lnocl.core.runs.outcome import Outcome

N = 64
Y, X = np.indices((N, N), float)
PSF = np.exp(-((X - 32) ** 2 + (Y - 32) ** 2 / 0.7) / 4.0)
PSF += 0.05 * np.exp(-((X - 34) ** 2 + (Y - 31) ** 2) / 6.0)
PSF /= PSF.sum()
STARS, FLUXES, LEVEL = [(20, 44), (47, 12)], [8e3, 3e3], 84.0
GALAXY = np.exp(-np.hypot(X - 30, (Y - 28) / 0.6) / 3.0)
GALAXY *= 1.5e4 / GALAXY.sum()


def an_image(seed, rise=0.0):
    """Return an image of two stars and a galaxy, on a sky that rises along x."""
    spectrum = np.fft.fft2(np.roll(PSF, (-32, -32), (0, 1)))
    light = np.fft.ifft2(spectrum * np.fft.fft2(GALAXY)).real.clip(0)
    for (x, y), flux in zip(STARS, FLUXES, strict=True):
        light += flux * np.roll(PSF, (y - 32, x - 32), (0, 1))
    return np.random.default_rng(seed).poisson(light + LEVEL + rise * (X / (N - 1) - 0.5))


def reconstruct(seed, background, error, rise=0.0, **options):
    observation = lnocl.Observation(
        an_image(seed, rise), PSF, background=background, background_error=error
    )
    return lnocl.deconvolve(observation, STARS, engine="numpy", **options)


@pytest.mark.parametrize("seed", range(3))
def test_the_light_above_a_level_that_is_wrong_is_within_its_error(seed):
    result = reconstruct(seed, LEVEL + 1.0, 1.0, rise=6.0)
    flux, error = result.extended_flux
    assert abs(flux - 1.5e4) < 2.5 * error
    assert error < 1500.0
    level = result._outcome.scene.observation.background
    middle, along_x, along_y = result._outcome.levels[0].errors[0]
    assert abs(level.mean() - LEVEL) < 2.5 * middle < 1.0
    assert abs(level[0, 0, -1] - level[0, 0, 0] - 6.0) < 2.5 * along_x
    assert abs(level[0, -1, 0] - level[0, 0, 0]) < 2.5 * along_y
    assert (abs(result.star_fluxes - FLUXES) < 3.0 * result.star_flux_errors).all()


def test_without_its_error_the_same_level_is_taken_as_known():
    flux, error = reconstruct(0, LEVEL + 1.0, 0.0).extended_flux
    assert flux < 1.5e4 - 4.0 * error


def test_with_a_number_for_smoothing_a_level_stays_and_its_error_is_in_all_errors():
    options = {"smoothing": 0.003, "stop": None, "n_iter": 20}
    known, free = (reconstruct(0, LEVEL, error, **options) for error in (0.0, 0.5))
    np.testing.assert_array_equal(known.extended, free.extended)
    added = np.sqrt(free.extended_flux[1] ** 2 - known.extended_flux[1] ** 2)
    assert added == pytest.approx(0.5 * N**2, rel=1e-4)
    assert (free.star_flux_errors > known.star_flux_errors).all()


def test_fitted_level_is_reported_with_its_error(log):
    reconstruct(0, LEVEL, 1.0)
    (line,) = [each for each in log.messages if "fitted with the rest" in each]
    assert line.startswith("image 0: background 8")


def test_reported_levels_exclude_the_read_noise_term_and_bad_pixels():
    """Which maps are 0 in."""
    mask = np.array([[[False, True]]])
    maps = np.where(mask, 0.0, 29.0), np.where(mask, 0.0, 3.0)
    observed = {"background": maps[0], "read_noise": maps[1], "mask": mask}
    scene = SimpleNamespace(observation=SimpleNamespace(**observed), n_images=1)
    estimate = SimpleNamespace(parts=[SimpleNamespace(images=[0])])
    levels = [SimpleNamespace(errors=np.array([[0.25]]))]
    outcome = SimpleNamespace(levels=levels, has_levels=True, scene=scene, estimate=estimate)
    (line,) = Outcome.levels_in_words(outcome)
    assert line.startswith("`images[0]`: background 20 +- 0.25 electrons per pixel")
