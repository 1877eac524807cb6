"""Zero points of images are told by their stars, and wrong PSFs are not taken for them."""

from types import SimpleNamespace

import numpy as np
import pytest
from test_saturation import lopsided

import lnocl
from lnocl.core.scene import zero_points as module
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.zero_points import zero_points

SHAPE, LEVEL = (60, 64), 50.0
STARS = np.array([(22.3, 36.8), (41.7, 24.1)])
WIDTHS, FACTORS = (2.6, 3.0, 3.4), np.array([0.7, 1.0, 1.1])


def observe(factors=FACTORS, flux=4e4, seed=0, psf_widths=WIDTHS, exposure=1.0, q=1, **known):
    """Return images of two stars on a host of the first, and of other widths each."""
    chance, images = np.random.default_rng(seed), []
    maps = known.get("transforms", np.tile(np.eye(2, 3), (len(WIDTHS), 1, 1)))
    dims = np.broadcast_to(exposure, (len(WIDTHS), *SHAPE)) if np.ndim(exposure) > 1 else exposure
    for j, width in enumerate(WIDTHS):
        places = STARS @ maps[j][:, :2].T + maps[j][:, 2]
        light = sum(
            c * lopsided(*at, SHAPE, width) for c, at in zip((1.0, 0.5), places, strict=True)
        )
        light += 2.0 * lopsided(*places[0], SHAPE, np.hypot(width, 4.0))
        dim = factors[j] * (dims[j] if np.ndim(dims) else dims)
        images.append(chance.poisson(LEVEL + dim * flux * light))
    n = 20 * q
    psfs = [lopsided(n, n, (2 * n + 1, 2 * n + 1), q * width) for width in psf_widths]
    given = {} if np.ndim(exposure) == 0 else {"exposure": exposure}
    return lnocl.Observation(images, psfs, background=LEVEL, oversample=q, **given, **known)


RAMP = np.linspace(0.5, 1.5, SHAPE[1]) * np.ones((3, *SHAPE))
KINDS = {
    "plain": {},
    "exposures": {"exposure": [10.0, 3.0, 5.0], "flux": 1e4},
    "maps of exposures": {"exposure": RAMP},
    "turned": {"transforms": lnocl.rotations([0.0, 25.0, 50.0], (31.0, 30.0))},
    "a finer sky": {"q": 2},
}


@pytest.mark.parametrize("name", KINDS)
def test_zero_points_are_measured_in_images_of_every_kind(name):
    observation = observe(**KINDS[name])
    found = zero_points(Scene(observation, STARS))
    assert found.n_stars == 2
    expected = np.log(FACTORS / np.median(FACTORS))
    assert (np.abs(found.values - expected) < 3.0 * found.errors).all()
    assert (found.errors < 0.015).all()
    assert found.values[1] == 0.0


RIGHT = {
    "right": {},
    "faint": {"flux": 300.0, "factors": [0.8, 1.0, 1.1]},
    "a PSF too narrow": {"psf_widths": (2.1, 3.0, 3.4), "flux": 4e6},
    "a PSF too wide": {"psf_widths": (2.6, 3.6, 3.4), "flux": 4e6},
    "exposures": {"exposure": [10.0, 3.0, 5.0]},
}


@pytest.mark.parametrize("name", RIGHT)
@pytest.mark.parametrize("seed", range(3))
def test_zero_points_are_absent_where_images_do_not_determine_them(name, seed):
    observation = observe(**{"factors": np.ones(3), **RIGHT[name]}, seed=seed)
    assert zero_points(Scene(observation, STARS)) is None


@pytest.mark.parametrize("epochs", [None, (0, 1, 2)])
def test_a_star_that_varies_and_masked_ones_do_not_matter_beside_others(epochs):
    y, x = np.indices((150, 150))
    stars = 25.0 + 33.0 * np.mgrid[:4, :4].reshape(2, -1).T
    stars += np.random.default_rng(5).uniform(-0.5, 0.5, stars.shape)
    images = []
    for j, factor in enumerate((0.8, 1.0, 1.0)):
        fluxes = np.full(16, 5e4)
        fluxes[1] *= (3.0, 1.0, 0.2)[j]
        light = sum(c * lopsided(*at, x.shape) for c, at in zip(fluxes, stars, strict=True))
        images.append(np.random.default_rng(j).poisson(LEVEL + factor * light))
    mask = np.hypot(x - stars[2, 0], y - stars[2, 1]) < 2.0
    psf = lopsided(20, 20, (41, 41))
    observation = lnocl.Observation(images, psf, background=LEVEL, mask=mask, epochs=epochs)
    found = zero_points(Scene(observation, stars))
    assert found.n_stars == 15
    assert found.values[0] == pytest.approx(np.log(0.8), abs=3.0 * found.errors[0])
    assert (found.values[1:] == 0.0).all()


def test_images_of_several_epochs_need_three_stars():
    """Two may vary alike."""
    observation = observe(epochs=(0, 1, 2))
    assert zero_points(Scene(observation, STARS)) is None
    assert zero_points(Scene(observe(epochs=(0, 0, 0)), STARS)) is not None


@pytest.mark.parametrize("factors", [[0.6, 1.0, 1.3, 1.3], [0.6, 1.0, 0.7 * 0.6, 1.0]])
def test_images_are_compared_with_those_of_their_own_filter(factors):
    """Stars that are all fainter in a filter than in another tell of no cloud."""
    stars = np.array([(20.2, 22.0), (50.7, 31.4), (79.3, 40.1)])
    alone = sum(lopsided(*at, (64, 100)) for at in stars)
    images = [np.random.default_rng(3).poisson(LEVEL + 5e4 * each * alone) for each in factors]
    weights = {"line": [1, 0, 1, 0], "continuum": [1, 1, 1, 1]}
    psf = lopsided(20, 20, (41, 41))
    observation = lnocl.Observation(images, psf, background=LEVEL, components=weights)
    found = zero_points(Scene(observation, stars))
    brighter = np.tile(np.reshape(factors, (2, 2)).max(axis=0), 2)
    told = np.log(factors / brighter)
    assert found.n_stars == 3
    np.testing.assert_allclose(found.values, told, atol=0.01)
    alike = observation.replace(images=np.array(images)[[0, 1, 0, 1]])
    assert zero_points(Scene(alike, stars)) is None
    two = lnocl.Observation(images[:2], psf, background=LEVEL, components={"a": [1, 0], "b": 1})
    assert zero_points(Scene(two, stars)) is None


def test_clouds_of_a_few_nights_are_told_by_four_stars_of_which_one_varies():
    rng, x = np.random.default_rng(11), np.indices((80, 80))[1]
    stars = np.array([(22.2, 24.0), (57.0, 26.4), (40.7, 56.1), (20.4, 60.3)])
    alone = [lopsided(*at, x.shape) for at in stars]
    clear = np.array([1.0, 0.7, 1.0, 0.85, 0.92, 1.0, 1.0, 1.0])
    fluxes = 5e4 * clear[:, None] * np.ones((8, 4))
    fluxes[:, 2] *= np.exp(0.2 * rng.standard_normal(8))
    images = [rng.poisson(LEVEL + np.einsum("s,syx->yx", each, alone)) for each in fluxes]
    psf = lopsided(20, 20, (41, 41))
    observation = lnocl.Observation(images, psf, background=LEVEL, epochs=range(8))
    found = zero_points(Scene(observation, stars))
    np.testing.assert_allclose(found.values, np.log(clear), atol=0.015)


@pytest.mark.parametrize(("n_stars", "spread"), [(4, 0.0), (30, 0.05)])
@pytest.mark.parametrize("blank", [0, 30])
def test_variation_counts_once_and_blank_nights_not(monkeypatch, n_stars, spread, blank):
    """Of photometry that is drawn: of nights of which one has a cloud, some without stars."""
    rng = np.random.default_rng(n_stars)
    fluxes = 1e4 * np.exp(spread * rng.standard_normal((10, n_stars)))
    fluxes[3] *= 0.8
    fluxes = np.concatenate([fluxes, np.full((blank, n_stars), np.nan)])
    drawn = (fluxes * (1.0 + 0.003 * rng.standard_normal(fluxes.shape)), (0.003 * fluxes) ** 2)
    monkeypatch.setattr(module, "_photometry", lambda *_: drawn)
    n = len(fluxes)
    found = zero_points(SimpleNamespace(mixing=None, n_epochs=n, n_images=n))
    assert found.values[3] == pytest.approx(np.log(0.8), abs=3.0 * found.errors[3])
    assert found.errors[3] < 2.0 * np.hypot(spread, 0.006) * np.sqrt(np.pi / 2.0 / n_stars)


def test_an_image_of_one_star_that_others_show_too_tells_nothing(monkeypatch):
    """Of three stars of a night two are seen in no other: the third may vary."""
    logs = 10.0 + 0.004 * np.random.default_rng(0).standard_normal((8, 8))
    logs[1:, 6:] = logs[0, 1:6] = np.nan
    logs[0, 0] -= 0.3
    drawn = np.exp(logs), (0.004 * np.exp(logs)) ** 2
    monkeypatch.setattr(module, "_photometry", lambda *_: drawn)
    assert zero_points(SimpleNamespace(mixing=None, n_epochs=8, n_images=8)) is None
    logs[1] = np.where(np.arange(8) < 6, np.nan, 10.0)  # and two of them in one that has no other
    drawn = np.exp(logs), (0.004 * np.exp(logs)) ** 2
    found = module._measured(None, 1.0, 3)
    assert np.isnan(found.values[:2]).all()
    assert np.isfinite(found.values[2:]).all()


@pytest.mark.parametrize("seed", range(10))
def test_chance_agreement_of_three_variable_stars_gives_no_zero_points(seed):
    """By a tenth in each of twelve nights; most such scenes had one, and 100 nights two."""
    rng, x = np.random.default_rng(seed), np.indices((80, 80))[1]
    stars = np.array([(22.2, 24.0), (57.0, 26.4), (40.7, 56.1)])
    alone = [lopsided(*at, x.shape) for at in stars]
    fluxes = 5e4 * np.exp(0.1 * rng.standard_normal((12, 3)))
    images = [rng.poisson(LEVEL + np.einsum("s,syx->yx", each, alone)) for each in fluxes]
    psf = lopsided(20, 20, (41, 41))
    observation = lnocl.Observation(images, psf, background=LEVEL, epochs=range(12))
    assert zero_points(Scene(observation, stars)) is None
