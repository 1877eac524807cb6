"""PSFs that several stars share: against the PSF that made them, and against one star's."""

import warnings

import numpy as np
import pytest
from star_frames import gaussian, line, quiet

from lnocl.errors import InputError
from lnocl.psf.make import make_psf, make_psfs

SHAPE = (120, 140)
PLACES = [(30.3, 30.8), (100.45, 40.1), (45.7, 90.25), (96.6, 88.5)]
FLUXES = [1.0, 0.5, 0.8, 0.3]
SIZE = 21


def a_frame(fwhm, places=PLACES, fluxes=FLUXES, scale=2e5):
    return scale * sum(
        flux * gaussian(fwhm, x, y, SHAPE) for (x, y), flux in zip(places, fluxes, strict=True)
    )


def truth(fwhm):
    psf = gaussian(fwhm, SIZE // 2, SIZE // 2, (SIZE, SIZE))
    return psf / psf.sum()


def error(star, fwhm):
    expected = truth(fwhm)
    return abs(star.psf - expected).max() / expected.max()


@pytest.mark.parametrize(("fwhm", "most"), [(1.5, 3e-3), (2.5, 2e-5), (4.0, 2e-5)])
def test_without_noise_it_is_the_psf_that_made_the_stars(fwhm, most):
    star = make_psf(a_frame(fwhm), PLACES, SIZE, background=0.0)
    assert error(star, fwhm) < most
    np.testing.assert_allclose(star.centres, PLACES, rtol=0, atol=2e-3)
    assert star.scatter.max() < most * star.psf.max()
    assert star.psf.sum() == pytest.approx(1.0, abs=1e-12)
    assert star.flux == pytest.approx(2e5 * sum(FLUXES), rel=1e-3)


def test_an_undersampled_star_is_not_blurred_as_one_alone_is():
    frame = a_frame(1.5)
    alone = quiet(frame, PLACES[2], SIZE, background=0.0)
    together = make_psf(frame, PLACES, SIZE, background=0.0)
    assert error(alone, 1.5) > 10 * error(together, 1.5)


@pytest.mark.exhaustive
def test_it_has_the_noise_of_all_stars_together():
    rng = np.random.default_rng(3)
    frame, found = a_frame(3.0) + 50.0, []
    for _ in range(8):
        counts = rng.poisson(frame).astype(float)
        several = make_psf(counts, PLACES, SIZE, background=50.0)
        alone = make_psf(counts, PLACES[0], SIZE, background=50.0)
        found.append([np.linalg.norm(each.psf - truth(3.0)) for each in (several, alone)])
    several, alone = np.sqrt(np.mean(np.square(found), axis=0))
    variances = [sum(f * 2e5 + 50.0 * SIZE**2 for f in each) for each in (FLUXES, FLUXES[:1])]
    noise = [
        np.sqrt(v) / (2e5 * sum(each))
        for v, each in zip(variances, (FLUXES, FLUXES[:1]), strict=True)
    ]
    assert several < 1.15 * noise[0]
    assert alone / several > 0.8 * noise[1] / noise[0]


def test_neighbours_that_are_given_are_modelled():
    places = [*PLACES, (38.2, 33.4)]
    frame = a_frame(2.5, places, [*FLUXES, 0.4])
    star = make_psf(frame, places, SIZE, background=0.0)
    assert error(star, 2.5) < 2e-3


@pytest.mark.parametrize(
    ("given", "use"), [(PLACES, "modelled beside them"), (PLACES[0], "taken too")]
)
def test_other_neighbours_are_modelled(given, use):
    frame = a_frame(2.5, [*PLACES, (38.2, 33.4)], [*FLUXES, 0.2])
    star = make_psf(frame, given, SIZE, background=0.0)
    assert error(star, 2.5) < 4e-3
    assert line(star, "neighbours").startswith(f"neighbours: 1 star not given, {use}; 0 ")


def test_a_target_with_a_ring_that_is_not_given_is_no_part_of_the_psf():
    """As it would be were it given."""
    target = 44.3, 31.2
    frame = a_frame(2.5, [*PLACES, target], [*FLUXES, 1.0])
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    ring = [(target[0] + 4.0 * np.cos(t), target[1] + 4.0 * np.sin(t)) for t in turns]
    frame += a_frame(2.5, ring, 0.02 * (1.0 + 0.5 * np.cos(turns)))
    star = make_psf(frame, PLACES, SIZE, background=0.0)
    assert line(star, "neighbours").startswith("neighbours: 1 star not given, modelled")
    assert error(star, 2.5) < 2e-5
    assert error(make_psf(frame, [*PLACES, target], SIZE, background=0.0), 2.5) > 4e-3


def test_a_star_with_a_hole_beside_a_neighbour_is_refused():
    frame = a_frame(4.0, [(60.2, 60.3), (85.1, 70.4)], [1.0, 0.4])
    y, x = np.indices(SHAPE)
    frame[np.hypot(x - 60, y - 60) < 8] = np.nan
    with pytest.raises(InputError, match="has too few good pixels among"):
        quiet(frame, (60, 60), 41)


@pytest.mark.parametrize("fwhm", [2.0, 4.0])
def test_two_stars_in_one_are_masked_as_no_neighbour(fwhm):
    other = np.array([PLACES[0]] * 2) + np.outer([6.0, 6.8], (fwhm, fwhm))
    star = make_psf(a_frame(fwhm, [PLACES[0], *other], [1.0, 0.2, 0.1]), PLACES[0], SIZE)
    assert line(star, "neighbours").endswith("0 stars not given, taken too; 1 other source masked")
    assert error(star, fwhm) < 0.02


@pytest.mark.exhaustive
@pytest.mark.parametrize(("n_given", "most"), [(9, 0.01), (1, 0.02)])
def test_stars_packed_within_the_window_are_not_its_wings(n_given, most):
    rng = np.random.default_rng(1)
    places = (70.0, 59.5) + 28 * np.array([(x, y) for x in (0, 1, -1) for y in (0, 1, -1)])
    places += rng.uniform(-0.5, 0.5, places.shape)
    frame = rng.poisson(50 + a_frame(4.0, places, 10 ** rng.uniform(0, 1, 9)))
    star = make_psf(frame, places[:n_given], 61)
    expected = gaussian(4.0, 30, 30, (61, 61))
    assert abs(star.psf - expected / expected.sum()).max() < most * expected.max()


def test_pixels_beyond_the_frame_are_left_to_other_stars():
    places = [*PLACES, (133.6, 60.2)]
    frame = a_frame(2.5, places, [*FLUXES, 0.9])
    star = make_psf(frame, places, SIZE, background=0.0)
    assert error(star, 2.5) < 2e-5
    with pytest.raises(InputError, match="give a size of 12 or less"):
        make_psf(frame, places[-1], SIZE, background=0.0)


def test_a_saturated_star_adds_wings_and_does_not_move_the_centre():
    rng = np.random.default_rng(5)
    places = [(60.62, 61.37), *PLACES]
    frame = rng.poisson(100.0 + a_frame(4.0, places, [20.0, *FLUXES]))
    star = make_psf(np.minimum(frame, 12_000), places, 31)
    assert "of them saturated" in line(star, "bad pixels")
    off = np.average(np.subtract(star.centres[1:], PLACES), axis=0, weights=FLUXES)
    assert abs(off).max() < 0.01
    expected = gaussian(4.0, 15, 15, (31, 31))
    assert abs(star.psf - expected).max() < 0.04 * expected.max()


def moffat(flux, x0, y0, side=96):
    """Return a Moffat function that is not round."""
    y, x = np.indices((side, side))
    return 0.06 * flux * (1 + ((x - x0) ** 2 + 1.2 * (y - y0) ** 2) / 9) ** -3.0


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", [1000, 1001, 1002])
def test_a_saturated_star_between_pixels_does_not_run_away(seed):
    """Half of the edge of its square lies beyond it: corrections of that did."""
    rng = np.random.default_rng(seed)
    places = np.array([(25.3, 30.2), (101.1, 27.4), (24.2, 102.3), (104.49, 98.02)])
    mean = 120.0 + sum(
        moffat(*each, 128) for each in zip((6e5, 4e5, 5e5, 9e6), *places.T, strict=True)
    )
    counts = (rng.poisson(mean) + rng.normal(0.0, 5.0, mean.shape)) / 2.0
    star, expected = make_psf(np.minimum(counts, 65535), places, 48), moffat(1.0, 24, 24, 48)
    expected /= expected.sum()
    assert abs(star.psf - expected).max() < 0.01 * expected.max()
    np.testing.assert_allclose(star.centres, places, rtol=0, atol=0.02)


@pytest.mark.exhaustive
def test_the_wings_of_a_saturated_star_settle():
    """Its flux, and so their share of the light, settles after tens of rounds."""

    places = np.array([(22.3, 25.2), (70.1, 24.4), (25.2, 72.3), (68.2, 70.1)])
    mean = 120.0 + sum(map(moffat, (6e5, 4e5, 5e5, 9e6), *places.T))
    expected, (y, x) = moffat(1.0, 16, 16, 33), np.indices((33, 33)) - 16
    wings, off = (np.hypot(x, y) > 5) & (np.hypot(x, y) < 13), []
    for seed in range(4):
        counts = np.random.default_rng(seed).poisson(mean) / 2.0
        psf = make_psf(np.minimum(counts, 65535), places, 33).psf
        off.append(psf[wings].sum() / expected[wings].sum() * expected.sum() - 1.0)
    assert abs(np.mean(off)) < 0.0015


def test_cosmic_rays_beside_stars_and_in_a_core_are_left_out():
    rng = np.random.default_rng(6)
    frame = rng.poisson(100.0 + a_frame(3.4)).astype(float)
    clean = make_psf(frame, PLACES, SIZE)
    frame[[70, 71, 50, 12, 88], [60, 61, 101, 20, 97]] += 3000.0  # the last in a core
    star = make_psf(frame, PLACES, SIZE)
    assert abs(star.psf - clean.psf).max() < 0.01 * clean.psf.max()
    np.testing.assert_allclose(star.centres, PLACES, rtol=0, atol=0.02)


def test_bad_and_saturated_pixels_are_left_to_other_stars():
    frame = a_frame(2.5)
    frame[30:32, 30:32] = 1e7
    frame[90, 46] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        star = make_psf(frame, PLACES, SIZE, background=0.0, saturation=1e6)
    assert error(star, 2.5) < 1e-3
    alone = quiet(frame, PLACES[0], SIZE, background=0.0, saturation=1e6)
    assert error(alone, 2.5) > 0.02


def test_all_angles_are_of_the_same_stars():
    frame = a_frame(3.0)
    straight, turned = make_psfs(frame, [0, 90], PLACES, SIZE, background=0.0)
    np.testing.assert_allclose(turned.psf, np.rot90(straight.psf, -1), rtol=0, atol=1e-12)
    np.testing.assert_allclose(turned.scatter, np.rot90(straight.scatter, -1), rtol=0, atol=1e-12)
    assert straight.shared_steps == turned.shared_steps


def test_a_star_at_a_place_without_light_is_refused():
    frame = np.random.default_rng(0).normal(0, 1, SHAPE) + a_frame(2.5)
    with pytest.raises(InputError, match=r"no star is found within 16 pixels of \(70, 65\)"):
        make_psf(frame, [*PLACES, (70, 65)], SIZE, background=0.0)


def test_stars_that_all_lack_their_middle_are_refused():
    frame = a_frame(4.0)
    for x, y in PLACES:
        frame[round(y) - 1 : round(y) + 2, round(x) - 1 : round(x) + 2] = np.nan
    with pytest.raises(InputError, match="no star shows the middle"):
        make_psf(frame, PLACES, SIZE, background=0.0)


def test_positions_of_another_shape_are_refused():
    for position in (
        [1.0, 2.0, 3.0],
        [[[1.0, 2.0]]],
        [[1.0, 2.0], [3.0, np.nan]],
        np.zeros((0, 2)),
    ):
        with pytest.raises(InputError, match="position is"):
            make_psf(a_frame(2.5), position)
