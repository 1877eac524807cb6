"""What PSFs may have wrong: its derivatives, its light, and its place among the unknowns."""

import numpy as np
import pytest
from scipy.linalg import expm

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.view import View, Window
from lnocl.core.solvers.psf_errors import (
    ALIKE,
    COMMON,
    N_SHAPES,
    N_SLOPES,
    SHIFT,
    VARIANCE,
    WINGS,
    ZERO_POINTS,
    PsfErrors,
    alike,
    slopes_of,
    with_errors,
)

N, ERROR = 65, 0.04
Y, X = np.indices((N, N)) - N // 2
SIGMA = 2.5
WIDTH = SIGMA / VARIANCE**0.5


def gaussian(xx=SIGMA**2, xy=0.0, yy=SIGMA**2, dx=0.0, dy=0.0):
    """Return a Gaussian of a covariance at a place, of unit light."""
    x, y = X - dx, Y - dy
    det = xx * yy - xy**2
    return np.exp(-(yy * x**2 - 2 * xy * x * y + xx * y**2) / 2 / det) / (2 * np.pi * det**0.5)


def slope(make, step):
    """Return the derivative by a difference on both sides."""
    return (make(step) - make(-step)) / (2 * step)


H = 1e-4
VAR = SIGMA**2
EXPECTED = {
    "stretch x": slope(lambda h: gaussian(xx=VAR * (1 + h) ** 2), H) * ERROR,
    # Coordinates (x + h y, y + h x).
    "stretch across": slope(lambda h: gaussian(VAR * (1 + h**2), 2 * h * VAR, VAR * (1 + h**2)), H)
    * ERROR,
    "stretch y": slope(lambda h: gaussian(yy=VAR * (1 + h) ** 2), H) * ERROR,
    # A covariance of 2 error sigma^2, which makes it wider by the error.
    "blur x": slope(lambda h: gaussian(xx=VAR + h), H) * 2 * ERROR * VAR,
    "blur across": slope(lambda h: gaussian(xy=h), H) * 2 * ERROR * VAR,
    "blur y": slope(lambda h: gaussian(yy=VAR + h), H) * 2 * ERROR * VAR,
    "shift x": slope(lambda h: gaussian(dx=h), H) * SHIFT * ERROR * WIDTH,
    "shift y": slope(lambda h: gaussian(dy=h), H) * SHIFT * ERROR * WIDTH,
}
ORDER = [name for name in EXPECTED if not name.startswith("shift")]
ORDER += ["wings", "shift x", "shift y"]


@pytest.mark.parametrize("name", EXPECTED)
def test_slopes_of_a_gaussian_are_those_of_its_formula(name):
    found = slopes_of(gaussian(), ERROR)[ORDER.index(name)]
    # The width is that of the sampled core (`lnocl.core.scene.cores.fwhm`).
    np.testing.assert_allclose(found, EXPECTED[name], rtol=0, atol=0.01 * abs(found).max())


def test_wings_are_those_of_a_convolution_with_a_lorentzian():
    v, u = np.fft.fftfreq(N)[:, None], np.fft.rfftfreq(N)
    width = WINGS * ERROR * WIDTH

    def wider(h):
        factor = np.exp(-2 * np.pi * h * width * np.hypot(u, v))
        return np.fft.irfft2(np.fft.rfft2(gaussian()) * factor, (N, N))

    found = slopes_of(gaussian(), ERROR)[ORDER.index("wings")]
    expected = slope(wider, 1e-3)
    middle = np.s_[N // 2 - 12 : N // 2 + 13, N // 2 - 12 : N // 2 + 13]
    # What they have beyond the array is taken from all of it, in proportion to the PSF.
    lost = (expected - found)[middle].sum() / gaussian()[middle].sum()
    np.testing.assert_allclose(
        found[middle], (expected - lost * gaussian())[middle], rtol=0, atol=0.02 * abs(found).max()
    )
    assert abs(lost * gaussian()).max() < 0.15 * abs(found).max()


def lopsided(width=2.0, n=41):
    y, x = np.indices((n, n)) - n // 2
    psf = (1 + (x**2 + 1.2 * y**2 + 0.3 * x * y) / width**2) ** -3.0
    psf *= 1 + 0.2 * np.tanh(x / width)
    return psf / psf.sum()


def test_changed_psfs_keep_their_light_and_those_alike_stay_so():
    psfs = [lopsided(3.5), lopsided(4.0), lopsided(3.5)]
    observation = lnocl.Observation(np.ones((3, 48, 48)), psfs, psf_centre="given", psf_error=ERROR)
    np.testing.assert_array_equal(alike(observation), [0, 1, 0])
    theta = np.array([[0.5, 0.2, 0.4, 0.1, 0, 0.3], np.zeros(N_SHAPES)])
    found = with_errors(observation, theta).psfs
    np.testing.assert_allclose(found.sum(axis=(1, 2)), 1.0, rtol=1e-12)
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_allclose(found[1], observation.psfs[1], rtol=0, atol=1e-15)
    sharp = with_errors(observation, np.array([[0, 0, 0, -15.0, 0, -15.0]] * 2)).psfs[0]
    assert sharp.min() == 0.0
    assert sharp.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("shape", [(81, 81), (80, 82)])
def test_stretches_are_of_the_whole_psf(shape):
    """Far from the middle a speckle is moved by more than its width, and keeps it."""
    along, across, up = 0.06, -0.02, -0.04
    y, x = (i - n // 2 for i, n in zip(np.indices(shape), shape, strict=True))

    def speckles(x, y):
        return sum(
            a * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2 / 1.3**2)
            for a, x0, y0 in ((1.0, 0, 0), (0.3, 26, -5), (0.2, -20, 24))
        )

    back = expm([[-along, -across], [-across, -up]])
    expected = speckles(back[0, 0] * x + back[0, 1] * y, back[1, 0] * x + back[1, 1] * y)
    observation = lnocl.Observation(
        np.ones((1, 96, 96)), speckles(x, y), psf_centre="given", psf_error=ERROR
    )
    theta = np.array([[along, across, up, 0, 0, 0]]) / ERROR
    found = with_errors(observation, theta).psfs[0]
    np.testing.assert_allclose(found, expected / expected.sum(), rtol=0, atol=2e-3 * found.max())


def test_no_stretch_turns_a_psf_over():
    """By more than its width, too: what is narrower stays on its own side of the middle."""
    psf = lopsided(6.0, 61)
    observation = lnocl.Observation(np.ones((1, 64, 64)), psf, psf_centre="given", psf_error=0.3)
    found = with_errors(observation, np.array([[-4.0, 0, 2.0, 0, 0, 0]])).psfs[0]
    assert np.isfinite(found).all()
    assert found.sum() == pytest.approx(1.0)
    sides = [each[:, 31:].sum() - each[:, :30].sum() for each in (psf, found)]
    assert sides[0] > 0.01
    assert sides[1] > 0.01


def test_small_stretches_are_their_derivatives():
    psf = lopsided(3.5)
    observation = lnocl.Observation(np.ones((1, 48, 48)), psf, psf_centre="given", psf_error=ERROR)
    theta = np.array([0.05, 0.02, -0.04, 0, 0, 0])
    change = with_errors(observation, theta[None]).psfs[0] - psf
    expected = np.tensordot(theta, slopes_of(psf, ERROR)[:N_SHAPES], 1)
    np.testing.assert_allclose(change, expected, rtol=0, atol=0.02 * abs(expected).max())


@pytest.mark.parametrize("blur", [4.0, -3.0])
def test_blurs_are_convolutions_with_a_gaussian_and_back(blur):
    y, x = np.indices((49, 49)) - 24
    variance = (3.5 / 2.3548) ** 2
    added = 2 * ERROR * variance * blur
    psf, expected = (
        np.exp(-(x**2) / (2 * along) - y**2 / (2 * variance)) / np.sqrt(along * variance)
        for along in (variance, variance + added)
    )
    observation = lnocl.Observation(np.ones((1, 64, 64)), psf, psf_error=ERROR)
    found = with_errors(observation, np.array([[0, 0, 0, blur, 0, 0]])).psfs[0]
    expected *= found.sum() / expected.sum()
    assert abs(expected - psf / psf.sum()).max() > 0.05 * expected.max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * expected.max())


def scene_of(psfs, **known):
    places = np.array([(20.3, 25.1), (31.7, 22.4)])
    observation = lnocl.Observation(
        np.full((3, 48, 48), 30.0), psfs, psf_centre="given", background=5.0, **known
    )
    scene = Scene(observation, places)
    fluxes = np.full(scene.n_fluxes, 4e3) + 1e3 * np.arange(scene.n_fluxes)
    return Estimate(scene, np.full(scene.grid, 2.0), fluxes)


KNOWN = {
    "plain": {"exposure": [1.0, 0.5, 2.0]},
    "turned": {"transforms": lnocl.rotations([0.0, 30.0, -40.0], centre=(24, 24))},
    "finer": {"oversample": 2},
    "epochs": {"epochs": [0, 1, 1]},
    "behind a transmission": {"transmission": np.linspace(0.4, 1, 48) * np.ones((48, 1))},
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KNOWN)
def test_slopes_of_images_are_those_of_stars_through_changed_psfs(kind):
    known = KNOWN[kind] | {"psf_error": 0.03}
    psfs = [lopsided(4.0, 95), lopsided(4.5, 95), lopsided(4.0, 95)]
    estimate = scene_of(psfs, **known)
    views = [View(estimate.scene, j, Window(6, 4, (40, 36))) for j in range(3)]
    errors = PsfErrors(estimate, views)
    step = 0.01

    def seen(number, k, sign):
        theta = np.zeros((2, N_SHAPES))
        theta[number, k] = sign * step
        observation = with_errors(estimate.scene.observation, theta)
        scene = Scene(observation, estimate.scene.places)
        changed = Estimate(scene, estimate.sky, estimate.star_fluxes)
        light = [scene.star_field.light(j, changed.fluxes) for j in range(3)]
        return np.array(light)[:, 6:46, 4:40]

    for j, number in enumerate((0, 1, 0)):
        slopes, unknowns = errors.slopes(j, views[j].model(estimate))
        assert unknowns[:N_SLOPES].tolist() == list(
            range(number * N_SLOPES, (number + 1) * N_SLOPES)
        )
        for k in range(N_SHAPES):
            expected = (seen(number, k, 1) - seen(number, k, -1))[j] / (2 * step)
            np.testing.assert_allclose(slopes[k], expected, rtol=0, atol=0.02 * abs(expected).max())


def test_zero_points_are_unknowns_within_an_epoch_without_a_common_part():
    estimate = scene_of(lopsided(), psf_error=0.03, epochs=[0, 1, 1])
    views = [View(estimate.scene, j) for j in range(3)]
    errors = PsfErrors(estimate, views)
    assert errors.n == N_SLOPES + 2
    expected = np.eye(2) + COMMON**-2
    np.testing.assert_allclose(errors.prior[-2:, -2:], expected)
    np.testing.assert_array_equal(errors.prior[:-2, :-2], np.eye(N_SLOPES))
    assert len(errors.slopes(0, views[0].model(estimate))[0]) == N_SLOPES
    model = views[1].model(estimate)
    slopes, unknowns = errors.slopes(1, model)
    np.testing.assert_allclose(slopes[-1], ZERO_POINTS * 0.03 * (model - views[1].background))
    assert unknowns[-1] == N_SLOPES


def test_theta_of_two_psfs_is_correlated_and_each_has_its_own_variance():
    estimate = scene_of([lopsided(3.0), lopsided(3.5), lopsided(3.0)], psf_error=0.03)
    views = [View(estimate.scene, j) for j in range(3)]
    prior = PsfErrors(estimate, views).prior[: 2 * N_SLOPES, : 2 * N_SLOPES]
    expected = np.kron([[1.0, ALIKE], [ALIKE, 1.0]], np.eye(N_SLOPES))
    np.testing.assert_allclose(np.linalg.inv(prior), expected, rtol=0, atol=1e-12)


def test_light_beyond_a_file_is_an_unknown_where_images_are_larger():
    y, x = np.indices((401, 401)) - 200
    whole = (1 + (x**2 + y**2) / 4.0) ** -2.0
    whole /= whole.sum()
    cut = whole[185:216, 185:216]
    missing = 1.0 / cut.sum() - 1.0
    assert 0.01 < missing < 0.1
    estimate = scene_of(cut, psf_error=0.03)
    view = View(estimate.scene, 0)
    slopes, _ = PsfErrors(estimate, [view] * 3).slopes(0, view.model(estimate))
    beyond = slopes[N_SLOPES - 2]
    light = estimate.scene.star_field.light(0, estimate.fluxes)
    inside = light > 0.05 * light.max()
    np.testing.assert_allclose(beyond[inside], -missing * light[inside], rtol=0.2)
    assert beyond[30:, :8].min() > 0  # beyond the file of either star
    as_large = np.pad(whole[176:225, 176:225], 4)
    estimate = scene_of(as_large, psf_error=0.03)
    view = View(estimate.scene, 0)
    slopes, _ = PsfErrors(estimate, [view] * 3).slopes(0, view.model(estimate))
    assert not slopes[N_SLOPES - 2].any()


@pytest.mark.parametrize("share", [0.04, 0.2])
def test_a_level_of_a_file_is_as_bright_as_its_border_but_for_more_than_the_error(share):
    clean = lopsided(2.0, 41)
    estimate = scene_of((1 - share) * clean + share / clean.size, psf_error=0.05)
    view = View(estimate.scene, 0)
    slopes, _ = PsfErrors(estimate, [view] * 3).slopes(0, view.model(estimate))
    with_it, without = (
        each.scene.star_field.light(0, estimate.fluxes)
        for each in (estimate, scene_of(clean, psf_error=0.05))
    )
    expected = (1 - share) * (with_it - without) * min(0.05 / share, 1.0)
    found, most = slopes[N_SLOPES - 1], abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=5e-3 * most)
    assert found[0, 0] == pytest.approx(expected[0, 0], rel=0.05)  # far from both stars


class TestPixels:
    def errors(self, **known):
        estimate = scene_of([lopsided(), lopsided(2.4), lopsided()], **known)
        return PsfErrors(estimate, [View(estimate.scene, j) for j in range(3)]).pixels((60, 54))

    def test_they_change_no_light_and_images_of_one_psf_alike(self):
        field = self.errors(psf_error=0.03)
        x = np.random.default_rng(1).standard_normal(field.at.shape)
        assert x.shape == (2, 60, 54)
        images = np.array(list(field.forward(x)))
        assert abs(images[0]).max() > 0
        largest = abs(images).sum(axis=(1, 2))
        assert (abs(images.sum(axis=(1, 2))) < 1e-12 * largest).all()
        np.testing.assert_array_equal(images[0], images[2])

    def test_the_adjoint_is_the_transpose(self):
        field, rng = self.errors(psf_error=0.03), np.random.default_rng(2)
        x, y = rng.standard_normal(field.at.shape), rng.standard_normal((3, 60, 54))
        forward = sum(np.vdot(a, b) for a, b in zip(field.forward(x), y, strict=True))
        assert forward == pytest.approx(np.vdot(x, field.adjoint(y)), rel=1e-12)

    def test_they_are_as_large_as_the_scatter_that_is_given(self):
        scatter = np.array([0.2 * lopsided(), 0.2 * lopsided(2.4), 0.2 * lopsided()])
        field, rng = self.errors(psf_error=0.0, psf_scatter=scatter), np.random.default_rng(3)
        drawn = [field.forward(rng.standard_normal(field.at.shape))[0] for _ in range(400)]
        found = np.std(drawn, axis=0)[:48, :48]
        light = scene_of([lopsided()] * 3).scene.star_field.light(
            0, np.array([4e3, 5e3]) / scene_of(lopsided()).scene.unit
        )
        there = (light > 0.1 * light.max()) & (light < 0.3 * light.max())
        # Where the light that the pixels win, and all lose, counts little.
        assert found[there] == pytest.approx(0.2 * light[there], rel=0.25)
