"""Texture: the skies that an estimate may stand for."""

import numpy as np
import pytest

import lnocl
from lnocl.core.scene import texture
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.texture import Texture, hidden_radii, resolution

N = 64
Y, X = np.indices((N, N), float)
SKY = 100.0 * np.exp(-0.5 * ((X - 30) / 4.0) ** 2) + 1.0


def gaussian(fwhm):
    return np.exp(-0.5 * ((X - 32) ** 2 + (Y - 32) ** 2) / (fwhm / 2.3548) ** 2)


def a_texture(stars=(), sky=SKY, psfs=None):
    psfs = np.array([gaussian(5.0), gaussian(8.0)]) if psfs is None else psfs
    images = np.full((len(psfs), N, N), 10.0)
    scene = Scene(lnocl.Observation(images, psfs), stars)
    found = Texture(sky, scene.stars, resolution(scene))
    found.resolution = resolution(scene)
    return found


def test_the_resolution_is_that_of_all_images_together():
    """Two PSFs that are wide across each other resolve more than either."""
    assert a_texture(psfs=gaussian(6.0)[None]).resolution == pytest.approx(6.0, rel=0.01)
    assert 5.0 < a_texture().resolution < 6.5
    y, x = (Y - 32) / 2.5, X - 32
    long = np.exp(-0.5 * (x**2 + y**2) / (4.0 / 2.3548) ** 2)
    alone, both = (a_texture(psfs=np.array(p)).resolution for p in ([long], [long, long.T]))
    assert alone == pytest.approx(4.0 * np.sqrt(2.5), rel=0.02)
    assert both < 0.85 * alone


def test_without_stars_the_mean_is_the_estimate_and_the_amplitude_a_share_of_it():
    found = a_texture()
    np.testing.assert_array_equal(found.mean, SKY)
    inner = np.s_[:, 28:33]
    np.testing.assert_allclose(found.amplitude[inner], texture.SHARE * SKY[inner], rtol=0.2)


def test_drawn_skies_have_the_mean_and_amplitude_and_a_width():
    found, rng = a_texture(), np.random.default_rng(4)
    fields = np.array([found.draw(rng) - found.mean for _ in range(400)])[:, :, 30]
    assert fields.mean() == pytest.approx(0.0, abs=0.5)
    amplitude = np.sqrt(np.mean(fields**2))
    assert amplitude == pytest.approx(found.amplitude[:, 30].mean(), rel=0.03)
    lag = 3
    product = np.mean(fields[:, lag:] * fields[:, :-lag]) / amplitude**2
    assert product == pytest.approx(np.exp(-(lag**2) / (2 * found.width**2)), abs=0.03)


def test_no_drawn_sky_is_negative():
    found = a_texture(sky=np.where(X > 30, 50.0, 0.0))
    assert found.draw(np.random.default_rng(5)).min() == 0.0


@pytest.mark.parametrize("star", [(30.0, 20.0), (30.3, 0.2), (30.0, 63.4)])
@pytest.mark.parametrize("length", [4.0, 20.0, -20.0, np.inf])
def test_under_a_star_the_sky_is_expected_to_go_on_as_round_it(star, length):
    """Whatever the estimate has there, a hole or a heap; also where the grid wraps round."""
    away = ((at - star_at + N / 2) % N - N / 2 for at, star_at in zip((X, Y), star, strict=True))
    distance = np.hypot(*away) / a_texture().resolution
    sky = 100.0 * np.exp(-distance * a_texture().resolution / length)
    core = distance <= texture.CORE
    is_round = (distance > texture.CORE) & (distance <= texture.ROUND)
    for held in (0.0, 1e4):
        found = a_texture([star], np.where(core, held, sky))
        # A pixel on the edge may be on either side of it.
        expected = np.minimum(sky, texture.STEEPEST * sky[is_round].mean())
        np.testing.assert_allclose(found.mean[core], expected[core], rtol=0.06)
        far = distance > texture.CORE + texture.EDGE
        np.testing.assert_array_equal(found.mean[far], sky[far])
        near = found.amplitude[distance <= texture.NEAR]
        assert near.min() >= 0.5 * texture.SHARE_NEAR * sky[is_round].max()


def test_a_psf_wider_than_the_grid_leaves_the_estimate():
    images = np.full((1, 8, 8), 10.0)
    wide = np.exp(-((np.arange(41) - 20) ** 2)[:, None] / 200.0 - (np.arange(41) - 20) ** 2 / 200.0)
    with pytest.warns(lnocl.LnoclWarning, match="larger than the grid"):
        scene = Scene(lnocl.Observation(images, wide), [(4, 4)])
    found = Texture(np.ones((8, 8)), scene.stars, resolution(scene))
    np.testing.assert_array_equal(found.mean, 1.0)
    assert resolution(scene) > 8


def hidden(mask, star, **known):
    images = np.full(mask.shape, 9.0)
    psf = 1.0 / (4.0 + (X[:41, :41] - 20) ** 2 + 2 * (Y[:41, :41] - 20) ** 2)
    observation = lnocl.Observation(images, psf, mask=mask, **known)
    return hidden_radii(Scene(observation, [star]), 3.0)[0]


def test_a_hidden_radius_ends_at_the_nearest_pixel_that_an_image_has_observed():
    star = 15.3, 17.8
    away = np.hypot(X - star[0], Y - star[1])
    disc = away < 6.0
    found = hidden(disc, star)
    assert found == pytest.approx(away[~disc].min() - 0.5**0.5)
    assert hidden(np.zeros_like(disc), star) == 0.0
    assert hidden(disc & (X != 15), star) == 0.0  # its own pixel is observed
    column = (X == 15) & (Y > 2)
    assert hidden(column, star) == 0.0  # it is narrower than the core
    assert hidden(np.array([disc, np.zeros_like(disc)]), star) == 0.0
    larger = away < 8.0
    assert hidden(np.array([disc, larger]), star) == pytest.approx(found)


def test_hidden_core_is_expected_to_match_its_surroundings():
    """Light in it is expected to be that round it, however much the estimate has there."""
    sky = np.where(np.hypot(X - 16, Y - 16) < 6, 50.0, 2.0) + 0.1 * X
    stars, radii = np.array([(16.0, 16.0)]), np.array([7.0])
    seen, unseen = Texture(sky, stars, 3.0), Texture(sky, stars, 3.0, radii)
    assert seen.mean[16, 20] > 40
    inside = np.hypot(X - 16, Y - 16) < 7
    assert (unseen.mean[inside] < 6).all()
    assert unseen.amplitude[16, 16] < 0.2 * seen.amplitude[16, 16]
