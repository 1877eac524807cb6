"""Images that are turned against the sky: both engines against an explicit matrix and each other.

The matrix holds Gaussians, evaluated where a pixel of an image sees each pixel of the sky; it knows
nothing of shears.
"""

import functools

import numpy as np
import pytest
import turned_scenes as scenes_turned
from scenes import FEWER_ENGINES, NUMPY_FIRST, make_psfs, named, paper, same, worst
from scipy.ndimage import gaussian_filter
from turned_scenes import ANGLES, FLUXES, GRID, NX, NY, STARS, observation, psfs

import lnocl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.opencl.tuning import Tuning
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model, model_images
from lnocl.core.scene.padding import recommend_pad
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.stars import MAX_SHIFT
from lnocl.core.scene.view import View, Window
from lnocl.core.solvers.marginal import marginal
from lnocl.core.solvers.near_star import NearStar, Surroundings
from lnocl.core.solvers.positions import StarFit, Stars

START = {"initial_extended": np.full((NY, NX), 8.0), "initial_star_fluxes": FLUXES / 2}

# PSFs are cut off at their edges.
pytestmark = pytest.mark.filterwarnings("ignore:psf . is undersampled")


MAPS = {"turned": None, "scaled": scenes_turned.scaled()}


@pytest.fixture(scope="module", params=MAPS)
def maps(request):
    return MAPS[request.param]


@pytest.fixture(scope="module")
def scene(maps):
    return Scene(observation(maps), STARS)


@pytest.mark.exhaustive
def test_the_grid_holds_all_that_is_turned(scene, maps):
    assert scene.grid == GRID
    assert scene.observation.sky_shape == (NY, NX)
    scales = [rotation.scale for rotation in scene.rotations]
    assert scales == pytest.approx([1.0, 1.0, 1.0 if maps is None else 1.7])


@pytest.mark.exhaustive
def test_model_is_that_of_the_matrix(scene, maps):
    """The shears and the PSF's edges leave 2e-4 of the brightest pixel."""
    extended = scenes_turned.sky()
    model = Model(scene)
    found = model.forward(extended)[:, :NY, :NX]
    good = ~scene.observation.mask
    expected = scenes_turned.matrix(scene.observation.transforms) @ extended.ravel()
    assert worst(found[good], expected.reshape(3, NY, NX)[good]) <= 3e-4
    images = list(model_images(scene, extended / scene.unit, FLUXES / scene.unit))
    counts = np.array([scene.in_electrons(image, j)[:NY, :NX] for j, image in enumerate(images)])
    assert worst(counts[good], scenes_turned.means(maps=maps)[good]) <= 3e-4


@pytest.mark.parametrize("scale", [1.0, 1.6])
@pytest.mark.parametrize(("n", "degrees"), [(60, -33.0), (70, 20.0), (106, 45.0)])
def test_corners_are_on_one_side_of_the_period(n, degrees, scale):
    """What the corners of an image see of the sky is where the shears leave it."""
    middle = (n - 1) / 2.0
    maps = lnocl.rotations([0.0, degrees], (middle, middle))
    maps[1] = np.column_stack([maps[1, :, :2] / scale, maps[1, :, 2] + (-5.1, -9.2)])
    psf = scenes_turned.gaussian(*(np.indices((15, 15)) - 7), scenes_turned.COVARIANCES[0])
    scene = Scene(lnocl.Observation(np.ones((2, n, n)), [psf, psf], transforms=maps))
    ends = (0.0, middle, n - 1.0)
    seen = np.array([(x, y) for x in ends for y in ends]) - maps[1, :, 2]
    places = np.round(np.linalg.solve(maps[1, :, :2], seen.T).T).astype(int)
    sky = np.zeros(scene.grid)
    np.add.at(sky, tuple((places % scene.grid[::-1]).T[::-1]), 1.0)
    y, x = np.indices((n, n))
    expected = 0.0
    for u, v in places @ maps[1, :, :2].T + maps[1, :, 2]:
        expected = expected + scenes_turned.gaussian(y - v, x - u, scenes_turned.COVARIANCES[0])
    found = Model(scene).forward(sky)[1, :n, :n]
    assert worst(found, expected) <= 1e-3


def test_model_and_its_adjoint(scene):
    rng = np.random.default_rng(3)
    model = Model(scene)
    sky, images = rng.normal(size=GRID), rng.normal(size=model.shape)
    one, other = (model.forward(sky) * images).sum(), (sky * model.adjoint(images)).sum()
    size = np.linalg.norm(model.forward(sky)) * np.linalg.norm(images)
    assert abs(one - other) <= 1e-14 * size


def split_gradient(given, n_iter, maps=None, step=1):
    """Return extended source and star fluxes of the paper's iteration on the matrix.

    The images may have every second pixel alone, and `maps` those of all.
    """
    maps = given.transforms if maps is None else maps
    matrix = np.hstack([scenes_turned.matrix(maps), scenes_turned.star_columns(maps)])
    matrix = step**2 * matrix.reshape(3, NY, NX, -1)[:, ::step, ::step]
    matrix = matrix.reshape(given.images.size, -1)
    weights, images = (~given.mask).ravel().astype(float), given.images.ravel()
    background = np.tile(scenes_turned.background()[::step, ::step].ravel(), 3)
    start = np.full(GRID, 8.0)
    total = matrix.T @ weights
    is_observed = total[:-2] >= 0.01 * total[:-2].max()
    x = np.append(np.where(is_observed, start.ravel(), 0.0), FLUXES / 2)
    total[:-2][~is_observed] = np.inf
    for _ in range(n_iter):
        x *= matrix.T @ (weights * images / (matrix @ x + background)) / total
    return x[:-2].reshape(GRID)[:NY, :NX], x[-2:]


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_iterations_are_those_of_the_matrix(engine, maps):
    """The shears' error grows where an estimate is sharpened: 3e-4 becomes 1e-3 in 30."""
    given = observation(maps)
    result = paper(given, STARS, n_iter=30, **START, **engine)
    extended, fluxes = split_gradient(given, 30)
    assert worst(result.extended, extended) <= 3e-3
    assert worst(result.star_fluxes, fluxes) <= 4e-4  # measured 1.4e-4


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_iterations_of_a_finer_sky_are_those_of_the_matrix(engine, maps):
    """Images have every second pixel of those before, along each axis."""
    given = scenes_turned.finer_observation(maps)
    assert Scene(given).grid == GRID
    stars = (STARS - 0.5) / 2
    result = paper(given, stars, n_iter=30, **START, **engine)
    before = scenes_turned.transforms() if maps is None else maps
    extended, fluxes = split_gradient(given, 30, before, 2)
    assert worst(result.extended, extended) <= 3e-3
    assert worst(result.star_fluxes, fluxes) <= 4e-4


@functools.cache
def reference(solver, name):
    return paper(observation(MAPS[name]), STARS, solver=solver, n_iter=30, **START, engine="numpy")


# About three times what was measured; steps of the second method are longer.
@pytest.mark.parametrize(
    ("solver", "precision", "allowed"),
    [
        ("sgm", "single", 3e-6),
        ("sgp", "single", 2e-4),
        pytest.param("sgm", "double", 3e-14, marks=pytest.mark.exhaustive),
        pytest.param("sgp", "double", 1e-12, marks=pytest.mark.exhaustive),
    ],
)
@pytest.mark.parametrize("name", named({name: name for name in MAPS}, "turned"))
def test_engines_agree(name, solver, precision, allowed):
    given = observation(MAPS[name])
    found = paper(given, STARS, solver=solver, n_iter=30, **START, precision=precision)
    expected = reference(solver, name)
    assert worst(found.extended, expected.extended) <= allowed
    assert worst(found.star_fluxes, expected.star_fluxes) <= allowed
    assert worst(found.history["objective"], expected.history["objective"]) <= allowed


@pytest.mark.exhaustive
def test_images_that_are_launched_together(maps):
    """A GPU has one launch for all images that are turned; those of larger pixels have their own.

    The program is that of the case "turned, group" of tests/kernel_cases.py.
    """
    found = []
    for tuning in (None, Tuning(1, 8, group=4)):
        scene = Scene(observation(maps), STARS)
        engine = OpenCLEngine(scene, "single", None, 20, tuning)
        engine.start(*scene.start(None, None))
        engine.go_on(9, 0.0)
        engine.finish()
        found.append(engine)
    assert engine.look().done == 8
    assert worst(found[1].extended(), found[0].extended()) <= 3e-6
    assert worst(found[1].objectives(), found[0].objectives()) <= 3e-6


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_engines_agree_where_stars_move(engine, maps):
    moved = {"refine_positions": True, "solver": "sgp", "stop": None, "n_iter": 40, "pad": 0}
    fluxes = 30.0 * FLUXES
    means = scenes_turned.means(fluxes, maps)
    seen = observation(maps, images=np.random.default_rng(5).poisson(means).astype(float))
    found = lnocl.deconvolve(seen, np.add(STARS, (0.4, -0.3)), smoothing=0.0, **moved, **engine)
    assert abs(found.star_positions - STARS).max() <= 0.05
    assert worst(found.star_fluxes, fluxes) <= 0.02


@pytest.mark.parametrize("engine", NUMPY_FIRST)
@pytest.mark.parametrize("is_flipped", [False, True])
def test_quarter_turns_are_those_by_index(engine, is_flipped):
    """Images turned by 0, 90, 180 and 270 degrees give what those not turned give, bit for bit."""
    rng = np.random.default_rng(4)
    images = rng.poisson(30.0, (4, 16, 16)).astype(float)
    kernels = np.round(512.0 * make_psfs(4, (7, 7)))  # whose sums are exact in any order
    mask = rng.random((4, 16, 16)) < 0.05
    stars, background = [(6.3, 9.0)], 4.0 + rng.random((4, 16, 16))
    still = paper(
        lnocl.Observation(images, kernels, mask=mask, background=background, psf_centre="given"),
        stars,
        n_iter=8,
        **engine,
    )
    maps = lnocl.rotations([0.0, 90.0, 180.0, 270.0], (7.5, 7.5))

    def turned(arrays):
        # From x towards y is from a row's end towards a column's: the other way round for rot90.
        by_index = [np.rot90(array, -j) for j, array in enumerate(arrays)]
        return np.array([each[:, ::-1] for each in by_index] if is_flipped else by_index)

    if is_flipped:
        maps[:, 0] = [0.0, 0.0, 15.0] - maps[:, 0]
    given = lnocl.Observation(
        turned(images),
        turned(kernels),
        mask=turned(mask),
        background=turned(background),
        psf_centre="given",
        transforms=maps,
    )
    found = paper(given, stars, n_iter=8, **engine)
    same(found, still)
    np.testing.assert_array_equal(found.models(), turned(still.models()))
    np.testing.assert_array_equal(found.residuals(), turned(still.residuals()))
    np.testing.assert_array_equal(found.psfs, turned(still.psfs))


@pytest.mark.exhaustive
def test_images_of_any_order():
    order = [2, 0, 1]
    given = observation()
    swapped = observation(
        images=given.images[order],
        psfs=given.psfs[order],
        mask=given.mask[order],
        transforms=scenes_turned.transforms()[order],
    )
    one, other = (paper(each, STARS, n_iter=10, engine="numpy") for each in (given, swapped))
    assert worst(one.extended, other.extended) <= 1e-12


def test_turns_beyond_45_degrees():
    """An image turned by 100 degrees more, about its own middle, and its map turned with it."""
    turn = lnocl.core.scene.transforms.rotation(np.radians(100.0))
    maps = scenes_turned.transforms()
    middle = scenes_turned.CENTRE
    maps[:, :, 2] = (maps[:, :, 2] - middle) @ turn.T + middle
    maps[:, :, :2] = turn @ maps[:, :, :2]
    n = 40
    y, x = np.indices((n, n))
    blob = np.array([18.0, 8.0])
    images = []
    for each in maps:
        at = each[:, :2] @ blob + each[:, 2] + (0, 9)
        images.append(5.0 + 4000.0 * scenes_turned.gaussian(x - at[0], y - at[1], np.eye(2) * 8))
    maps[:, :, 2] += (0, 9)
    psf = scenes_turned.gaussian(*(np.indices((15, 15)) - 7), np.eye(2) * 2)
    given = lnocl.Observation(np.array(images), psf, background=5.0, transforms=maps)
    result = lnocl.deconvolve(given, smoothing=0.0, stop=None, n_iter=50, engine="numpy")
    rows, columns = np.indices(result.extended.shape)
    light = result.extended / result.extended.sum()
    assert (light * columns).sum() == pytest.approx(blob[0], abs=0.02)
    assert (light * rows).sum() == pytest.approx(blob[1], abs=0.02)
    assert abs(result.residuals()).max() <= 0.2  # in the images' own orientation


@pytest.mark.exhaustive
def test_derivatives_of_stars_are_along_the_skys_axes():
    scene = Scene(observation(), STARS, max_shift=MAX_SHIFT)
    model = Model(scene)
    extended = scenes_turned.sky() / scene.unit
    fit = StarFit(scene, model, extended, scene.stars)
    stars = Stars(FLUXES / scene.unit, np.add(STARS, (0.3, -0.2)))
    gradient = fit._gradient(fit._try(stars))
    step = 1e-4
    for index in range(2, 6):
        axis, s = divmod(index - 2, 2)
        changes = []
        for sign in (1, -1):
            positions = stars.positions.copy()
            positions[s, axis] += sign * step
            changes.append(fit.objective(Stars(stars.fluxes, positions)))
        assert gradient[index] == pytest.approx((changes[0] - changes[1]) / (2 * step), rel=1e-5)


def test_errors_of_stars_are_those_of_images_that_are_not_turned():
    """Round PSFs on a flat sky know no direction, and a map of it moves no information."""
    psf = scenes_turned.gaussian(*(np.indices((15, 15)) - 7), np.eye(2) * 2.2)
    n, star = 64, np.array([31.5, 31.5])
    y, x = np.indices((n, n))
    image = 20.0 + 3000.0 * scenes_turned.gaussian(x - star[0], y - star[1], np.eye(2) * 2.2)
    errors = []
    for angles in ([0.0, 0.0], [20.0, -35.0]):
        given = lnocl.Observation(
            np.array([image, image]), psf, background=5.0, transforms=lnocl.rotations(angles, star)
        )
        scene = Scene(given, [star])
        around = Surroundings(Estimate(scene, np.full(scene.grid, 15.0), np.array([3000.0])), True)
        near = NearStar(around, 0, 1e-6)
        errors.append(np.sqrt(np.diag(near.fit.information)))
    assert worst(errors[0], errors[1]) <= 0.02


def coarse_and_fine(n, side, scale, degrees, is_flipped=False, half=9):
    """Return an image of the sky's pixels and one of larger ones, about one middle."""
    turn = lnocl.rotations([degrees], (0, 0))[0, :, :2] / scale
    turn = turn @ np.diag([-1.0, 1.0]) if is_flipped else turn
    middle = np.full(2, (n - 1) / 2)
    maps = np.array([np.eye(2, 3), np.column_stack([turn, (side - 1) / 2 - turn @ middle])])
    psf = scenes_turned.gaussian(*(np.indices((2 * half + 1,) * 2) - half), 1.6 * np.eye(2))
    images = [np.full((n, n), 9.0), np.full((side, side), 9.0 * scale**2)]
    return lnocl.Observation(images, [psf, psf], transforms=maps)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_windows_over_an_edge(scale):
    """A turned image is no period: a window that begins before it sees what lies there."""
    scene = Scene(coarse_and_fine(60, round(60 / scale), scale, 20.0))
    sky = np.random.default_rng(0).random(scene.grid)
    image = list(model_images(scene, sky, np.zeros(0)))[1]
    for first in ((0, 0), (-8, -8)):
        view = View(scene, 1, Window(*first, (20, 20)))
        window = view.model(Estimate(scene, sky * scene.unit, np.zeros(0)))
        rows, columns = (slice(max(-at, 0), None) for at in first)
        expected = image[: 20 + min(first[0], 0), : 20 + min(first[1], 0)]
        assert worst(window[rows, columns], expected) <= 2e-3


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_errors_of_a_star_near_an_edge(scale):
    """Bad rows and columns before the image change nothing of a star that lies there."""
    n, side, room = 60, round(60 / scale), 40
    given, star = coarse_and_fine(n, side, scale, 20.0), np.array([8.0, 9.0])
    found = []
    for before in (0, room):
        width = (before, 0), (before, 0)
        maps = given.transforms
        maps[:, :, 2] += before - np.einsum("jxy,y->jx", maps[:, :, :2], np.full(2, before))
        images = [
            np.pad(image[:size, :size], width)
            for image, size in zip(given.images, (n, side), strict=True)
        ]
        bad = [
            np.pad(np.zeros((size, size), bool), width, constant_values=True) for size in (n, side)
        ]
        wider = lnocl.Observation(images, list(given.psfs), transforms=maps, mask=bad)
        scene = Scene(wider, [star + before])
        y, x = np.indices(scene.grid) - (12 + before)
        sky = 9.0 + 2e4 * scenes_turned.gaussian(x, y, 16.0 * np.eye(2))
        around = Surroundings(Estimate(scene, sky, np.array([3000.0])), False)
        found.append(np.sqrt(np.diag(NearStar(around, 0, 1e-6).fit.information)))
    assert worst(found[0], found[1]) <= 0.02


def test_a_small_image_has_a_small_grid_however_it_lies():
    grids = {
        Scene(coarse_and_fine(120, 20, 6.0, degrees, is_flipped)).grid
        for degrees in (5.0, 95.0, 185.0)
        for is_flipped in (False, True)
    }
    assert grids == {(192, 192)}


def test_stars_that_only_larger_pixels_blend():
    """Their images overlap though they are far apart on the sky."""
    given = coarse_and_fine(200, 10, 20.0, 10.0)
    field = Scene(given, [(70.0, 100.0), (130.0, 101.0), (100.0, 160.0)]).star_field
    shape = Scene(given).image_grid
    images = np.array([field.cutouts[1][s].on_grid(shape).ravel() for s in range(3)])
    found = field.images(1, np.ones(shape, bool)).information(np.ones(images[0].size))
    moments = np.array([1.0, 2.0, 3.0])
    assert worst(found.solve(moments), np.linalg.solve(images @ images.T, moments)) <= 1e-4


def test_a_grid_holds_the_psf_of_larger_pixels():
    given = coarse_and_fine(60, 20, 3.0, 0.0, half=20)
    assert min(Scene(given).grid) >= 3 * 41
    assert recommend_pad(given) >= 3 * 2


def test_rows_that_a_small_psf_was_given_do_not_count(recwarn):
    """A PSF of few large pixels beside one of many small ones, in one array."""
    given = coarse_and_fine(120, 20, 6.0, 0.0)
    wide = scenes_turned.gaussian(*(np.indices((81, 81)) - 40), 1.6 * np.eye(2))
    both = lnocl.Observation(
        [given.images[0], given.images[1, :20, :20]],
        [wide, given.psfs[1]],
        transforms=given.transforms,
        psf_centre="fit",
    )
    assert Scene(both).grid == Scene(given).grid == (192, 192)
    assert not recwarn.list


def test_the_sky_has_the_frame_of_its_image():
    assert coarse_and_fine(20, 30, 2.0, 0.0).sky_shape == (20, 20)
    assert coarse_and_fine(20, 30, 2.0, 0.0).shape == (30, 30)


def test_lists_go_wrong_in_one_line():
    maps = coarse_and_fine(32, 16, 2.0, 10.0).transforms
    images = [np.full((32, 32), 9.0), np.full((16, 16), 36.0)]
    psf = scenes_turned.gaussian(*(np.indices((9, 9)) - 4), np.eye(2))
    cases = [
        ({"mask": [np.zeros((16, 16), bool), np.zeros((32, 32), bool)]}, "`mask[0]` has shape"),
        ({"background": [np.ones((32, 32)), np.ones((10, 10))]}, "`background[1]` has shape (10"),
        ({"psfs": psf}, "one PSF is given for images whose pixels are 1 and 2 times"),
    ]
    for changes, message in cases:
        with pytest.raises(lnocl.InputError) as caught:
            lnocl.Observation(images, **{"psfs": [psf, psf], "transforms": maps, **changes})
        assert caught.value.message.startswith(message)


@pytest.mark.exhaustive
@pytest.mark.parametrize(("degrees", "scale"), [(0.0, 5.6), (20.0, 4.0)])
def test_stars_in_larger_pixels_are_marginal(degrees, scale):
    """Where sky and fluxes are right, the step of stars leaves them, but for the texture's pull."""
    n, side = 128, round(128 / scale)
    turn = lnocl.rotations([degrees], (0, 0))[0, :, :2] / scale
    transform = np.column_stack([turn, (side - 1) / 2 - turn @ [63.5, 63.5]])
    star, blob, covariance = np.array([61.3, 66.8]), np.array([75.0, 60.0]), 2.2 * np.eye(2)
    blurred = covariance + turn @ turn.T * 100.0  # a blob of 10 pixels of the sky
    y, x = np.indices((side, side))
    means = 20.0 * scale**2 + np.zeros((side, side))
    for at, flux, width in ((star, 1e6, covariance), (blob, 1e6, blurred)):
        u, v = turn @ at + transform[:, 2]
        means += flux * scenes_turned.gaussian(x - u, y - v, width)
    bad = np.arange(2)[:, None, None] < np.ones((1, n, n))  # the image that has the sky's pixels
    given = lnocl.Observation(
        [np.zeros((n, n)), means],
        [scenes_turned.gaussian(*(np.indices((21, 21)) - 10), covariance)] * 2,
        background=[0.0, 20.0 * scale**2],
        transforms=np.array([np.eye(2, 3), transform]),
        mask=[bad[0], np.zeros((side, side), bool)],
    )
    scene = Scene(given, [star])
    y, x = np.indices(scene.grid)
    sky = 1e6 * scenes_turned.gaussian(x - blob[0], y - blob[1], 100.0 * np.eye(2))
    fluxes = marginal(Estimate(scene, sky, np.array([1e6]))).star_fluxes
    assert fluxes == pytest.approx(1e6, rel=0.03)


@pytest.mark.parametrize("engine", NUMPY_FIRST)
@pytest.mark.parametrize("shape", [(2, 3), (4, 5)])
def test_images_of_few_pixels(engine, shape):
    """The grid has sixteen rows and columns at least, and all light that is there."""
    maps = lnocl.rotations([0.0, 30.0], ((shape[1] - 1) / 2, (shape[0] - 1) / 2))
    given = lnocl.Observation(np.full((2, *shape), 9.0), psfs()[0], transforms=maps)
    assert min(Scene(given).grid) >= 16
    result = paper(given, n_iter=20, **engine)
    assert worst(result.models(), 9.0) <= 0.02


@pytest.mark.exhaustive
def test_a_run_that_was_cut_off_goes_on(tmp_path):
    file = tmp_path / "run.ckpt"

    def stop(iteration, _):
        return iteration == 7

    given = observation(), STARS
    whole = paper(*given, n_iter=12)
    paper(*given, n_iter=12, callback=stop, checkpoint=file)
    same(paper(*given, n_iter=12, resume=file), whole)


@pytest.mark.exhaustive
def test_all_goes_wrong_in_one_line():
    maps = scenes_turned.transforms()
    sheared = maps.copy()
    sheared[0, 0, 1] += 0.01
    cases = [
        ({"offsets": np.zeros((3, 2))}, "`transforms` are not taken beside offsets"),
        ({"transforms": maps[:2]}, "`transforms` has shape (2, 2, 3); give 2 x 3 numbers"),
        ({"transforms": maps * np.nan}, "`transforms` must be finite"),
        ({"transforms": maps * 1.01}, "`transforms[0]` is for pixels of 0.9901 of the sky's"),
        ({"transforms": sheared}, "`transforms[0]` shears an image of 40 x 22 pixels by 0.1"),
    ]
    for changes, message in cases:
        with pytest.raises(lnocl.LnoclError) as caught:
            paper(observation(**changes), STARS, n_iter=1, engine="numpy")
        assert caught.value.message.startswith(message)
    with pytest.raises(lnocl.LnoclError, match=r"angles.* must be finite"):
        lnocl.rotations([np.inf], (0, 0))
    with pytest.raises(lnocl.LnoclError, match="of shape"):
        lnocl.rotations(3.0, (0, 0))


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_defaults_and_errors(caplog):
    """Held-out counts, smoothing and errors take images that are turned."""
    caplog.set_level("INFO", "lnocl")
    result = lnocl.deconvolve(observation(), STARS, engine="numpy")
    assert result.stop_reason in ("held-out", "converged")
    assert abs(result.star_fluxes - FLUXES).max() <= 5 * result.star_flux_errors.max()
    assert 0.8 < np.nanstd(result.residuals()) < 1.1
    errors = result.bootstrap(10, seed=0).to_table()
    assert np.isfinite(errors["error"]).all()


@pytest.mark.exhaustive
def test_images_of_several_shapes():
    """A list of arrays is what those with bad pixels at their ends are; PSFs keep their centre."""
    maps, whole = scenes_turned.scaled(), observation(scenes_turned.scaled())
    height, width = scenes_turned.LARGER

    def cut(array):
        return [*array[:2], array[2][:height, :width]]

    given = observation(
        maps,
        images=cut(whole.images),
        mask=cut(whole.mask),
        background=cut(np.broadcast_to(scenes_turned.background(), (3, NY, NX))),
        psfs=[*psfs()[:2], psfs()[2][2:17, 1:18]],
    )
    assert given.psfs.shape == (3, 19, 19)
    np.testing.assert_array_equal(given.images, whole.images)
    np.testing.assert_array_equal(given.mask, whole.mask)
    assert worst(given.psfs, whole.psfs) <= 1e-3
    one, other = (paper(each, STARS, n_iter=5, engine="numpy") for each in (given, whole))
    assert worst(one.extended, other.extended) <= 0.02  # the edges of the PSF that were cut


@pytest.mark.exhaustive
def test_a_flat_sky_is_as_bright_as_pixels_are_large():
    """The start is flat, and of the light of all images, whatever their pixels are."""
    maps = scenes_turned.scaled()
    flat = np.array([9.0, 9.0, 9.0 * 1.7**2])
    images = np.broadcast_to(flat[:, None, None], (3, NY, NX)) + 4.0
    scene = Scene(observation(maps, images=images, background=4.0))
    assert scene.levels == pytest.approx(9.0, rel=1e-12)
    result = paper(scene.observation, n_iter=20, engine="numpy")
    assert worst(result.models()[2][~scene.observation.mask[2]], 9.0 * 1.7**2 + 4.0) <= 0.021


NODES = [(0.0, 0.0), (NX - 1.0, 0.0), (0.0, NY - 1.0), (NX - 1.0, NY - 1.0)]


def fields():
    """Return PSFs that vary over each image: those of another image in its last column."""
    one, other = psfs(), np.roll(psfs(), 1, axis=0)
    return [lnocl.PsfField([a, b, a, b], NODES) for a, b in zip(one, other, strict=True)]


QUARTERS = ANGLES + np.array([90.0, 180.0, -90.0])


@pytest.mark.exhaustive
@pytest.mark.parametrize("angles", [ANGLES, QUARTERS], ids=["turned", "quarter turns"])
def test_stars_have_the_psf_of_their_place_in_each_image(angles):
    maps = scenes_turned.transforms(angles)
    maps[1, 0] *= -1.0  # a flip
    maps[1, 0, 2] += NX - 1.0
    scene = Scene(observation(maps, psfs=fields()), STARS)
    y, x = np.indices((NY, NX))
    for s, star in enumerate(STARS):
        images = np.array([scene.star_image(j, s) for j in range(3)])
        height, width = scene.observation.shape
        found = scene.observation.as_given(images[:, :height, :width])
        for j, each in enumerate(maps):
            at = each[:, :2] @ star + each[:, 2]
            share = np.clip(at[0] / (NX - 1), 0.0, 1.0)
            one, other = (
                scenes_turned.psf(x - at[0], y - at[1], scenes_turned.COVARIANCES[k])
                for k in (j, j - 1)
            )
            expected = (1.0 - share) * one + share * other
            assert worst(found[j], expected) <= 3e-4, (j, s)


@pytest.mark.exhaustive
@pytest.mark.parametrize("angles", [ANGLES, QUARTERS], ids=["turned", "quarter turns"])
def test_the_sky_has_the_psfs_of_the_middle_of_each_image(angles):
    maps = scenes_turned.transforms(angles)
    middle = np.array([each.at((NX - 1) / 2, (NY - 1) / 2) for each in fields()])
    scenes = [Scene(observation(maps, psfs=each), STARS) for each in (fields(), middle)]
    scenes.append(scenes[0].seen_through(scenes[0].observation.psfs_over_images))
    for j in range(3):
        expected = scenes[1].psf(j)
        for scene in scenes[::2]:
            np.testing.assert_allclose(scene.psf(j), expected, atol=1e-11)


@pytest.mark.exhaustive
def test_one_field_is_not_for_pixels_of_several_sizes():
    with pytest.raises(lnocl.LnoclError, match="one PSF is given for images whose pixels are 1"):
        observation(scenes_turned.scaled(), psfs=fields()[0])


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize(("oversample", "allowed"), [(1, 7.5e-3), (2, 4e-5), (4, 2e-5)])
def test_rolls_with_pixels_as_wide_as_the_psf(oversample, allowed):
    """Two stars in a ring of Gaussians; all images are known in closed form."""
    n, middle, q = 64, 31.5, oversample
    stars, fluxes = [(31.3, 33.8), (33.4, 35.1)], np.array([2e5, 6e3])
    turns = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    ring = stars[0] + np.stack([12.0 * np.cos(turns), 7.2 * np.sin(turns)], axis=1)
    knots = 2000.0 * (1.0 + 0.5 * np.cos(turns))
    maps = lnocl.rotations([0.0, 22.0, -33.0, 41.0], (middle, middle))
    maps[:, :, 2] += [(0, 0), (0.37, -0.21), (-0.45, 0.3), (0.18, 0.44)]
    y, x = np.indices((n, n))

    def seen(x, y, blur=0.0):
        square = (1.4 / 2.3548) ** 2
        first = scenes_turned.gaussian(x, y, np.diag([square, 1.2 * square]) + blur * np.eye(2))
        ghost = scenes_turned.gaussian(x - 0.7, y + 0.5, (2.0 * square + blur) * np.eye(2))
        return 0.8 * first + 0.2 * ghost

    def images(places, light, blur=0.0):
        at = np.einsum("jik,nk->jni", maps[:, :, :2], places) + maps[:, None, :, 2]
        sums = [
            sum(c * seen(x - px, y - py, blur) for c, (px, py) in zip(light, each, strict=True))
            for each in at
        ]
        return np.array(sums)

    of_ring = images(ring, knots, 1.0)
    v, u = (np.indices((32 * q + 1,) * 2) - 16 * q) / q
    mean = of_ring + images(stars, fluxes) + 40.0
    given = lnocl.Observation(
        np.random.default_rng(4).poisson(mean).astype(float),
        [seen(u, v)] * 4,
        background=40.0,
        transforms=maps,
        oversample=q,
        effective_psfs=True,
    )
    model = Model(Scene(given, stars))
    v, u = (np.indices(model.grid) - (q - 1) / 2) / q
    blobs = (scenes_turned.gaussian(u - px, v - py, np.eye(2)) for px, py in ring)
    sky = sum(c * blob for c, blob in zip(knots, blobs, strict=True)) / q**2
    assert worst(model.forward(sky)[:, :n, :n], of_ring) <= allowed
    if oversample == 2:
        result = lnocl.deconvolve(given, stars, refine_psfs=(), refine_positions=False)
        assert (abs(result.star_fluxes - fluxes) < 4 * result.star_flux_errors).all()
        np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=0.012)
        smooth = [gaussian_filter(each[: n * q, : n * q], q) for each in (result.extended, sky)]
        assert np.linalg.norm(smooth[0] - smooth[1]) <= 0.03 * np.linalg.norm(smooth[1])
