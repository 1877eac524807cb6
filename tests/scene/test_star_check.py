"""PSFs that are wider or narrower than the stars, and stars that are not where they are said."""

import warnings

import numpy as np
import pytest
from scenes import paper

import lnocl
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.star_check import check_stars, warn_of_stars
from lnocl.errors import LnoclWarning

SIZE, WIDTH, LEVEL = 96, 4.0, 30.0
STAR = (50, 44)


def moffat(width, x=0.0, y=0.0, size=65):
    rows, columns = np.indices((size, size)) - size // 2
    a = width / (2 * np.sqrt(2 ** (1 / 3) - 1))
    psf = (1 + ((columns - x) ** 2 + (rows - y) ** 2) / a**2) ** -3.0
    return psf / psf.sum()


def observe(psf, flux=1e5, star=STAR, extended=0.0, seed=0, **given):
    """Return an observation of a star through a PSF of `WIDTH`, given another."""
    means = np.full((SIZE, SIZE), LEVEL) + extended
    x, y = star
    whole = np.round(star).astype(int)
    means[whole[1] - 32 : whole[1] + 33, whole[0] - 32 : whole[0] + 33] += flux * moffat(
        WIDTH, x - whole[0], y - whole[1]
    )
    image = np.random.default_rng(seed).poisson(means)
    return lnocl.Observation(image, psf, background=LEVEL, **given)


def said(observation, star=STAR, moves=False):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        warn_of_stars(Scene(observation, [star]), moves)
    return [str(each.message) for each in caught]


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("flux", [2e3, 1e5, 1e7])
def test_right_psf_gives_no_warning(seed, flux):
    assert said(observe(moffat(WIDTH), flux, seed=seed)) == []


def test_masked_star_gives_a_warning():
    mask = np.zeros((SIZE, SIZE), bool)
    mask[STAR[1] - 2 : STAR[1] + 3, STAR[0] - 2 : STAR[0] + 3] = True
    observation = observe(moffat(WIDTH), mask=mask)
    assert said(observation) == [
        "the star at (50, 44) lies on bad pixels: its flux rests on its wings, and so on the "
        "PSF's; see to the mask"
    ]
    assert said(observation, (47.4, 44.0)) == []
    two = lnocl.Observation(
        [observation.images[0]] * 2, moffat(WIDTH), mask=[mask, ~mask], background=LEVEL
    )
    assert [each for each in said(two) if "bad pixels" in each] == []


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.2, 1.35, 2.0, 5.0])
def test_psf_of_another_width_gives_a_warning(factor):
    (message,) = said(observe(moffat(factor * WIDTH)))
    stated = float(message.split(" times as wide")[0].rsplit(" ", 1)[1])
    assert stated == pytest.approx(factor, rel=0.05)
    assert ("times too fine is: rebin it" in message) == (factor >= 2)


@pytest.mark.parametrize("offset", [0.3, 1.0])
def test_misplaced_star_gives_a_warning(offset):
    observation = observe(moffat(WIDTH), star=(STAR[0] + offset, STAR[1]))
    (message,) = said(observation)
    stated = float(message.split("lies (")[1].split(",")[0])
    assert stated == pytest.approx(offset, abs=0.05)
    assert "give its place, take refine_positions, or mend the centre of psf 0" in message
    assert said(observation, moves=True) == []


def test_refined_position_gives_no_warning():
    observation = observe(moffat(WIDTH), star=(STAR[0] + 0.6, STAR[1]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paper(observation, [STAR], refine_positions=True, n_iter=1, engine="numpy")
    with pytest.warns(LnoclWarning, match="the star at .* lies .* pixels from there in image 0"):
        paper(observation, [STAR], n_iter=1, engine="numpy")


def halos(**given):
    return list(check_stars(Scene(observe(moffat(2 * WIDTH), **given), [given.get("star", STAR)])))


def test_stars_that_show_nothing_are_left_out():
    """Faint, at the edge, masked, on bright emission, and two close by each other."""
    mask = np.zeros((SIZE, SIZE), bool)
    assert len(halos(mask=mask)) == 1
    mask[STAR[1] + 3, STAR[0] - 2] = True
    emission = np.zeros((SIZE, SIZE))
    emission[:, STAR[0] + 12 :] = 3e3
    assert halos(mask=mask) == []
    assert halos(flux=300.0) == []
    assert halos(extended=emission) == []
    edge = Scene(observe(moffat(2 * WIDTH)), [(5, 44)])
    assert list(check_stars(edge)) == []
    close = Scene(observe(moffat(2 * WIDTH)), [STAR, (STAR[0] + 9, STAR[1])])
    assert list(check_stars(close)) == []


def test_of_several_images_the_worst_is_named():
    observation = observe(moffat(WIDTH))
    images = np.array([observation.images[0]] * 3)
    psfs = [moffat(WIDTH), moffat(1.3 * WIDTH), moffat(0.85 * WIDTH)]
    (message,) = said(lnocl.Observation(images, psfs, background=LEVEL))
    assert message.startswith("psf 1 does not fit: it is 1.3")
    assert "in image 1, FWHM 5." in message


@pytest.mark.parametrize("given", [{}, {"epochs": ["a"]}, {"epochs": ["a", "b"]}])
def test_advised_position_refinement_corrects_the_position(given):
    n = len(given.get("epochs", "a"))
    image = observe(moffat(WIDTH), seed=3).images[0]
    observation = lnocl.Observation(np.array([image] * n), moffat(WIDTH), background=LEVEL, **given)
    star = (STAR[0] + 0.6, STAR[1] - 0.3)
    (line,) = said(observation, star)
    assert "give its place, take refine_positions, or mend" in line
    found = lnocl.deconvolve(
        observation, [star], refine_positions=True, n_iter=1, engine="numpy", stop=None,
        smoothing=0.0, pad=0,
    )  # fmt: skip
    np.testing.assert_allclose(found.star_positions, [STAR] * n, rtol=0, atol=0.05)
