"""Tiles of every kind of scene: against the whole, and against the sky that was simulated.

Sources and PSFs are Gaussians, each PSF with a ghost beside it, so that images are known between
the pixels of the sky too.
"""

import warnings

import numpy as np
import pytest
from scipy.signal import fftconvolve
from turned_scenes import COVARIANCES, gaussian, psf

import lnocl
from lnocl import tiles, tiling
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_check import warn_of_stars
from lnocl.errors import InputError

SHAPE = 40, 56
# Of the image whose pixels are larger.
LARGER = 32, 43
STARS = np.array([(14.3, 11.8), (36.6, 27.2), (44.8, 13.4)])
FLUXES = np.array([3e4, 5e4, 2e4])
# How much brighter they are in the second epoch.
RISES = np.array([1.5, 1.0, 2.0])
# Flux, place and covariance of the sources.
SOURCES = [(4e4, (28, 18), [[9, 3], [3, 6]]), (2e4, (12, 28), [[5, 0], [0, 8]])]
SOURCES += [(1.5e4, (46, 29), [[16, -4], [-4, 7]])]
# Of two skies, those that are of the line, and how bright images show it.
OF_LINE, LINE = np.array([True, False, False]), np.array([1.0, 0.0, 0.7])
EXPOSURE = np.array([1.0, 2.5, 0.6])
PSF_COVARIANCES = [0.7 * each for each in COVARIANCES]
# A transmission is less by a Gaussian of this depth, place and covariance.
DEPTH, HIDDEN, WIDTH = 0.8, np.array([31.0, 23.0]), np.diag([20.0, 12.0])

OFFSETS = {"offsets": [(0, 0), (4.4, -3.3), (-6.0, 5.0)]}
EPOCHS = {"epochs": ["1 Jan", "2 Feb", "1 Jan"]}
BEHIND = {"transmission": True}
TURNED = {"transforms": lnocl.rotations([0.0, 17.0, -75.0], (27.0, 20.0))}
SCALED = {"transforms": TURNED["transforms"].copy()}
SCALED["transforms"][2] = [[0.6, 0.1, -2.2], [-0.1, 0.6, 5.1]]
FINER = {"oversample": 2, "effective_psfs": True}
TWO = {"components": {"line": LINE, "continuum": np.ones(3)}}
UNSURE = {"component_errors": {"continuum": [0.02, 0.02, 0.01]}}
KINDS = {
    "epochs": EPOCHS,
    "transmission": BEHIND,
    "offsets": OFFSETS,
    "offsets, epochs, transmission": OFFSETS | EPOCHS | BEHIND,
    "turned": TURNED,
    "scaled": SCALED,
    "turned, epochs, transmission": TURNED | EPOCHS | BEHIND,
    "finer": FINER,
    "turned, finer": TURNED | FINER,
    "line and continuum": TWO | UNSURE,
    "line and continuum, turned": TWO | TURNED,
}


def shares(x, y):
    """Return the transmission at places of the sky."""
    peak = 2 * np.pi * np.sqrt(np.linalg.det(WIDTH))
    return 1.0 - DEPTH * peak * gaussian(x - HIDDEN[0], y - HIDDEN[1], WIDTH)


def hidden(flux, place, covariance):
    """Return what of a source a transmission takes away, which is a Gaussian too."""
    inverse, of_mask = np.linalg.inv(covariance), np.linalg.inv(WIDTH)
    both = np.linalg.inv(inverse + of_mask)
    share = shares(*HIDDEN) - 1.0  # at most
    share *= gaussian(*(np.array(place) - HIDDEN), np.array(covariance) + WIDTH)
    share *= 2 * np.pi * np.sqrt(np.linalg.det(WIDTH))
    return share * flux, both @ (inverse @ place + of_mask @ HIDDEN), both


def make_skies(y, x, kind=""):
    """Return the extended source at places of the sky, or line and continuum."""
    of = [flux * gaussian(x - cx, y - cy, np.array(c)) for flux, (cx, cy), c in SOURCES]
    masks = [OF_LINE, ~OF_LINE] if "line" in kind else [np.ones(3, bool)]
    skies = [sum(np.array(of)[mask]) for mask in masks]
    return np.array(skies) if "line" in kind else skies[0]


def make_means(j, shape, maps, fluxes, transmission, line=1.0):
    """Return what image j has of sky and stars for an exposure of 1, without background."""
    y, x = np.indices(shape)
    turn, shift = maps[j, :, :2], maps[j, :, 2]
    behind = [hidden(*each) for each in SOURCES] if transmission else []
    stars = fluxes * shares(*STARS.T) if transmission else fluxes
    points = [(flux, place, np.zeros((2, 2))) for flux, place in zip(stars, STARS, strict=True)]
    image = np.zeros(shape)
    sources = [
        (flux * (line if of_line else 1.0), place, covariance)
        for (flux, place, covariance), of_line in zip(SOURCES, OF_LINE, strict=True)
    ]
    for flux, place, covariance in (*sources, *behind, *points):
        at = turn @ place + shift
        seen = turn @ covariance @ turn.T + PSF_COVARIANCES[j]
        image += flux * psf(x - at[0], y - at[1], seen)
    return image


def observe(kind, seed=0, side=13):
    """Return counts of a scene, their means, and the fluxes of its stars, in each epoch."""
    given = dict(KINDS.get(kind, {}))
    maps = np.array(given.get("transforms", [np.eye(2, 3)] * 3))
    if "offsets" in given:
        maps[:, :, 2] = given["offsets"]
    has_epochs, has_mask = "epochs" in given, given.pop("transmission", False)
    of_images = [FLUXES * RISES if j == 1 and has_epochs else FLUXES for j in range(3)]
    shapes = [SHAPE, SHAPE, LARGER if kind == "scaled" else SHAPE]
    lines = LINE if "line" in kind else np.ones(3)
    means = [
        EXPOSURE[j] * make_means(j, shape, maps, of_images[j], has_mask, line) + 5.0
        for j, (shape, line) in enumerate(zip(shapes, lines, strict=True))
    ]
    rng = np.random.default_rng(seed)
    counts = [rng.poisson(mean) for mean in means]
    if has_mask:
        given["transmission"] = shares(*np.indices(SHAPE)[::-1])
    q = given.get("oversample", 1)
    y, x = (np.indices((q * side + 1 - q % 2,) * 2) - q * side // 2) / q
    psfs = [psf(x, y, each) for each in PSF_COVARIANCES]
    observation = lnocl.Observation(counts, psfs, background=5.0, exposure=EXPOSURE, **given)
    return observation, means, np.transpose(of_images[: observation.n_epochs]).ravel()


@pytest.mark.parametrize("kind", KINDS)
def test_cores_of_tiles_are_the_images_that_were_simulated(kind):
    """Each pixel is in the core of one tile, which models it by its own part of the sky.

    Between pixels stars err by 5e-4 of their peak, and by three times as much behind a
    transmission, which is taken to be linear between these.
    """
    observation, means, fluxes = observe(kind, side=19)
    upright = observation.upright()
    laid = tiling.lay(upright, 80 if kind == "scaled" else 56, 5)
    mosaic = tiles._Mosaic(upright, STARS, "", laid[0])
    assert len(laid) > 1
    for tile in filter(None, (tiling.cut(upright, STARS, None, spans) for spans in laid)):
        scene = Scene(tile.observation, tile.stars, pad=5)
        rows, columns = (span.window for span in tile.spans)
        sky, q = np.zeros(scene.sky_grid), scene.oversample
        fine = (np.arange(q * at.start, q * at.stop) - (q - 1) / 2 for at in (rows, columns))
        y, x = np.ix_(*(each / q for each in fine))
        sky[..., : y.size, : x.size] = make_skies(y, x, kind) / q**2
        seen = abs(tile.stars[:, None] + (columns[0], rows[0]) - STARS).sum(axis=2).argmin(axis=1)
        estimate = Estimate(scene, sky, fluxes.reshape(3, -1)[seen].ravel())
        models = [scene.in_electrons(each, j) for j, each in enumerate(estimate.models())]
        mosaic.add_models(tile, np.array(models))
    models = upright.as_given(np.array(list(mosaic.models())))
    for model, mean, exposure in zip(models, means, EXPOSURE, strict=True):
        error = abs(model[: len(mean), : mean.shape[1]] - mean).max() / exposure
        assert error < (2e-3 if "transmission" in kind else 6e-4) * means[0].max()


RUN = {"engine": "numpy", "stop": None, "smoothing": 0.02}


@pytest.mark.exhaustive
def test_stars_of_tiles_have_a_flux_in_each_epoch():
    observation, _, _ = observe("epochs")
    run = RUN | {"n_iter": 10}
    whole = lnocl.deconvolve(observation, STARS, **run)
    found = lnocl.deconvolve_tiles(observation, STARS[::-1], tile=56, pad=4, **run)
    assert len(found.tiles) > 1
    backwards = [4, 5, 2, 3, 0, 1]
    np.testing.assert_allclose(found.star_positions, whole.star_positions[backwards], rtol=1e-14)
    assert found.to_table()["epoch"].tolist() == [0, 1] * 3
    off = (found.star_fluxes - whole.star_fluxes[backwards]) / whole.star_flux_errors[backwards]
    assert abs(off).max() < 0.5
    early, late = found.star_fluxes.reshape(-1, 2).T
    np.testing.assert_allclose(late / early, RISES[::-1], rtol=0.02)
    assert len(found.star_residuals()) == 6


@pytest.mark.filterwarnings("error:invalid value")
def test_an_image_that_a_tile_does_not_see_tells_nothing_of_its_light():
    counts = np.random.default_rng(0).poisson(20.0, (2, 12, 14))
    psf_of_all = np.ones((2, 3, 2))
    bad = np.zeros(counts.shape, bool)
    bad[1] = True
    both = lnocl.Observation(counts, psf_of_all, mask=bad)
    one = lnocl.Observation(counts[:1], psf_of_all[:1])
    run = RUN | {"n_iter": 3}
    fluxes = [lnocl.deconvolve(each, **run).extended_flux for each in (both, one)]
    np.testing.assert_allclose(fluxes[0], fluxes[1], rtol=1e-6)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_tiles_are_the_whole_and_the_sky_that_was_simulated(kind):
    observation, _, fluxes = observe(kind)
    # Line and continuum are told apart slowly; with a Tikhonov term sooner.
    run = RUN | ({"n_iter": 1000, "mu": 2e-4} if "line" in kind else {"n_iter": 120})
    tile = {"scaled": 72}.get(kind, 56 if "turned" in kind else 46)
    whole = lnocl.deconvolve(observation, STARS, **run)
    found = lnocl.deconvolve_tiles(observation, STARS, tile=tile, pad=4, **run)
    assert len(found.tiles) > 1
    difference = abs(found.extended - whole.extended)
    assert difference.max() < 4e-3 * whole.extended.max()
    np.testing.assert_allclose(found.star_fluxes, whole.star_fluxes, rtol=2e-4)
    np.testing.assert_allclose(found.star_flux_errors, whole.star_flux_errors, rtol=0.02)
    sky, q = make_skies(*np.indices(SHAPE), kind), observation.oversample
    (ny, nx), errors = SHAPE, []
    for each in (whole, found):
        pixels = each.extended.reshape(-1, ny, q, nx, q).sum(axis=(2, 4))
        errors.append(np.linalg.norm(pixels - sky))
    assert errors[1] == pytest.approx(errors[0], rel=0.01)
    for each in (whole, found):
        assert (abs(each.star_fluxes - fluxes) < 3 * each.star_flux_errors).all()
        flux, error = each.extended_flux
        assert (abs(flux - sky.sum(axis=(-2, -1))) < 3 * error).all()
    # Tiles are summed as if the noise at their borders were of each alone.
    np.testing.assert_allclose(found.extended_flux[1], whole.extended_flux[1], rtol=0.08)
    assert found.fit().rms == pytest.approx(whole.fit().rms, rel=0.01)


@pytest.mark.exhaustive
@pytest.mark.parametrize("epochs", [None, [0, 1]])
def test_tiles_warn_of_their_own_stars_alone(epochs):
    """A neighbour's lies in the corner of what is seen of a turned image, and beyond the other."""
    y, x = np.indices((13, 13)) - 6
    observation = lnocl.Observation(
        np.full((2, 72, 72), 20.0), psf(x, y, COVARIANCES[0]), epochs=epochs,
        transforms=lnocl.rotations([0.0, 40.0], (35.5, 35.5)),
    )  # fmt: skip
    stars = np.stack(np.meshgrid(*[np.arange(13.0, 60.0, 5.0)] * 2), axis=-1).reshape(-1, 2)
    said = {"own": [], "all": [], "whole": []}
    laid = tiling.lay(observation, 48, 0)
    cuts = [tiling.cut(observation, stars, None, spans) for spans in laid]
    cuts = [tile.without_unseen_neighbours() for tile in cuts]
    assert sum(len(tile.own) for tile in cuts) == len(stars)
    scenes = [(Scene(tile.observation, tile.stars), tile.own, "own") for tile in cuts]
    scenes += [(scene, None, "all") for scene, _, _ in scenes]
    for scene, own, name in [*scenes, (Scene(observation, stars), None, "whole")]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            warn_of_stars(scene, False, own)
        said[name] += [str(each.message) for each in caught]
    assert said["own"] == said["whole"] == []
    assert any("bad pixels" in each for each in said["all"])
    assert any("its flux there is NaN" in each for each in said["all"]) == (epochs is not None)


def test_tiles_behind_a_transmission_of_0_have_the_background():
    y, x = np.indices((9, 9)) - 4
    shares = np.ones((80, 96))
    shares[10:70, 30:80] = 0.0
    of_star = psf(x, y, COVARIANCES[0])
    of_star /= of_star.sum()
    means = 20.0 + fftconvolve(30.0 * shares, of_star, "same")
    counts = np.random.default_rng(0).poisson(means, (2, 80, 96))
    observation = lnocl.Observation(counts, of_star, background=20.0, transmission=shares)
    run = RUN | {"tile": 40, "pad": 4, "n_iter": 10}
    found = lnocl.deconvolve_tiles(observation, **run)
    assert len(found.tiles) < len(tiling.lay(observation, 40, 4))
    models = np.array(list(found._findings.models()))
    np.testing.assert_allclose(models[:, 30:50, 40:70], 20.0)
    assert found.fit().rms == pytest.approx(1.0, abs=0.03)
    with pytest.raises(InputError, match=r"lies in a tile .* behind a transmission of 0"):
        lnocl.deconvolve_tiles(observation, [(55, 40)], **run)
    behind = observation.replace(star_psfs=0.1 * of_star, star_places=(55, 40))
    with pytest.raises(InputError, match=r"a star with a PSF of its own, .* a larger tile"):
        lnocl.deconvolve_tiles(behind, [(55, 40)], **run)
