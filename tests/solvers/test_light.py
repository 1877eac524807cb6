"""Light without bias: an explicit matrix, its noise, and skies of which the sum is known."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import named

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.light import Light

N = 32
Y, X = np.indices((N, N)) - N // 2
PSF = np.exp(-4 * np.log(2) * (X**2 + Y**2) / 9.0)
PSF /= PSF.sum()
BACKGROUND = 20.0
STARS, FLUXES = [(16, 16), (5.3, 25.2)], np.array([5e4, 4e3])
SKY = 50.0 * np.exp(-((X - 6) ** 2 + (Y + 4) ** 2) / 2 / 3.0**2)
SHARES = (np.hypot(X, Y) < 7).astype(float)
KNOWN = {
    "plain": {},
    "exposures": {"exposure": [0.5, 4.0]},
    "exposure maps": {"exposure": np.array([0.2 + 4.0 * (X > 0), 0.3 + 2.0 * (Y > 2)])},
    "a mask": {"mask": np.random.default_rng(1).random((2, N, N)) < 0.2},
    "offsets": {"offsets": [(0.0, 0.0), (1.3, -2.4)]},
}


def a_scene(known, pad=8, rng=None, oversample=1, sky=SKY, fluxes=FLUXES, stars=STARS):
    """Return a scene of two images of the sky, with noise where there is a generator."""
    known = {**known, "oversample": oversample, "background": BACKGROUND}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        flat = Scene(lnocl.Observation(np.full((2, N, N), 5.0), PSF, **known), stars, pad=pad)
        laid = np.zeros(flat.grid)
        laid[: sky.shape[0], : sky.shape[1]] = sky
        images = Model(flat).images(laid / flat.unit, fluxes / flat.unit)
        if flat.has_exposure_map:
            images *= flat.weights
        images = images[:, :N, :N] * flat.scale
        if rng is not None:
            images = rng.poisson(images)
        scene = Scene(lnocl.Observation(images, PSF, **known), stars, pad=pad)
    return scene, laid


def flux(scene, sky, fluxes=FLUXES, shares=SHARES):
    return float((shares * Light(Estimate(scene, sky, fluxes)).sky()).sum())


@pytest.mark.parametrize("known", KNOWN.values(), ids=KNOWN)
def test_the_truth_stays(known):
    scene, sky = a_scene(known)
    np.testing.assert_allclose(Light(Estimate(scene, sky, FLUXES)).sky(), SKY, atol=1e-9)


@pytest.mark.parametrize("known", KNOWN.values(), ids=KNOWN)
@pytest.mark.parametrize("floor", [0.0, 3.0])
def test_a_flat_error_of_the_estimate_is_taken_out(known, floor):
    if "mask" in known:  # pixels that nothing is known of
        known = {"mask": np.array([np.zeros((N, N)), X == 3], bool)}
    scene, sky = a_scene(known, pad=0, sky=np.zeros((N, N)))
    assert abs(flux(scene, sky + floor)) < 1e-9 * SHARES.sum()


def test_a_sky_finer_than_the_pixels_holds_the_same_light():
    fine = np.kron(SKY, np.ones((2, 2))) / 4
    scene, sky = a_scene({}, pad=0, oversample=2, sky=fine)
    found = Light(Estimate(scene, sky + 1.0, FLUXES)).sky()
    np.testing.assert_allclose(found, fine, atol=1e-9)


def test_it_is_the_explicit_matrix():
    rng = np.random.default_rng(5)
    scene, sky = a_scene(KNOWN["a mask"], pad=0, rng=rng)
    matrices = [
        np.array([np.fft.irfft2(np.fft.rfft2(PSF_AT_0) * np.fft.rfft2(e), (N, N)).ravel()
                  for e in np.eye(N * N).reshape(-1, N, N)]).T
        for _ in range(2)
    ]  # fmt: skip
    left, weight = np.zeros(N * N), np.zeros(N * N)
    stars = [scene.star_field.light(j, FLUXES) for j in range(2)]
    for matrix, image, mask, star in zip(
        matrices, scene.observation.images, scene.observation.mask, stars, strict=True
    ):
        good = ~mask.ravel()
        model = matrix @ sky.ravel() + star.ravel() + BACKGROUND
        left += matrix.T @ (good * (image.ravel() - model))
        weight += matrix.T @ good
    expected = sky + (left / weight).reshape(N, N)
    np.testing.assert_allclose(Light(Estimate(scene, sky, FLUXES)).sky(), expected, atol=1e-8)


PSF_AT_0 = np.roll(PSF, (-(N // 2), -(N // 2)), (0, 1))


@pytest.mark.filterwarnings("ignore:the images are shifted")
@pytest.mark.parametrize("known", named(KNOWN, "exposure maps"))
def test_errors_are_the_scatter_of_sums(known):
    known = {**known, "psf_centre": "given"}
    rng, n, dark = np.random.default_rng(7), 400, np.zeros(0)
    fluxes, stated = [], []
    means, sky = a_scene(known, pad=0, fluxes=dark, stars=())
    for _ in range(n):
        counts = rng.poisson(means.observation.images)
        scene = Scene(lnocl.Observation(counts, PSF, background=BACKGROUND, **known), pad=0)
        light = Light(Estimate(scene, 0.0 * sky, dark))
        fluxes.append((SHARES * light.sky()).sum())
        stated.append(light.flux(SHARES, dark)[1])
    # The standard deviation of n values has a relative error of 1 / sqrt(2 n).
    assert abs(np.std(fluxes) / np.mean(stated) - 1) < 3 / np.sqrt(2 * n)
    assert abs(np.mean(fluxes) - (SHARES * SKY).sum()) < 0.03 * SKY.sum()


def test_light_error_includes_errors_of_stars_inside_the_region_only():
    scene, sky = a_scene({}, pad=0)
    light, none = Light(Estimate(scene, sky, FLUXES)), np.zeros(2)
    alone = light.flux(SHARES, none)[1]
    # The second star lies beyond the region.
    assert light.flux(SHARES, np.array([3e4, 1e6]))[1] == pytest.approx(
        np.hypot(alone, 3e4), rel=1e-4
    )
    # A star that is known as well as its photons tell adds nothing to the noise of the rest.
    image, whole = scene.observation.images, np.ones((N, N))
    photons = np.sqrt(FLUXES / 2)
    expected = np.sqrt((image.sum() / 2 - FLUXES.sum()) / 2)
    assert light.flux(whole, photons)[1] == pytest.approx(expected, rel=0.01)


@given(st.floats(-3, 3), st.floats(-6, 6))
def test_light_scales_with_the_unit_of_counts(power, exposure):
    """Counts 2^k times as large, or exposures, give a sky as many times as bright, or faint."""
    counts, time = 2.0 ** round(power), 2.0 ** round(exposure)
    scene, sky = a_scene({}, pad=0, rng=np.random.default_rng(3))
    before = Light(Estimate(scene, 0.9 * sky, FLUXES))
    observation = lnocl.Observation(
        counts * scene.observation.images, PSF, background=counts * BACKGROUND, exposure=time
    )
    factor = counts / time
    after = Light(Estimate(Scene(observation, STARS), 0.9 * factor * sky, factor * FLUXES))
    np.testing.assert_allclose(after.sky(), factor * before.sky(), rtol=1e-12)
    errors = np.array([100.0, 100.0])
    noise = [each.flux(SHARES, k * errors)[1] for each, k in ((before, 1), (after, factor))]
    assert noise[1] > 0
    if counts == 1:
        assert noise[1] == pytest.approx(factor * noise[0])


@pytest.mark.parametrize("known", KNOWN.values(), ids=KNOWN)
@pytest.mark.parametrize("pad", [0, 8])
def test_fluxes_are_sums_of_the_light(known, pad):
    scene, sky = a_scene(known, pad=pad, rng=np.random.default_rng(2))
    light = Light(Estimate(scene, 0.8 * sky + 1.0, FLUXES))
    for shares in (SHARES, np.ones((N, N))):
        found = light.flux(shares, np.zeros(2))[0]
        assert found == pytest.approx((shares * light.sky()).sum(), rel=1e-10)
