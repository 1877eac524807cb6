"""Marginal star fluxes: holes under stars filled, light conserved, and what they depend on."""

import numpy as np
import pytest

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.marginal import marginal
from lnocl.core.solvers.psf_errors import PsfErrors

N = 48
Y, X = np.indices((N, N)) - N // 2
PSF = np.exp(-4 * np.log(2) * (X**2 + Y**2) / 16.0)
PSF /= PSF.sum()
HOST = np.exp(-np.hypot(X, Y) / 6.0)
HOST *= 1e5 / HOST.sum()
STARS, FLUXES = [(24, 24), (33, 21)], np.array([1e5, 3e4])


def a_scene(scale=1.0, stars=STARS, fluxes=FLUXES, psf=PSF, host=HOST, **known):
    """Return a scene of the mean counts of a host and stars."""
    observation = lnocl.Observation(np.full((N, N), 5.0), psf, background=scale * 30.0, **known)
    flat = Scene(observation, stars)
    light = np.array(list(Model(flat).images(scale * host / flat.unit, scale * fluxes / flat.unit)))
    if flat.has_exposure_map:
        light *= flat.weights
    observation = lnocl.Observation(light * flat.scale, psf, background=scale * 30.0, **known)
    return Scene(observation, stars)


def after_step(scene, sky, fluxes):
    found = marginal(Estimate(scene, sky, fluxes))
    return found.sky, found.star_fluxes


def with_hole(share=0.7):
    """Return an estimate that has given a share of the light under the first star to it."""
    hole = share * HOST * np.exp(-(((X**2 + Y**2) / 6.0) ** 2))
    return HOST - hole, FLUXES + np.array([hole.sum(), 0.0])


@pytest.mark.parametrize(
    "known", [{}, {"exposure": 2.0}, {"mask": np.eye(N, dtype=bool)}, {"offsets": [(0.3, -1.2)]}]
)
@pytest.mark.filterwarnings("ignore:the images are shifted")
def test_a_hole_under_a_star_is_filled(known):
    scene = a_scene(**known)
    sky, fluxes = with_hole()
    found_sky, found = after_step(scene, sky, fluxes)
    assert abs(found[0] - FLUXES[0]) < 0.25 * abs(fluxes[0] - FLUXES[0])
    assert np.linalg.norm(found_sky - HOST) < 0.25 * np.linalg.norm(sky - HOST)
    assert abs(found[1] / FLUXES[1] - 1) < 0.01


def test_the_extended_source_gains_no_more_than_the_stars_lose():
    sky, fluxes = with_hole()
    found_sky, found = after_step(a_scene(), sky, fluxes)
    gained, lost = found_sky.sum() - sky.sum(), fluxes.sum() - found.sum()
    assert 0.9 * lost < gained < 1.0001 * lost
    assert (found_sky >= 0).all()
    far = np.min([np.hypot(X + 24 - x, Y + 24 - y) for x, y in STARS], axis=0) > 5
    np.testing.assert_array_equal(found_sky[far], sky[far])


def test_light_where_no_image_has_observed_a_pixel_goes_to_the_star():
    """An estimate has given a ring under the mask a tenth of the star."""
    radius, sky, flux = np.hypot(X, Y), np.full((N, N), 2.0), FLUXES[:1]
    psf = (1 + (X**2 + Y**2) / 15.0) ** -3.0  # with wings, which are seen beyond the mask
    scene = a_scene(stars=STARS[:1], fluxes=flux, psf=psf, host=sky, mask=radius < 6)
    ring = np.exp(-0.5 * (radius - 4.5) ** 2)
    ring *= 1e4 / ring.sum()
    found_sky, found = after_step(scene, sky + ring, flux - 1e4)
    won, taken = found - (flux - 1e4), sky + ring - found_sky
    assert won[0] == pytest.approx(1e4, rel=0.1)
    assert taken.sum() == pytest.approx(won[0], rel=0.01)
    assert taken[radius > 3.5].sum() > 0.5 * won[0]


def test_the_truth_stays():
    found_sky, found = after_step(a_scene(), HOST, FLUXES)
    np.testing.assert_allclose(found, FLUXES, rtol=0.005)
    assert np.linalg.norm(found_sky - HOST) < 0.02 * np.linalg.norm(HOST)


def test_a_star_that_nothing_determines_stays():
    scene = a_scene()
    scene.move_stars([STARS[0], STARS[0]])
    sky, fluxes = with_hole()
    found_sky, found = after_step(scene, sky, fluxes)
    np.testing.assert_array_equal(found, fluxes)
    np.testing.assert_array_equal(found_sky, sky)


def test_shapes_of_psfs_that_may_be_wrong_are_held(monkeypatch):
    sky, fluxes = with_hole()
    exact = after_step(a_scene(), sky, fluxes)
    held = after_step(a_scene(psf_scatter=0.1 * PSF), sky, fluxes)
    for found, expected in zip(held, exact, strict=True):
        np.testing.assert_array_equal(found, expected)
    monkeypatch.delattr(PsfErrors, "slopes")
    _, found = after_step(a_scene(psf_error=0.03), sky, fluxes)
    assert found[0] != exact[1][0]  # as pixels of PSFs are free, and so is a cusp
    np.testing.assert_allclose(found, FLUXES, rtol=0.01)


def test_fluxes_are_not_negative_and_absent_stars_stay_at_zero():
    """Where the images show nothing of a star that the estimate has, or has no more."""
    scene = a_scene(fluxes=np.array([0.0, 3e4]))
    for held in (10.0, 0.0):
        _, found = after_step(scene, 0.9 * HOST, np.array([held, 3e4]))
        assert found[0] >= 0.0
    assert found[0] == 0.0
    scene = a_scene(fluxes=np.array([-500.0, 3e4]))  # a hole in the light of the host
    _, found = after_step(scene, HOST, np.array([300.0, 3e4]))
    assert found[0] == 0.0


class TestByDefault:
    """A quasar on an exponential host, whose centre early iterations give to it."""

    def run(self, seed, **options):
        means = a_scene().images()
        counts = np.random.default_rng(seed).poisson(next(iter(means)) * a_scene().scale)
        observation = lnocl.Observation(counts, PSF, background=30.0)
        return lnocl.deconvolve(observation, STARS, pad=0, engine="numpy", **options)

    @pytest.mark.exhaustive
    @pytest.mark.filterwarnings("ignore:held-out counts have chosen")
    def test_fluxes_are_within_their_errors(self):
        results = [self.run(seed) for seed in range(3)]
        off = np.array([(r.star_fluxes - FLUXES) / r.star_flux_errors for r in results])
        assert np.sqrt(np.mean(off**2)) < 1.5
        near = np.hypot(X, Y) < 5
        assert all(abs(r.extended[near].sum() / HOST[near].sum() - 1) < 0.1 for r in results)

    def test_given_smoothing_disables_marginal_fluxes(self):
        result = self.run(0, smoothing=0.0, stop=None, n_iter=20)
        before = result._outcome
        assert not before.is_marginal
        assert self.run(0, n_iter=20, stop=None)._outcome.is_marginal
