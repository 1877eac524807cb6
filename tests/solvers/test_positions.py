"""Star positions and fluxes: the fit against SciPy, its errors against noise, and whole runs.

Tolerances are two to three times what was measured, which stands beside them.
"""

import dataclasses
import functools
import warnings

import numpy as np
import pytest
from scenes import FEWER_ENGINES, Recipe, paper, worst
from scipy.optimize import minimize
from scipy.special import kl_div

import lnocl
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.stars import MAX_SHIFT
from lnocl.core.solvers import fluxes, positions, scaling
from lnocl.core.solvers.positions import StarFit, Stars

# PSFs here are small, and whole offsets periodic.
pytestmark = pytest.mark.filterwarnings(
    "ignore:psf . is undersampled",
    "ignore:the images are shifted by up to",
    "ignore:the star at .* lies on bad pixels",
)

SHAPE = (32, 32)
SIGMA = 3.0 / np.sqrt(8.0 * np.log(2.0))
numpy_alone = {"engine": "numpy"}


def gaussian(x, y, shape=SHAPE):
    """Return a Gaussian star of unit flux and FWHM 3 pixels."""
    rows, columns = np.indices(shape)
    return np.exp(-0.5 * ((columns - x) ** 2 + (rows - y) ** 2) / SIGMA**2) / (2 * np.pi * SIGMA**2)


PSF = gaussian(7, 7, (15, 15))

# --- The fit

RECIPES = {
    "two stars": Recipe(SHAPE, 2, 2, psf_shape=(9, 9), background="each"),
    "exposures, offsets, mask, noise": Recipe(
        (32, 16),
        3,
        2,
        masked=0.1,
        background="map",
        read_noise=1.0,
        exposure="each",
        fractions=True,
    ),
    "exposure map, three stars, room for margins": Recipe(
        (32, 128), 2, 3, psf_shape=(11, 12), exposure="map", fractions=True
    ),
}
# Of the standard errors, and in standard errors: measured 2.9e-5 and 1.5e-3.
LOST_TO_WINGS = 9e-5, 4.5e-3
every_recipe = pytest.mark.parametrize("name", RECIPES)


@pytest.fixture
def whole_psfs(monkeypatch):
    """Look at all pixels that a star lights, not only at those that say much of its position."""
    monkeypatch.setattr(positions, "INFORMATION_SHARE", 1.0)


def fit_of(name, fluxes=(2.5e3, 1.1e3, 3e3)):
    """Return the recipe's arrays, its scene, the fit, and stars off the truth."""
    made = RECIPES[name].make()
    scene = Scene(made.observation(), made.stars, max_shift=MAX_SHIFT)
    extended, _ = scene.start(made.sky, None)
    n = len(made.stars)
    off = np.array([(0.42, -0.73), (-1.15, 0.3), (0.0, 0.55)])[:n]
    stars = Stars(np.array(fluxes[:n]) / scene.unit, scene.stars + off)
    return made, scene, StarFit(scene, Model(scene), extended, scene.stars), stars, extended


def as_vector(stars):
    return np.concatenate([stars.fluxes, *stars.positions.T])


def as_stars(vector):
    n = len(vector) // 3
    return Stars(vector[:n], vector[n:].reshape(2, n).T)


def differences(function, vector):
    """Return the derivatives of a function along each unknown, by differences of fourth order."""
    columns = []
    for i, value in enumerate(vector):
        h = 1e-3 * (value if i < len(vector) // 3 else 1.0)
        unit = np.eye(len(vector))[i]
        columns.append(
            sum(
                weight * function(as_stars(vector + step * h * unit))
                for step, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1))
            )
            / (12 * h)
        )
    return np.array(columns)


def models(scene, extended, stars):
    """Return images, models and weights of all pixels, by the scene's own PSFs moved there."""
    other = Scene(scene.observation, stars.positions)
    otfs = [np.fft.rfft2(other.psf(j)) for j in range(other.n_images)]
    model = np.array([np.fft.irfft2(otf * np.fft.rfft2(extended), other.grid) for otf in otfs])
    for j in range(other.n_images):
        for s, flux in enumerate(stars.fluxes):
            model[j] += flux * other.star_image(j, s)
    background = other.background()
    background = background if background.ndim == 3 else background[:, None, None]
    weights = np.ones(model.shape) if other.weights is None else other.weights.astype(float)
    return np.array(list(other.images())), model + background, weights


@pytest.mark.usefixtures("whole_psfs")
@every_recipe
def test_objective_is_the_data_term(name):
    """But for what no star lights."""
    _, scene, fit, stars, extended = fit_of(name)
    further = Stars(1.3 * stars.fluxes, stars.positions + 0.3)
    terms = []
    for each in (stars, further):
        images, model, weights = models(scene, extended, each)
        terms.append((weights * kl_div(images, model)).sum())
    difference = fit.objective(further) - fit.objective(stars)
    assert abs(difference - (terms[1] - terms[0])) <= 1e-13 * abs(terms[1] - terms[0])


@every_recipe
def test_gradient_is_that_of_the_objective(name):
    *_, fit, stars, _ = fit_of(name)
    trial = fit._try(stars)
    gradient, information = fit._gradient(trial), fit._information(trial)
    errors = 1.0 / np.sqrt(information.diagonal)
    expected = differences(fit.objective, as_vector(stars))
    # In units of the least the objective could be bent by.
    assert worst(gradient * errors, expected * errors) <= 1e-10  # measured 1.2e-11 to 3.7e-11


@pytest.mark.usefixtures("whole_psfs")
@every_recipe
def test_information_is_that_of_the_model(name):
    _, scene, fit, stars, extended = fit_of(name)
    _, model, weights = models(scene, extended, stars)
    columns = differences(lambda each: models(scene, extended, each)[1], as_vector(stars))
    columns = columns.reshape(len(columns), -1)
    expected = (columns * (weights / model).ravel()) @ columns.T
    information = fit._information(fit._try(stars)).block(slice(None))
    errors = 1.0 / np.sqrt(np.diag(expected))
    assert (
        worst(information * errors * errors[:, None], expected * errors * errors[:, None]) <= 1e-9
    )


def errors_of(fit, stars):
    """Return standard errors where the extended source is known, and images are of unit counts."""
    return np.sqrt(fluxes.variances(fit._information(fit._try(stars)).block(slice(None))))


@pytest.mark.exhaustive
@pytest.mark.usefixtures("whole_psfs")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if "offsets" in name else [pytest.mark.exhaustive])
        for name in RECIPES
    ],
)
def test_minimum_is_that_of_scipy(name):
    """On J itself, summed over all pixels, in standard errors."""
    _, scene, fit, stars, extended = fit_of(name)
    found = as_vector(fit.minimise(stars))
    errors = errors_of(fit, as_stars(found))

    def objective(z):
        images, model, weights = models(scene, extended, as_stars(z * errors))
        return (weights * kl_div(images, np.maximum(model, 1e-12))).sum()

    best = minimize(objective, as_vector(stars) / errors, method="BFGS", options={"gtol": 1e-7})
    assert abs(found / errors - best.x).max() * np.sqrt(scene.scale) <= 1e-4  # measured 3.9e-5
    assert objective(found / errors) <= best.fun * (1 + 1e-11)
    assert abs(found / errors - as_vector(stars) / errors).max() > 1.0


@pytest.mark.exhaustive
@pytest.mark.usefixtures("whole_psfs")
def test_a_star_is_at_one_place_in_all_epochs():
    """Two stars in each other's light, in three images of two epochs, against SciPy."""
    true = np.array([(14.3, 15.6), (17.9, 13.8)])
    fluxes = np.array([9e3, 3e3, 2e3, 8e3])  # star by star, in its epochs
    epochs, spots = [0, 1, 0], [gaussian(x, y) for x, y in true]
    means = [8.0 + sum(fluxes[2 * s + e] * spots[s] for s in (0, 1)) for e in epochs]
    images = np.random.default_rng(2).poisson(means).astype(float)
    observation = lnocl.Observation(images, PSF, background=8.0, epochs=epochs)
    given = true + np.array([(0.3, -0.2), (-0.4, 0.3)])
    scene = Scene(observation, given, max_shift=MAX_SHIFT)
    fit = StarFit(scene, Model(scene), np.full(scene.grid, 1e-6), np.repeat(given, 2, axis=0))
    start = Stars(fluxes[::-1] / scene.unit, scene.stars)
    found = fit.minimise(fit.look_round(start))
    np.testing.assert_array_equal(found.positions[::2], found.positions[1::2])

    def objective(z):
        moved = Scene(observation, z[4:].reshape(2, 2))
        return kl_div(images, Model(moved).images(np.zeros(scene.grid), z[:4] * 1e3 / moved.unit)
                      * moved.scale).sum()  # fmt: skip

    first = np.append(fluxes / 1e3, true)
    best = minimize(objective, first, method="BFGS", options={"gtol": 1e-5}).x
    np.testing.assert_allclose(found.fluxes * scene.unit, best[:4] * 1e3, rtol=2e-3)
    np.testing.assert_allclose(found.positions[::2].ravel(), best[4:], rtol=0, atol=2e-3)
    assert abs(found.positions[::2] - true).max() < 0.1


@every_recipe
def test_far_wings_say_little(name, monkeypatch):
    """The squares that are looked at, against all pixels: errors, and the minimum in errors."""
    *_, fit, stars, _ = fit_of(name)
    monkeypatch.setattr(positions, "INFORMATION_SHARE", 1.0)
    *_, whole, _, _ = fit_of(name)
    found, best = (as_vector(each.minimise(stars)) for each in (fit, whole))
    errors, least = (errors_of(each, as_stars(best)) for each in (fit, whole))
    assert (abs(errors / least - 1.0) <= LOST_TO_WINGS[0]).all()
    assert (abs(found - best) <= LOST_TO_WINGS[1] * least).all()


# --- A star on a flat sky: noise


def flat_sky(x, y, flux, level, seed, **known):
    mean = flux * gaussian(x, y) + level
    return lnocl.Observation(
        np.random.default_rng(seed).poisson(mean), PSF, background=level, **known
    )


def fitted(observation, given, level, flux):
    scene = Scene(observation, [given], max_shift=MAX_SHIFT)
    fit = StarFit(scene, Model(scene), np.zeros(scene.grid), scene.stars)
    stars = fit.minimise(Stars(np.array([flux / scene.unit]), scene.stars))
    errors = errors_of(fit, stars) * (scene.unit, 1.0, 1.0)
    values = np.array([stars.fluxes[0] * scene.unit, *stars.positions[0]])
    return values, errors / np.sqrt(scene.scale)


@pytest.mark.exhaustive
def test_scatter_of_fits_matches_their_errors():
    """Of 100 realisations; the sum of squares over the errors' has a chi-square distribution."""
    truth, level, n = np.array([2000.0, 15.3, 16.4]), 5.0, 100
    pulls = []
    for seed in range(n):
        observation = flat_sky(*truth[1:], truth[0], level, seed)
        values, errors = fitted(observation, (15, 17), level, 0.7 * truth[0])
        pulls.append((values - truth) / errors)
    pulls = np.array(pulls)
    # Four standard errors of the mean and of the variance.
    assert (abs(pulls.mean(axis=0)) <= 4.0 / np.sqrt(n)).all()
    assert (abs((pulls**2).mean(axis=0) - 1.0) <= 4.0 * np.sqrt(2.0 / n)).all()


def test_a_star_keeps_within_its_radius():
    observation = flat_sky(15.0, 16.0, 5000.0, 5.0, 0)
    for given, away in (((20, 16), 5.0), ((12.0, 12.0), 5.0), ((17.5, 16), 0.0)):
        values, _ = fitted(observation, given, 5.0, 5000.0)
        gone = np.hypot(*(values[1:] - given))
        if away:
            assert gone == pytest.approx(MAX_SHIFT, abs=1e-12)
        else:
            assert np.hypot(*(values[1:] - (15, 16))) <= 0.1
    result = paper(observation, [(20, 16)], n_iter=20, refine_positions=True, **numpy_alone)
    assert np.hypot(*(result.star_positions[0] - (20, 16))) <= MAX_SHIFT + 1e-12


def test_a_star_without_light_is_left_alone():
    """Its flux ends at 0, where its position means nothing and has no error."""
    observation = lnocl.Observation(np.zeros(SHAPE), PSF, background=3.0)
    result = paper(
        observation, [(15, 16)], n_iter=3, refine_positions=True, initial_star_fluxes=[0.0],
        **numpy_alone,
    )  # fmt: skip
    np.testing.assert_array_equal(result.star_positions, [(15, 16)])
    np.testing.assert_array_equal(result.star_fluxes, [0.0])
    assert np.isnan(result.star_position_errors).all()
    assert np.isfinite(result.star_flux_errors).all()


def test_a_star_may_leave_the_images_but_not_go_where_all_is_masked():
    """It must not end the run."""
    observation = flat_sky(-1.2, 16.0, 3000.0, 5.0, 0)
    result = paper(observation, [(0, 16)], n_iter=6, pad=8, refine_positions=True, **numpy_alone)
    assert result.star_positions[0, 0] < -0.5
    mask = np.zeros(SHAPE, bool)
    mask[:, 16:] = True
    observation = flat_sky(17.5, 16.0, 3e5, 5.0, 0, mask=mask)
    scene = Scene(observation, [(14.0, 16.0), (5.0, 5.0)], max_shift=30.0)
    weights = scene.star_weights
    scene.move_stars([(25.0, 16.0), (6.0, 5.5)])
    np.testing.assert_array_equal(scene.stars, [(14.0, 16.0), (6.0, 5.5)])
    np.testing.assert_array_equal(scene.star_weights[0], weights[0])
    expected = Scene(observation, [(6.0, 5.5)]).star_weights
    np.testing.assert_array_equal(scene.star_weights[1:], expected)


@pytest.mark.parametrize("shape", [(128, 64), (16, 128)])
def test_box_that_a_star_may_light_holds_it_wherever_it_goes(shape):
    """The engine has room for that alone; an undersampled PSF rings to the end of its margins."""
    psf = np.zeros((9, 5))
    psf[4, 2] = 1.0  # the rest of it is empty
    observation = lnocl.Observation(np.ones((2, *shape)), psf, offsets=[(0, 0), (1.5, -3.25)])
    for given in ((30.0, 10.0), (30.5, 10.5), (30.2, 0.0)):
        scene = Scene(observation, [given], max_shift=MAX_SHIFT)
        boxes = [scene.star_box(j, 0) for j in range(2)]
        fit = StarFit(scene, Model(scene), np.ones(scene.grid), scene.stars)
        for angle in np.linspace(0, 2 * np.pi, 17):
            position = np.array(given) + MAX_SHIFT * np.array([np.cos(angle), np.sin(angle)])
            scene.move_stars([position])
            for j, (rows, columns) in enumerate(boxes):
                cutout = scene.star_cutout(j, 0)
                assert rows[cutout.rows(scene.grid)].all()
                assert columns[cutout.columns(scene.grid)].all()
            for movable, offset in zip(fit._stars, observation.offsets, strict=True):
                moving = movable._moving(0, position + offset)
                pixels = movable._at(moving).ravel()
                assert (pixels >= 0).all()  # else the fit has no place for them
                assert len(np.unique(pixels)) == len(pixels) == moving.values[0].size
    if shape[0] == 128:
        assert not any(rows.all() for rows, _ in boxes)


# --- Runs

RUN = Recipe((16, 32), 2, 1, mu=1e-3, background="each", masked=0.03, psf_shape=(9, 9))
OFF = np.array([(0.6, -0.4)])
# As other tests build a program for.
TWO_STARS = dataclasses.replace(RUN, n_stars=2)


def run(recipe=RUN, engine=FEWER_ENGINES[0].values[0], **changes):
    made = recipe.make()
    given = {"stars": made.stars + OFF, "n_iter": 13, "refine_positions": True, **engine}
    return made, made.deconvolve(**(given | changes))


@functools.cache
def reference_run(solver):
    return run(TWO_STARS, solver=solver)[1]


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_positions_are_found_in_a_run(solver):
    made, result = run(solver=solver, n_iter=50)
    off = result.star_positions - made.stars
    assert abs(off / result.star_position_errors).max() <= 4.0
    _, without = run(solver=solver, n_iter=50, refine_positions=False)
    np.testing.assert_array_equal(without.star_positions, made.stars + OFF)
    assert (without.star_flux_errors > 0).all()
    assert np.isnan(without.star_position_errors).all()
    assert result.history["objective"][-1] < without.history["objective"][-1]
    away = without.star_positions - made.stars
    assert (np.hypot(*off.T) < 0.2 * np.hypot(*away.T)).all()


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_objectives_never_rise_and_are_one_for_each_iteration(solver):
    """Those after which stars were moved are of the moved stars: J falls by that, too."""
    for n_iter in (1, 3, 4, 6, 13):
        _, result = run(solver=solver, n_iter=n_iter)
        np.testing.assert_array_equal(result.history["iteration"], np.arange(n_iter + 1))
        assert (np.diff(result.history["objective"]) < 0).all()
    # Not those of iteration 3 and 6 as the solver left them: stars were moved then.
    before = run(solver=solver, n_iter=3)[1].history["objective"]
    np.testing.assert_array_equal(before[:3], result.history["objective"][:3])
    assert result.history["objective"][3] < before[3]


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_stars_are_moved_after_3_6_and_12_iterations(solver):
    """And before the first: as if runs were begun anew from there."""
    seen = []

    def look(iteration, estimate):
        seen.append(tuple(estimate._live().star_positions()[0]))

    run(solver=solver, n_iter=14, callback=look)
    changed = [i for i in range(1, 14) if seen[i] != seen[i - 1]]  # seen[i]: iteration i + 1
    assert changed == [3, 6, 12]
    assert seen[0] != tuple((RUN.make().stars + OFF)[0])


@pytest.mark.parametrize("solver", [pytest.param("sgm", marks=pytest.mark.exhaustive), "sgp"])
@pytest.mark.parametrize("engine", FEWER_ENGINES[1:])
def test_engines_agree(engine, solver):
    expected = reference_run(solver)
    _, result = run(TWO_STARS, engine, solver=solver)
    found = {
        "extended": worst(result.extended, expected.extended),
        "fluxes": worst(result.star_fluxes, expected.star_fluxes),
        "positions": abs(result.star_positions - expected.star_positions).max(),
        "flux errors": worst(result.star_flux_errors, expected.star_flux_errors),
        "position errors": worst(result.star_position_errors, expected.star_position_errors),
        "objective": worst(result.history["objective"], expected.history["objective"]),
    }
    # Measured 1.6e-14, 1.8e-15, 1.4e-14, 2.8e-7, 1.8e-6 and 2.8e-16; in single 3.7e-6, 4.3e-7,
    # 3.5e-6, 1.1e-6, 2.9e-6 and 8.6e-8.
    tolerances = {
        "double": (5e-14, 5.5e-15, 4.5e-14, 8e-7, 6e-6, 1e-15),
        "single": (1.1e-5, 1.3e-6, 1.1e-5, 3.5e-6, 9e-6, 2.6e-7),
    }[engine["precision"]]
    assert (np.array(list(found.values())) <= tolerances).all(), found


# --- With the rules

FULL = dataclasses.replace(RUN, n_images=3, exposure="map", fractions=True, mu=0.0)


@pytest.mark.parametrize("recipe", [FULL, dataclasses.replace(FULL, exposure="each")])
@pytest.mark.parametrize("stop", ["held-out", "discrepancy", 1e-3])
def test_rules_go_with_refinement_exposures_and_offsets(stop, recipe):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        made, result = run(recipe, solver="sgp", stop=stop, n_iter=200)
    reason = "change" if stop == 1e-3 else stop
    assert result.stop_reason == reason
    assert 1 < result.n_iter < 200
    assert len(result.history) == result.n_iter + 1
    truth = np.round(made.stars)  # the data are of whole pixels
    assert abs(result.star_positions - truth).max() <= 0.2


def test_discrepancy_knows_where_the_stars_are():
    """Its expectation at the end is that of the last model."""
    from lnocl.core.runs.stopping import Discrepancy, expected_deviance

    ratios = []
    rule = Discrepancy()

    def look(iteration, estimate):
        going = estimate._live()
        rule.met(going)
        _, model, weights = models(
            going.scene,
            going.engine.extended(),
            Stars(going.engine.star_fluxes(), going.scene.stars),
        )
        seen = weights > 0
        means = (weights * model)[seen] * going.scene.scale
        ratios.append(rule._expected / expected_deviance(means).sum() if iteration in (1, 4) else 1)

    # Stars are moved after 3 iterations: what is expected after 4 is of where they are then.
    run(solver="sgp", n_iter=4, callback=look)
    assert abs(np.array(ratios) - 1.0).max() <= 1e-12


def test_steps_are_measured_anew_where_stars_have_moved(monkeypatch):
    made, prepared, prepare = RUN.make(), [], scaling.prepare

    def prepare_and_note(*given):
        prepared.append(prepare(*given))
        return prepared[-1]

    monkeypatch.setattr(scaling, "prepare", prepare_and_note)
    stars, how = made.stars + OFF, (0, "sgp", "double", "numpy", None)
    setup = Setup(made.observation(), stars, *how, refine_positions=True)
    run = Run(make_start(setup, Penalty()), 7)
    assert run.complete() == "n_iter"
    assert len(prepared) == 3  # at the start, after 3 and after 6
    assert run.engine.scaling is prepared[-1][1]


@pytest.mark.parametrize("share", [0.01, 0.3, 3.0, 30.0])
def test_no_step_leads_uphill(share, monkeypatch):
    """One step at a time, from fluxes and positions far off."""
    monkeypatch.setattr(positions, "MAX_STEPS", 1)
    monkeypatch.setattr(positions, "MAX_STEP", 6.0)  # far beyond the parabola
    for name in RECIPES:
        *_, fit, stars, _ = fit_of(name)
        for far in np.random.default_rng(0).uniform(-2, 2, (10, *stars.positions.shape)):
            begin = Stars(share * stars.fluxes, stars.positions + far)
            assert fit.objective(fit.minimise(begin)) <= fit.objective(begin)
