"""PSFs with parameters: each family against what it stands for, and the slopes."""

import numpy as np
import pytest
from scipy.ndimage import fourier_gaussian

import lnocl
from lnocl.core.scene.psf_families import PsfFamilies, spectrum
from lnocl.core.scene.shifting import place

N = 32
Y, X = np.indices((N, N)) - N // 2
PSF = np.exp(-(X**2 + (Y / 1.2) ** 2) / 12.0)
PSF /= PSF.sum()
IDEAL = np.exp(-(X**2 + Y**2) / 6.0)
IDEAL /= IDEAL.sum()
RNG = np.random.default_rng(0)
MODES = 1e-3 * RNG.standard_normal((1, 2, N, N))
ALL = ("shift", "jitter", "strehl", "pupil", "modes")
PUPIL = (np.hypot(X, Y / 1.1) < 7.0).astype(float)
SCATTER = 0.2 * PSF[None]


def families(*names, psf=PSF, ideal=IDEAL, modes=MODES):
    known = {"ideal_psfs": ideal, "psf_modes": modes, "pupils": PUPIL, "psf_centre": "given"}
    return PsfFamilies(names, lnocl.Observation(np.ones((N, N)), psf, **known), SCATTER)


def with_values(found, values):
    """Return parameters of these families, their pixels as given."""
    return found.first()._replace(values=np.atleast_2d(values))


def changed(names, *values, **known):
    found = families(*names, **known)
    (psf,) = found.psfs(with_values(found, values))
    return psf


def test_without_a_change_it_is_the_psf_given():
    np.testing.assert_allclose(changed(ALL, *np.zeros(15)), PSF, rtol=0, atol=1e-16)


def test_parameters_have_names_and_priors():
    found = families("modes", "shift", "strehl")
    assert found.parameters == ["shift x", "shift y", "strehl power", "modes 1", "modes 2"]
    np.testing.assert_array_equal(found.prior, [0.5, 0.5, 0.7, 1.0, 1.0])


def test_shift_moves_it():
    moved = place(PSF, (N, N), N // 2 + 0.3, N // 2 - 0.2).on_grid((N, N))
    np.testing.assert_allclose(changed(["shift"], 0.3, -0.2), moved, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("xx", "yy"), [(1.5, 0.4), (0.0, 2.0)])
def test_jitter_convolves_it_with_a_gaussian(xx, yy):
    expected = np.fft.ifft2(fourier_gaussian(np.fft.fft2(PSF), (yy**0.5, xx**0.5))).real
    np.testing.assert_allclose(changed(["jitter"], xx, 0.0, yy), expected, rtol=0, atol=1e-15)


def test_jitter_has_the_covariance_that_it_says():
    wide = changed(["jitter"], 0.7, 0.3, 1.1)
    change = [((wide - PSF) * each).sum() for each in (X * X, X * Y, Y * Y)]
    np.testing.assert_allclose(change, [0.7, 0.3, 1.1], rtol=3e-5)  # of light beyond the edge


def test_jitter_that_is_negative_sharpens_it():
    wide = changed(["jitter"], 1.0, -0.2, 0.5).clip(0.0)  # rounding leaves some below
    again = changed(["jitter"], -1.0, 0.2, -0.5, psf=wide)
    np.testing.assert_allclose(again, PSF, rtol=0, atol=1e-10)


def test_strehl_goes_from_the_ideal_to_it_and_beyond():
    given, ideal = spectrum(PSF, (N, N)), spectrum(IDEAL, (N, N))
    good = abs(given) > 1e-3  # what the PSF has lost, nothing brings back
    for power, expected in ((-1.0, ideal), (-0.5, (given * ideal) ** 0.5), (1.0, given**2 / ideal)):
        found = spectrum(changed(["strehl"], power), (N, N))
        np.testing.assert_allclose(found[good], expected[good], rtol=1e-9)


def test_modes_are_added_without_their_light():
    difference = changed(["modes"], 2.0, -1.0) - PSF
    expected = 2.0 * MODES[0, 0] - MODES[0, 1]
    np.testing.assert_allclose(difference, expected - expected.sum() * PSF, rtol=0, atol=1e-16)


@pytest.mark.parametrize("names", [(name,) for name in ALL] + [ALL])
def test_the_sum_stays(names):
    n = len(families(*names).prior)
    values = np.random.default_rng(3).uniform(-0.4, 0.4, n)
    assert changed(names, *values).sum() == pytest.approx(1.0, abs=1e-14)


@pytest.mark.parametrize("shape", [(9, 9), (8, 10), (32, 32)])
def test_psfs_keep_their_shape_and_middle(shape):
    y, x = (np.arange(n) - n // 2 for n in shape)
    psf = np.exp(-(y[:, None] ** 2 + x**2) / 2.0)
    psf /= psf.sum()
    found = PsfFamilies(["jitter"], lnocl.Observation(np.ones(shape), psf))
    (wide,) = found.psfs(with_values(found, [0.2, 0.0, 0.2]))
    assert wide.shape == shape
    assert np.unravel_index(wide.argmax(), shape) == (shape[0] // 2, shape[1] // 2)


def test_slopes_are_the_derivatives_of_its_spectrum():
    found, values, h = families(*ALL), np.full(15, 0.1), 1e-6
    factors, modes = found.slopes(0, (N, N), values)
    base = spectrum(changed(ALL, *values), (N, N))
    smooth = base - sum(0.1 * mode for mode in modes)
    slopes = [factor * smooth for factor in factors] + modes
    # The highest frequency of an even number has no sign, and a shift no derivative there.
    inner = np.s_[np.r_[0 : N // 2, N // 2 + 1 : N], : N // 2]
    for k, slope in enumerate(slopes):
        up, down = values.copy(), values.copy()
        up[k] += h
        down[k] -= h
        change = spectrum(changed(ALL, *up), (N, N)) - spectrum(changed(ALL, *down), (N, N))
        np.testing.assert_allclose((change / (2 * h))[inner], slope[inner], rtol=0, atol=1e-8)


def test_the_spectrum_of_a_small_psf_is_that_of_it_laid_on_the_grid():
    small = PSF[N // 2 - 4 : N // 2 + 5, N // 2 - 4 : N // 2 + 5]
    laid = np.zeros((16, 20))
    laid[np.ix_(np.arange(-4, 5) % 16, np.arange(-4, 5) % 20)] = small
    np.testing.assert_allclose(spectrum(small, (16, 20)), np.fft.rfft2(laid), rtol=0, atol=1e-15)


def test_only_psfs_with_positive_light_are_possible():
    found = families("jitter")
    assert found.are_possible(with_values(found, [0.5, 0.1, 0.2]))
    assert found.are_possible(with_values(found, [-0.5, 0.0, -0.5]))
    assert not found.are_possible(with_values(found, [-9.0, 0.0, 0.0]))
    assert not found.are_possible(with_values(found, [np.nan, 0.0, 0.0]))


def test_a_common_shift_is_taken_out():
    both = np.array([PSF, PSF])
    found = PsfFamilies(["shift", "jitter"], lnocl.Observation(np.ones((2, N, N)), both))
    values = np.array([[0.3, 0.1, 0.5, 0.0, 0.2], [0.1, -0.3, 0.4, 0.1, 0.3]])
    (apart, _), common = found.without_common_shift(with_values(found, values))
    np.testing.assert_allclose(common, (0.2, -0.1))
    np.testing.assert_allclose(apart[:, :2], [(0.1, 0.2), (-0.1, -0.2)])
    np.testing.assert_array_equal(apart[:, 2:], values[:, 2:])
    found = families("jitter")
    (alone, _), none = found.without_common_shift(with_values(found, values[:1, 2:]))
    np.testing.assert_array_equal(alone, values[:1, 2:])
    np.testing.assert_array_equal(none, (0.0, 0.0))


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (20.0, 70.0, 200.0)])
def test_common_shift_of_the_sky_is_removed_from_psfs_of_rotated_images(angles):
    """The mean along the images' axes was taken for it, and moved stars where they are not."""
    maps = lnocl.rotations(angles, (7.5, 7.5))
    observation = lnocl.Observation(np.ones((3, 16, 16)), np.ones((5, 5)), transforms=maps)
    families = PsfFamilies(("shift", "jitter"), observation)
    shift, own, jitter = np.array([0.3, -0.2]), 0.1 * np.eye(3, 2), np.arange(9.0).reshape(3, 3)
    own -= maps[:, :, :2] @ np.mean(maps[:, :, :2].swapaxes(1, 2) @ own[:, :, None], axis=0)[:, 0]
    values = np.hstack([own + maps[:, :, :2] @ shift, jitter])
    found, common = families.without_common_shift(families.first()._replace(values=values))
    np.testing.assert_allclose(common, shift, rtol=1e-12)
    np.testing.assert_allclose(found.values, np.hstack([own, jitter]), atol=1e-12)


@pytest.mark.parametrize(
    "maps", [{"offsets": [(0, 0), (3.5, -2.0), (0, 0)]}, {"angles": (0, 70, 0)}]
)
def test_it_is_that_of_the_images_whose_pixels_the_sky_has(maps):
    """Not of those whose offsets may be wrong."""
    if "angles" in maps:
        maps = {"transforms": lnocl.rotations(maps["angles"], (7.5, 7.5))}
    observation = lnocl.Observation(np.ones((3, 16, 16)), np.ones((5, 5)), **maps)
    families = PsfFamilies(("shift",), observation)
    values = np.array([(0.1, 0.2), (0.4, -0.3), (0.3, 0.0)])
    found, common = families.without_common_shift(families.first()._replace(values=values))
    np.testing.assert_allclose(common, (0.2, 0.1))
    np.testing.assert_allclose(found.values, values - observation.turns @ common, atol=1e-12)
