"""Levels of the background: against explicit least squares, draws, and reconstructions."""

import numpy as np
import pytest

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.levels import Levels
from lnocl.core.solvers.light import Light
from lnocl.core.solvers.marginal import marginal
from lnocl.core.solvers.star_errors import standard_errors

N = 48
Y, X = np.indices((N, N), float)
PSFS = np.array(
    [
        np.exp(-((X - 24) ** 2 + (Y - 24) ** 2 / a) / 5.0)
        + 0.1 * np.exp(-((X - 26) ** 2 + (Y - 23) ** 2) / 4.0)
        for a in (0.7, 2.0)
    ]
)
STARS, FLUXES = np.array([(14.3, 30.1), (36.0, 11.4)]), np.array([4000.0, 900.0])
SKY = 60.0 * np.exp(-np.hypot(X - 25, (Y - 20) / 0.7) / 2.5)
LEVELS, RISES, ERRORS = np.array([20.0, 55.0]), np.array([(1.5, -2.0), (-3.0, 1.0)]), [0.7, 1.5]
KNOWN = {
    "alike": {},
    "masked and moved": {
        "mask": np.random.default_rng(3).random((2, N, N)) < 0.05,
        "offsets": [(0.0, 0.0), (2.3, -1.4)],
        "exposure": [1.0, 1.5],
    },
    "maps": {
        "exposure": np.array([0.5 + X / N, 0.8 + Y / N]),
        "read_noise": np.array([2.0 + X / N, 3.0 + Y / N]),
    },
}


def as_planes(levels):
    """Return the levels (p, 3) of images as images: in the middle, and the rise along x and y."""
    steps = np.array([np.ones(X.shape), X / (N - 1) - 0.5, Y / (N - 1) - 0.5])
    return np.einsum("ji,iyx->jyx", levels, steps)


def a_scene(known, rng=None, sky=SKY, errors=ERRORS, at=LEVELS, rises=RISES):
    """Return a scene whose backgrounds are flat, and counts whose backgrounds are not."""
    given = {**known, "background": LEVELS}
    flat = Scene(lnocl.Observation(np.full((2, N, N), 9.0), PSFS, **given), STARS, pad=8)
    laid = np.zeros(flat.grid)
    laid[:N, :N] = sky
    light = Model(flat).images(laid / flat.unit, FLUXES / flat.unit)
    light = np.array([flat.in_electrons(each, j)[:N, :N] for j, each in enumerate(light)])
    mean = light + as_planes(np.column_stack([at - LEVELS, rises]))
    added = flat.observation.read_noise**2
    added = added if added.ndim == 3 else added[:, None, None]
    counts = mean - added
    if rng is not None:
        counts = rng.poisson(mean - added) + rng.standard_normal(mean.shape) * np.sqrt(added)
    observation = lnocl.Observation(counts, PSFS, **given, background_error=errors)
    return Scene(observation, STARS, pad=8), laid


def explicit(scene):
    """Yield the change of each level and its error where all is dark, by least squares."""
    observation = scene.observation
    stars = list(Model(scene).starlight(FLUXES / scene.unit))
    for j in range(2):
        light = scene.in_electrons(stars[j], j)[:N, :N]
        known = light + observation.background[j]
        good = ~observation.mask[j]
        shapes = np.array([np.ones(X.shape), X / (N - 1) - 0.5, Y / (N - 1) - 0.5])[:, good]
        variance = (known + (0.03 * light) ** 2)[good]
        # A gradient is of the order of the noise of a pixel, in the median.
        steep = np.median(1.0 / known[good])
        prior = np.diag([ERRORS[j] ** -2, steep, steep])
        covariance = np.linalg.inv((shapes / variance) @ shapes.T + prior)
        left = (observation.images[j] - known)[good]
        yield covariance @ ((shapes / variance) @ left), np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("known", KNOWN.values(), ids=KNOWN)
def test_levels_on_a_dark_sky_are_those_of_explicit_least_squares(known):
    scene, sky = a_scene(known, np.random.default_rng(1), sky=0.0 * SKY)
    found = Levels(Estimate(scene, sky, FLUXES))
    for j, (change, errors) in enumerate(explicit(scene)):
        np.testing.assert_allclose(found.change[j], change, rtol=1e-8)
        np.testing.assert_allclose(found.errors[j], errors, rtol=1e-8)


@pytest.mark.parametrize("known", KNOWN.values(), ids=KNOWN)
def test_levels_beside_a_source_are_within_their_errors(known):
    rng, off = np.random.default_rng(2), []
    truth = np.column_stack([[0.0, 0.0], RISES])
    for _ in range(12):
        scene, sky = a_scene(known, rng)
        found = Levels(Estimate(scene, sky, FLUXES))
        off.append((found.change - truth) / found.errors)
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3


def test_a_known_level_stays_and_has_no_error():
    scene, sky = a_scene({}, errors=[0.0, 1.5])
    found = Levels(Estimate(scene, sky, FLUXES))
    assert not found.change[0].any()
    assert not found.errors[0].any()
    assert (found.change[1] != 0).all()
    assert (found.errors[1] > 0).all()


@pytest.mark.exhaustive
def test_the_error_of_a_sum_is_that_of_draws(monkeypatch):
    monkeypatch.setattr("lnocl.core.solvers.levels.SHARE", 1e-6)
    source = np.where(SKY > 4.0, SKY, 0.0)  # without wings
    rng, found, stated = np.random.default_rng(44), [], []
    regions = [(np.hypot(X - 25, Y - 20) < radius).astype(float) for radius in (8, 20, 60)]
    for _ in range(100):
        at = LEVELS + ERRORS * rng.standard_normal(2)
        rises = np.sqrt(LEVELS)[:, None] * rng.standard_normal((2, 2))
        scene, sky = a_scene({}, rng, source, at=at, rises=rises)
        fitted = Levels(Estimate(scene, sky, FLUXES))
        light, planes = Light(Estimate(scene, sky, FLUXES), fitted), as_planes(fitted.change)
        sums = [light.flux(region, np.zeros(2)) for region in regions]
        more = [float((region * planes.mean(axis=0)).sum()) for region in regions]
        found.append([flux - less for (flux, _), less in zip(sums, more, strict=True)])
        stated.append([error for _, error in sums])
    truth = [(region * source).sum() for region in regions]
    rms = np.sqrt(np.mean((np.array(found) - truth) ** 2, axis=0))
    np.testing.assert_allclose(rms, np.mean(stated, axis=0), rtol=0.2)


# So small that it changes the variances of pixels by a two-hundredth at most.
CHANGE = 0.1


def test_a_star_changes_with_a_level_as_its_error_says():
    scene, sky = a_scene({}, np.random.default_rng(5))
    errors = []
    for given in (0.0, np.array([CHANGE, 0.0]), np.array([0.0, CHANGE])):
        observation = scene.observation.replace(background_error=np.broadcast_to(given, (2,)))
        there = Scene(observation, STARS, pad=8)
        known = Levels(Estimate(there, sky, FLUXES), are_fitted=False)
        errors.append(standard_errors(Estimate(there, sky, FLUXES), False, levels=known)[0][:, 0])
    for j in range(2):
        more = scene.observation.background + CHANGE * (np.arange(2) == j)
        higher = Scene(scene.observation.replace(background=more), STARS, pad=8)
        there, here = (marginal(Estimate(each, sky, FLUXES)) for each in (higher, scene))
        shift = there.star_fluxes - here.star_fluxes
        added = np.sqrt(errors[1 + j] ** 2 - errors[0] ** 2)
        np.testing.assert_allclose(added, abs(shift), rtol=0.1)


def test_the_level_of_an_image_without_a_good_pixel_stays():
    mask = np.zeros((2, N, N), bool)
    mask[1] = True
    scene, sky = a_scene({"mask": mask}, np.random.default_rng(6))
    found = Levels(Estimate(scene, sky, FLUXES))
    assert not found.change[1].any()
    assert found.errors[1, 0] == pytest.approx(ERRORS[1])
    assert 0 < found.errors[0, 0] < ERRORS[0]
