"""Whatever is given to the Python interface: a right answer, or one of lnocl's own errors."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import paper

import lnocl

ODD = [np.nan, np.inf, -np.inf, -3.0, 0.0, 1e300, -1e300, 1e-300, 5e-324, 1e40, 1e155, 2.5]
WORDS = [
    *(None, "auto", "", "nan", True, 1j, [], {}, object(), -1, 10**400, [[1.0], [2.0, 3.0]]),
    *(np.ones((2, 2, 2, 2)), np.array("x"), np.array(["1", "2"]), np.zeros((0, 3))),
    *(np.array([1, 2], "datetime64[D]"), np.zeros(3, [("a", float)]), np.array([None, 1])),
    *(3.0 * u.s, [1.0, 2.0] * u.m, [2.0] * u.electron / u.s, [(np.nan, 1.0)], [(10**400, 2)]),
    *(np.ma.masked, np.ma.masked_all((1, 3, 3)), float, lambda: 3, b"abc", range(3), {1.0}),
]


def odd_arrays(shape, rng, values):
    """Return an array of small counts with some odd values in it."""
    array = rng.poisson(5.0, shape).astype(float)
    for value in values:
        array[tuple(rng.integers(0, n) for n in shape)] = value
    return array


def doubled(array):
    wide = np.zeros((*array.shape[:-1], 2 * array.shape[-1]), array.dtype)
    wide[..., ::2] = array
    return wide[..., ::2]


def locked(array):
    array = array.copy()
    array.flags.writeable = False
    return array


# The same numbers in other forms: small whole numbers go through all of them unchanged.
FORMS = {
    "big-endian": lambda array: array.astype(">f8"),
    "float32": lambda array: array.astype(np.float32),
    "big-endian single": lambda array: array.astype(">f4"),
    "longdouble": lambda array: array.astype(np.longdouble),
    "half": lambda array: array.astype(np.float16),
    "uint8": lambda array: array.astype(np.uint8),
    "big-endian int": lambda array: array.astype(">i2"),
    "int64": lambda array: array.astype(np.int64),
    "list": lambda array: array.tolist(),
    "Fortran": np.asfortranarray,
    "strided": doubled,
    "reversed": lambda array: array[..., ::-1].copy()[..., ::-1],
    "transposed": lambda array: array.T.copy().T,
    "read-only": locked,
    "masked array": np.ma.masked_array,
    "matrix stack": lambda array: list(array),
    "electrons": lambda array: array * u.electron,
}
form = st.sampled_from(sorted(FORMS))
repeated = settings(derandomize=True, database=None)


def deconvolve(observation, **keywords):
    """Deconvolve; warnings other than lnocl's own are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        return paper(lnocl.Observation(**observation, psf_centre="given"), **keywords)


def check(result):
    assert result.extended.dtype == np.float64
    shown = result._outcome.scene.is_shown[: len(result.star_fluxes)]
    assert np.isnan(result.star_fluxes[~shown]).all()
    for values in (result.extended, result.star_fluxes[shown]):
        assert np.isfinite(values).all()
        assert (values >= 0).all()
    assert np.isfinite(result.history["objective"]).all()
    assert result.stop_reason != "not finite"


@st.composite
def anything(draw):
    """Return the arguments of an observation and of a run, of which some are no good."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    p, ny, nx = draw(st.integers(1, 3)), draw(st.integers(1, 11)), draw(st.integers(1, 11))
    few = st.lists(st.sampled_from(ODD), max_size=2)
    none = st.just([])
    odd = draw(st.sampled_from([none, none, few]))  # most have to come through the door
    shape = (p, ny, nx)
    psf_shape = (draw(st.sampled_from([1, p])), draw(st.integers(1, 13)), draw(st.integers(1, 13)))
    values = {
        "images": odd_arrays(shape, rng, draw(few)),
        "psfs": odd_arrays(psf_shape, rng, draw(odd)) + 0.1,
        "background": odd_arrays(shape, rng, draw(odd)),
        "read_noise": odd_arrays((p,), rng, draw(odd)),
        "exposure": odd_arrays(shape, rng, draw(odd)) + 0.5,
        "mask": rng.random(shape) < 0.2,
        "offsets": rng.uniform(-0.6, 0.6, (p, 2)) * min(ny, nx) / 2,
    }
    observation = {
        name: values[name] for name in values if name in ("images", "psfs") or draw(st.booleans())
    }
    n_stars = draw(st.integers(0, 2))
    stars = [tuple(rng.uniform(-0.5, (nx - 0.5, ny - 0.5))) for _ in range(n_stars)]
    keywords = {
        "stars": stars,
        "mu": draw(st.sampled_from([0.0, 0.0, 1e-3, 1.0, *draw(odd)])),
        "smoothing": draw(st.sampled_from([0.0, 0.0, 1e-2, *draw(odd)])),
        "solver": draw(st.sampled_from(["sgm", "sgp"])),
        "pad": draw(st.sampled_from([0, 1, 3, "auto", "auto"])),
        "n_iter": draw(st.integers(1, 4)),
        "stop": draw(st.sampled_from([None, None, 0.5, "discrepancy"])),
        "precision": "double",
        "device": None,
        "refine_positions": False,
        "resume": None,
    }
    if draw(st.booleans()):
        keywords["initial_extended"] = odd_arrays((ny, nx), rng, draw(odd))
    if draw(st.booleans()):
        keywords["initial_star_fluxes"] = odd_arrays((n_stars,), rng, [])
    if draw(st.booleans()):  # one argument that is something else altogether
        both = draw(st.sampled_from([observation, keywords]))
        name = draw(st.sampled_from(sorted(both)))
        both[name] = draw(st.sampled_from([*WORDS, *ODD]))
    return observation, keywords


def answers(case, **engine):
    observation, keywords = case
    try:
        result = deconvolve(observation, **keywords, **engine)
    except lnocl.LnoclError as error:
        refusal = str(error)
    else:
        check(result)
        return
    assert "\n" not in refusal
    assert len(refusal) > 10


@repeated
@given(anything())
def test_anything_is_answered_or_refused(case):
    answers(case, engine="numpy")


@pytest.mark.exhaustive
@settings(repeated, max_examples=2000)
@given(anything())
def test_anything_is_answered_or_refused_more(case):
    answers(case, engine="numpy")


@repeated
@given(form, form, st.integers(0, 99), st.sampled_from([(8, 8), (3, 5), (1, 6)]))
def test_forms_of_the_same_numbers_give_the_same(images, psfs, seed, shape):
    rng = np.random.default_rng(seed)
    counts, psf = rng.integers(0, 200, (2, *shape)) * 1.0, rng.integers(1, 9, (2, 3, 3)) * 1.0
    start, fluxes = rng.integers(1, 9, shape) * 1.0, rng.integers(1, 9, 1) * 1.0
    plain = {"images": counts, "psfs": psf, "background": np.ones((2, *shape))}
    # PSFs have no unit.
    psfs = "strided" if psfs == "electrons" else psfs
    other = {"images": FORMS[images](counts), "psfs": FORMS[psfs](psf)}
    other["background"] = FORMS[images](plain["background"])
    keywords = {"stars": [(0, 0)], "n_iter": 3, "engine": "numpy"}
    expected = deconvolve(plain, **keywords, initial_extended=start, initial_star_fluxes=fluxes)
    found = deconvolve(
        other,
        **keywords,
        initial_extended=FORMS[psfs](start),
        initial_star_fluxes=FORMS[psfs](fluxes),
    )
    assert np.array_equal(found.extended, expected.extended)
    assert np.array_equal(found.star_fluxes, expected.star_fluxes)
    assert np.array_equal(found.history, expected.history)


@pytest.mark.parametrize(
    "precision", ["single", pytest.param("double", marks=pytest.mark.exhaustive)]
)
@repeated
@given(form, st.integers(0, 99), st.lists(st.sampled_from(ODD), max_size=3))
def test_opencl_answers_or_refuses_as_the_reference_does(precision, form, seed, values):
    """Of one shape, so that all have the program of tests of other files."""
    rng = np.random.default_rng(seed)
    images = rng.integers(1, 200, (2, 16, 32)) * 1.0
    given = FORMS[form](images)
    if form in ("strided", "Fortran", "masked array"):
        for value in values:
            given[0, int(rng.integers(16)), int(rng.integers(16))] = value
    # Always masked, and so always the same program.
    mask = np.zeros((16, 32), bool)
    mask[3, 4] = True
    observation = {"images": given, "psfs": np.ones((3, 3)), "background": 1.0, "mask": mask}
    case = observation, {"stars": [(5, 6), (20, 3)], "n_iter": 3, "mu": 1e-6}
    answers(case, engine="opencl", precision=precision)
    if not values:
        plain = {**observation, "images": images}
        found, expected = (
            deconvolve(o, **case[1], engine="opencl", precision=precision)
            for o in (observation, plain)
        )
        assert np.array_equal(found.extended, expected.extended)
