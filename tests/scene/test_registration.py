"""Images that lie elsewhere than they are said to, found by their stars."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import lnocl
from lnocl import rotations
from lnocl.core.scene.registration import displacements, turned_otherwise
from lnocl.core.scene.shifting import place

N = 80
MIDDLE = np.array([40.0, 40.0])
STARS = np.array([[31.3, 46.2], [52.8, 35.1], [44.6, 58.4]])
FLUXES = [3e4, 1e4, 2e4]
Y, X = np.indices((33, 33)) - 16
PSFS = [(1 + (X**2 + (1 + e) * Y**2 + e * X * Y) / w**2) ** -2.5 for w, e in ((2, 0.1), (3, 0.3))]
PSFS = [psf / psf.sum() for psf in PSFS]
MOVES = {"not at all": (0.0, 0.0), "by half a pixel": (0.4, 0.3), "far": (-13.3, 9.6)}


def observe(moved, transforms=None, seed=0, stars=STARS, said=None, extended=0.0):
    """Return two images of stars, the second of which lies elsewhere by these pixels."""
    rng, images = np.random.default_rng(seed), []
    maps = [np.eye(2, 3), np.eye(2, 3)] if transforms is None else transforms
    for psf, turn, by in zip(PSFS, maps, [(0.0, 0.0), moved], strict=True):
        image = np.full((N, N), 60.0)
        for star, flux in zip(stars, FLUXES, strict=False):
            x, y = turn[:, :2] @ star + turn[:, 2] + by
            image += flux * place(psf, (N, N), x, y).on_grid((N, N))
        x, y = turn[:, :2] @ (stars[0] + (6.0, -7.0)) + turn[:, 2] + by
        light = np.zeros((N, N))
        light[round(y), round(x)] = extended
        images.append(rng.poisson(image + gaussian_filter(light, 3.0)))
    said = transforms if said is None else said
    return lnocl.Observation(images, PSFS, background=60.0, transforms=said)


@pytest.mark.parametrize("moved", MOVES.values(), ids=MOVES)
@pytest.mark.parametrize("n_stars", [1, 3])
def test_images_are_moved_to_their_stars_beyond_a_pixel(moved, n_stars):
    found = displacements(observe(moved, extended=1.5e4), STARS[:n_stars])
    expected = np.array([(0.0, 0.0), moved]) if np.hypot(*moved) > 1 else np.zeros((2, 2))
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.15)


def test_places_of_stars_that_are_wrong_move_no_image():
    assert not displacements(observe((0.0, 0.0)), STARS + np.array([2.4, -1.7])).any()


def test_stars_in_noise_move_no_image():
    assert not displacements(observe((0.0, 0.0)), np.array([[20.0, 15.0]])).any()


@pytest.mark.parametrize("widths", [(1.2, 2.5), (2.5, 1.2)])
@pytest.mark.parametrize(("flux", "width", "away"), [(1e5, 1.5, 6), (3e5, 0.7, 10), (1e5, 3.0, 4)])
def test_brighter_light_beside_a_star_moves_no_image(widths, flux, width, away):
    """Which a wide PSF blends with the star, or makes higher than it."""
    rng, images, psfs = np.random.default_rng(3), [], []
    light = np.zeros((N, N))
    light[round(STARS[0][1]), round(STARS[0][0]) + away] = flux
    for sigma in widths:
        psf = np.exp(-(X**2 + Y**2) / 2 / sigma**2)
        psfs.append(psf / psf.sum())
        star = 5e4 * place(psfs[-1], (N, N), *STARS[0]).on_grid((N, N))
        images.append(rng.poisson(30 + star + gaussian_filter(light, np.hypot(sigma, width))))
    observation = lnocl.Observation(images, psfs, background=30.0)
    assert not displacements(observation, STARS[:1]).any()


def test_the_image_whose_pixels_the_sky_has_stays():
    images = observe((0.0, 0.0)).images[::-1]
    maps = [np.array([[1.0, 0.0, 5.0], [0.0, 1.0, 0.0]]), np.eye(2, 3)]
    observation = lnocl.Observation(images, PSFS[::-1], background=60.0, transforms=maps)
    np.testing.assert_allclose(displacements(observation, STARS), [(-5, 0), (0, 0)], atol=0.15)


def test_turned_images_are_moved_in_their_own_pixels():
    maps = rotations([0.0, 35.0], MIDDLE)
    found = displacements(observe((5.2, -7.7), maps), STARS + np.array([0.6, -0.5]))
    np.testing.assert_allclose(found, [(0.0, 0.0), (5.2, -7.7)], rtol=0, atol=0.15)


@pytest.mark.parametrize("angle", [35.0, -50.0])
def test_angles_of_the_other_sign_are_seen_by_several_stars(angle):
    maps, others = (rotations([0.0, each], MIDDLE) for each in (angle, -angle))
    assert turned_otherwise(observe((3.0, 2.0), maps), STARS) == []
    assert turned_otherwise(observe((3.0, 2.0), maps, said=others), STARS) == [1]
    assert turned_otherwise(observe((3.0, 2.0), maps, said=others), STARS[:1]) == []


@pytest.mark.filterwarnings("ignore:the PSFs do not fit")  # of an image that is not moved
def test_images_are_moved_before_they_are_fitted(caplog):
    moved = (4.2, -3.3)
    observation = observe(moved)
    options = {"engine": "numpy", "stop": None, "n_iter": 12, "refine_psfs": (), "pad": 8}
    with caplog.at_level("INFO", "lnocl"):
        result = lnocl.deconvolve(observation, STARS, **options)
    assert any(each.startswith("images moved: image 1 by (+4.") for each in caplog.messages)
    np.testing.assert_allclose(result.star_fluxes, FLUXES, rtol=0.03)
    left = lnocl.deconvolve(observation, STARS, mend_images=False, **options)
    assert abs(left.star_fluxes - FLUXES).max() > 0.2 * max(FLUXES)


def test_the_file_of_a_result_has_where_its_images_were_moved(tmp_path):
    from lnocl.result.kept import from_parts, to_parts

    observation = observe((4.2, -3.3))
    options = {"engine": "numpy", "stop": None, "n_iter": 3, "refine_psfs": (), "pad": 8}
    outcome = lnocl.deconvolve(observation, STARS, **options)._outcome
    again = from_parts(to_parts(outcome, observation), observation, None, "single")
    np.testing.assert_array_equal(again.observation.offsets, outcome.observation.offsets)
    assert outcome.observation.offsets[1] == pytest.approx((4.2, -3.3), abs=0.1)
    for model, expected in zip(again.models(), outcome.models(), strict=True):
        np.testing.assert_array_equal(model, expected)


def test_an_image_without_a_good_pixel_stays_without_a_warning():
    observation = observe((9.0, 4.0))
    mask = np.zeros(observation.images.shape, bool)
    mask[1] = True
    assert not displacements(observation.replace(mask=mask), STARS).any()


def test_right_angles_are_not_doubted_for_brighter_stars_that_are_not_given():
    maps = rotations([0.0, 40.0], MIDDLE)
    stars = np.array([[31.3, 46.2], [44.6, 58.4], [52.8, 35.1]])
    observation = observe((0.0, 0.0), maps, stars=stars[::-1])  # FLUXES: the last has most light
    assert turned_otherwise(observation, stars[:2]) == []
