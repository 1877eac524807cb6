"""What must hold of any implementation, whatever its arithmetic: identities of the method.

Tolerances are shares of the largest value, about three times the error measured. What is
promised bit for bit is compared bit for bit.
"""

import dataclasses

import numpy as np
import pytest
from scenes import FEWER_ENGINES, NUMPY_FIRST, Recipe, make_psfs, paper, same, worst

import lnocl

SHAPE = (16, 32)
# Few scenes, as an OpenCL program is built for each: what a scene has is fixed when it is built.
# Without background, stars and mask: Richardson-Lucy for several images as printed.
BARE = Recipe(SHAPE, 3, background="zero")
# The same with stars and bad pixels.
MASKED = Recipe(SHAPE, 3, 2, masked=0.1, background="zero")
# Everything at once, on the periodic grid and with unobserved pixels round the images.
FULL = Recipe(SHAPE, 3, 2, mu=1e-3, smoothing=0.01, masked=0.05, background="map")
PADDED = Recipe((11, 27), 3, 2, mu=1e-3, smoothing=0.01, masked=0.05, background="map", pad=2)

# What rounding leaves after 50 iterations: extended source, star fluxes, objective.
ROUNDING = {"double": (2.7e-15, 4.4e-16, 8e-16), "single": (1.7e-6, 2.5e-7, 1.2e-7)}
# What it leaves of a sum over the sky.
SUM_ROUNDING = {"double": 8.5e-16, "single": 4.4e-7}

every_engine = pytest.mark.parametrize("engine", FEWER_ENGINES)
each_solver = pytest.mark.parametrize("solver", ["sgm", "sgp"])
numpy_first = pytest.mark.parametrize("engine", NUMPY_FIRST)
in_double = pytest.mark.parametrize("engine", NUMPY_FIRST[:2])


def adjoint(pixels, psf):
    """Return what `blur` is the adjoint of, as a plain sum over the PSF's pixels."""
    summed = np.zeros(pixels.shape)
    cy, cx = psf.shape[0] // 2, psf.shape[1] // 2
    for (y, x), value in np.ndenumerate(psf / psf.sum()):
        summed += value * np.roll(pixels, (cy - y, cx - x), axis=(0, 1))
    return summed


def assert_close(result, extended, star_fluxes, objective, precision):
    extended_tolerance, star_tolerance, objective_tolerance = ROUNDING[precision]
    assert worst(result.extended, extended) <= extended_tolerance
    assert worst(result.star_fluxes, star_fluxes) <= star_tolerance
    assert worst(result.history["objective"], objective) <= objective_tolerance


# --- The adjoint


# --- What is conserved, what stays as it is


@numpy_first
def test_observed_flux_is_conserved_with_stars_and_masks(engine):
    made = MASKED.make()
    weights = ~made.mask
    total_weight = sum(adjoint(w, psf) for w, psf in zip(weights, made.psfs, strict=True))
    star_weights = np.array([total_weight[y, x] for x, y in made.stars])
    flux = made.images[weights].sum()
    errors = []

    def measure(iteration, estimate):
        given = (total_weight * estimate.extended).sum() + star_weights @ estimate.star_fluxes
        errors.append(abs(given - flux) / flux)

    made.deconvolve(n_iter=30, callback=measure, **engine)
    assert len(errors) == 30
    assert max(errors) <= SUM_ROUNDING[engine["precision"]]


@in_double
def test_faint_pixels_are_not_lost_in_a_floor(engine):
    # Nine orders of magnitude below the mean: nearly all that the transform leaves of double.
    image = 1.0 + np.arange(512.0).reshape(SHAPE) % 7
    faint = image.copy()
    image[5, 9] = 512e9
    observation = lnocl.Observation([image] * 3, np.ones((1, 1)))
    result = paper(observation, n_iter=5, **engine)
    extended = result.extended.copy()
    extended[5, 9] = faint[5, 9]
    np.testing.assert_allclose(extended, faint, rtol=6e-5)


@numpy_first
def test_rounding_makes_nothing_negative(engine):
    # Far from the only bright pixel the correction is 0: what the transform leaves has any sign.
    image = np.zeros(SHAPE)
    image[5, 9] = 1000.0
    observation = lnocl.Observation([image] * 3, make_psfs(3, (2, 2)), background=1.0)
    result = paper(observation, n_iter=1, **engine)
    assert result.extended.min() == 0.0


@pytest.mark.parametrize(
    "recipe",
    [BARE, dataclasses.replace(MASKED, background="each")],
    ids=["bare", "stars, mask, background"],
)
@in_double
def test_objective_never_rises(engine, recipe):
    objective = recipe.make().deconvolve(n_iter=300, **engine).history["objective"]
    assert (np.diff(objective) < 0).all()


# --- What the answer does not depend on


@every_engine
def test_order_of_the_images_does_not_matter(engine):
    made = FULL.make()
    order = [2, 0, 1]
    shuffled = {
        name: getattr(made, name)[order] for name in ("images", "psfs", "background", "mask")
    }
    result = made.deconvolve(n_iter=50, **engine)
    other = made.deconvolve(made.observation(**shuffled), n_iter=50, **engine)
    objective = result.history["objective"]
    assert_close(other, result.extended, result.star_fluxes, objective, engine["precision"])


@pytest.mark.parametrize("shift", [(0, 1), (5, 0), (11, 23)])
@every_engine
def test_shifted_images_give_a_shifted_sky(engine, shift):
    made = FULL.make()
    result = made.deconvolve(n_iter=50, **engine)
    rolled = {
        name: np.roll(getattr(made, name), shift, axis=(-2, -1))
        for name in ("images", "background", "mask")
    }
    ny, nx = SHAPE
    other = made.deconvolve(
        made.observation(**rolled),
        n_iter=50,
        stars=[((x + shift[1]) % nx, (y + shift[0]) % ny) for x, y in made.stars],
        initial_extended=np.roll(made.initial_extended, shift, axis=(0, 1)),
        **engine,
    )
    extended = np.roll(result.extended, shift, axis=(0, 1))
    objective = result.history["objective"]
    assert_close(other, extended, result.star_fluxes, objective, engine["precision"])


STARTS = ("initial_extended", "initial_star_fluxes")


@pytest.mark.parametrize("start", ["given", "default"])
@pytest.mark.parametrize("recipe", [FULL, PADDED], ids=["full", "padded"])
@each_solver
@every_engine
def test_scaling_by_a_power_of_two_is_bit_for_bit(engine, solver, recipe, start):
    made = recipe.make()
    starts = {name: getattr(made, name) if start == "given" else None for name in STARTS}
    result = made.deconvolve(n_iter=20, solver=solver, **starts, **engine)
    for factor in (2.0**-60, 2.0**-3, 2.0, 2.0**60):
        scaled_starts = {
            name: None if value is None else factor * value for name, value in starts.items()
        }
        scaled = made.deconvolve(
            made.observation(images=factor * made.images, background=factor * made.background),
            n_iter=20,
            solver=solver,
            mu=recipe.mu / factor,
            **scaled_starts,
            **engine,
        )
        np.testing.assert_array_equal(scaled.extended, factor * result.extended)
        np.testing.assert_array_equal(scaled.star_fluxes, factor * result.star_fluxes)
        objective = factor * result.history["objective"]
        np.testing.assert_array_equal(scaled.history["objective"], objective)


@pytest.mark.parametrize("start", ["given", "default"])
@pytest.mark.parametrize("recipe", [FULL, PADDED], ids=["full", "padded"])
@every_engine
def test_masked_pixels_have_no_influence(engine, recipe, start):
    made = recipe.make()
    starts = {name: getattr(made, name) if start == "given" else None for name in STARTS}

    def run(**changes):
        return made.deconvolve(made.observation(**changes), n_iter=20, **starts, **engine)

    result = run()
    for value in (np.nan, np.inf, -1e30, 1e30):
        images, background = (
            np.where(made.mask, value, array) for array in (made.images, made.background)
        )
        same(run(images=images, background=background), result)
    same(run(images=np.ma.array(images, mask=made.mask), mask=None), result)


@pytest.mark.parametrize("recipe", [FULL, PADDED], ids=["full", "padded"])
@each_solver
@every_engine
def test_runs_repeat_bit_for_bit(engine, solver, recipe):
    given = {"n_iter": 50, "solver": solver, **engine}
    same(recipe.make().deconvolve(**given), recipe.make().deconvolve(**given))


@every_engine
def test_continued_run_equals_one_run(engine):
    made = FULL.make()
    whole = made.deconvolve(n_iter=60, **engine)
    first = made.deconvolve(n_iter=25, **engine)
    second = made.deconvolve(
        n_iter=35,
        initial_extended=first.extended,
        initial_star_fluxes=first.star_fluxes,
        **engine,
    )
    np.testing.assert_array_equal(second.extended, whole.extended)
    np.testing.assert_array_equal(second.star_fluxes, whole.star_fluxes)
    # The sum of squares of a start is not summed where those of the iterations are.
    objective = whole.history["objective"][25:]
    assert worst(second.history["objective"], objective) <= ROUNDING[engine["precision"]][2]


# --- The callback


@pytest.mark.parametrize("last", [1, 4, 9])
@each_solver
@every_engine
def test_callback_stops_the_run(engine, solver, last):
    made = FULL.make()
    seen = {}

    def stop(iteration, estimate):
        seen["extended"], seen["star_fluxes"] = estimate.extended, estimate.star_fluxes
        return iteration == last

    result = made.deconvolve(n_iter=9, solver=solver, callback=stop, **engine)
    assert (result.n_iter, result.stop_reason) == (last, "callback")
    np.testing.assert_array_equal(result.extended, seen["extended"])
    np.testing.assert_array_equal(result.star_fluxes, seen["star_fluxes"])
    same(result, made.deconvolve(n_iter=last, solver=solver, **engine))


@every_engine
def test_estimate_must_be_read_in_the_callback(engine):
    kept = []
    FULL.make().deconvolve(
        n_iter=2, callback=lambda iteration, estimate: kept.append(estimate), **engine
    )
    for estimate in kept:
        with pytest.raises(RuntimeError, match="before the callback returns"):
            _ = estimate.extended
        with pytest.raises(RuntimeError, match="before the callback returns"):
            _ = estimate.star_fluxes


@every_engine
def test_callback_cannot_change_the_run(engine):
    made = FULL.make()

    def spoil(iteration, estimate):
        estimate.extended[:] = -1.0
        estimate.star_fluxes[:] = -1.0

    same(made.deconvolve(n_iter=5, callback=spoil, **engine), made.deconvolve(n_iter=5, **engine))


def test_callback_hears_the_warnings_of_numpy():
    """Which are turned off for the iteration, where what overflows is looked for."""
    with pytest.warns(RuntimeWarning, match="invalid value"):
        FULL.make().deconvolve(n_iter=1, callback=lambda *_: np.log(np.array(-1.0)), engine="numpy")


# --- What kind of array the input comes as
