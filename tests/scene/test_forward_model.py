"""The models and residuals of a result, against the equation written out in numpy."""

import numpy as np
import pytest
from scenes import blur, make_psfs, paper

import lnocl

SHAPE = (16, 32)
STARS = [(20, 5), (3, 12)]
RNG = np.random.default_rng(5)
IMAGES = RNG.poisson(40.0, (2, *SHAPE)).astype(float)
IMAGES[:, 5, 20] += 900.0
MAP = 1.0 + RNG.random((2, *SHAPE))
MASK = RNG.random((2, *SHAPE)) < 0.1
PSFS = make_psfs(2, (5, 6))


def solve(psfs=PSFS, stars=STARS, pad=0, refine=False, images=IMAGES, **known):
    observation = lnocl.Observation(images, psfs, **known)
    result = paper(
        observation, stars=stars, n_iter=4, pad=pad, engine="numpy", refine_positions=refine
    )
    return observation, result


def written_out(result, exposure, background):
    """Return the m_j on a periodic grid, stars on whole pixels."""
    sky = result.extended.copy()
    for (x, y), flux in zip(result.star_positions.astype(int), result.star_fluxes, strict=True):
        sky[y, x] += flux
    return exposure * np.array([blur(sky, psf) for psf in PSFS]) + background


@pytest.mark.parametrize("stars", [STARS, []])
@pytest.mark.parametrize(
    ("known", "exposure", "background"),
    [
        ({}, 1.0, 0.0),
        ({"background": [3.0, 5.0]}, 1.0, np.array([3.0, 5.0])[:, None, None]),
        ({"background": MAP, "read_noise": 2.0}, 1.0, MAP + 4.0),
        ({"exposure": [10.0, 30.0]}, np.array([10.0, 30.0])[:, None, None], 0.0),
        ({"exposure": 7.0 * MAP, "background": 2.0}, 7.0 * MAP, 2.0),
        ({"exposure": MAP, "background": MAP, "mask": MASK}, MAP, MAP),
        ({"mask": MASK, "background": 1.0}, 1.0, 1.0),
    ],
)
def test_the_model_is_the_equation(known, exposure, background, stars):
    observation, result = solve(stars=stars, **known)
    expected = written_out(result, exposure, background)
    good = ~observation.mask
    assert result.models().shape == (2, *SHAPE)
    np.testing.assert_allclose(result.models()[good], expected[good], rtol=1e-9)


@pytest.mark.parametrize("exposure", [1.0, MAP[:, :13, :27]])
def test_with_a_margin_round_the_images(exposure):
    images = IMAGES[:, :13, :27]
    _, result = solve(stars=[(20, 5)], pad=3, images=images, exposure=exposure, background=2.0)
    sky = result.extended.copy()
    sky[5, 20] += result.star_fluxes[0]
    # What lies farther from the edges than a PSF reaches owes nothing to the margin.
    inner = np.s_[:, 3:-3, 3:-3]
    expected = exposure * np.array([blur(sky, psf) for psf in PSFS]) + 2.0
    np.testing.assert_allclose(result.models()[inner], expected[inner], rtol=1e-9)


def test_with_stars_where_they_were_refined_to():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def star(x0, y0):
        light = np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / 1.5**2)
        return light / (2 * np.pi * 1.5**2)

    k = np.mgrid[-7:8, -7:8]
    psf = np.exp(-0.5 * (k**2).sum(axis=0) / 1.5**2)
    images = np.random.default_rng(1).poisson(20.0 + 5e4 * star(19.6, 7.7)).astype(float)
    _, result = solve(psf, [(20, 8)], refine=True, images=images)
    np.testing.assert_allclose(result.star_positions, [(19.6, 7.7)], atol=0.05)
    assert (result.star_flux_errors > 0).all()
    starlight = result.star_fluxes[0] * star(*result.star_positions[0])
    expected = blur(result.extended, psf) + starlight
    np.testing.assert_allclose(result.models()[0], expected, rtol=1e-3)


@pytest.mark.parametrize(
    "known", [{}, {"background": 3.0, "read_noise": 2.0}, {"mask": MASK}, {"exposure": 7.0 * MAP}]
)
def test_residuals_are_in_standard_deviations(known):
    observation, result = solve(**known)
    models = result.models()
    residuals = result.residuals()
    images = IMAGES + known.get("read_noise", 0.0) ** 2
    bad = known.get("mask", np.zeros(IMAGES.shape, bool))
    np.testing.assert_array_equal(observation.mask, bad)
    np.testing.assert_array_equal(np.isnan(residuals), bad)
    expected = (images - models) / np.sqrt(models)
    np.testing.assert_allclose(residuals[~bad], expected[~bad], rtol=1e-12, atol=1e-12)


def test_residuals_are_nan_where_the_model_is_zero(monkeypatch):
    _, result = solve()
    models = result.models()
    models[0, 2, 3] = 0.0
    monkeypatch.setattr("lnocl.core.runs.outcome.Outcome.models", lambda _: iter(models))
    residuals = result.residuals()
    assert np.isnan(residuals[0, 2, 3])
    assert np.isnan(residuals).sum() == 1


def test_they_are_those_of_the_last_iteration_whatever_follows():
    _, result = solve()
    first = result.models()
    first[:] = 0.0  # what is returned is the caller's
    assert result.models().min() > 0.0
