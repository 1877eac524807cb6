"""A transmission of the sky before the PSF: engines against an explicit matrix, and its fluxes.

The scenes are turned too, so that their program is that of tests/turned_scenes.py.
"""

import numpy as np
import pytest
import turned_scenes
from scenes import FEWER_ENGINES, make_smooth_psfs, paper, worst
from turned_scenes import FLUXES, GRID, NX, NY, STARS, observation

import lnocl
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_check import warn_of_stars

pytestmark = pytest.mark.filterwarnings(
    "ignore:psf . is undersampled", "ignore:the star at .* lies on bad pixels"
)
START = {"initial_extended": np.full((NY, NX), 8.0), "initial_star_fluxes": FLUXES / 2}


def share(j, x, y):
    """Return a plane, which is the same between pixels."""
    a, b, c = [(0.2, 0.011, 0.013), (0.95, -0.014, -0.012), (0.6, 0.004, -0.02)][j]
    return a + b * x + c * y


def shares():
    """Return transmissions of three images, of which the first hides a corner of the sky."""
    y, x = np.indices((NY, NX))
    given = np.array([share(j, x, y) for j in range(3)])
    given[0, 16:, 30:] = 0.0
    return given


def split_gradient(n_iter, given):
    """Return extended source and star fluxes of the paper's iteration on the matrix."""
    maps = turned_scenes.transforms()
    before = [(n - k) // 2 for n, k in zip(GRID, (NY, NX), strict=True)]
    beyond = [(0, 0), *((m, n - k - m) for n, k, m in zip(GRID, (NY, NX), before, strict=True))]
    dimmed = np.roll(np.pad(shares(), beyond, mode="edge"), np.negative(before), (1, 2))
    dimmed = dimmed.reshape(3, 1, -1)
    sky = turned_scenes.matrix(maps).reshape(3, NY * NX, -1) * dimmed
    stars = turned_scenes.star_columns(maps).reshape(3, NY * NX, 2)
    stars = stars * np.array([share(j, *STARS.T) for j in range(3)])[:, None]
    matrix = np.concatenate([sky, stars], axis=2).reshape(3 * NY * NX, -1)
    weights, images = (~given.mask).ravel().astype(float), given.images.ravel()
    background = np.tile(turned_scenes.background().ravel(), 3)
    total = matrix.T @ weights
    is_observed = total[:-2] >= 0.01 * total[:-2].max()
    x = np.append(np.where(is_observed, 8.0, 0.0), START["initial_star_fluxes"])
    total[:-2][~is_observed] = np.inf
    for _ in range(n_iter):
        x *= matrix.T @ (weights * images / (matrix @ x + background)) / total
    return x[:-2].reshape(GRID)[:NY, :NX], x[-2:]


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_iterations_are_those_of_the_matrix(engine):
    given = observation(transmission=shares())
    result = paper(given, STARS, n_iter=30, **START, **engine)
    extended, fluxes = split_gradient(30, given)
    # Three times what was measured, the error of the shears.
    assert worst(result.extended, extended) <= 3e-4
    assert worst(result.star_fluxes, fluxes) <= 2e-5


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_steps_of_both_engines_agree(engine):
    given = observation(transmission=shares())
    options = {"solver": "sgp", "n_iter": 12, **START}
    expected = paper(given, STARS, **options | {"engine": "numpy"})
    found = paper(given, STARS, **options, **engine)
    assert worst(found.extended, expected.extended) <= 2e-6
    assert worst(found.star_fluxes, expected.star_fluxes) <= 2e-6


@pytest.mark.exhaustive
def test_all_of_the_light_changes_nothing():
    ones = observation(transmission=np.ones((NY, NX)))
    found, expected = (
        paper(each, STARS, n_iter=20, engine="numpy", **START) for each in (ones, observation())
    )
    assert worst(found.extended, expected.extended) <= 1e-13
    assert worst(found.star_fluxes, expected.star_fluxes) <= 1e-13


def scene_of(sky, transmission, **more):
    """Return two images of a sky, seen through their transmissions and then their PSFs."""
    psfs = make_smooth_psfs(2, (13, 15))
    laid = np.pad(psfs, [(0, 0), (0, sky.shape[0] - 13), (0, sky.shape[1] - 15)])
    otfs = np.fft.rfft2(np.roll(laid, (-6, -7), axis=(1, 2)))
    otfs /= psfs.sum(axis=(1, 2))[:, None, None]
    images = np.fft.irfft2(otfs * np.fft.rfft2(transmission * sky), sky.shape)
    given = {"psf_centre": "given", "transmission": transmission, "background": 4.0}
    return lnocl.Observation(images + 4.0, psfs, **(given | more))


def test_stars_behind_nothing_are_left_out_and_the_others_are_dimmed():
    y, x = np.indices((32, 48))
    hidden = np.where(np.hypot(x - 30, y - 20) < 4, 0.0, 0.2 + 0.015 * x)
    sky = 3.0 + np.sin(x / 5.0) * np.cos(y / 7.0)
    extended = sky.copy()
    sky[11, 13] += 5e4
    sky[20, 30] += 9e4
    given = scene_of(sky, np.array([hidden, 0.5 * hidden]))
    scene = Scene(given, [(13, 11), (30, 20)])
    with pytest.warns(lnocl.LnoclWarning, match=r"masked or not 0\.01 is transmitted"):
        warn_of_stars(scene, moves=False)
    np.testing.assert_array_equal(scene.is_shown, [True, False])
    means = Model(scene).images(extended / scene.unit, np.array([5e4, 9e4]) / scene.unit)
    np.testing.assert_allclose(scene.scale * means, given.images, rtol=1e-12)


def test_a_sky_that_good_pixels_do_not_show_is_refused():
    shares = np.array([np.zeros((8, 9)), np.ones((8, 9))])
    given = lnocl.Observation(np.ones((2, 8, 9)), np.ones((3, 3)), transmission=shares)
    with pytest.raises(lnocl.InputError, match="0 everywhere for the images that have good pixels"):
        given.replace(mask=shares > 0)


@pytest.mark.exhaustive
def test_a_window_has_its_part_of_the_transmission():
    given = observation(transforms=None, transmission=shares())
    cut = given.window(range(3, 19), range(5, 30))
    np.testing.assert_array_equal(cut.transmission, shares()[:, 3:19, 5:30])
    fine = lnocl.Observation(
        np.ones((8, 8)), np.ones((3, 3)), oversample=2, transmission=np.eye(16)
    )
    assert fine.window(range(2, 6), range(0, 8)).transmission.shape == (1, 8, 16)


def test_beyond_each_edge_a_transmission_is_that_of_the_edge():
    """What lies left of the frame is at the end of the grid."""
    shares = np.indices((32, 32))[1] / 32.0
    given = lnocl.Observation(np.ones((32, 32)), np.ones((3, 3)), transmission=shares)
    found = Scene(given, (), pad=9).transmission[0]
    np.testing.assert_array_equal(found[:, [-1, -4]], 0.0)
    np.testing.assert_array_equal(found[:, 32:36], 31 / 32)


@pytest.mark.exhaustive
def test_one_map_serves_all_images_and_takes_no_more_memory():
    given = observation(transmission=np.full((NY, NX), 0.5))
    scene = Scene(given, STARS)
    assert scene.transmission.shape == (3, *GRID)
    assert scene.transmission.strides[0] == 0


def test_a_psf_of_its_own_holds_the_share_of_its_star():
    """Its sum is what the mask lets through, so it is not dimmed again."""
    own = {"star_psfs": 0.3 * make_smooth_psfs(1, (9, 9)), "star_places": [(13, 11)]}
    own["star_psfs"] /= make_smooth_psfs(1, (9, 9)).sum()
    sky, stars = np.full((32, 48), 3.0), [(13, 11), (30, 20)]
    dimmed = Scene(scene_of(sky, np.full((2, 32, 48), 0.5), **own), stars)
    clear = Scene(scene_of(sky, np.ones((2, 32, 48)), **own), stars)
    for j in range(2):
        np.testing.assert_array_equal(dimmed.star_image(j, 0), clear.star_image(j, 0))
        assert dimmed.star_image(j, 0).sum() == pytest.approx(0.3)
        np.testing.assert_allclose(2.0 * dimmed.star_image(j, 1), clear.star_image(j, 1))
