"""Runs: their grid, and the errors of stars that the images do not determine."""

import dataclasses

import numpy as np
import pytest

import lnocl
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty

GOOD = (12, 9)
Y, X = np.mgrid[-3:4, -3:4]
PSF = np.exp(-(X**2 + Y**2) / 3.0)


def run_of(observation, stars):
    setup = Setup(observation, stars, 0, "sgm", "double", "numpy", None, refine_positions=True)
    return Run(make_start(setup, Penalty()), 1)


def errors_of(run):
    return run.outcome("n_iter").star_errors()


def test_coincident_stars_have_nan_errors_and_a_warning():
    observation = lnocl.Observation(np.full((32, 32), 9.0), PSF)
    run = run_of(observation, [(8.0, 9.0), (8.5, 9.0), (23.0, 22.0)])
    errors_of(run)
    alone = run.scene.stars[2]
    run.scene.move_stars([(8.25, 9.0), (8.25, 9.0), alone])
    with pytest.warns(
        lnocl.LnoclWarning,
        match=r"do not determine .* each star at \(8\.25, 9\), \(8\.25, 9\), so that these errors",
    ):
        fluxes, positions, _ = errors_of(run)
    np.testing.assert_array_equal(np.isnan(fluxes), [True, True, False])
    assert np.isnan(positions[2]).all()  # there is no star: it may be more than 3 pixels off
    assert np.isnan(positions[:2]).any(axis=1).all()


def test_errors_of_a_star_with_one_good_pixel_are_nan():
    """Flux and position are three unknowns."""
    mask = np.ones((32, 32), bool)
    mask[GOOD[::-1]] = False
    run = run_of(lnocl.Observation(np.full((32, 32), 9.0), PSF, mask=mask), [(12.3, 9.2)])
    with pytest.warns(lnocl.LnoclWarning, match=r"of each star at \(\d+\.?\d*, "):
        fluxes, *_ = errors_of(run)
    assert np.isnan(fluxes).all()


def test_the_pad_that_was_chosen_stays_when_levels_are_fitted():
    """Runs of what was found would else be on another grid than it."""
    counts = np.random.default_rng(0).poisson(100.0, (32, 32))
    observation = lnocl.Observation(counts, PSF, background=100.0)
    setup = Setup(observation, np.zeros((0, 2)), "auto", "sgm", "double", "numpy", None)
    outcome = Run(make_start(setup, Penalty()), 1).outcome("n_iter")
    fitted = outcome.setup.observation.replace(background=np.full((1, 32, 32), 70.0))
    again = make_start(dataclasses.replace(outcome.setup, observation=fitted), Penalty())
    assert again.scene.grid == outcome.scene.grid == (32, 32)
    anew = make_start(dataclasses.replace(setup, observation=fitted), Penalty())
    assert anew.scene.grid > (32, 32)
