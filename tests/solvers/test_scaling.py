"""The shifted scaling, and the star fluxes that it starts with, against an explicit matrix."""

import itertools

import numpy as np
import pytest
from explicit_matrix import problem_of
from scenes import Recipe, make_psfs, make_smooth_psfs, worst

import lnocl
from lnocl.core.engines.numpy import ReferenceEngine
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers import scaling
from lnocl.core.solvers.fluxes import fit_fluxes

TINY = Recipe((8, 8), 2, 2, mu=1e-3, masked=0.1, background="map", psf_shape=(3, 4))


def prepared(made, stars, star_fluxes):
    """Return the problem, its unknowns at the start, and the scaling with its unit."""
    scene = Scene(made.observation(), stars, Penalty(made.recipe.mu))
    start = scene.start(made.initial_extended, star_fluxes)
    fluxes, steps = scaling.prepare(scene, Model(scene), *start)
    x = np.append(made.initial_extended, fluxes * scene.scale)
    return problem_of(made, stars), x, steps, scene.scale


@pytest.mark.parametrize("fluxes", [(0.0, 0.0), (1.0, 1e3), (1e3, 1.0), (3e4, 3e4)])
def test_star_fluxes_are_the_best_for_the_start(fluxes):
    made = TINY.make()
    problem, x, _, _ = prepared(made, made.stars, fluxes)
    slopes = problem.split(problem.gradient(x) * problem.errors(x))[1]
    assert np.abs(slopes).max() <= 2e-7  # measured 7.1e-8


def test_star_fluxes_are_the_best_for_the_start_where_one_is_not_there():
    made = Recipe((16, 16), 2, 1, mu=0.05).make()
    (x, y) = made.stars[0]
    problem, start, _, _ = prepared(made, [(x, y), (x, y - 1)], [1e3, 1e3])
    there, not_there = problem.split(problem.gradient(start) * problem.errors(start))[1]
    assert abs(there) <= 3e-7  # measured 1.1e-7
    assert not_there > 1.0
    assert problem.split(start)[1][1] <= 1e-3


@pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
def test_a_pixel_that_a_star_makes_negative_says_nothing_of_its_flux():
    """The model there is the guard, whatever the flux; before, all fluxes were fitted to it."""
    psf = np.outer([1.0, 2.0, 4.0, 2.0, 1.0], [1.0, 2.0, 4.0, 2.0, 1.0])
    psf[0, 0] = -5.0
    image = np.full((16, 16), 10.0)
    image[6:11, 6:11] += 1e4 * psf.clip(0) / psf.sum()
    masked = np.ma.masked_array(image, np.zeros(image.shape, bool))
    masked[6, 6] = np.ma.masked
    found = []
    for images in (image, masked):
        scene = Scene(lnocl.Observation(images, psf, background=10.0), [(8, 8)])
        start = np.zeros(scene.grid), np.array([1e4 / scene.unit])
        fluxes, steps = scaling.prepare(scene, Model(scene), *start)
        found.append([fluxes[0] * scene.unit, steps.star_information.diagonal[0] / scene.unit])
    assert found[0][0] == pytest.approx(1e4, rel=1e-12)
    np.testing.assert_allclose(*found, rtol=0.02)


def test_scaling_is_that_of_the_matrix():
    made = TINY.make()
    problem, x, steps, unit = prepared(made, made.stars, [1e3, 1e3])
    weights, (sky, stars) = problem.weights, np.split(problem.matrix, [problem.n_pixels], axis=1)
    seen = stars @ problem.split(x)[1] + problem.background
    shift = scaling.SHIFT * (sky.T @ weights) / (sky.T @ (weights / seen))
    weighted = unit * (weights / problem.model(x))[:, None] * stars
    # Measured 8.0e-15, 4.9e-16 and 1.6e-16.
    assert worst(steps.shift.ravel(), shift / unit) <= 2.4e-14
    cross = [cutout.on_grid((8, 8)).ravel() for cutout in steps.cross_information]
    assert worst(cross, (sky.T @ weighted).T) <= 1.5e-15
    assert worst(steps.star_information.block(slice(None)), stars.T @ weighted) <= 5e-16


@pytest.mark.parametrize("psf_shape", [(9, 11), (40, 9), (128, 128)])
@pytest.mark.parametrize("offsets", [[(0, 0), (0, 0)], [(1.4, -0.7), (-3, 2)]])
@pytest.mark.filterwarnings("ignore:the images are shifted", "ignore:psf . is undersampled")
def test_cross_information_lies_in_a_window(psf_shape, offsets):
    """It is that of the whole grid, but for rounding; larger PSFs do not fit into a smaller one."""
    rng, stars = np.random.default_rng(5), [(60, 50), (70.3, 120.6), (0.2, 1.0)]
    images = rng.poisson(9.0, (2, 128, 128)).astype(float)
    mask = rng.random(images.shape) < 0.1
    psfs = make_psfs(2, psf_shape)
    scene = Scene(
        lnocl.Observation(images, psfs, background=2.0, mask=mask, offsets=offsets), stars
    )
    model = Model(scene)
    extended, fluxes = scene.start(None, None)
    fluxes, steps = scaling.prepare(scene, model, extended, fluxes)
    covered = np.where(scene.observed(model.adjoint(model.weights)), extended, 0.0)
    ratios = model.weights / model.images(covered, fluxes)
    for s, cutout in enumerate(steps.cross_information):
        cores = [each[s].on_grid(scene.grid) for each in scene.star_field.cores]
        expected = model.adjoint(x * core for x, core in zip(ratios, cores, strict=True))
        found = cutout.on_grid(scene.grid)
        assert worst(found, expected) <= 1.5e-15
        assert psf_shape != (9, 11) or cutout.values.size < found.size / 2


FAR, CLOSE, ROUND_THE_EDGE = [(40, 50)], [(40, 50), (47.3, 52.6)], [(0.2, 1.0), (94.0, 3.0)]


@pytest.mark.exhaustive
@pytest.mark.parametrize("stars", [[], FAR, CLOSE, ROUND_THE_EDGE])
@pytest.mark.filterwarnings("ignore:psf . is undersampled")
def test_shift_is_that_of_the_whole_grid(stars):
    """Where stars light a small part of it, and where nothing tells one pixel from another."""
    rng, shape = np.random.default_rng(7), (2, 80, 96)
    images, psfs = rng.poisson(30.0, shape).astype(float), make_smooth_psfs(2, (15, 17))
    for x, y in np.round(stars).astype(int):
        images[:, y, x] += 3e4
    bad, given = rng.random(shape) < 0.1, rng.uniform(0.0, 9.0, shape[1:])
    backgrounds = 3.0, np.array([2.0, 5.0]), rng.uniform(2.0, 5.0, shape)
    cases = itertools.product((None, bad, bad[0]), backgrounds)
    for (mask, background), start in zip(cases, itertools.cycle((None, given))):
        scene = Scene(lnocl.Observation(images, psfs, background=background, mask=mask), stars)
        model = Model(scene)
        extended, sought_from = scene.start(start, np.full(len(stars), 3e4))
        fluxes, steps = scaling.prepare(scene, model, extended, sought_from)
        total = model.adjoint(model.weights)
        light = np.array(list(model.starlight(fluxes))) + model.background
        light = np.maximum(light, scaling.MIN_BACKGROUND)
        shift = scaling.SHIFT * total / model.adjoint(model.weights / light)
        case = f"mask {np.shape(mask)}, background {np.shape(background)}, start {np.shape(start)}"
        # Measured 2.6e-11: under a star 1 / light is less by 5 digits, in both.
        assert worst(steps.shift, shift) <= 8e-11, case
        observed = np.where(scene.observed(total), extended, 0.0)
        diffuse = model.images(observed, np.zeros(len(stars)))
        expected = fit_fluxes(scene, model, diffuse, sought_from)
        np.testing.assert_allclose(fluxes, expected, rtol=1e-12, err_msg=case)


@pytest.mark.parametrize("n_stars", [0, 2])
def test_scaling_is_restored_from_its_state(n_stars):
    made = TINY.make()
    _, _, steps, _ = prepared(made, made.stars[:n_stars], [1e3, 1e3][:n_stars])
    moved = [(x + 1, y) for x, y in made.stars[:n_stars]]
    _, _, elsewhere, _ = prepared(made, moved, [1e3, 1e3][:n_stars])
    other = elsewhere.restored(steps.state())
    for name, array in steps.state().items():
        np.testing.assert_array_equal(other.state()[name], array)
    cutouts = zip(other.cross_information, steps.cross_information, strict=True)
    for found, expected in cutouts:
        np.testing.assert_array_equal(found.values, expected.values)
        assert (found.y, found.x) == (expected.y, expected.x)
    assert other.star_information.solve(np.ones(n_stars)).shape == (n_stars,)
    assert set(other.state()) == set(steps.state())  # whatever was computed meanwhile


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe((16, 16), 3, 3, mu=1e-3, masked=0.05, background="map"),
        Recipe((20, 12), 3, 2, mu=1e-3, pad=4, masked=0.05, background="each"),
    ],
)
def test_star_fluxes_are_best_where_the_engine_starts(recipe):
    """The sky that was not observed is dark, for the engine and for the fit."""
    made = recipe.make()
    scene = Scene(made.observation(), made.stars, Penalty(made.recipe.mu), made.recipe.pad)
    extended, star_fluxes = scene.start(None, None)
    star_fluxes, steps = scaling.prepare(scene, Model(scene), extended, star_fluxes)
    engine = ReferenceEngine(scene, steps)
    engine.start(extended, star_fluxes)
    slopes = engine._star_sums / np.sqrt(steps.star_information.diagonal)
    assert abs(slopes).max() < 1e-7  # measured: 3.1e-8; with a covered sky 3.6e-3
