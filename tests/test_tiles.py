"""Tiles, and PSFs that vary over the field: against the whole, and against a PSF for each pixel."""

import argparse
import re

import numpy as np
import pytest
from astropy.io import fits
from commandline import outcome
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RegularGridInterpolator
from scipy.signal import fftconvolve

import lnocl
from lnocl import PsfField, tiles, tiling
from lnocl.commands import cli
from lnocl.commands.deconvolve import in_tiles
from lnocl.core.scene.shifting import MovablePsf
from lnocl.errors import InputError
from lnocl.metrics import restoration_error

HALF = 10
Y, X = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
N = 128
RUN = {"engine": "numpy", "precision": "double", "stop": None}


def vary(x, y, size=N, growth=0.5, turn=60.0):
    """Return a Gaussian whose width grows by half, and that turns by 60 degrees, to the corner."""
    middle = (size - 1) / 2.0
    r = np.hypot(x - middle, y - middle) / np.hypot(middle, middle)
    width, angle = 1.7 * (1.0 + growth * r), np.deg2rad(turn * r)
    along = (X * np.cos(angle) + Y * np.sin(angle)) / width
    across = (Y * np.cos(angle) - X * np.sin(angle)) / (0.8 * width)
    psf = np.exp(-0.5 * (along**2 + across**2))
    return psf / psf.sum()


def make_field(n=3, size=N, **how):
    nodes = np.linspace(0.0, size - 1.0, n)
    positions = [(x, y) for y in nodes for x in nodes]
    return PsfField([vary(x, y, size, **how) for x, y in positions], positions)


def make_sky(seed=0, size=N):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:size, :size]
    sky = np.full((size, size), 2.0)
    for _ in range(size // 8):
        (cx, cy), width, peak = rng.uniform(0, size, 2), rng.uniform(2.0, 8.0), rng.uniform(10, 60)
        sky += peak * np.exp(-np.hypot(x - cx, y - cy) / width)
    return sky


def see(sky, psf_at):
    """Return the image of a sky through a PSF for each of its pixels, by brute force."""
    ny, nx = sky.shape
    image = np.zeros((ny + 2 * HALF, nx + 2 * HALF))
    for (y, x), light in np.ndenumerate(sky):
        image[y : y + 2 * HALF + 1, x : x + 2 * HALF + 1] += light * psf_at(x, y)
    return image[HALF:-HALF, HALF:-HALF]


# --- Fields of PSFs


def test_between_nodes_psfs_are_bilinear_and_beyond_them_constant():
    rng = np.random.default_rng(1)
    x, y = np.array([0.0, 30.0, 100.0]), np.array([5.0, 60.0])
    psfs = rng.random((2, 3, 4, 5))
    positions = [(a, b) for b in y for a in x]
    mixed = rng.permutation(6)
    field = PsfField(psfs.reshape(6, 4, 5)[mixed], np.array(positions)[mixed])
    expected = RegularGridInterpolator((y, x), psfs)
    for a, b in rng.uniform((-20, -20), (120, 80), (50, 2)):
        at = np.clip((b, a), (5.0, 0.0), (60.0, 100.0))
        np.testing.assert_allclose(field.at(a, b), expected(at)[0], rtol=1e-13)
    moved = field.moved(-7.0, 3.0)
    np.testing.assert_allclose(moved.at(13.0, 33.0), field.at(20.0, 30.0), rtol=1e-13)


@pytest.mark.parametrize(
    ("psfs", "positions", "message"),
    [
        (np.ones((2, 3, 3)), [(0, 0)], r"positions \(1, 2\)"),
        (np.ones((3, 3)), [(0, 0)], r"psfs has shape \(3, 3\)"),
        (np.ones((0, 3, 3)), np.zeros((0, 2)), r"psfs has shape \(0, 3, 3\)"),
        (np.ones((3, 3, 3)), [(0, 0), (0, 1), (1, 0)], "3 PSFs do not fill a grid of 2 columns"),
        (np.ones((2, 3, 3)), [(0, 0), (0, 0)], "do not fill a grid of 1 columns and 1 rows"),
        (np.ones((1, 3, 3)), [(0, np.nan)], "must be finite"),
    ],
)
def test_invalid_psf_fields_are_refused(psfs, positions, message):
    with pytest.raises(InputError, match=message):
        PsfField(psfs, positions)


@pytest.mark.parametrize("oversample", [1, 2])
@pytest.mark.parametrize("side", [29, 28])
def test_models_of_photutils_are_sampled_on_the_pixels_of_the_sky(side, oversample):
    photutils = pytest.importorskip("photutils.psf", reason="photutils is not installed")
    from astropy.nddata import NDData

    middle = (side - 1) / 2.0
    y, x = (np.mgrid[:side, :side] - middle) / 4.0
    widths = {(0.0, 0.0): 1.0, (40.0, 0.0): 1.2, (0.0, 50.0): 1.1, (40.0, 50.0): 1.4}
    gaussians = [np.exp(-0.5 * (x**2 + y**2) / w**2) / (2 * np.pi * w**2) for w in widths.values()]
    meta = {"grid_xypos": list(widths), "oversampling": 4}
    model = photutils.GriddedPSFModel(NDData(np.array(gaussians), meta=meta))
    observation = lnocl.Observation(
        np.ones((51, 41)), model, oversample=oversample, effective_psfs=oversample > 1
    )
    assert observation.psfs.shape[1] % 2 == 1
    half = observation.psfs.shape[1] // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1] / oversample
    for (px, py), width in widths.items():
        expected = np.exp(-0.5 * (x**2 + y**2) / width**2)
        found = observation.psf_fields[0].at(px, py)
        np.testing.assert_allclose(found, expected / expected.sum(), atol=1e-4 * found.max())
    mean = np.mean([observation.psf_fields[0].at(*place) for place in widths], axis=0)
    np.testing.assert_allclose(observation.psfs[0], mean, atol=1e-15)
    if oversample > 1:
        with pytest.raises(InputError, match="give effective_psfs=True"):
            lnocl.Observation(np.ones((51, 41)), model, oversample=2)
    with pytest.raises(InputError, match="oversample must be a whole number, 1 or more"):
        PsfField.of_model(model, 0)


def test_fields_must_serve_all_images():
    one, other = make_field(), PsfField(np.ones((1, 3, 3)), [(0, 0)])
    images = np.ones((3, N, N))
    assert lnocl.Observation(images, [one] * 3).psfs.shape == (3, 21, 21)
    assert len(lnocl.Observation(images, one).psf_fields) == 3
    with pytest.raises(InputError, match="2 fields of PSFs for 3 images"):
        lnocl.Observation(images, [one, one])
    with pytest.raises(InputError, match="differ in shape"):
        lnocl.Observation(images, [one, other, one])
    with pytest.raises(InputError, match="psf 0 has the sum 0"):
        lnocl.Observation(images, PsfField(np.zeros((1, 3, 3)), [(0, 0)]))


@pytest.mark.parametrize(
    ("known", "tile", "are_tiles"),
    [
        ({}, None, True),
        ({"transforms": [np.eye(2, 3), [[0, -1, N - 1], [1, 0, 0]]]}, None, True),
        ({"components": {"line": [1, 0], "continuum": [1, 1]}}, None, True),
        ({"halos": [np.ones((N, N))]}, None, False),
        ({"halos": [np.ones((N, N))]}, 48, True),  # which is refused
    ],
)
def test_the_shell_takes_tiles_where_psfs_vary_and_tiles_take_the_images(known, tile, are_tiles):
    observation = lnocl.Observation(np.ones((2, N, N)), [make_field()] * 2, **known)
    assert in_tiles(argparse.Namespace(tile=tile), observation) == are_tiles


# --- Stars through the PSFs of their own places


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the noise of image", "ignore:neighbouring pixels")
@pytest.mark.filterwarnings("ignore:psf 1 varies")
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_each_star_has_the_psf_of_its_own_place(solver):
    """Without noise their fluxes and places are found in every corner, and nothing beside them."""
    field = make_field()
    stars = np.array([(20.3, 25.8), (110.6, 14.2), (64.0, 64.0), (16.1, 108.7), (104.9, 111.4)])
    fluxes = np.array([3e5, 1e5, 2e5, 5e5, 4e5])
    offset = (0.4, -1.3)
    images = np.zeros((2, N, N))
    for image, moved in zip(images, ((0.0, 0.0), offset), strict=True):
        for place, flux in zip(stars + moved, fluxes, strict=True):
            image += flux * MovablePsf(field.at(*place), (N, N)).at(*place).on_grid((N, N))
    observation = lnocl.Observation(
        np.maximum(images, 0.0) + 5.0, field, background=5.0, offsets=[(0, 0), offset]
    )
    given = stars + np.random.default_rng(0).uniform(-0.3, 0.3, stars.shape)
    with pytest.warns(lnocl.LnoclWarning, match="psf 0 varies over the image by 48%, and what"):
        result = lnocl.deconvolve(
            observation,
            given,
            solver=solver,
            n_iter=30,
            smoothing=0.0,
            refine_positions=True,
            **RUN,
        )
    np.testing.assert_allclose(result.star_positions, stars, atol=6e-3)
    np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=2e-3)
    middle = lnocl.Observation(
        observation.images, observation.psfs, background=5.0, offsets=[(0, 0), offset]
    )
    with pytest.warns(lnocl.LnoclWarning, match="does not fit"):
        wrong = lnocl.deconvolve(
            middle, given, solver=solver, n_iter=30, smoothing=0.0, refine_positions=True, **RUN
        )
    assert abs(wrong.star_fluxes / fluxes - 1.0).max() > 0.1
    errors = result.star_flux_errors
    assert (errors > 0.9 * np.sqrt(fluxes / 2)).all()
    assert (errors < 2.0 * np.sqrt(fluxes / 2)).all()


@pytest.mark.filterwarnings("ignore:the noise of image", "ignore:neighbouring pixels")
@pytest.mark.filterwarnings("ignore:psf . varies")
def test_checkpoint_of_other_psf_fields_is_refused(tmp_path):
    path = tmp_path / "c.fits"
    image = make_sky() + 5.0
    run = {"n_iter": 2, "smoothing": 0.0, **RUN}
    lnocl.deconvolve(lnocl.Observation(image, make_field()), checkpoint=path, **run)
    # The PSF of the middle is the same.
    other = lnocl.Observation(image, make_field(growth=0.4))
    with pytest.raises(InputError, match="psf_fields differs"):
        lnocl.deconvolve(other, resume=path, **run)
    lnocl.deconvolve(lnocl.Observation(image, make_field()), resume=path, **run)


# --- Tiles


@given(st.integers(20, 400), st.integers(24, 120), st.integers(1, 12), st.sampled_from([1, 2, 4]))
def test_tiles_cover_an_axis_and_their_weights_sum_to_one(size, window, margin, oversample):
    window = max(window, 2 * margin + 8)
    spans = tiling.divide(range(size), window, margin)
    assert [n for span in spans for n in span.core] == list(range(size))
    total = np.zeros(oversample * size)
    for span in spans:
        assert len(span.window) == min(window, size)
        assert span.window.start <= max(span.core.start - margin, 0)
        assert span.window.stop >= min(span.core.stop + margin, size)
        weights = span.weights(oversample)
        total[oversample * span.window.start : oversample * span.window.stop] += weights
    assert (total > 0).all()
    if min(len(span.core) for span in spans) >= margin:  # else ramps of both sides meet
        np.testing.assert_allclose(total, 1.0, rtol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_a_star_with_a_masked_core_keeps_its_light_in_tiles():
    """A cosmic ray in another tile asks for hundreds of iterations; half of the star was lost."""
    rng, (y, x) = np.random.default_rng(3), np.indices((300, 300), float)

    def moffat(dx, dy, fwhm=4.0):
        square = fwhm**2 / 4.0 / (2.0 ** (1.0 / 3.0) - 1.0)
        return 2.3 / np.pi / square * (1.0 + (dx**2 + (1.15 * dy) ** 2) / square) ** -3.0

    fluxes, stars = np.array([2e6, 6e4]), [(70.3, 64.7), (220.4, 230.1)]
    mean = 60.0 + 3e4 * moffat(x - 200.0, y - 60.0, 6.4)
    for (at_x, at_y), flux in zip(stars, fluxes, strict=True):
        mean += flux * moffat(x - at_x, y - at_y)
    image = rng.poisson(mean).astype(float)
    image[250, 260] += 5e4
    psf, mask = moffat(x[:61, :61] - 30.0, y[:61, :61] - 30.0), np.hypot(x - 70.3, y - 64.7) < 7
    observation = lnocl.Observation(image, psf, background=60.0, mask=mask)
    result = lnocl.deconvolve_tiles(observation, stars, tile=180)
    np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=0.03)
    assert (abs(result.star_fluxes - fluxes) < 3 * result.star_flux_errors).all()


def make_frame(seed=0, n_images=1, psf=None, n_stars=9, size=N):
    """Return noisy images of a sky with stars, through one PSF, and the stars."""
    rng = np.random.default_rng(seed)
    psf = vary(N / 2, N / 2) if psf is None else psf
    sky = make_sky(seed, size)
    stars = rng.uniform(4, size - 4, (n_stars, 2))
    image = fftconvolve(np.pad(sky, 32, mode="reflect"), psf, "same")[32:-32, 32:-32] + 5.0
    for place in stars:
        image += 3e4 * MovablePsf(psf, (size, size)).at(*place).on_grid((size, size))
    counts = rng.poisson(np.maximum(image, 0.0), (n_images, size, size))
    return lnocl.Observation(counts, psf, background=5.0), stars


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("run", "n_stars", "middle", "blends"),
    [
        # With stars the fluxes that "sgm" starts from, and depends on, differ.
        ({"solver": "sgm", "n_iter": 60, "smoothing": 0.0}, 0, 1e-3, 1e-2),
        pytest.param(
            {"solver": "sgp", "n_iter": 400, "smoothing": 0.02},
            9,
            6e-4,
            1e-3,
            marks=pytest.mark.exhaustive,
        ),
    ],
)
def test_tiles_are_the_whole(run, n_stars, middle, blends):
    observation, stars = make_frame(n_images=2, n_stars=n_stars)
    whole = lnocl.deconvolve(observation, stars, pad=16, **run, **RUN)
    result = lnocl.deconvolve_tiles(observation, stars, tile=96, pad=8, **run, **RUN)
    assert len(result.tiles) == 9
    difference = abs(result.extended - whole.extended) / np.percentile(whole.extended, 99.9)
    for each in result.tiles:
        x, y, width, height = (int(each[name]) for name in ("x", "y", "width", "height"))
        inner = np.s_[y + height // 4 : y + height * 3 // 4, x + width // 4 : x + width * 3 // 4]
        assert difference[inner].max() < middle
    assert difference[8:-8, 8:-8].max() < blends
    np.testing.assert_allclose(result.star_fluxes, whole.star_fluxes, rtol=3e-6)
    np.testing.assert_array_equal(result.star_positions, stars)
    np.testing.assert_allclose(result.star_flux_errors, whole.star_flux_errors, rtol=1e-5)
    (flux, error), (expected, its_error) = result.extended_flux, whole.extended_flux
    assert abs(flux - expected) < 0.05 * its_error
    assert error == pytest.approx(its_error, rel=0.03)  # what tiles share at their edges
    assert result.fit().rms == pytest.approx(whole.fit().rms, rel=3e-5)
    assert len(result.star_residuals()) == len(stars)


@pytest.mark.exhaustive
def test_one_tile_is_the_whole_bit_for_bit():
    observation, stars = make_frame()
    run = {"n_iter": 20, "smoothing": 0.01, **RUN}
    whole = lnocl.deconvolve(observation, stars, **run)
    result = lnocl.deconvolve_tiles(observation, stars, **run)
    for name in ("extended", "star_fluxes", "star_flux_errors", "history"):
        np.testing.assert_array_equal(getattr(result, name), getattr(whole, name), name)
    np.testing.assert_array_equal(result.models(), whole.models())
    assert result.extended_flux == pytest.approx(whole.extended_flux, rel=1e-9)
    assert result.n_iter == whole.n_iter


JUDGED = {"engine": "numpy", "stop": None, "n_iter": 15, "pad": 2}
JUDGED |= {"refine_psfs": ("jitter", "pixels")}


@pytest.fixture(scope="module")
def narrow():
    """Two stars whose PSF is given a tenth too narrow, their places, fluxes, and one run."""
    y, x = np.mgrid[-6:7, -6:7]
    true, given = (
        np.exp(-0.5 * ((0.9 * x + 0.3 * y) ** 2 + (y - 0.2 * x) ** 2) / width**2)
        + 0.15 * np.exp(-0.5 * ((x - 2) ** 2 + (y + 1) ** 2) / width**2)
        for width in (1.5, 1.35)
    )
    stars, fluxes = np.array([(38, 15), (13, 35)]), np.array([2e5, 5e4])
    means = 20.0 + make_sky(0, 56)
    for (sx, sy), flux in zip(stars, fluxes, strict=True):
        means[sy - 6 : sy + 7, sx - 6 : sx + 7] += flux * true / true.sum()
    counts = np.random.default_rng(0).poisson(means)
    observation = lnocl.Observation(counts, given, background=20.0, psf_centre="given")
    return observation, stars, fluxes, lnocl.deconvolve(observation, stars, **JUDGED)


def test_stars_of_tiles_are_those_of_one_run_though_their_psf_is_wrong(narrow):
    observation, stars, fluxes, whole = narrow
    result = lnocl.deconvolve_tiles(observation, stars, tile=44, **JUDGED)
    assert len(result.tiles) == 4
    assert result.psf_refinement.is_accepted
    np.testing.assert_array_equal(result.psfs, whole.psfs)
    for each in (whole, result):
        assert (abs(each.star_fluxes - fluxes) < 3 * each.star_flux_errors).all()
    assert (abs(result.star_fluxes - whole.star_fluxes) < 0.6 * whole.star_flux_errors).all()
    np.testing.assert_allclose(result.star_flux_errors, whole.star_flux_errors, rtol=0.06)


@pytest.mark.exhaustive
def test_families_that_are_named_are_fitted_before_tiles_are_cut(narrow):
    observation, stars, *_ = narrow
    run = {**JUDGED, "smoothing": 0.01}
    whole = lnocl.deconvolve(observation, stars, **run)
    found = lnocl.deconvolve_tiles(observation, stars, tile=44, **run)
    assert found.psf_refinement.parameters == whole.psf_refinement.parameters
    np.testing.assert_array_equal(found.psfs, whole.psfs)


@pytest.mark.exhaustive
@pytest.mark.parametrize("is_wrong", [True, pytest.param(False, marks=pytest.mark.exhaustive)])
def test_one_tile_is_judged_as_the_whole_is(is_wrong, narrow):
    observation, stars, _, whole = narrow
    if not is_wrong:
        observation = observation.replace(psfs=whole.psfs)
        whole = lnocl.deconvolve(observation, stars, **JUDGED)
    result = lnocl.deconvolve_tiles(observation, stars, **JUDGED)
    assert whole.psf_refinement.is_accepted == is_wrong
    for name in ("extended", "star_fluxes", "star_flux_errors", "star_positions", "doubtful"):
        np.testing.assert_array_equal(getattr(result, name), getattr(whole, name), name)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the PSFs do not fit the stars, by 30 %")
@pytest.mark.parametrize("tile", [48, 128])
def test_a_weight_that_is_given_stays_in_tiles_beside_a_scatter_of_psfs(tile):
    """Tiles added to it near stars, which one run does not."""
    psf = np.exp(-(np.hypot(X, 1.2 * Y) ** 2) / 5.0)
    sky = 5.0 + 40.0 * np.exp(-np.hypot(*(np.indices((64, 64)) - 30.0)) / 6.0)
    sky[30, 28] += 3000.0
    counts = np.random.default_rng(4).poisson(fftconvolve(sky, psf / psf.sum(), "same") + 9.0)
    known = {"background": 9.0, "psf_scatter": 0.3 * psf / psf.sum()}
    observation = lnocl.Observation(counts, psf, **known)
    options = {**RUN, "smoothing": 0.02, "n_iter": 150, "pad": 0}
    whole = lnocl.deconvolve(observation, [(28, 30)], **options)
    found = lnocl.deconvolve_tiles(observation, [(28, 30)], tile=tile, **options)
    np.testing.assert_allclose(found.star_fluxes, whole.star_fluxes, rtol=0.01)
    np.testing.assert_allclose(found.extended.sum(), whole.extended.sum(), rtol=0.01)


def test_tiles_come_near_a_psf_for_each_pixel():
    """Model against model: nine tiles leave a third of the error of one PSF for all."""
    sky, field = make_sky(3), make_field()
    exact = see(sky, lambda x, y: vary(x, y))
    observation = lnocl.Observation(exact, field)
    inner, peak = np.s_[HALF:-HALF, HALF:-HALF], exact.max()
    one = fftconvolve(sky, vary(63.5, 63.5), "same")
    spans = tiling.divide(range(N), 62, 10)
    seen = np.zeros_like(sky)
    for y in spans:
        for x in spans:
            tile = tiling.cut(observation, np.zeros((0, 2)), None, (y, x))
            image = fftconvolve(sky, tile.observation.psfs[0], "same")
            rows, columns = y.core, x.core
            core = np.s_[rows.start : rows.stop, columns.start : columns.stop]
            seen[core] = image[core]
    errors = [abs(each - exact)[inner].max() / peak for each in (one, seen)]
    assert errors[1] < errors[0] / 3.0
    assert errors[1] < 0.03


@pytest.mark.exhaustive
def test_all_tiles_use_the_settings_chosen_by_the_brightest():
    observation, stars = make_frame(n_stars=4)
    run = {key: RUN[key] for key in ("engine", "precision")}
    result = lnocl.deconvolve_tiles(observation, stars, tile=96, pad=4, n_iter=60, **run)
    assert result.stop_reason == "held-out"
    assert len(result.held_out)
    assert set(result.tiles["n_iter"]) == {result.n_iter}
    assert result.smoothing in set(result.held_out["smoothing"])


def test_stars_beyond_a_tile_do_not_choose_for_it():
    """Their light is in its margins, as pixels as bright, of which held-out counts are sure."""
    stars = np.array([(92.0, 30.0), (36.0, 100.0), (30.0, 92.0), (100.0, 36.0)])
    sky, of_star = make_sky(4), vary(0.0, 0.0, growth=0.0)
    light = sky.copy()
    np.add.at(light, tuple(stars.astype(int).T[::-1]), 1e6)
    means = fftconvolve(light, of_star, "same").clip(0) + 5.0
    counts = np.random.default_rng(8).poisson(means)
    observation = lnocl.Observation(counts, of_star, background=5.0, psf_error=0)
    whole = lnocl.deconvolve(observation, stars, engine="numpy")
    found = lnocl.deconvolve_tiles(observation, stars, tile=96, pad=4, engine="numpy")
    errors = [restoration_error(each.extended, sky) for each in (whole, found)]
    assert errors[1] < 1.2 * errors[0]


def test_tiles_with_a_fair_share_of_the_light_choose(monkeypatch):
    """A source at the corner of four tiles is in the margins of three, whose parts are blank."""
    light = np.zeros((N, N))
    light[40:62, 40:62] = 100.0
    counts = np.random.default_rng(1).poisson(5.0 + light)
    observation = lnocl.Observation(counts, vary(0.0, 0.0), background=5.0, psf_error=0)
    choice, chosen_by = tiles._choice, []
    monkeypatch.setattr(tiles, "_choice", lambda *a: chosen_by.append(a[1].core) or choice(*a))
    found = lnocl.deconvolve_tiles(observation, tile=96, pad=4, engine="numpy", n_iter=10)
    assert len(found.tiles) == 4
    assert chosen_by == [(slice(0, 64), slice(0, 64))]


def test_tiles_beyond_the_frame_of_the_sky_have_no_light_to_choose_by():
    """They stand for nothing of it."""
    turns = [np.eye(2, 3), [[1, 0, 40], [0, 1, 40]]]
    images = np.random.default_rng(3).poisson(100.0, (2, 120, 120))
    frames = [images[0, :40, :40], images[1]]
    observation = lnocl.Observation(frames, np.ones((21, 21)), background=5.0, transforms=turns)
    laid = tiling.lay(observation.upright(), 64, 4)
    cuts = [tiling.cut(observation.upright(), np.zeros((0, 2)), None, spans) for spans in laid]
    shown = [np.prod([at.stop - at.start for at in tile.core]) for tile in cuts]
    assert 0 < np.count_nonzero(shown) < len(cuts)
    for tile, n_pixels in zip(cuts, shown, strict=True):
        assert tiles._light(tile) == pytest.approx(2 * 95.0 * n_pixels, rel=0.05, abs=0.0)


def test_light_of_stars_makes_no_tile_bright():
    observation, _ = make_frame(n_stars=0)
    images = observation.images.copy()
    images[0, 20, 20] += 1e7
    starry = lnocl.Observation(images, observation.psfs, background=5.0)
    spans = tiling.divide(range(N), 64, 10)[0]
    empty = tiling.cut(observation, np.zeros((0, 2)), None, (spans, spans))
    tile = tiling.cut(starry, np.array([[20.0, 20.0]]), None, (spans, spans))
    assert tiles._light(tile) < tiles._light(empty)
    assert tiles._light(tile._replace(stars=np.zeros((0, 2)))) > 9e6


@pytest.mark.exhaustive
def test_masked_tiles_are_dark_and_stars_keep_their_order():
    observation, stars = make_frame()
    images = np.array(observation.images)
    images[:, :, :64] = np.nan
    seen = stars[stars[:, 0] > 70]
    with pytest.warns(lnocl.LnoclWarning, match="not finite"):
        half = lnocl.Observation(images, observation.psfs, background=5.0)
    run = {"tile": 64, "pad": 4, "n_iter": 20, "smoothing": 0.01, **RUN}
    result = lnocl.deconvolve_tiles(half, seen[::-1], **run)
    assert not result.extended[:, :40].any()
    assert (result.star_fluxes > 1e4).all()
    np.testing.assert_array_equal(result.star_positions, seen[::-1])
    assert np.isnan(result.residuals()[:, :, :64]).all()


@pytest.mark.filterwarnings("ignore:.*psf 0 varies", "ignore:.*other warnings of tiles")
@pytest.mark.exhaustive
def test_processes_give_the_same_tiles():
    pytest.importorskip("distributed", reason="Dask is not installed")
    field = make_field()
    observation, stars = make_frame()
    observation = lnocl.Observation(observation.images, field, background=5.0)
    run = {"n_iter": 8, "smoothing": 0.01, **RUN}
    here = lnocl.deconvolve_tiles(observation, stars, tile=64, pad=4, **run)
    there = lnocl.deconvolve_tiles(observation, stars, tile=64, pad=4, parallel=2, **run)
    for name in ("extended", "star_fluxes", "star_flux_errors", "tiles", "history"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name), name)


@pytest.mark.exhaustive
def test_images_that_are_shifted_are_seen_whole_by_tiles():
    """Most of the light is in the image that is shifted by more than half a PSF."""
    psf = vary(N / 2, N / 2)
    rng, far = np.random.default_rng(2), 26
    sky = make_sky(4, N + far)
    image = fftconvolve(sky, psf, "same")
    images = np.stack([image[:N, :N], 30.0 * image[:N, far : N + far]]) + 5.0
    observation = lnocl.Observation(
        rng.poisson(images), psf, background=5.0, exposure=[1.0, 30.0],
        offsets=[(0.0, 0.0), (-float(far), 0.0)],
    )  # fmt: skip
    run = {"n_iter": 300, "smoothing": 0.02, **RUN}
    whole = lnocl.deconvolve(observation, pad=30, **run)
    result = lnocl.deconvolve_tiles(observation, tile=96, **run)
    assert len(result.tiles) > 4
    inner = np.s_[16:-16, far + 16 : -16]
    difference = abs(result.extended - whole.extended)[inner] / whole.extended[inner].max()
    assert difference.max() < 0.02
    assert result.fit().rms == pytest.approx(whole.fit().rms, rel=0.01)


@pytest.mark.exhaustive
def test_a_star_in_a_masked_tile_is_refused_and_one_beside_it_is_not():
    observation, stars = make_frame(n_stars=6)
    bad = np.zeros((N, N), bool)
    bad[:64, :64] = True
    masked = lnocl.Observation(observation.images, observation.psfs, background=5.0, mask=bad)
    run = {"tile": 64, "pad": 4, "n_iter": 5, "smoothing": 0.0, **RUN}
    with pytest.raises(InputError, match=r"\(10, 10\) lies in a tile that all images mask"):
        lnocl.deconvolve_tiles(masked, [(10.0, 10.0), *stars], **run)
    bad[:] = False
    bad[:, 40:52] = True
    masked = lnocl.Observation(observation.images, observation.psfs, background=5.0, mask=bad)
    beside = [(37.0, 30.0), (54.0, 60.0)]
    result = lnocl.deconvolve_tiles(masked, beside, **run)
    whole = lnocl.deconvolve(masked, beside, pad=8, n_iter=5, smoothing=0.0, **RUN)
    np.testing.assert_array_equal(result.star_positions, beside)
    assert (abs(result.star_fluxes - whole.star_fluxes) < 3 * whole.star_flux_errors).all()


def test_warnings_of_tiles_say_where_positions_begin():
    observation, _ = make_frame(n_stars=0)
    bad = np.zeros((N, N), bool)
    bad[70:100, 70:100] = True
    masked = lnocl.Observation(observation.images, observation.psfs, background=5.0, mask=bad)
    with pytest.warns(lnocl.LnoclWarning, match="where all images are masked") as caught:
        result = lnocl.deconvolve_tiles(
            masked, [(85, 85)], tile=64, pad=4, n_iter=2, smoothing=0.0, **RUN
        )
    message = next(str(each.message) for each in caught if "masked" in str(each.message))
    assert message.startswith("tile that begins at pixel")
    corner, at = (list(map(int, each)) for each in re.findall(r"\((\d+), (\d+)\)", message))
    assert [a + b for a, b in zip(corner, at, strict=True)] == [85, 85]
    assert np.isnan(result.star_fluxes).all()


def test_a_psf_of_one_pixel_has_margins_too():
    image = np.random.default_rng(0).poisson(9.0, (64, 64)).astype(float)
    observation = lnocl.Observation(image, np.ones((1, 1)))
    run = {"n_iter": 20, "smoothing": 0.0, **RUN}
    result = lnocl.deconvolve_tiles(observation, tile=40, pad=1, **run)
    np.testing.assert_allclose(result.extended, image, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tile": 30}, "tile must be a whole number, 46 or more, for margins of half a PSF"),
        ({"tile": 80.0}, "tile must be a whole number"),
        ({"tile": 80, "pad": -1}, "pad must be a whole number, 0 or more"),
        ({"tile": 80, "checkpoint": "c"}, "checkpoint is no option of tiles"),
        ({"tile": 80, "parallel": "many"}, "parallel must be True, False"),
        ({"tile": 80, "n_iter": 0}, "n_iter must be a whole number"),
        ({"tile": 80, "smoothing": [0.1]}, "smoothing must be a number"),
        ({"tile": 80, "solver": "best"}, "solver 'best' is not known"),
    ],
)
def test_invalid_options_for_tiles_are_refused(options, message):
    observation, stars = make_frame()
    with pytest.raises(InputError, match=message):
        lnocl.deconvolve_tiles(observation, stars, **{"stop": None, "pad": 5, **options})


def test_tiles_have_no_replicas():
    result = lnocl.deconvolve_tiles(make_frame()[0], n_iter=1, smoothing=0, **RUN)
    with pytest.raises(InputError, match="replicas are of one run"):
        result.bootstrap()


@pytest.mark.exhaustive
def test_warnings_of_tiles_are_limited_and_summarised():
    observation, stars = make_frame(n_stars=12)
    bad = np.zeros((N, N), bool)
    bad[*np.round(stars[:, ::-1]).astype(int).T] = True
    masked = lnocl.Observation(observation.images, observation.psfs, background=5.0, mask=bad)
    with pytest.warns(lnocl.LnoclWarning) as given:
        lnocl.deconvolve_tiles(masked, stars, tile=80, pad=4, n_iter=2, smoothing=0, **RUN)
    said = [str(each.message) for each in given if each.category is lnocl.LnoclWarning]
    assert len(said) == 4
    assert all(
        each.startswith("tile that begins at pixel (") and "on bad pixels" in each
        for each in said[:3]
    )
    assert said[3].endswith("of tiles")


# --- The command line


def write_frame(grid_keywords, psfs):
    observation, stars = make_frame(n_stars=3)
    fits.writeto("image.fits", observation.images[0])
    header = fits.Header(grid_keywords)
    fits.writeto("grid.fits", psfs, header)
    star = [word for x, y in stars for word in ("--star", f"{x},{y}")]
    return ["deconvolve", "image.fits", "--psf", "grid.fits", "--background", "5", *star,
            "--engine", "numpy", "--stop", "none", "--n-iter", "5", "-o", "out.fits"]  # fmt: skip


def stpsf_file(oversample=1):
    nodes = (0, N - 1)
    places = [(x, y) for y in nodes for x in nodes]
    keywords = {f"DET_YX{k}": f"({x}.0, {y}.0)" for k, (x, y) in enumerate(places)}
    psfs = np.array([vary(x, y, growth=0.1, turn=5.0) for x, y in places])
    return keywords | {"OVERSAMP": oversample}, psfs


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the PSFs do not fit the stars, by 12 %")
def test_a_grid_of_psfs_is_taken_tile_by_tile(tmp_path, monkeypatch, capsys):
    pytest.importorskip("photutils", reason="photutils is not installed")
    monkeypatch.chdir(tmp_path)
    words = write_frame(*stpsf_file())
    assert cli.main([*words, "--tile", "80", "--pad", "4", "--residuals"]) == 0
    assert "out.fits\n" in capsys.readouterr().out
    observation, stars = make_frame(n_stars=3)
    _, psfs = stpsf_file()
    nodes = [(0, 0), (N - 1, 0), (0, N - 1), (N - 1, N - 1)]
    varied = lnocl.Observation(observation.images, PsfField(psfs, nodes), background=5.0)
    expected = lnocl.deconvolve_tiles(varied, stars, tile=80, pad=4, n_iter=5, **RUN)
    found = outcome("out.fits")
    # The PSFs differ by 1e-16.
    np.testing.assert_allclose(found["PRIMARY"], expected.extended, rtol=1e-8)
    np.testing.assert_allclose(found["STARS"]["flux"], expected.star_fluxes, rtol=1e-11)
    assert cli.main([*words, "--overwrite", "--pad", "4"]) == 0  # without being told


@pytest.mark.exhaustive
def test_stdpsf_files_are_read(tmp_path, monkeypatch):
    pytest.importorskip("photutils", reason="photutils is not installed")
    monkeypatch.chdir(tmp_path)
    keywords = {"NXPSFS": 2, "NYPSFS": 2, "IPSFX01": 1, "IPSFX02": N, "JPSFY01": 1, "JPSFY02": N}
    y, x = np.mgrid[-50:51, -50:51] / 4.0
    psfs = np.array([np.exp(-0.5 * (x**2 + y**2) / w**2) for w in (1.6, 1.7, 1.8, 1.9)])
    words = write_frame(keywords, psfs)
    assert cli.main([*words, "--tile", "96", "--pad", "4"]) == 0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--checkpoint", "c.fits"], "--checkpoint is not for tiles; leave it out"),
        (["--tile", "20"], "--tile must be a whole number, "),
        (["--oversample", "2"], "give --effective-psfs"),
    ],
)
def test_command_refuses_invalid_options_for_tiles(more, message, tmp_path, monkeypatch, capsys):
    pytest.importorskip("photutils", reason="photutils is not installed")
    monkeypatch.chdir(tmp_path)
    assert cli.main([*write_frame(*stpsf_file()), *more]) == 2
    assert message in capsys.readouterr().err


def test_an_error_of_the_level_is_alike_in_all_tiles():
    """Over the exposure of good pixels: bad ones hold none that belongs to an image."""
    frame, _ = make_frame()
    bad = np.zeros(frame.images.shape, bool)
    bad[:, :40] = True
    known = frame.replace(exposure=np.full(frame.images.shape, 5.0), mask=bad)
    free = known.replace(background_error=np.full(known.n_images, 0.3))
    run = {"n_iter": 2, "smoothing": 0.01, "stop": None, "tile": 96, "pad": 8, **RUN}
    errors = [lnocl.deconvolve_tiles(each, **run).extended_flux[1] for each in (known, free)]
    added = 0.3 * np.sqrt(known.n_images) * known.images[0].size / (5.0 * known.n_images)
    assert np.sqrt(errors[1] ** 2 - errors[0] ** 2) == pytest.approx(added, rel=1e-6)
