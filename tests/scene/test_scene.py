"""The scene on its grid, and every parameter of a run that is refused."""

import warnings

import numpy as np
import pytest
from scenes import Recipe, make_psfs, paper

import lnocl
from lnocl.core.scene.grid import MAX_AXIS
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene

SHAPE = (8, 16)
OBSERVATION = lnocl.Observation(np.full((2, *SHAPE), 5.0), make_psfs(2, (3, 4)))


# --- The grid


@pytest.mark.parametrize(
    ("shape", "pad", "grid"),
    [
        ((1, 1), 0, (2, 2)),
        ((2, 3), 0, (2, 4)),
        ((64, 32), 0, (64, 32)),
        ((64, 32), 1, (80, 48)),
        ((60, 30), 1, (64, 32)),
        ((60, 30), 2, (64, 48)),
        ((120, 120), 0, (128, 128)),
        ((33, 65), 0, (48, 80)),
        ((129, 225), 0, (144, 256)),
        ((100, 100), 60, (224, 224)),
        ((513, 1025), 0, (576, 1152)),
        ((1, MAX_AXIS), 0, (2, MAX_AXIS)),
    ],
)
def test_grid_is_the_least_that_the_transform_takes(shape, pad, grid):
    scene = Scene(lnocl.Observation(np.ones(shape), np.ones((1, 1))), pad=pad)
    assert scene.grid == grid
    assert (scene.weights is None) == (shape == grid)


@pytest.mark.parametrize(
    ("psf_shape", "grid"), [((8, 16), (8, 16)), ((9, 31), (16, 32)), ((33, 99), (16, 32))]
)
@pytest.mark.filterwarnings("ignore:the psf")
def test_grid_holds_psfs_as_far_as_they_reach(psf_shape, grid):
    scene = Scene(lnocl.Observation(np.ones(SHAPE), np.ones(psf_shape)))
    assert scene.grid == grid


@pytest.mark.filterwarnings("ignore:the psf")
def test_a_psf_that_no_grid_holds_refuses_no_image():
    image, psf = np.ones((1, MAX_AXIS - 192)), np.ones((1, MAX_AXIS + 1))
    assert Scene(lnocl.Observation(image, psf)).grid == (2, MAX_AXIS)


def test_images_lie_at_the_origin():
    mask = np.zeros((2, 5, 11), bool)
    mask[1, 2, 3] = True
    images = np.arange(110.0).reshape(2, 5, 11)
    scene = Scene(lnocl.Observation(images, np.ones((1, 1)), background=images, mask=mask))
    laid, weights, background = np.array(list(scene.images())), scene.weights, scene.background()
    np.testing.assert_array_equal(laid[:, :5, :11] * scene.scale, np.where(mask, 0, images))
    np.testing.assert_array_equal(weights[:, :5, :11], ~mask)
    np.testing.assert_array_equal(background[:, :5, :11] * scene.scale, np.where(mask, 0, images))
    for array, beyond in [(laid, 0), (weights, 0), (background, 1)]:
        assert array.shape == (2, 8, 16)
        assert (array[:, 5:] == beyond).all()
        assert (array[:, :, 11:] == beyond).all()


@pytest.mark.parametrize("level", [1e-12, 0.99, 1.0, 3.0, 1e12])
def test_scale_is_a_power_of_two_that_gives_unit_mean(level):
    mask = np.zeros(SHAPE, bool)
    mask[0] = True
    images = np.where(mask, 1e30, level)
    scene = Scene(lnocl.Observation(images, np.ones((1, 1)), mask=mask), penalty=Penalty(0.7))
    assert np.frexp(scene.scale)[0] == 0.5
    assert 0.5 <= next(scene.images())[~mask].mean() < 1
    assert scene.mu == 0.7 * scene.scale


@pytest.mark.parametrize("psf_shape", [(1, 1), (3, 4), (8, 16), (11, 37)])
def test_psf_is_folded_with_its_peak_at_the_origin(psf_shape):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)  # the largest wraps round
        scene = Scene(lnocl.Observation(np.ones(SHAPE), make_psfs(1, psf_shape)), [(14, 1)])
    ny, nx = scene.grid
    at_origin, at_star = np.zeros((2, ny, nx))
    for (y, x), value in np.ndenumerate(scene.observation.psfs[0]):
        dy, dx = y - psf_shape[0] // 2, x - psf_shape[1] // 2
        at_origin[dy % ny, dx % nx] += value
        at_star[(1 + dy) % ny, (14 + dx) % nx] += value
    # Wings that wrap round are summed in another order.
    np.testing.assert_allclose(scene.psf(0), at_origin, rtol=5e-16)
    np.testing.assert_allclose(scene.star_image(0, 0), at_star, rtol=5e-16)


def test_star_weights_are_the_observed_shares():
    mask = np.zeros((2, *SHAPE), bool)
    mask[1, :, 8:] = True  # all that the second image sees of the first star
    stars = [(12, 4), (8, 3), (2, 2)]
    observation = lnocl.Observation(np.ones((2, *SHAPE)), make_psfs(2, (3, 5)), mask=mask)
    scene = Scene(observation, stars)
    expected = [sum(scene.star_image(j, s)[~mask[j]].sum() for j in range(2)) for s in range(3)]
    np.testing.assert_allclose(scene.star_weights, expected, rtol=3e-16)
    np.testing.assert_allclose(scene.star_weights[[0, 2]], [1.0, 2.0], rtol=3e-16)
    assert 1.1 < scene.star_weights[1] < 1.9


def test_psf_larger_than_the_grid_is_announced():
    observation = lnocl.Observation(np.ones(SHAPE), make_psfs(1, (33, 5)))
    with pytest.warns(lnocl.LnoclWarning, match=r"psf \(33, 5\) is larger than the grid") as caught:
        paper(observation, n_iter=1, engine="numpy")
    of_psf, *of_fit = caught
    assert of_psf.filename == __file__
    assert all(each.category is lnocl.errors.MisfitWarning for each in of_fit)
    paper(observation, n_iter=1, engine="numpy", pad=13)  # fits: nothing announced


# --- The start


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe((16, 32), 2, 2),
        Recipe((16, 32), 2, 2, background="map", masked=0.1),
        Recipe((13, 27), 3, 3, background="each", pad=3),
    ],
    ids=["periodic", "mask", "pad"],
)
def test_default_start_is_read_off_the_data(recipe):
    made = recipe.make()
    empty = Scene(made.observation(), made.stars, pad=recipe.pad)
    fluxes = np.array([300.0, 7.0, 90.0])[: recipe.n_stars]
    ny, nx = recipe.shape
    images = np.array(
        [
            20.0 + sum(flux * empty.star_image(j, s) for s, flux in enumerate(fluxes))
            for j in range(recipe.n_images)
        ]
    )[:, :ny, :nx]
    level = np.asarray(made.background)
    images += level[:, None, None] if level.ndim == 1 else level
    scene = Scene(made.observation(images=images), made.stars, pad=recipe.pad)
    extended, star_fluxes = scene.start(None, None)
    np.testing.assert_allclose(extended * scene.scale, np.full(scene.grid, 20.0), rtol=1e-13)
    np.testing.assert_allclose(star_fluxes * scene.scale, fluxes, rtol=1e-13)


@pytest.mark.parametrize("images", [np.zeros(SHAPE), np.full(SHAPE, 3.0)])
def test_default_start_never_is_zero(images):
    observation = lnocl.Observation(images, make_psfs(1, (3, 4)), background=3.0)
    extended, star_fluxes = Scene(observation, [(3, 4)]).start(None, None)
    assert (extended > 0).all()
    assert (star_fluxes > 0).all()


def test_given_start():
    observation = lnocl.Observation(np.full((5, 12), 300.0), make_psfs(1, (3, 4)))
    scene = Scene(observation, [(3, 4), (7, 1)])
    given = np.arange(60.0).reshape(5, 12)
    extended, star_fluxes = scene.start(given, [4.0, 0.0])
    np.testing.assert_array_equal(extended[:5, :12] * scene.scale, given)
    assert (extended[5:] * scene.scale == given.mean()).all()
    assert (extended[:, 12:] * scene.scale == given.mean()).all()
    np.testing.assert_array_equal(star_fluxes * scene.scale, [4.0, 0.0])


@pytest.mark.parametrize("exposure", [None, 2.0], ids=["no exposure", "exposure"])
def test_edge_is_three_times_the_mean_of_the_extended_source(exposure):
    images = np.full((2, 8, 16), 8.0)
    images[:, 3, 4] += 600.0
    observation = lnocl.Observation(images, np.ones((1, 1)), background=2.0, exposure=exposure)
    scene = Scene(observation, [(4, 3)], Penalty(0.0, 0.5))
    np.testing.assert_allclose(scene.edge * scene.unit, 3.0 * 6.0 / (exposure or 1.0))
    # J and electrons at the mean exposure are in one unit, that of the scale.
    assert scene.smoothing == 0.5
    assert Scene(observation, [(4, 3)]).edge == 0.0


def test_weights_near_stars_are_at_the_exposure_of_the_penalty_as_that_of_all_is():
    """A tile that was exposed for less has the same penalty on electrons at the mean of all."""
    observation = lnocl.Observation(np.full((8, 16), 8.0), np.ones((1, 1)), exposure=2.0)
    near = np.linspace(0.0, 0.3, 128).reshape(8, 16)
    scene = Scene(observation, penalty=Penalty(smoothing=0.1, near_stars=near, exposure=5.0))
    np.testing.assert_allclose(scene.smoothing_map, (0.1 + near) * 5.0 / 2.0)


# --- What a run refuses

REFUSED = [
    (
        {"observation": np.ones((2, *SHAPE))},
        "observation is of type ndarray; give an lnocl.Observation, as lnocl.Observation(images, ",
    ),
    ({"observation": np.ones((2, *SHAPE)), "stop": "held-out"}, "observation is of type ndarray"),
    ({"stars": [(3, 4), (-1, 4)]}, "the star at (-1, 4) lies outside"),
    ({"stars": [(16, 4)]}, "the star at (16, 4) lies outside"),
    ({"stars": [(3, -0.75)]}, "the star at (3, -0.75) lies outside"),
    ({"stars": [(4, 8)]}, "x must be in [0, 15] and y in [0, 7]"),
    ({"stars": [(np.nan, 4)]}, "the star at (nan, 4) lies outside"),
    ({"stars": [(4, np.nan)]}, "the star at (4, nan) lies outside"),
    ({"stars": [(np.inf, 4)]}, "the star at (inf, 4) lies outside"),
    (
        {"stars": np.ma.array([(3, 4), (5, 6)], mask=[(0, 0), (1, 1)])},
        "stars has 2 masked values; fill them or leave them out",
    ),
    ({"stars": [(3, 4), np.ma.array((5, 6), mask=(0, 1))]}, "stars has 1 masked value;"),
    ({"mu": 10**400}, "mu must be a number, finite and not negative; 1000"),
    ({"mu": 1e30}, "mu 1e+30 is too large for images of about"),
    ({"smoothing": 1e30}, "smoothing 1e+30 is too large for images of"),
    ({"n_iter": 10**400}, "n_iter must be 16777214 at most; 1000"),
    ({"mu": None, "stop": "held-out"}, "mu must be a number, finite and not negative; None"),
    ({"pad": MAX_AXIS // 2}, "with pad=4096 need a grid of (8200, 8208)"),
    ({"initial_extended": np.ones((8, 15))}, "initial_extended has shape"),
    (
        {"initial_extended": np.ma.array(np.ones(SHAPE), mask=np.eye(*SHAPE))},
        "initial_extended has 8 masked values; fill them or leave them out",
    ),
    (
        {"initial_star_fluxes": [1.0], "stars": [(3, 4), (5, 6)]},
        "initial_star_fluxes has shape (1,); it must have (2,)",
    ),
    (
        {"initial_star_fluxes": np.ma.array([1.0], mask=True), "stars": [(3, 4)]},
        "initial_star_fluxes has 1 masked value;",
    ),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_refused(changes, message):
    with pytest.raises(lnocl.InputError) as caught:
        paper(**({"observation": OBSERVATION, "n_iter": 1, "engine": "numpy"} | changes))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# Parameter: what the message says of values that are none of it, and such values.
WRONG_VALUES = {
    "observation": ("observation is of type {type}; give an", [None, "x", lnocl.Observation]),
    "mu": (
        "mu must be a number, finite and not negative; {value!r} was given",
        [-1e-9, np.nan, np.inf, "0.1", 1j, None],
    ),
    "smoothing": ("smoothing must be a number, finite and not negative; {value}", [-1.0, np.nan]),
    "n_iter": (
        "n_iter must be a whole number, 1 or more; {value} was given",
        [0, -1, 1.5, "5", None],
    ),
    "pad": ("pad must be a whole number, 0 or more, or auto; {value} was given", [-1, 1.5, "1"]),
    "solver": ("solver {value!r} is not known; choose from sgm, sgp", ["cg"]),
    "engine": ("engine {value!r} is not known; choose from opencl, numpy", ["cuda"]),
    "precision": ("precision {value!r} is not known; choose from single, double", ["half"]),
    "stop": (
        "stop {value!r} is not known; give held-out, discrepancy, none, or a number between 0",
        ["never", 0.0, 1.0, np.nan, ("held-out",)],
    ),
    "callback": ("callback must be a function or None; {value} was given", [3]),
    "progress": ("progress must be True or False; {value!r} was given", ["no"]),
    "refine_positions": ("refine_positions must be True, False or auto; {value}", [1]),
    "initial_extended": (
        "initial_extended must be finite",
        [-np.ones(SHAPE), np.full(SHAPE, np.nan), np.full(SHAPE, np.inf)],
    ),
    "initial_star_fluxes": ("initial_star_fluxes must be finite", [[-1.0], [np.nan]]),
}


@pytest.mark.parametrize("name", WRONG_VALUES)
def test_wrong_values_are_refused(name):
    words, values = WRONG_VALUES[name]
    stars = [(3, 4)] if name == "initial_star_fluxes" else []
    for value in values:
        given = {"observation": OBSERVATION, "stars": stars, "n_iter": 1, "engine": "numpy"}
        with pytest.raises(lnocl.InputError) as caught:
            paper(**(given | {name: value}))
        assert words.format(value=value, type=type(value).__name__) in str(caught.value)


KINDS_OF_NOTHING = ["a", 1j, [[1.0, 2.0], [3.0]], np.ones((2, 2, 2))]


@pytest.mark.parametrize("name", ["mu", "n_iter", "pad", "initial_extended", "initial_star_fluxes"])
def test_values_of_another_kind_are_refused(name):
    for value in KINDS_OF_NOTHING:
        with pytest.raises(lnocl.InputError, match=f"^{name}"):
            paper(OBSERVATION, [(3, 4)], **({"n_iter": 1, "engine": "numpy"} | {name: value}))


@pytest.mark.parametrize(
    "stars",
    [
        *([(1, 2, 3)], [(1, 2, 3), (4, 5, 6)], np.ones((2, 3)), [(1,), (2,)], [(1, 2), (3,)]),
        *([1, 2, 3, 4], [("a", "b")], "3,4", [(1j, 2)], np.array([[1j, 2]]), 5),
    ],
)
def test_invalid_stars_are_refused(stars):
    with pytest.raises(lnocl.InputError, match="star"):
        paper(OBSERVATION, stars, n_iter=1, engine="numpy")


def test_image_too_large_for_the_grid_is_refused():
    observation = lnocl.Observation(np.ones((1, MAX_AXIS + 1)), np.ones((1, 1)))
    with pytest.raises(lnocl.InputError, match=r"images of \(1, 8193\) .* largest axis is 8192"):
        paper(observation, n_iter=1, engine="numpy")


def test_star_that_no_image_observed_is_left_out():
    mask = np.zeros((2, *SHAPE), bool)
    mask[:, :5, 8:] = True
    observation = lnocl.Observation(np.ones((2, *SHAPE)), make_psfs(2, (3, 4)), mask=mask)
    with pytest.warns(lnocl.LnoclWarning, match=r"the star at \(11, 2\) lies where all .* masked"):
        result = paper(observation, stars=[(3, 2), (11, 2)], n_iter=1, engine="numpy")
    assert np.isnan(result.star_fluxes).tolist() == [False, True]
    mask[1] = False
    observation = lnocl.Observation(np.ones((2, *SHAPE)), make_psfs(2, (3, 4)), mask=mask)
    paper(observation, stars=[(3, 2), (11, 2)], n_iter=1, engine="numpy")


def hidden_star(case):
    """Return an observation in one image of which alone its star is good, and its flux."""
    flux, sky, (x, y) = 5e4, 3.0, (15, 8)
    p, exposure = (101, 1.0) if case == "one image of many" else (2, np.array([1000.0, 1.0]))
    psf = gaussian(3.0, 9)
    mean = np.full((p, 16, 32), sky)
    mean[:, y - 4 : y + 5, x - 4 : x + 5] += flux * psf / psf.sum()
    mask = np.zeros(mean.shape, bool)
    mask[:-1, y - 4 : y + 5, x - 4 : x + 5] = True
    mean *= np.reshape(exposure, (-1, 1, 1))
    if case == "short exposure, map":
        exposure = exposure[:, None, None] * np.ones((16, 32))
    images = np.where(mask, 0.0, mean)
    return lnocl.Observation(images, psf, mask=mask, exposure=exposure), (x, y), flux


HIDDEN = ["one image of many", "short exposure", "short exposure, map"]


@pytest.mark.parametrize(
    ("engine", "case", "solver"),
    [
        *(("numpy", case, "sgm") for case in HIDDEN),
        ("numpy", "short exposure, map", "sgp"),
        pytest.param("opencl", "one image of many", "sgm", marks=pytest.mark.exhaustive),
        pytest.param("opencl", "short exposure", "sgp", marks=pytest.mark.exhaustive),
    ],
)
def test_star_that_one_image_observed_is_found(engine, case, solver):
    """Each image is judged alone: it once took a hundredth of all exposures together."""
    observation, star, flux = hidden_star(case)
    scene = Scene(observation, [star])
    assert 0 < scene.star_weights[0] < 0.01 * scene.n_images
    result = paper(observation, [star], solver=solver, n_iter=30, engine=engine)
    # Measured 7e-4, the sky below the star.
    np.testing.assert_allclose(result.star_fluxes, [flux], rtol=1.5e-3)


def test_stars_are_moved_to_where_one_image_observed_them():
    observation, (x, y), _ = hidden_star("one image of many")
    scene = Scene(observation, [(x - 10.0, y)], max_shift=10.0)
    scene.move_stars([(x, y)])
    np.testing.assert_array_equal(scene.stars, [(x, y)])


def test_negative_pixels_leave_the_weight_of_a_star_positive():
    """All that the long exposure has of it is a negative pixel, a thousand times heavier."""
    psf = gaussian(3.0, 9)
    psf[0, 0] = -0.05 * psf.sum()
    mask = np.zeros((2, 32, 32), bool)
    mask[0, 4:, 4:] = True
    observation = lnocl.Observation(np.ones((2, 32, 32)), psf, mask=mask, exposure=[1000.0, 1.0])
    scene = Scene(observation, [(7, 7)])
    expected = scene.star_cutout(1, 0).values.sum()
    np.testing.assert_allclose(scene.star_weights, [expected], rtol=1e-14)


@pytest.mark.parametrize(
    "stars", [(), [], np.zeros((0, 2)), [(3, 4)], np.array([[3, 4]]), ((3.0, 4),)]
)
def test_stars_are_any_sequence_of_pairs(stars):
    result = paper(OBSERVATION, stars=stars, n_iter=np.int64(2), engine="numpy")
    assert result.star_fluxes.shape == (len(stars),)
    assert result.device == "numpy"


def gaussian(fwhm, size=15, off=0.0):
    y, x = np.indices((size, size)) - size // 2 - off
    return np.exp(-4 * np.log(2) * (x**2 + y**2) / fwhm**2)


SHARP = "psf 0 is undersampled: shifted by half a pixel it rings by"


@pytest.mark.parametrize(
    ("fwhm", "off", "given", "warned"),
    [
        (1.5, 0.5, {"stars": [(20, 21.5)]}, SHARP),
        (1.5, 0.5, {"stars": [(20, 21)], "max_shift": 3.0}, SHARP),
        (1.5, 0.5, {"stars": [(20, 21)]}, None),
        (1.5, 0.5, {}, None),
        (1.5, 0.5, {"max_shift": 3.0}, None),
        (2.5, 0.5, {"stars": [(20, 21.5)]}, None),
        (0.8, 0.0, {"stars": [(20, 21.5)]}, None),
    ],
)
def test_psf_that_rings_between_pixels_is_warned_of(fwhm, off, given, warned):
    """Its centre is between pixels; on a pixel it would not ring."""
    observation = lnocl.Observation(np.ones((48, 48)), gaussian(fwhm, off=off))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Scene(observation, **given)
    assert [str(w.message).startswith(str(warned)) for w in caught] == [True] * (warned is not None)


def test_warning_states_the_ringing_of_a_shifted_star():
    observation = lnocl.Observation(np.ones((48, 48)), gaussian(1.5, off=0.5))
    with pytest.warns(lnocl.LnoclWarning, match="it rings by 4.7% of its peak"):
        scene = Scene(observation, [(20.5, 21.5)])
    darkest = -scene.star_image(0, 0).min() / observation.psfs.max()
    assert 0.0465 < darkest < 0.0475


@pytest.mark.parametrize(
    ("shape", "offsets", "pad", "warned"),
    [
        ((32, 32), [(0, 0), (2.25, 0)], 0, True),
        ((32, 32), [(0, 0), (0, -3)], 0, True),
        ((32, 32), [(0, 0), (0, 0)], 0, False),
        ((32, 32), [(0, 0), (2.25, 0)], 3, False),
        ((32, 30), [(0, 0), (2, 0)], 0, False),
        ((30, 32), [(0, 0), (2, 0)], 0, True),
    ],
)
def test_offsets_that_wrap_round_are_warned_of(shape, offsets, pad, warned):
    observation = lnocl.Observation(np.ones((2, *shape)), gaussian(3), offsets=offsets)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Scene(observation, pad=pad)
    expected = [f"by up to {int(np.ceil(np.abs(offsets).max()))} pixels"] if warned else []
    assert len(caught) == len(expected)
    assert all(words in str(w.message) for w, words in zip(caught, expected, strict=True))


def test_an_image_that_is_all_masked_says_nothing_of_stars():
    mask = np.zeros((2, 8, 8), bool)
    mask[0] = True
    images = np.stack([np.full((8, 8), 1e9), np.full((8, 8), 5.0)])
    both = lnocl.Observation(images, np.ones((3, 3)), mask=mask)
    one = lnocl.Observation(images[1:], np.ones((3, 3)))
    found, expected = (
        paper(observation, stars=[(3, 3)], n_iter=5, engine="numpy") for observation in (both, one)
    )
    assert np.allclose(found.star_fluxes, expected.star_fluxes, rtol=1e-10)


@pytest.mark.parametrize("factor", [1e3, 1e7, 1e12, 1e200])
@pytest.mark.parametrize("known", [{}, {"exposure": [0.5, 20.0]}, {"background": 7.0}])
def test_a_start_in_another_unit_is_made_as_bright_as_the_images(factor, known):
    shape = 1.0 + (np.indices((32, 32))[1] > 16)
    observation = lnocl.Observation(np.full((2, 32, 32), 9.0), np.ones((3, 3)), **known)
    flat = Scene(observation)
    level = flat.start(None, None)[0].mean()
    with pytest.warns(
        lnocl.LnoclWarning, match="times the light of the images, as in another unit"
    ):
        extended, _ = Scene(observation).start(factor * shape, None)
    np.testing.assert_allclose(extended, level * shape / shape.mean(), rtol=1e-12)


@pytest.mark.parametrize("factor", [1e-12, 1.0, 2.9])
def test_a_start_that_is_no_brighter_than_the_images_stays(factor):
    observation = lnocl.Observation(np.full((32, 32), 9.0), np.ones((3, 3)), background=4.0)
    scene = Scene(observation)
    extended, _ = scene.start(np.full((32, 32), 5.0 * factor), None)
    np.testing.assert_allclose(extended * scene.unit, 5.0 * factor, rtol=1e-12)
