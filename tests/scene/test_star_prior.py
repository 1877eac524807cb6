"""The prior of star fluxes: its slope, its units, and the minimum of both solvers with it."""

import numpy as np
import pytest
from scenes import Recipe

from lnocl.core.reference import follow_stars
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.star_prior import StarPrior
from lnocl.core.scene.steps import Steps

RECIPE = Recipe((16, 32), 3, 2, masked=0.05, background="each")


def a_start(solver, prior):
    made = RECIPE.make()
    setup = Setup(made.observation(), np.array(made.stars), 0, solver, "double", "numpy", None)
    return make_start(setup, Penalty(mu=1e-2, stars=prior))


def value(prior, fluxes):
    """Return its term, as a step from the flux that is known finds it."""
    steps = Steps(shortened=1.0, share=1.0)
    sums = np.zeros(3), np.zeros((1, 3)), np.ones((3, 1))
    arrays = prior.fluxes, fluxes - prior.fluxes, *sums, np.eye(3)
    follow_stars(steps, *arrays, prior.fluxes, prior.precision, 0.0, (1.0, 1.0))
    return steps.prior_change


def test_the_gradient_is_the_slope_of_the_value():
    prior = StarPrior.of(np.array([30.0, 4.0, 9.0]), np.array([2.0, np.nan, 0.5]))
    fluxes, step = np.array([34.0, 5.0, 8.0]), 1e-4 * np.eye(3)
    slopes = [(value(prior, fluxes + d) - value(prior, fluxes - d)) / 2e-4 for d in step]
    np.testing.assert_allclose(prior.gradient(fluxes), slopes, rtol=1e-7, atol=1e-7)
    assert value(prior, fluxes) == pytest.approx(0.5 * (4 / 2) ** 2 + 0.5 * (1 / 0.5) ** 2)


def test_of_half_of_the_counts_it_is_the_same_scaled():
    """A half has half of the flux and of the information: its error is half of that of all, r2."""
    prior = StarPrior.of(np.array([500.0, 80.0]), np.array([20.0, 9.0]))
    scene = a_start("sgp", prior).scene
    half = StarPrior.of(np.array([250.0, 40.0]), np.array([20.0, 9.0]) / 2 * np.sqrt(2))
    found = half.scaled(scene.unit / 2, scene.scale / 2)
    np.testing.assert_allclose(found.fluxes, scene.star_prior.fluxes, rtol=1e-15)
    np.testing.assert_allclose(found.precision, scene.star_prior.precision, rtol=1e-14)


@pytest.mark.exhaustive
@pytest.mark.parametrize("solver", ["sgp", "sgm"])
def test_iterations_end_where_the_gradients_of_data_and_prior_cancel(solver):
    """From where the data have the fluxes: the data term has to rise on the way."""
    told = np.array([900.0, np.nan])
    prior = StarPrior.of(told, np.array([7.0, 1.0]))
    start, without = a_start(solver, prior), a_start(solver, None)
    run = Run(start, 3000)
    engine = run.engine
    engine.start(without.extended, without.star_fluxes)
    run.complete()
    engine.restore(engine.state())  # which makes the gradient of the estimate, not of a last try
    of_data, fluxes = -engine._star_sums, engine.star_fluxes()
    of_prior = start.scene.star_prior.gradient(fluxes)
    assert abs(of_data[1]) < 1e-4  # measured below 4e-5
    assert abs(of_prior[0]) > 0.01
    assert abs(of_data[0] + of_prior[0]) < 1e-3 * abs(of_prior[0])


def test_a_prior_that_is_added_to_a_start_is_that_of_a_start_with_it():
    prior = StarPrior.of(np.array([900.0, np.nan]), np.array([7.0, 1.0]))
    made, without = a_start("sgp", prior), a_start("sgp", None)
    added = without.penalised(Penalty(mu=1e-2, stars=prior))
    np.testing.assert_array_equal(added.star_fluxes, made.star_fluxes)
    informations = [
        each.scaling.star_information.block(slice(None)) for each in (added, made, without)
    ]
    np.testing.assert_array_equal(*informations[:2])
    more = informations[0] - informations[2]
    np.testing.assert_allclose(more, np.diag(made.scene.star_prior.precision), rtol=1e-9, atol=1e-9)
    assert more[0, 0] > 0
    far, near = (abs(each.star_fluxes - prior.fluxes / each.scene.unit) for each in (without, made))
    assert near[0] < 0.5 * far[0]


def test_priors_are_drawn_about_the_fluxes_with_their_errors():
    errors = np.array([20.0, np.nan, 3.0])
    prior = StarPrior.of(np.array([500.0, 80.0, 40.0]), errors)
    rng = np.random.default_rng(4)
    drawn = np.array([prior.drawn(np.array([600.0, 9.0, 50.0]), rng).fluxes for _ in range(4000)])
    np.testing.assert_allclose(drawn.mean(axis=0), [600.0, 0.0, 50.0], atol=1.0)
    np.testing.assert_allclose(drawn.std(axis=0), [20.0, 0.0, 3.0], rtol=0.03)
