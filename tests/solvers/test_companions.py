"""Points beside stars that are held while PSFs are fitted: found where they are, and no others."""

import logging

import numpy as np
import pytest

import lnocl
from lnocl.core.runs.guarded_runs import GuardedRuns
from lnocl.core.runs.psf_refinement import mend
from lnocl.core.runs.start import Setup
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers import companions as room
from lnocl.core.solvers.companions import Companion, companions
from lnocl.core.solvers.halos import halo_errors
from lnocl.core.solvers.near_star import NearStar, Surroundings
from lnocl.core.solvers.psf_errors import CORRELATED

N, STAR, FLUX, LEVEL = 48, (23.3, 24.6), 1e6, 50.0
Y, X = np.indices((N, N), float)
R, SIDE = np.hypot(X - STAR[0], Y - STAR[1]), X - STAR[0]
WIDTHS, DEPTHS = (3.2, 3.6), (1.0, 0.6)
# 1.5 and 2.4 widths of the PSFs away, on both sides.
POINTS = {(27.6, 27.9): 3e4, (15.7, 21.9): 1e4}


def psf(width, skew=0.1):
    """Return a lopsided Moffat function of a full width at half maximum."""
    y, x = np.indices((31, 31)) - 15.0
    square = width**2 / 4 / (2 ** (1 / 3.5) - 1)
    values = (1 + (x**2 + 1.2 * y**2 + 0.2 * x * y) / square) ** -3.5
    values *= 1 + skew * np.tanh(x / width)
    return values / values.sum()


def observe(points=(), sky=None, wrong=1.0, skew=0.1, error=0.03):
    """Return images of a star, points and a sky, whose PSFs are not those that are given."""
    known = {"background": LEVEL, "psf_centre": "given", "exposure": DEPTHS, "psf_error": error}
    true = [psf(width, skew) for width in WIDTHS]
    stars = [STAR, *points]
    flat = Scene(lnocl.Observation(np.full((2, N, N), LEVEL), true, **known), stars)
    fluxes = np.array([FLUX, *dict(points).values()]) / flat.unit
    sky = np.zeros((N, N)) if sky is None else sky
    means = Model(flat).images(sky / flat.unit, fluxes) * flat.scale
    counts = np.random.default_rng(4).poisson(means)
    return lnocl.Observation(counts, [psf(wrong * width) for width in WIDTHS], **known)


def start(observation, sky=1.0):
    """Return an estimate that has the star, and the sky or a level."""
    sky = np.broadcast_to(sky, (N, N)) + 0.0
    return Estimate(Scene(observation, [STAR]), sky, np.array([FLUX]))


@pytest.mark.parametrize("wrong", [1.0, 1.03])
def test_points_are_found_where_they_are_though_psfs_are_wrong(wrong):
    estimate, found = companions(start(observe(POINTS, wrong=wrong)))
    assert len(found) == len(POINTS)
    np.testing.assert_array_equal(estimate.scene.stars[1:], [each.place for each in found])
    for place, flux in POINTS.items():
        point = min(found, key=lambda each, place=place: np.hypot(*(each.place - place)))
        flux_error, *errors = point.errors
        assert (abs(point.place - place) < 3 * np.array(errors)).all()
        assert max(errors) < 0.3
        assert abs(point.flux - flux) < 3 * flux_error
        assert flux_error < flux / 3


@pytest.mark.exhaustive
def test_a_point_that_is_likely_farther_off_is_taken_where_it_fits():
    place, flux = np.array([37.8, 19.2]), 1e4  # 4.5 widths
    observation = observe({tuple(place): flux}, wrong=1.03)
    estimate, found = companions(start(observation))
    assert not found
    assert estimate.scene.n_stars == 1
    beside = Companion(np.add(place, (0.7, -0.5)), 0.7 * flux, np.zeros(3), 9.0)
    none = Companion(np.array([9.0, 30.0]), 0.1 * flux, np.zeros(3), 8.0)
    with_it, [point] = companions(estimate, [beside, none, beside])
    assert with_it.scene.n_stars == 2
    np.testing.assert_allclose(point.place, place, rtol=0, atol=0.1)
    assert abs(point.flux - flux) < 3 * point.errors[0]
    assert point.errors[0] < 0.1 * flux
    assert point.significance == 9.0


@pytest.mark.exhaustive
def test_halos_that_are_not_known_are_in_the_errors_of_points():
    halo = np.exp(-((X - 27) ** 2 + (Y - 28) ** 2) / 4)
    observation = observe({(27.6, 27.9): 3e4}).replace(halos=halo)
    fluxes = np.array([FLUX, 100.0, 100.0])
    estimate = Estimate(Scene(observation, [STAR]), np.ones((N, N)), fluxes)
    _, [known] = companions(estimate)
    _, [found] = companions(estimate, raised=halo_errors(estimate).raised)
    assert found.errors[0] > 1.1 * known.errors[0]
    assert abs(found.flux - 3e4) < 3 * found.errors[0]


def light(values):
    return 3e5 * values / values.sum()


NONE = {
    "host": light(np.exp(-R / 4.0)),
    "ring": light(np.exp(-((R - 8) ** 2) / 6) * (1 + 0.6 * SIDE / (R + 1))),
    "jet": light(np.exp(-((SIDE - 7) ** 2) / 20 - (Y - STAR[1]) ** 2 / 8)),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("error", [0.03, 0.0])
@pytest.mark.parametrize("name", NONE)
def test_extended_sources_are_no_points(name, error):
    assert not companions(start(observe(sky=NONE[name], error=error), NONE[name]))[1]


@pytest.mark.exhaustive
@pytest.mark.parametrize("wrong", [{"wrong": 1.04}, {"skew": -0.05}, {"skew": 0.2}])
def test_errors_of_psfs_are_no_points(wrong):
    assert not companions(start(observe(**wrong)))[1]


def test_fluxes_are_those_of_least_squares_with_all_unknowns():
    estimate = start(observe(POINTS, wrong=1.02))
    near = NearStar(Surroundings(estimate, False), 0, 1e-3)
    near.prior[near.level, near.level] = 1e9  # which is not asked
    y, x = 14, 19
    fluxes, errors = room._points(near, estimate, (np.array([y]), np.array([x])))
    point = np.zeros(near.expected.shape)
    point[y, x] = 1.0
    n, rows, right = len(near.prior), [], []
    pixels, prior = near.fields[1].scatter, near.prior.copy()
    prior[near.level, near.level] = 0.0  # it may be any
    whole = near.source.images_of(near.expected + estimate.part(near.places(estimate.scene)))
    for image, scatter, seen, extended in zip(
        near.images, pixels, near.source.images_of(point), whole, strict=True
    ):
        columns = np.zeros((n + 1, image.left.size))
        columns[image.unknowns], columns[n] = image.slopes, seen.ravel()
        variance = 1 / image.precision + 2 * np.pi * (CORRELATED * scatter) ** 2
        rows.append(columns / np.sqrt(variance).ravel())
        right.append(((image.left + extended) / np.sqrt(variance)).ravel())
    roots = np.zeros((n + 1, n))
    roots[:n] = np.linalg.cholesky(prior + 1e-14 * np.eye(n))
    matrix = np.concatenate([*rows, roots], axis=1).T
    values = np.concatenate([*right, np.zeros(n)])
    solved = np.linalg.lstsq(matrix, values, rcond=None)[0]
    expected = np.sqrt(np.linalg.inv(matrix.T @ matrix)[-1, -1])
    assert fluxes[0] == pytest.approx(solved[-1], rel=1e-6)
    assert errors[0] == pytest.approx(expected, rel=1e-6)


def test_points_that_are_fitted_have_the_errors_that_limits_have():
    """A companion of a flux beside the star is found where it is three of them, and no less."""
    place, estimate = (28.2, 25.2), start(observe())
    errors = room.errors_beside(estimate)[1]
    error = errors[round(place[1]), round(place[0])]
    now = room.holding(estimate, [room.Companion(np.array(place), 5 * error)], 3.0)
    near = NearStar(Surroundings(now, True), 1, 1e-3)
    assert room.step_of(near, 1, 1)[1] * now.scene.unit == pytest.approx(error, rel=0.25)


def test_errors_beside_a_star_are_those_of_a_point_at_each_place():
    """Those typical of a distance were of a few points, and off by up to 1.6."""
    estimate = start(observe())
    errors, fitted, share = room.errors_beside(estimate)[:, :N, :N]
    near = NearStar(Surroundings(estimate, False), 0, 1e-3)
    away = R / near.resolution
    is_near = (away > 0.5) & (away <= 3.0)
    for each in (errors, fitted, share):
        assert (each[away > 3.0] == 0).all()
        assert np.isnan(each[away <= 0.5]).all()
    assert (fitted[is_near] > errors[is_near]).mean() > 0.9
    np.testing.assert_allclose(share[is_near], np.minimum(3.0 - away[is_near], 1.0))
    top, left = near.window[:2]
    y, x = np.nonzero(is_near)
    of_points = room._points(near, estimate, (y - top, x - left))[1] * estimate.scene.unit
    np.testing.assert_allclose(errors[y, x], of_points, rtol=0.01)
    exact = room.errors_beside(start(observe(error=0.0)))[0, :N, :N]
    beside = abs(away - 1) < 0.3
    assert (errors[beside] > 3 * exact[beside]).all()


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:held-out counts have chosen")
def test_a_companion_that_is_not_named_stays_out_of_the_psf(caplog):
    """One width away, beside a PSF 3 % too wide; a third of it went to the PSF."""
    place, flux = (26.5, 25.2), 2e4
    observation = observe({place: flux}, wrong=1.03)
    with caplog.at_level(logging.INFO, "lnocl"):
        result = lnocl.deconvolve(observation, [STAR], engine="numpy")
    (line,) = (each for each in caplog.messages if "beside stars held" in each)
    assert line.startswith("1 point beside stars held while PSFs are fitted, (26.")
    assert len(result.star_fluxes) == 1
    is_near = np.hypot(X - place[0], Y - place[1]) < 2.4
    assert result.extended[is_near].sum() == pytest.approx(flux, rel=0.12)
    assert abs(result.star_fluxes[0] - FLUX) < 2 * result.star_flux_errors[0]


@pytest.mark.exhaustive
def test_points_are_looked_for_through_psfs_without_the_noise_of_their_wings(monkeypatch):
    observation, seen = observe().replace(psf_error=0.03), []
    noise = 2e-4 * np.random.default_rng(2).standard_normal(observation.psfs.shape)
    noisy = observation.replace(psfs=observation.psfs + noise)

    def run(_, psfs, stars):
        seen.append(psfs)
        raise StopIteration

    monkeypatch.setattr(GuardedRuns, "steady", run)
    for each in (observation, noisy):
        setup = Setup(each, np.array([STAR]), 0, "sgp", "double", "numpy", None)
        with pytest.raises(StopIteration):
            mend(GuardedRuns(setup), ("jitter",), False, False)
    np.testing.assert_array_equal(seen[0], observation.psfs)
    assert noisy.psfs.min() < -1e-4
    assert seen[1].min() >= 0


def test_a_point_that_is_not_clear_alone_is_tried_with_the_next(monkeypatch):
    """A source beside it that is not found yet may hide it, and it that source."""
    estimate, seen = start(observe()), []
    points = [room.Companion(np.array(at), 1e4, significance=9.0) for at in ((27, 24), (20, 31))]
    last = room.Companion(np.zeros(2), 0.0)
    monkeypatch.setattr(room, "_likeliest", lambda *_: [*points, last][len(seen)])

    def with_points(_, tried, *more):
        seen.append(list(tried))
        return (estimate, tried) if len(tried) == 2 else None

    monkeypatch.setattr(room, "_with_points", with_points)
    assert room.companions(estimate)[1] == points
    assert seen == [points[:1], points]
