"""The public function: how it is called, and what it returns."""

import numpy as np
import pytest
from astropy import units as u
from scenes import paper, same

import lnocl
from lnocl.core.scene.padding import recommend_pad
from lnocl.core.scene.penalty import recommend_smoothing

OBSERVATION = lnocl.Observation(np.full((8, 8), 5.0), np.ones((1, 1)), background=1.0)


def deconvolve(**given):
    return paper(OBSERVATION, **({"n_iter": 3, "engine": "numpy"} | given))


def test_all_but_the_observation_and_the_stars_go_by_name():
    with pytest.raises(TypeError, match="from 1 to 2 positional arguments but 3 were given"):
        lnocl.deconvolve(OBSERVATION, [(3, 3)], 0.1)


def test_results_are_compared_by_identity():
    first, second = deconvolve(), deconvolve()
    assert first == first
    assert first != second
    assert len({first, second}) == 2


@pytest.mark.parametrize("exposure", [1.0, 4.0])
@pytest.mark.parametrize("refine_positions", [False, True])
def test_the_table_of_stars(exposure, refine_positions):
    image, stars = np.full((8, 8), 5.0), [(3, 4), (6, 1)]
    image[[4, 1], [3, 6]] = 500.0
    observation = lnocl.Observation(image, np.ones((1, 1)), exposure=exposure)
    options = {"n_iter": 3, "engine": "numpy", "refine_positions": refine_positions}
    result = paper(observation, stars=stars, **options)
    table = result.to_table()
    errors = ["x_error", "y_error"] if refine_positions else []
    assert table.colnames == ["x", "y", "flux", *errors, "flux_error"]
    unit = u.electron if exposure == 1.0 else u.electron / u.s
    np.testing.assert_array_equal(table["flux"].to_value(unit), result.star_fluxes)
    again = paper(observation, stars=table["x", "y"], n_iter=1, engine="numpy")
    np.testing.assert_array_equal(again.star_positions, result.star_positions)
    if refine_positions:
        found = np.array([table[name].to_value("pix") for name in errors]).T
        np.testing.assert_array_equal(found, result.star_position_errors)
    np.testing.assert_array_equal(table["flux_error"].to_value(unit), result.star_flux_errors)


def test_no_stars_are_an_empty_table():
    assert len(deconvolve().to_table()) == 0


DARK_STARTS = {
    "extended source": (
        {"initial_extended": np.zeros((8, 8))},
        ("sgm", "sgp"),
        "initial_extended is 0 everywhere",
    ),
    "star": ({"initial_star_fluxes": [2.0, 0.0]}, ("sgm",), "initial_star_fluxes holds 1 of 0"),
}


@pytest.mark.parametrize("start", DARK_STARTS)
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_starts_that_no_iteration_leaves_are_refused(start, solver):
    given, refused_by, message = DARK_STARTS[start]
    given = {"stars": [(2, 2), (5, 5)], "solver": solver, **given}
    if solver in refused_by:
        with pytest.raises(lnocl.InputError, match=message):
            deconvolve(**given)
    else:
        assert (deconvolve(**given).star_fluxes > 0).all()


def test_an_extended_source_may_start_at_0_in_places():
    start = np.ones((8, 8))
    start[2, 3] = 0.0
    extended = deconvolve(initial_extended=start).extended
    np.testing.assert_array_equal(extended == 0, start == 0)


@pytest.mark.parametrize("name", ["initial_extended", "initial_star_fluxes"])
def test_units_of_a_start(name):
    numbers = {"initial_extended": np.eye(8), "initial_star_fluxes": np.array([2.0])}[name]
    exposed = lnocl.Observation(np.full((8, 8), 5.0), np.ones((1, 1)), exposure=4.0)

    def begin(start, observation=OBSERVATION):
        options = {"stars": [(3, 4)], "n_iter": 1, "engine": "numpy", name: start}
        return paper(observation, **options).extended

    for unit, electrons in ((u.electron, 1), (u.ct, 1), (u.Unit(2 * u.photon), 2)):
        np.testing.assert_array_equal(begin(numbers * unit), begin(numbers * electrons))
    np.testing.assert_array_equal(begin(numbers * u.ct / u.s, exposed), begin(numbers, exposed))
    for unit, message in {
        u.km: f"^{name} must be counts.*, not km; give electrons",
        u.adu: f"^{name} must be counts.*, not adu; multiply by the gain",
        u.ct / u.s: f"^{name} in ct / s are counts per time; give electrons",
    }.items():
        with pytest.raises(lnocl.InputError, match=message):
            begin(numbers * unit)


ARRAYS = {"extended", "star_fluxes", "star_positions", "history", "held_out", "halo_fluxes"}


def test_arrays_of_a_result_are_read_only():
    result = deconvolve(stars=[(3, 4)])
    arrays = {name: each for name, each in vars(result).items() if isinstance(each, np.ndarray)}
    assert set(arrays) == ARRAYS
    errors = result.star_flux_errors, result.star_position_errors
    for array in (*arrays.values(), *errors):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = array


def test_models_are_those_of_the_images_that_were_given():
    images, stars = np.random.default_rng(2).poisson(9.0, (8, 8)).astype(float), [[3.0, 4.0]]
    observation = lnocl.Observation(images, np.ones((1, 1)), background=1.0)
    result = paper(observation, stars, n_iter=3, engine="numpy")
    models, residuals = result.models(), result.residuals()
    images += 100.0
    stars[0][0] = 6.0
    with pytest.raises(AttributeError, match=r"replace\(images=...\) returns another"):
        observation.images = images
    np.testing.assert_array_equal(result.models(), models)
    np.testing.assert_array_equal(result.residuals(), residuals)


def test_stars_may_be_any_iterable(tmp_path):
    observation = lnocl.Observation(np.full((8, 8), 5.0), np.ones((3, 3)))
    given = {"n_iter": 2, "engine": "numpy"}
    expected = paper(observation, [(4, 4), (2, 6)], **given)
    saved = {"checkpoint": str(tmp_path / "run.fits")}
    found = paper(observation, (star for star in [(4, 4), (2, 6)]), **given, **saved)
    np.testing.assert_array_equal(found.star_fluxes, expected.star_fluxes)
    assert len({found, expected}) == 2  # compared by identity


def test_an_array_that_cannot_be_made_is_named():
    class Failing:
        def __array__(self, *_, **__):
            raise RuntimeError("the file\nis gone")

    with pytest.raises(lnocl.InputError) as caught:
        lnocl.Observation(Failing(), np.ones((3, 3)))
    assert str(caught.value) == (
        "images cannot be read as an array: RuntimeError: the file is gone"
    )


def test_defaults_are_those_that_are_recommended():
    """What is not given is chosen: solver, rule, smoothing, pad."""
    rng = np.random.default_rng(4)
    y, x = np.indices((32, 32)) - 16
    psf = np.exp(-(x**2 + y**2) / 6.0)
    observation = lnocl.Observation(rng.poisson(30.0 + 900.0 * psf), psf, background=20.0)
    found = lnocl.deconvolve(observation, [(16, 16)], engine="numpy")
    assert found.stop_reason == "held-out"
    expected = lnocl.deconvolve(
        observation,
        [(16, 16)],
        mu=0.0,
        smoothing="auto",
        solver="sgp",
        n_iter=1000,
        stop="held-out",
        pad=recommend_pad(observation),  # the sky is brighter than the background
        engine="numpy",
    )
    same(found, expected)
    tried = recommend_smoothing(observation) * np.array([0.0, 1.0, 3.0, 10.0])
    assert found.smoothing in tried
