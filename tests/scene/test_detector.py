"""Skies finer than the images: what pixels see, against sums written out and profiles known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import erf

import lnocl
from lnocl.core.scene.detector import DetectorPsf, on_sky, psfs_on_detector
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.texture import resolution

RNG = np.random.default_rng(24)


def gaussian(n, x, y, sigma, step=1.0):
    """Return a Gaussian of unit light integrated over pixels of so many units, n to a side."""
    edges = (np.arange(n + 1) - 0.5) * step
    along = [np.diff(erf((edges - at) / (sigma * 2**0.5))) / 2 for at in (y, x)]
    return np.outer(*along)


def fine_gaussian(q, sigma, half=6):
    """Return a PSF of this width in pixels of the images, on pixels q times finer."""
    n = 2 * half * q + 1
    return gaussian(n, half, half, sigma, 1 / q)


def seen(sky, psf, q):
    """Return what pixels see of a periodic sky: the model of a detector, written out."""
    ny, nx = sky.shape
    middle = psf.shape[0] // 2, psf.shape[1] // 2
    convolved = sum(
        psf[i, j] * np.roll(sky, (i - middle[0], j - middle[1]), axis=(0, 1))
        for i in range(psf.shape[0])
        for j in range(psf.shape[1])
    )
    return convolved.reshape(ny // q, q, nx // q, q).sum(axis=(1, 3))


def scene_of(q, psf, shape=(16, 16), p=2, **more):
    images = RNG.poisson(40.0, (p, *shape))
    observation = lnocl.Observation(
        images, psf, oversample=q, background=4.0, psf_centre="given", **more
    )
    return Scene(observation)


@pytest.mark.parametrize("q", [1, 2, 4])
@pytest.mark.parametrize("shape", [(5, 5), (6, 3)])
def test_forward_is_the_sum_over_the_pixels_of_the_sky(q, shape):
    psf = RNG.random(shape)
    scene = scene_of(q, psf)
    sky = RNG.random(scene.grid)
    expected = seen(sky, psf / psf.sum(), q)
    for image in Model(scene).forward(sky):
        np.testing.assert_allclose(image, expected, rtol=1e-13)


@given(
    q=st.sampled_from([1, 2, 4]),
    ny=st.integers(5, 20),
    nx=st.integers(5, 20),
    effective=st.booleans(),
    pad=st.integers(0, 3),
    offset=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
)
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_adjoint_is_the_adjoint(q, ny, nx, effective, pad, offset):
    rng = np.random.default_rng(ny * 100 + nx)
    observation = lnocl.Observation(
        rng.poisson(9.0, (2, ny, nx)),
        fine_gaussian(q, 0.8, 2),
        oversample=q,
        effective_psfs=effective,
        offsets=[(0, 0), offset],
    )
    scene = Scene(observation, pad=pad)
    model = Model(scene)
    sky, images = rng.random(scene.grid), rng.random((2, *scene.image_grid))
    forth, back = model.forward(sky), model.adjoint(images)
    assert (forth * images).sum() == pytest.approx((sky * back).sum(), rel=1e-12)


@pytest.mark.parametrize("q", [2, 4])
@pytest.mark.parametrize("fwhm", [1.0, 1.5, 2.0])
def test_stars_anywhere_are_as_pixels_see_them(q, fwhm):
    """Gaussians alone: others are in docs/validation/oversample.md."""
    sigma = fwhm / 2.3548
    psf = DetectorPsf(fine_gaussian(q, sigma, 8), (32, 32), q, is_effective=False)
    worst = 0.0
    for x, y in RNG.uniform(14, 17, (10, 2)):
        expected = gaussian(32, x, y, sigma)
        worst = max(worst, abs(psf.at(x, y).on_grid((32, 32)) - expected).max())
    peak = gaussian(1, 0, 0, sigma).max()
    assert worst < 6e-15 * peak


@pytest.mark.parametrize("q", [2, 4])
def test_effective_psfs_are_sampled(q):
    """Both kinds of one PSF give the same images; the samples of one are seen by whole pixels."""
    sigma, half = 0.8, 8
    left = {2: 7e-8, 4: 5e-15}  # three times what was measured
    places = (np.arange(2 * half * q + 1) / q) - half
    along = (erf((places + 0.5) / sigma / 2**0.5) - erf((places - 0.5) / sigma / 2**0.5)) / 2
    effective = np.outer(along, along)
    kinds = [
        DetectorPsf(effective / effective.sum(), (32, 32), q, is_effective=True),
        DetectorPsf(fine_gaussian(q, sigma, half), (32, 32), q, is_effective=False),
    ]
    for x, y in RNG.uniform(14, 17, (5, 2)):
        images = [kind.at(x, y).on_grid((32, 32)) for kind in kinds]
        expected = gaussian(32, x, y, sigma)
        for image in images:
            np.testing.assert_allclose(image, expected, rtol=0, atol=left[q] * expected.max())
    for x, y in ((0.0, 0.0), (0.3, -0.6)):
        skies = [kind.response(x, y).on_grid((32 * q, 32 * q)) for kind in kinds]
        np.testing.assert_allclose(*skies, rtol=0, atol=left[q])


@pytest.mark.parametrize("effective", [False, True])
@pytest.mark.parametrize("q", [1, 2, 4])
def test_a_star_is_a_point_of_the_sky(q, effective):
    """In the middle of a pixel of the sky it gives what the extended source gives there."""
    observation = lnocl.Observation(
        np.ones((2, 16, 16)),
        fine_gaussian(q, 0.9, 3),
        oversample=q,
        effective_psfs=effective,
        offsets=[(0, 0), (0.25, -1.5)],
    )
    u, v = 9 * q + q // 2, 7 * q
    star = ((u - (q - 1) / 2) / q, (v - (q - 1) / 2) / q)
    assert tuple(on_sky(np.array(star), q)) == (u, v)
    scene = Scene(observation, [star], pad=2)
    sky = np.zeros(scene.grid)
    sky[v, u] = 1.0
    for j, image in enumerate(Model(scene).forward(sky)):
        np.testing.assert_allclose(image, scene.star_image(j, 0), atol=1e-15)


@pytest.mark.parametrize("q", [2, 4])
def test_slopes_are_those_of_differences(q):
    psf = DetectorPsf(fine_gaussian(q, 0.6), (32, 32), q, is_effective=False)
    x, y, step = 15.3, 16.1, 1e-5
    cutout = psf.with_slopes(x, y)
    values = cutout.values
    np.testing.assert_allclose(values[0], psf.at(x, y).values)
    for k, (dx, dy) in enumerate(((step, 0), (0, step)), 1):
        ahead, behind = (psf.at(x + s * dx, y + s * dy).on_grid((32, 32)) for s in (1, -1))
        slope = cutout._replace(values=values[k]).on_grid((32, 32))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), atol=1e-10)
    along_x = psf.at(x, y, axis=1).values
    np.testing.assert_allclose(along_x, values[1], atol=1e-12)


@pytest.mark.parametrize("q", [2, 4])
def test_a_psf_as_large_as_the_grid_goes_round(q):
    psf = RNG.random((16 * q - 1, 16 * q))
    scene = scene_of(q, psf)
    sky = RNG.random(scene.grid)
    expected = seen(sky, psf / psf.sum(), q)
    np.testing.assert_allclose(Model(scene).forward(sky)[0], expected, rtol=1e-12)


def test_psfs_as_pixels_see_them():
    observation = lnocl.Observation(np.ones((8, 8)), fine_gaussian(4, 0.8, 5), oversample=4)
    (psf,) = psfs_on_detector(observation)
    assert np.unravel_index(psf.argmax(), psf.shape) == (psf.shape[0] // 2, psf.shape[1] // 2)
    middle = psf.shape[0] // 2
    np.testing.assert_allclose(psf, gaussian(len(psf), middle, middle, 0.8), atol=1e-8)


@pytest.mark.parametrize("given", [0, 3, 8, 2.0, "2", None])
def test_other_factors_are_refused(given):
    with pytest.raises(lnocl.InputError, match=r"oversample must be 1, 2 or 4; .* was given"):
        lnocl.Observation(np.ones((8, 8)), np.ones((3, 3)), oversample=given)


def test_images_whose_sky_is_too_large_are_refused():
    observation = lnocl.Observation(np.ones((8, 2049)), np.ones((1, 1)), oversample=4)
    with pytest.raises(lnocl.InputError, match=r"oversample=4 need .* the largest axis is 2048"):
        Scene(observation)


@pytest.mark.parametrize("q", [2, 4])
@pytest.mark.parametrize("sigma", [0.4, 1.0])
def test_resolution_is_equal_for_optical_and_effective_psfs(q, sigma):
    """One instrument, its PSF given either way."""
    places = (np.arange(2 * 8 * q + 1) / q) - 8
    along = (erf((places + 0.5) / sigma / 2**0.5) - erf((places - 0.5) / sigma / 2**0.5)) / 2
    widths = []
    for psf, effective in ((np.outer(along, along), True), (fine_gaussian(q, sigma, 8), False)):
        observation = lnocl.Observation(
            np.ones((32, 32)), psf, oversample=q, effective_psfs=effective
        )
        widths.append(resolution(Scene(observation)) / q)
    assert widths[0] == pytest.approx(widths[1], rel=1e-3)


def test_star_weight_equals_the_sum_of_its_samples():
    psf = fine_gaussian(2, 0.5, 3)  # its samples a pixel apart sum to another number
    observation = lnocl.Observation(np.ones((16, 16)), psf, oversample=2, effective_psfs=True)
    scene = Scene(observation, [(7.2, 8.4)])
    light = scene.star_image(0, 0).sum()
    assert abs(light - 1.0) > 1e-4
    assert scene.star_weights[0] == pytest.approx(light, rel=1e-12)


@pytest.mark.parametrize("given", [1, "yes", None])
def test_effective_psfs_must_be_a_boolean(given):
    with pytest.raises(lnocl.InputError, match="effective_psfs must be True or False"):
        lnocl.Observation(np.ones((8, 8)), np.ones((3, 3)), effective_psfs=given)
