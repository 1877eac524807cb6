"""Exposures and offsets: identities of the method, on every engine.

Tolerances are shares of the largest value, two to three times the error measured. What is promised
bit for bit is compared bit for bit.
"""

import dataclasses

import numpy as np
import pytest
from scenes import FEWER_ENGINES, NUMPY_FIRST, Recipe, paper, same, worst

import lnocl

# PSFs here are small, and whole offsets periodic.
pytestmark = pytest.mark.filterwarnings(
    "ignore:psf . is undersampled",
    "ignore:the images are shifted by up to",
    "ignore:the star at .* lies on bad pixels",
)

SHAPE = (16, 32)
# Few scenes, as an OpenCL program is built for each. The two differ in what the kernels are given:
# numbers go into the PSFs, maps are weights.
EACH = Recipe(SHAPE, 3, 2, mu=1e-3, masked=0.05, background="map", exposure="each", fractions=True)
MAP = dataclasses.replace(EACH, exposure="map")
WHOLE = np.array([(0, 0), (3, -5), (-31, 15)])

# Of extended source, star fluxes and objective, after 20 iterations. Measured 8.2e-16, 9.9e-17 and
# 1.2e-16; in single 5.2e-7, 7.6e-8 and 4.3e-8.
ROUNDING = {"double": (2e-15, 3e-16, 3e-16), "single": (1.3e-6, 2e-7, 1.2e-7)}

every_engine = pytest.mark.parametrize("engine", FEWER_ENGINES)
numpy_first = pytest.mark.parametrize("engine", NUMPY_FIRST)
every_scene = pytest.mark.parametrize("recipe", [EACH, MAP], ids=["each", "map"])
numpy_alone = {"engine": "numpy"}


def assert_close(result, other, extended, star_fluxes, objective):
    assert worst(result.extended, other.extended) <= extended
    assert worst(result.star_fluxes, other.star_fluxes) <= star_fluxes
    assert worst(result.history["objective"], other.history["objective"]) <= objective


# --- Exposures


@pytest.mark.parametrize("exponent", [-40, -3, 40])
@pytest.mark.parametrize("start", ["given", "default"])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
@every_scene
def test_a_longer_unit_of_time_is_bit_for_bit(solver, recipe, start, exponent):
    """Of exposures times k, fluxes are k times less; weights of penalties stay, and so does J."""
    made, factor = recipe.make(), 2.0**exponent
    starts = {
        name: getattr(made, name) if start == "given" else None
        for name in ("initial_extended", "initial_star_fluxes")
    }
    given = {"n_iter": 10, "solver": solver, "smoothing": 0.02, **numpy_alone}
    result = made.deconvolve(**starts, **given)
    scaled = made.deconvolve(
        made.observation(exposure=factor * made.exposure),
        **given,
        **{k: None if v is None else v / factor for k, v in starts.items()},
    )
    np.testing.assert_array_equal(scaled.extended, result.extended / factor)
    np.testing.assert_array_equal(scaled.star_fluxes, result.star_fluxes / factor)
    np.testing.assert_array_equal(scaled.history["objective"], result.history["objective"])


@pytest.mark.parametrize("oversample", [1, 2])
@pytest.mark.parametrize("smoothing", [0.02, "auto"])
@every_scene
def test_models_do_not_hang_on_the_unit_of_time(recipe, smoothing, oversample):
    made = dataclasses.replace(recipe, n_stars=0, fractions=False).make()
    psfs = np.repeat(np.repeat(made.psfs, oversample, 1), oversample, 2)
    given = {"n_iter": 10, "stop": None, "smoothing": smoothing, "mu": 1e-3, **numpy_alone}
    found = []
    for factor in (1.0, 1024.0, 1000.0):
        changes = {"psfs": psfs, "oversample": oversample, "exposure": factor * made.exposure}
        found.append(lnocl.deconvolve(made.observation(**changes), **given))
    expected, exact, close = (each.models() for each in found)
    np.testing.assert_array_equal(exact, expected)
    assert found[1].smoothing == found[0].smoothing
    assert worst(close, expected) <= 1e-12


@pytest.mark.exhaustive
def test_tiles_are_smoothed_by_one_weight_where_exposures_differ_between_them():
    seconds = np.broadcast_to(np.where(np.arange(64) < 32, 1.0, 4.0), (32, 64))
    images = np.random.default_rng(0).poisson(10.0 * seconds).astype(float)
    psf = [[0.0, 1.0, 0.0], [1.0, 4.0, 2.0], [0.0, 1.5, 0.0]]
    observation = lnocl.Observation(images, psf, exposure=seconds)
    given = {"smoothing": 0.2, "stop": None, "n_iter": 300, "pad": 0, **numpy_alone}
    whole = lnocl.deconvolve(observation, **given)
    tiled = lnocl.deconvolve_tiles(observation, tile=32, **given)
    assert len(tiled.tiles) > 1
    inner = np.s_[4:28, 4:60]  # what wraps round the whole does not round a tile
    assert worst(tiled.extended[inner], whole.extended[inner]) <= 3e-4


@numpy_first
def test_equal_exposures_equal_no_exposures(engine):
    made = dataclasses.replace(EACH, exposure="none").make()
    result = made.deconvolve(n_iter=10, **engine)
    for exposure in (1.0, [1.0, 1.0, 1.0]):
        same(made.deconvolve(made.observation(exposure=exposure), n_iter=10, **engine), result)
    if engine["engine"] == "numpy":
        other = made.deconvolve(
            made.observation(exposure=8.0),
            n_iter=10,
            initial_extended=made.initial_extended / 8,
            initial_star_fluxes=made.initial_star_fluxes / 8,
            **engine,
        )
        np.testing.assert_array_equal(8 * other.extended, result.extended)


@pytest.mark.exhaustive
@pytest.mark.parametrize("start", ["given", "default"])
@every_engine
def test_masked_and_unexposed_pixels_have_no_influence(engine, start):
    made = MAP.make()
    starts = {} if start == "given" else {"initial_extended": None, "initial_star_fluxes": None}
    result = made.deconvolve(n_iter=10, **starts, **engine)
    unseen = made.mask | (made.exposure == 0)
    for value in (1e30, -1e30, np.nan):
        changes = {
            name: np.where(made.mask, value, getattr(made, name))
            for name in ("background", "exposure")
        }
        changes["images"] = np.where(unseen, 0.0 if np.isnan(value) else abs(value), made.images)
        other = made.deconvolve(made.observation(**changes), n_iter=10, **starts, **engine)
        same(other, result)


# --- Offsets


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_whole_offsets_are_rolled_images(solver):
    made = dataclasses.replace(MAP, fractions=False).make()
    rolled = {
        name: np.array(
            [
                np.roll(each, (dy, dx), axis=(0, 1))
                for each, (dx, dy) in zip(getattr(made, name), WHOLE, strict=True)
            ]
        )
        for name in ("images", "background", "mask", "exposure")
    }
    result = made.deconvolve(n_iter=10, solver=solver, **numpy_alone)
    other = made.deconvolve(
        made.observation(**rolled, offsets=WHOLE), n_iter=10, solver=solver, **numpy_alone
    )
    # Measured 4.8e-16 and 1.3e-14, fluxes 1.4e-15: the mean of the rolled map is rounded in
    # another order, and sgp multiplies that.
    assert_close(other, result, {"sgm": 1.5e-15, "sgp": 4e-14}[solver], 4e-15, 9e-16)


# --- Stars beyond some of the images


def test_a_star_in_an_image_with_an_offset_is_enough():
    images, offsets = np.ones((2, *SHAPE)), [(0, 0), (10, 0)]
    observation = lnocl.Observation(images, np.ones((3, 3)), offsets=offsets)
    result = paper(observation, [(-3, 4), (-10.4, 4)], n_iter=1, **numpy_alone, pad=9)
    np.testing.assert_array_equal(result.star_positions, [(-3, 4), (-10.4, 4)])
    for star in ((-10.6, 4), (31.6, 4), (3, -0.6), (3, 15.5)):
        with pytest.raises(lnocl.InputError, match=r"outside the images: .* its offset added"):
            paper(observation, [(3, 4), star], n_iter=1, **numpy_alone)


def test_a_star_where_the_map_saw_nothing_is_left_out():
    exposure = np.ones((2, *SHAPE))
    exposure[:, 3:9, 5:14] = 0.0
    observation = lnocl.Observation(np.ones((2, *SHAPE)), np.ones((3, 3)), exposure=exposure)
    with pytest.warns(lnocl.LnoclWarning, match=r"star at \(9, 6\) lies where all images are mask"):
        paper(observation, [(9, 6)], n_iter=1, **numpy_alone)
    moved_there = lnocl.Observation(
        np.ones((2, *SHAPE)), np.ones((3, 3)), exposure=exposure, offsets=[(0, 0), (-8, 0)]
    )
    result = paper(moved_there, [(9, 6)], n_iter=1, **numpy_alone)
    assert result.star_fluxes > 0


@pytest.mark.parametrize("exposure", [[1e308, 1.5e308], np.full(SHAPE, 1e308)])
def test_exposures_that_cannot_be_summed_are_refused(exposure):
    observation = lnocl.Observation(np.ones((2, *SHAPE)), np.ones((3, 3)), exposure=exposure)
    with pytest.raises(
        lnocl.InputError, match=r"^the exposures are too large to be summed: divide"
    ):
        paper(observation, n_iter=1, **numpy_alone)


@pytest.mark.parametrize(
    ("counts", "exposure"),
    [(1.0, 1e-307), (1.0, 5e-324), (1e20, 1e-300), (1e-300, 1e300)],
)
def test_a_sky_that_no_number_holds_is_refused(counts, exposure):
    images = np.full((2, *SHAPE), counts)
    observation = lnocl.Observation(images, np.ones((3, 3)), exposure=exposure)
    with pytest.raises(lnocl.InputError, match="leave a sky that no number holds: divide or mult"):
        paper(observation, n_iter=1, **numpy_alone)


def test_exposures_whose_square_is_no_number_are_taken():
    made = EACH.make()
    ours = {"n_iter": 3, "mu": 0.0, "initial_extended": None, "initial_star_fluxes": None}
    ours |= numpy_alone
    expected = made.deconvolve(made.observation(), **ours)
    # A power of two, so that no digit changes.
    observation = made.observation(exposure=made.exposure * 2.0**-600)
    result = made.deconvolve(observation, **ours)
    np.testing.assert_array_equal(result.extended, expected.extended * 2.0**600)
    np.testing.assert_array_equal(result.star_fluxes, expected.star_fluxes * 2.0**600)
    assert result.mu == result.smoothing == 0.0


def test_mu_too_large_is_refused_with_the_largest_valid_value():
    made = EACH.make()
    observation = made.observation(exposure=made.exposure * 1e6)
    with pytest.raises(lnocl.InputError, match=r"mu 1e.40 is too large") as caught:
        paper(observation, made.stars, mu=1e40, n_iter=1, **numpy_alone)
    most = float(str(caught.value).rsplit(" ", 1)[-1])
    paper(observation, made.stars, mu=0.99 * most, n_iter=1, **numpy_alone)
    with pytest.raises(lnocl.InputError):
        paper(observation, made.stars, mu=1.01 * most, n_iter=1, **numpy_alone)


@pytest.mark.parametrize("engine", ["numpy", "opencl"])
def test_skies_that_no_number_holds_in_the_longest_exposure_are_refused(engine):
    """Scaled to about 1 it is a number; in electrons its objective is infinite."""
    exposure = np.array([[[7.5, 1e300]]])
    observation = lnocl.Observation([[[1e25, 7.0]]], [[[2.1]]], exposure=exposure)
    with pytest.raises(lnocl.InputError, match="overflow: divide images"):
        paper(observation, n_iter=1, engine=engine)
