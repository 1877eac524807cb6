"""Replicas of a run, and the errors that they give."""

import dataclasses
import pickle

import numpy as np
import pytest
from scenes import Recipe
from scipy.ndimage import gaussian_filter
from scipy.stats import t

import lnocl
from lnocl.core.runs import bootstrap, quantities
from lnocl.core.runs.bootstrap import Bootstrap, Quantity
from lnocl.core.runs.repeated import RerunWithCounts
from lnocl.core.runs.replicas import Replicas
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.apertures import Aperture
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.shifting import place
from lnocl.core.scene.star_prior import StarPrior

BASE = Recipe((32, 32), 2, 1, smooth=True)
RECIPES = {
    "plain": BASE,
    "masked, read noise": dataclasses.replace(BASE, masked=0.1, read_noise=2.0, shape=(30, 27)),
    "map of exposures": dataclasses.replace(BASE, exposure="map"),
}
pytestmark = pytest.mark.filterwarnings("ignore:psf . is undersampled")
ENGINES = [
    ("numpy", "double"),
    pytest.param("opencl", "single", marks=pytest.mark.exhaustive),
]
APERTURES = [Aperture("a", 4, 6, np.ones((12, 12))), Aperture("b", 20, 3, np.ones((2, 2)))]


def solved(recipe=BASE, **changes):
    made = recipe.make()
    observation = made.observation()
    options = {"stop": None, "n_iter": 8, "smoothing": 1e-3, "pad": 0, "engine": "numpy"} | changes
    return lnocl.deconvolve(observation, made.stars, **options)


# --- A run that is repeated


@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
@pytest.mark.parametrize(("engine", "precision"), ENGINES)
def test_a_repeated_run_is_bit_for_bit_a_new_one(engine, precision, solver, refine):
    """After another observation, whose stars are elsewhere, and more iterations than were due."""
    made = BASE.make()
    observation = made.observation()
    other = made.observation(images=made.images[:, ::-1, ::-1].copy())
    setup = Setup(observation, made.stars, 0, solver, precision, engine, None, refine)
    start = make_start(setup, Penalty(smoothing=1e-3))
    expected = Run(start, 9)
    run = Run(start, 9)
    for each in (other, observation):
        run.repeat(start, each)
        assert run.complete() == "n_iter"
    assert expected.complete() == "n_iter"
    np.testing.assert_array_equal(run.extended(), expected.extended())
    np.testing.assert_array_equal(run.star_fluxes(), expected.star_fluxes())
    np.testing.assert_array_equal(run.star_positions(), expected.star_positions())
    np.testing.assert_array_equal(run.objectives(), expected.objectives())


# --- What is drawn


def drawn_by(replicas, outcome, n):
    """Return counts of the answer itself."""
    models = list(replicas._means(replicas._model, outcome.sky / outcome.scene.unit))
    seeds = [np.random.SeedSequence(k).spawn(2) for k in range(n)]
    return np.array([replicas._draw(models, each) for each in seeds])


@pytest.mark.exhaustive
@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES)
def test_counts_have_the_mean_and_variance_of_the_model(recipe):
    result = solved(recipe)
    replicas, observation = Replicas(result._outcome, 0), result._outcome.scene.observation
    draws = drawn_by(replicas, result._outcome, 400)
    good, models = ~observation.mask, result.models()
    # Counts of a few are rounded up where read noise makes them negative.
    plenty = good & (models > 9 + 9 * observation.read_noise.max() ** 2)
    assert plenty.sum() > 200
    z = (draws.mean(axis=0) - models)[plenty] / np.sqrt(models[plenty] / 400)
    assert abs(z).max() < 5
    assert np.mean(z**2) == pytest.approx(1.0, abs=0.25)
    variances = draws.var(axis=0, ddof=1)[plenty] / models[plenty]
    assert np.mean(variances) == pytest.approx(1.0, abs=0.02)


def test_bad_pixels_are_bad_in_replicas_too(monkeypatch):
    result = solved(RECIPES["masked, read noise"])
    seen, repeat = [], Run.repeat
    monkeypatch.setattr(Run, "repeat", lambda *given: (seen.append(given[-1]), repeat(*given)))
    Replicas(result._outcome, 0).reconstruct(0)
    observation = result._outcome.scene.observation
    np.testing.assert_array_equal(seen[0].mask, observation.mask)
    assert not seen[0].images[observation.mask].any()
    assert seen[0].images[~observation.mask].all()


def test_replicas_hang_on_seed_and_number_alone():
    outcome = solved()._outcome
    first, second = Replicas(outcome, 5), Replicas(outcome, 5)
    for k in (3, 0):
        first.reconstruct(k)
    for k in (0, 3):
        same(*first.reconstruct(k), *second.reconstruct(k))
    different = Replicas(outcome, 6).reconstruct(0)[0][0].extended
    assert (different != second.reconstruct(0)[0][0].extended).any()
    assert (different != second.reconstruct(1)[0][0].extended).any()


def same(one, other):
    for found, expected in zip(one[:2], other[:2], strict=True):
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.exhaustive
def test_batches_are_as_large_as_they_gain_by(monkeypatch):
    sizes, make = [], bootstrap._Measuring
    monkeypatch.setattr(
        bootstrap, "_Measuring", lambda *given: (sizes.append(given[-1]), make(*given))[1]
    )
    for options in ({}, {"engine": "opencl"}, {"engine": "opencl", "refine_positions": True}):
        run_bootstrap(solved(**options)._outcome, 12)
    assert sizes == [1, 12, 1]


@pytest.mark.parametrize("engine", ["numpy", pytest.param("opencl", marks=pytest.mark.exhaustive)])
def test_replicas_of_a_batch_are_bit_for_bit_as_alone(engine):
    outcome = solved(engine=engine)._outcome
    alone, batch = Replicas(outcome, 5), Replicas(outcome, 5, 3)
    for numbers in ((3, 0, 1), (4, 2)):
        for k, replica in zip(numbers, batch.reconstruct(*numbers), strict=True):
            same(replica, *alone.reconstruct(k))


# --- The prior of star fluxes


def told(errors):
    """Return the outcome of a run with a prior of these errors, at the fluxes of the stars."""
    made = BASE.make()
    setup = Setup(made.observation(), made.stars, 0, "sgp", "double", "numpy", None)
    fluxes = Run(make_start(setup, Penalty(smoothing=1e-3)), 8).star_fluxes()
    run = Run(make_start(setup, Penalty(smoothing=1e-3, stars=StarPrior.of(fluxes, errors))), 8)
    return run.outcome(run.complete())


def test_a_repeated_run_heeds_the_prior_that_it_is_given():
    outcome = told(np.array([1e-3]))
    counts = outcome.scene.observation.images
    fluxes = 1.1 * outcome.star_fluxes
    found = RerunWithCounts(outcome).of((counts, StarPrior.of(fluxes, np.array([1e-3]))))[0]
    np.testing.assert_allclose(found.star_fluxes, fluxes, rtol=1e-3)


def test_each_replica_has_a_prior_that_is_drawn_about_its_truth(monkeypatch):
    outcome, seen = told(np.array([20.0])), []
    of = RerunWithCounts.of
    monkeypatch.setattr(
        RerunWithCounts, "of", lambda *given: (seen.append(given[-1]), of(*given))[1]
    )
    replicas = Replicas(outcome, 0)
    for k in range(12):
        replicas.reconstruct(k)
    pulls = np.array([prior.fluxes - outcome.star_fluxes for _, prior in seen]) / 20.0
    assert len(np.unique(pulls)) == 12
    assert 0.5 < pulls.std() < 1.7
    assert abs(pulls.mean()) < 3 / np.sqrt(12)


# --- What is made of it


def run_bootstrap(outcome, n, **changes):
    return bootstrap.bootstrap(outcome, n, APERTURES, 7, **changes)


def test_star_flux_errors_include_stated_errors_and_regions_their_share():
    flux, light = Quantity("star 1 flux", "flux", 100.0), Quantity("a", "flux", 50.0)
    errors = np.tile([[-3.0, -4.0], [3.0, 4.0]], (5, 1))
    alone = Bootstrap((flux, light), errors, errors[:0], np.zeros((3, 8, 8)), 2.0, 0)
    of_star, of_light = alone.standard_errors
    shares = np.array([[1.0], [0.5]])
    stated = dataclasses.replace(alone, stated=np.array([10.0]), shares=shares)
    rest = 10.0**2 - of_star**2
    expected = [10.0, np.hypot(of_light, 0.5 * np.sqrt(rest))]
    np.testing.assert_allclose(stated.standard_errors, expected)
    less = dataclasses.replace(alone, stated=np.array([1.0]), shares=shares)
    np.testing.assert_array_equal(less.standard_errors, alone.standard_errors)


def test_light_errors_are_at_least_the_change_by_smoothing():
    star, sharp, broad = (Quantity(name, "flux", 100.0) for name in ("star 1 flux", "a", "b"))
    errors = np.tile([[-1.0, -4.0, -4.0], [3.0, 2.0, 2.0]], (5, 1))  # of bias 1, -1 and -1
    changes = np.array([0.0, 50.0, 0.5])
    alone = Bootstrap((star, sharp, broad), errors, errors[:0], np.zeros((3, 8, 8)), 2.0, 0)
    found = dataclasses.replace(alone, of_smoothing=changes)
    expected = [alone.standard_errors[0], 51.0, alone.standard_errors[2]]
    np.testing.assert_allclose(found.standard_errors, expected)
    table = found.to_table(electrons=2.0)
    np.testing.assert_allclose(table["error_smoothing"], [0.0, 25.5, 0.75])
    assert "error_smoothing" not in alone.to_table().colnames


def test_light_is_compared_with_that_of_as_many_iterations_without_smoothing():
    smooth = solved()
    sharp = solved(smoothing=0.0)
    found = run_bootstrap(smooth._outcome, 10)
    light = [each._outcome.light().sky() for each in (smooth, sharp)]
    expected = [part.flux(light[0]) - part.flux(light[1]) for part in APERTURES]
    np.testing.assert_allclose(found.of_smoothing[-2:], expected, rtol=1e-9)
    assert not found.of_smoothing[:-2].any()
    assert abs(found.of_smoothing[-2:]).min() > 0
    assert not np.any(run_bootstrap(sharp._outcome, 10).of_smoothing)


@pytest.mark.exhaustive
def test_errors_hold_the_light_of_a_ring_thinner_than_a_pixel():
    """Replicas of its smooth estimate have an error a third of this."""
    from regions import CircleAnnulusPixelRegion, PixCoord

    y, x = np.indices((128, 128))
    middle, light = (66.3, 61.8), 24000.0

    def spot(x0, y0):
        """Return a Moffat function that is not round, and a Gaussian beside its middle."""
        r2 = (x - x0) ** 2 + 1.2 * (y - y0) ** 2 + 0.3 * (x - x0) * (y - y0)
        off = (x - x0 - 2.5) ** 2 + (y - y0) ** 2
        return 0.057 * (1 + r2 / 11.3) ** -3.2 + 0.0014 * np.exp(-off / 18)

    psf = spot(64, 64)
    unit = psf.sum()
    angles = np.linspace(0, 2 * np.pi, 150, endpoint=False)
    shares = 1 + 0.5 * np.cos(angles - 0.8)
    mean = 8e5 * spot(*middle)
    for flux, phi in zip(light * shares / shares.sum(), angles.tolist(), strict=True):
        mean += flux * spot(middle[0] + 9 * np.cos(phi), middle[1] + 9 * np.sin(phi))
    counts = np.random.default_rng(2).poisson(mean / unit + 120.0)
    observation = lnocl.Observation(counts, psf[33:96, 33:96], background=120.0, psf_error=0)
    result = lnocl.deconvolve(observation, [middle])
    annulus = CircleAnnulusPixelRegion(PixCoord(*middle), 5.0, 13.0)
    found = result.bootstrap(20, regions=[annulus])
    away = abs(found.values - found.bias - light)[-1]
    of_replicas = dataclasses.replace(found, of_smoothing=0.0).standard_errors[-1]
    assert away > 2.5 * of_replicas
    assert away < 2.0 * found.standard_errors[-1]


@pytest.mark.exhaustive
@pytest.mark.parametrize("what", ["level", "halo"])
def test_what_a_level_or_halo_takes_of_a_drawn_sky_is_no_bias(what):
    """A drawn sky is nowhere dark, and they take up what it has everywhere."""
    from regions import CirclePixelRegion, PixCoord

    y, x = np.indices((32, 32)) - 16.0
    psf, halo = np.exp(-(x**2 + y**2) / 4)[8:25, 8:25], 1.0 / (1.0 + (x**2 + y**2) / 200.0)
    image = np.random.default_rng(4).poisson(100.0 + 20.0 * halo * (what == "halo"))
    given = {"background_error": 3.0} if what == "level" else {"halos": halo}
    observation = lnocl.Observation(image, psf, background=100.0, psf_error=0, **given)
    region = CirclePixelRegion(PixCoord(16, 16), 12)
    result = lnocl.deconvolve(observation, engine="numpy", n_iter=10, stop=None)
    found = result.bootstrap(20, regions=[region])
    k = 0 if what == "halo" else -1
    light = result.extended[(x**2 + y**2) < 144].sum()
    assert abs(found.bias[k]) < 0.1 * light
    assert found.standard_errors[-1] < 0.5 * light


def test_shares_of_stars_are_their_light_in_each_region():
    outcome = solved(refine_positions=True)._outcome
    found = bootstrap.without_replicas(outcome, APERTURES, 7)
    observation, (x, y) = outcome.scene.observation, outcome.scene.stars[0]
    shape = observation.shape
    light = np.mean([place(psf, shape, x, y).on_grid(shape) for psf in observation.psfs], axis=0)
    within = [each.flux(light) for each in APERTURES]
    np.testing.assert_allclose(found.shares[:, 0], [1, 0, 0, *within], atol=1e-12)
    of_stars = outcome.star_errors()
    np.testing.assert_allclose(found.stated, [*of_stars.fluxes, *of_stars.positions.ravel()])
    np.testing.assert_array_equal(found.shares[:, 1:], np.eye(5, 2, -1))
    errors = np.zeros((10, 5))
    np.testing.assert_allclose(
        dataclasses.replace(found, errors=errors).standard_errors[:3], found.stated
    )


def test_light_is_there_in_the_replicas_whose_errors_leave_some():
    light, width = Quantity("a", "flux", 5.0), Quantity("b", "length", 5.0)
    errors = np.array([[4.0, 0.0], [6.0, 0.0], [5.0, 0.0], [-9.0, 0.0]])
    sums = np.stack([np.zeros((8, 8)), np.zeros((8, 8)), np.full((8, 8), 3.0)])
    found = Bootstrap((light, width), errors, errors[:0], sums, 2.0, 0)
    np.testing.assert_array_equal(found.shares_there, [0.5, np.nan])
    assert (found.share_map == 0.75).all()
    np.testing.assert_array_equal(found.to_table()["share"], [0.5, np.nan])


@pytest.mark.exhaustive
def test_pixels_have_light_where_they_are_brighter_than_their_errors():
    outcome = solved()._outcome
    found = run_bootstrap(outcome, 10)
    replicas = [Replicas(outcome, 7).reconstruct(k)[0] for k in range(10)]
    width = found.resolution / np.sqrt(8 * np.log(2))
    answer = gaussian_filter(outcome.sky[:32, :32], width, mode="nearest")
    there = [
        answer > gaussian_filter(each.found.extended - each.drawn.extended, width, mode="nearest")
        for each in replicas
    ]
    np.testing.assert_array_equal(found.share_map, np.mean(there, axis=0))
    assert found.share_map.max() == 1.0


@pytest.mark.exhaustive
def test_errors_are_found_less_drawn():
    outcome = solved(refine_positions=True)._outcome
    found = run_bootstrap(outcome, 10)
    assert [each.name for each in found.quantities] == [
        "star 1 flux", "star 1 x", "star 1 y", "a", "b",
    ]  # fmt: skip
    replicas = Replicas(outcome, 7)
    for k in (0, 9):
        drawn, seen, _ = replicas.reconstruct(k)[0]
        flux = seen.star_fluxes[0] - outcome.star_fluxes[0]
        light = (seen.light - drawn.extended)[4:16, 6:18].sum()
        assert found.errors[k, [0, 3]] == pytest.approx([flux, light], rel=1e-9)
        moved = seen.star_positions[0] - outcome.scene.stars[0]
        np.testing.assert_array_equal(found.errors[k, 1:3], moved)
    ny, nx = outcome.scene.observation.shape
    np.testing.assert_allclose(found.values[3], outcome.light().sky()[4:16, 6:18].sum())
    assert found.error_map.shape == found.bias_map.shape == (ny, nx)
    errors = []
    for k in range(10):
        drawn, seen, _ = replicas.reconstruct(k)[0]
        # Full width at half maximum in standard deviations.
        smoothed = gaussian_filter(seen.extended - drawn.extended, found.resolution / 2.35482)
        errors.append(smoothed[12:-12, 12:-12])  # the edges aside
    inner = np.s_[12:-12, 12:-12]
    np.testing.assert_allclose(found.bias_map[inner], np.mean(errors, axis=0), rtol=1e-4)
    np.testing.assert_allclose(found.error_map[inner], np.std(errors, axis=0, ddof=1), rtol=1e-4)


@pytest.mark.exhaustive
def test_replicas_are_continued_bit_for_bit():
    outcome = solved()._outcome
    at_once = run_bootstrap(outcome, 13)
    seen = []
    first = run_bootstrap(outcome, 10, look=lambda each: seen.append(each.n))
    assert seen == list(range(2, 11))
    continued = run_bootstrap(outcome, 13, earlier=first)
    np.testing.assert_array_equal(continued.errors, at_once.errors)
    np.testing.assert_array_equal(continued.sums, at_once.sums)
    np.testing.assert_array_equal(continued.error_map, at_once.error_map)


@pytest.mark.exhaustive
def test_processes_give_the_replicas_bit_for_bit():
    pytest.importorskip("distributed", reason="Dask is not installed")
    result = solved()
    here, there = (result.bootstrap(10, parallel=parallel) for parallel in (False, 2))
    for name in ("errors", "of_psfs", "sums"):
        np.testing.assert_array_equal(getattr(here, name), getattr(there, name))


def test_one_psf_for_all_images_is_one_in_other_processes_too():
    """On which its error hangs, and the bytes that are sent."""
    one = lnocl.Observation(np.ones((4, 32, 32)), np.ones((31, 31)))
    sent = pickle.dumps(one)
    got = pickle.loads(sent)
    assert got.psfs.strides[0] == 0
    np.testing.assert_array_equal(got.psfs, one.psfs)
    four = lnocl.Observation(np.ones((4, 32, 32)), np.ones((4, 31, 31)))
    assert len(pickle.dumps(four)) - len(sent) == pytest.approx(3 * 31**2 * 8, rel=0.02)


def made_up(errors, value=10.0):
    errors = np.asarray(errors, float).reshape(-1, 1)
    pixels = np.stack([errors.sum() * np.ones((2, 2)), (errors**2).sum() * np.ones((2, 2))])
    return Bootstrap((Quantity("a", "flux", value),), errors, errors[:0], pixels, 1.0, 0)


def test_intervals_are_those_of_student():
    errors = np.array([1.0, 2.0, 3.0, 6.0])
    found = made_up(errors)
    assert found.bias == errors.mean()
    assert found.standard_errors == errors.std(ddof=1)
    np.testing.assert_allclose(found.bias_map, errors.mean())
    np.testing.assert_allclose(found.error_map, errors.std(ddof=1))
    half = t(3).ppf(0.975) * errors.std(ddof=1) * np.sqrt(1.25)
    np.testing.assert_allclose(found.interval(0.95)[:, 0], [7.0 - half, 7.0 + half])


@pytest.mark.exhaustive
def test_intervals_of_normal_errors_hold_the_truth_as_often_as_they_say():
    """With ten replicas, so that the factors of Student and of the mean are seen."""
    rng, held = np.random.default_rng(1), []
    for _ in range(4000):
        low, high = made_up(rng.normal(2.0, 3.0, 10)).interval(0.68)[:, 0]
        truth = 10.0 - rng.normal(2.0, 3.0)
        held.append(low <= truth <= high)
    assert np.mean(held) == pytest.approx(0.68, abs=0.025)


def test_the_table_has_the_unit_that_is_asked_for():
    table = made_up([1.0, 2.0, 4.0]).to_table(2.0, "adu")
    assert table["unit"][0] == "adu"
    assert table["value"][0] == 5.0
    assert table["bias"][0] == pytest.approx(7 / 6)
    assert table["low68"][0] < table["value"][0] - table["bias"][0] < table["high68"][0]


def test_regions_whose_errors_may_not_hold_are_named():
    outcome = solved()._outcome
    width = bootstrap.without_replicas(outcome, [], 0).resolution
    x, y = np.round(outcome.scene.stars[0]).astype(int)
    side = int(np.ceil(width))
    named = {
        quantities.BELOW: Aperture("tiny", 20, 20, np.ones((1, 1))),
        quantities.UNDER: Aperture("core", y - side // 2, x - side // 2, np.ones((side, side))),
        "": Aperture("wide", 2, 2, np.ones((20, 20))),
    }
    found = bootstrap.without_replicas(outcome, list(named.values()), 0)
    assert [each.note for each in found.quantities[1:]] == list(named)


# --- The scatter of PSFs


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the PSFs do not fit")
def test_psf_part_of_errors_is_separate_and_scales_with_the_scatter():
    """Twice the scatter gives twice their part, and leaves the rest; without it there is none."""
    made = BASE.make()
    scatter = 1e-4 * made.psfs / made.psfs.sum(axis=(1, 2), keepdims=True)
    found = []
    for factor in (1.0, 2.0):
        observation = made.observation(psf_scatter=factor * scatter)
        result = lnocl.deconvolve(
            observation, made.stars, stop=None, n_iter=8, smoothing=1e-3, pad=0, engine="numpy"
        )
        found.append(result.bootstrap(12))
        drawn, seen, wrong = Replicas(result._outcome, 0).reconstruct(11)[0]
        error = wrong.star_fluxes - drawn.star_fluxes
        assert found[-1].errors[11, 0] == pytest.approx(error[0], rel=1e-9)
        of_psfs = wrong.star_fluxes - seen.star_fluxes
        assert found[-1].of_psfs[11, 0] == pytest.approx(of_psfs[0], rel=1e-9)
    tables = [each.to_table() for each in found]
    assert tables[0]["error_psf"][0] > 0
    ratio = tables[1]["error_psf"][0] / tables[0]["error_psf"][0]
    assert ratio == pytest.approx(2.0, rel=0.01)
    for each, table in zip(found, tables, strict=True):
        np.testing.assert_allclose(table["error"], each.errors.std(axis=0, ddof=1))
        without = each.errors - each.of_psfs
        np.testing.assert_allclose(table["error_noise"], without.std(axis=0, ddof=1))
    assert "error_psf" not in solved().bootstrap(10).to_table().colnames


def test_one_psf_for_all_images_has_one_error():
    made = dataclasses.replace(BASE, n_images=3).make()
    one = made.psfs[0] / made.psfs[0].sum()
    result = lnocl.deconvolve(
        made.observation(psfs=one, psf_scatter=1e-4 * one), made.stars, stop=None, n_iter=2,
        smoothing=0, pad=0, engine="numpy",
    )  # fmt: skip
    drawn = Replicas(result._outcome, 0)._draw_psfs(np.random.SeedSequence(1))
    assert (drawn[0] != one).any()
    np.testing.assert_array_equal(drawn[1:], drawn[:1].repeat(2, axis=0))


def test_regions_that_no_image_has_seen_are_named():
    made = dataclasses.replace(BASE, shape=(64, 64)).make()
    mask = np.zeros((64, 64), bool)
    mask[:, :25] = True
    outcome = lnocl.deconvolve(
        made.observation(mask=mask), [], stop=None, n_iter=3, smoothing=0, pad=0, engine="numpy"
    )._outcome
    parts = [Aperture("dark", 30, 4, np.ones((9, 9))), Aperture("lit", 30, 40, np.ones((9, 9)))]
    found = bootstrap.without_replicas(outcome, parts, 0)
    assert [each.note for each in found.quantities] == [quantities.UNSEEN, ""]


def test_rates_are_called_rates():
    made = BASE.make()
    observation = made.observation(exposure=[2.0, 2.0])
    result = lnocl.deconvolve(
        observation, made.stars, stop=None, n_iter=3, smoothing=0, pad=0, engine="numpy"
    )
    assert result.bootstrap(10).to_table()["unit"].tolist() == ["electron/s"]


# --- What is refused


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n": 9}, r"^bootstrap must be a whole number, 10 or more, such as 50; 9 was"),
        ({"n": 10.0}, "10.0 was given"),
        ({"n": 10, "seed": -1}, "^seed must be a whole number, 0 or more; -1 was given"),
    ],
)
def test_invalid_numbers_of_replicas_and_seeds_are_refused(options, message):
    with pytest.raises(lnocl.InputError, match=message):
        solved().bootstrap(**options)


@pytest.mark.parametrize("level", [0.0, 1.0, 95])
def test_invalid_interval_level_is_refused(level):
    with pytest.raises(lnocl.InputError, match=r"^the level of an interval lies between 0"):
        made_up([1.0, 2.0, 4.0]).interval(level)


@pytest.mark.exhaustive
def test_replicas_of_something_else_are_refused():
    result = solved()
    first = result.bootstrap(10)
    for other in (solved(n_iter=9).bootstrap, result.bootstrap):
        with pytest.raises(lnocl.InputError, match="has replicas of another run, other regions"):
            other(12, earlier=first, seed=0 if other != result.bootstrap else 1)


def test_a_result_gives_the_errors_of_its_regions():
    regions = pytest.importorskip("regions", reason="regions is not installed")
    circle = regions.CirclePixelRegion(regions.PixCoord(15, 15), 5.0)
    found = solved().bootstrap(10, regions=[circle], seed=3)
    assert [each.name for each in found.quantities] == ["star 1 flux", "region 1"]
    assert (found.standard_errors > 0).all()
