"""Sources beside the stars of a result: found, called a point or extended, and limited."""

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import lnocl
from lnocl.core.runs.injections import Injections
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.psf_errors import PsfErrors
from lnocl.detection.places import parted, random_pixels
from lnocl.detection.point_test import point_flux
from lnocl.errors import InputError
from lnocl.process import ignored_warnings
from lnocl.significance import Significance, significance

ROWS, COLUMNS = np.indices((33, 33)) - 16
RADIUS = np.hypot(ROWS, COLUMNS)
PSF = np.exp(-(RADIUS**2) / 4.5) + 0.02 * np.exp(-(RADIUS**2) / 50)
PSF /= PSF.sum()
N, SKY = 64, 20.0
STAR = (40.3, 22.6)


def point(x, y, flux, psf=PSF, n=N):
    """Return the light of a point, whose PSF is a sum of Gaussians, in a frame."""
    rows, columns = np.indices((n, n))
    distance = np.hypot(rows - y, columns - x)
    light = np.exp(-(distance**2) / 4.5) + 0.02 * np.exp(-(distance**2) / 50)
    return flux * light / (np.exp(-(RADIUS**2) / 4.5) + 0.02 * np.exp(-(RADIUS**2) / 50)).sum()


def seen(sky):
    """Return a sky as the PSF spreads it, round the edges of the frame."""
    kernel = np.fft.rfft2(np.fft.ifftshift(point(N // 2, N // 2, 1.0)))
    return np.fft.irfft2(np.fft.rfft2(sky) * kernel, (N, N)).clip(0)


def solve(light, stars=(), seed=0, **more):
    counts = np.random.default_rng(seed).poisson(SKY + light).astype(float)
    observation = lnocl.Observation(counts, PSF, background=SKY)
    options = {"stop": None, "n_iter": 15, "engine": "numpy", **more}
    return lnocl.deconvolve(observation, stars, **options)


@pytest.fixture(scope="module")
def result():
    """A star with a companion, a faint source, and a jet."""
    light = point(*STAR, 2e5) + point(52.4, 40.2, 2000) + point(12.7, 12.2, 700)
    rows, columns = np.indices((N, N))
    jet = (abs(rows - 46) < 1.5) * (columns > 8) * (columns < 34) * 1.0
    jet = ndimage.gaussian_filter(jet, 1.0)
    return solve(light + seen(8000 * jet / jet.sum()), [STAR], n_iter=60)


@pytest.fixture(scope="module")
def found(result):
    return result.significance()


def near(table, x, y, reach=1.5):
    return table[np.hypot(table["x"].value - x, table["y"].value - y) < reach]


@pytest.mark.parametrize(("distance", "flux"), [(1.1, 2e4), (1.5, 6e3)])
def test_companions_are_found_once_whose_ring_they_scatter(distance, flux):
    """Taken for an error of the PSF, the brighter the more, they had 0.5 of their light or none."""
    away = distance * 3.6 * np.array([0.6, -0.8])
    light = point(*STAR, 2e5) + point(*(STAR + away), flux)
    found = solve(light, [STAR], n_iter=60, smoothing=0.003).significance()
    [source] = found.detections
    assert source["kind"] == "point"
    assert source["significance"] > 10
    assert abs(source["flux"].value - flux) < 3 * source["flux_error"].value
    assert source["flux_error"].value < flux / 4
    for axis, at in zip(("x", "y"), STAR + away, strict=True):
        assert abs(source[axis].value - at) < 3 * source[f"{axis}_error"].value
        assert source[f"{axis}_error"].value < 0.3
    assert source["distance"].value == pytest.approx(distance * 3.6, abs=0.5)


@pytest.mark.parametrize(("x", "y", "flux"), [(52.4, 40.2, 2000), (12.7, 12.2, 700)])
def test_points_are_found_with_their_fluxes_and_places(found, x, y, flux):
    [source] = near(found.detections, x, y)
    assert source["kind"] == "point"
    assert abs(source["flux"].value - flux) < 3 * source["flux_error"].value
    assert source["flux_error"].value < flux / 5
    for axis, at in (("x", x), ("y", y)):
        assert abs(source[axis].value - at) < 4 * source[f"{axis}_error"].value
        assert source[f"{axis}_error"].value < 0.3
    assert source["star"] == 1
    assert source["distance"].value == pytest.approx(np.hypot(x - STAR[0], y - STAR[1]), abs=0.5)


def test_a_jet_is_called_extended(found):
    table = found.detections
    on_jet = abs(table["y"].value - 46) < 3
    assert on_jet.sum() >= 1
    assert (table["kind"][on_jet] == "extended").all()
    assert (table["kind"] == "point").sum() == 2


@pytest.mark.parametrize(("place", "is_point"), [((52.4, 40.2), True), ((20.0, 46.0), False)])
def test_the_extended_source_may_be_a_jet_but_no_point(result, place, is_point):
    """Nothing of a point is expected of the light round it; on the jet there is as much."""
    outcome = result._outcome
    flux, error = point_flux(outcome.estimate, np.array(place), 1000.0, False, np.zeros(0))
    assert (flux > 5 * error) == is_point
    assert (flux > 3 * error) == is_point
    if is_point:
        assert flux == pytest.approx(2000, rel=0.15)


def test_point_of_negative_flux_has_a_finite_flux_and_error(result):
    estimate = result._outcome.estimate
    flux, error = point_flux(estimate, np.array([20.0, 40.0]), -5.0, True, np.zeros(0))
    assert np.isfinite(flux)
    assert 0 < error < np.inf


def test_psf_error_raises_the_error_of_a_point_without_psf_slopes(result, monkeypatch):
    exact, found = result._outcome.estimate, []
    monkeypatch.delattr(PsfErrors, "slopes")
    scene = Scene(exact.scene.observation.replace(psf_error=0.03), exact.scene.places)
    assert scene.grid == exact.scene.grid
    for estimate in (exact, Estimate(scene, exact.sky, exact.star_fluxes)):
        found.append(point_flux(estimate, np.array([46.0, 27.0]), 1000.0, False, np.zeros(0)))
    (flux, error), (doubted, larger) = found
    assert larger > error
    assert doubted == pytest.approx(flux, abs=larger)


def test_detections_are_above_the_threshold_and_in_order(found):
    values = found.detections["significance"]
    assert (values > found.threshold).all()
    assert (np.diff(values) <= 0).all()
    assert np.isnan(found.signal_to_noise[23, 40])  # under the star
    assert np.isfinite(found.signal_to_noise).mean() > 0.85
    assert not found.signal_to_noise.flags.writeable


def test_all_wider_sources_are_called_extended(result):
    found = result.significance(width=5.0)
    assert len(found.detections)
    assert set(found.detections["kind"]) == {"extended"}
    assert near(found.detections, 20, 46, 14)["significance"].max() > 30


def test_a_wide_source_has_its_flux_at_its_width():
    rows, columns = np.indices((N, N))
    blob = np.exp(-((rows - 30) ** 2 + (columns - 33) ** 2) / (2 * 2.5**2))
    found = solve(seen(3000 * blob / blob.sum())).significance(width=2.5 * 2.3548)
    [source] = near(found.detections, 33, 30)
    assert source["flux"].value == pytest.approx(3000, rel=0.1)


def test_more_false_alarms_have_a_lower_threshold(result, found):
    lower = result.significance(false_alarms=1.0)
    assert 3 < lower.threshold < found.threshold
    assert len(lower.detections) >= len(found.detections)


def test_limits_rise_with_completeness_and_towards_the_star(found):
    half, most = found.limit(0.5), found.limit(0.95)
    tested = np.isfinite(half)
    assert (most[tested] >= half[tested]).all()
    curves = found.contrast_curves((0.5,))
    assert (curves["star"] == 1).all()
    assert curves["flux50"][0] > 3 * curves["flux50"][-1]
    expected = -2.5 * np.log10(curves["flux50"].value / found._outcome.star_fluxes[0])
    np.testing.assert_allclose(curves["magnitudes50"].value, expected)


def test_curves_have_whole_pixels_from_the_inner_working_angle_on(found):
    curves = found.contrast_curves(0.5)
    distance = curves["distance"].value
    assert distance.tolist() == list(range(int(distance[0]), int(distance[-1]) + 1))
    limits, (rows, columns) = found.limit(0.5), np.indices((N, N))
    away = np.hypot(columns - found._outcome.scene.stars[0, 0], rows - STAR[1])
    within = np.isfinite(limits)[abs(away - distance[0] + 1) <= 0.5]
    assert within.mean() < 0.5 <= curves["share"][0]
    [at_ten] = curves[distance == 10]
    ring = limits[abs(away - 10) <= 0.5]
    assert at_ten["flux50"].value == pytest.approx(np.nanmedian(ring), rel=0.05)


def test_curves_begin_where_half_of_a_ring_is_tested(found):
    maps, (rows, columns) = np.ones((2, N, N)), np.indices((N, N))
    maps[:, (np.hypot(columns - 30, rows - 30) < 7.5) & (columns > 28)] = np.nan
    assert next(found._rings(np.array([30.0, 30.0]), maps))[:2] == (8.0, 1.0)
    maps[:, columns > 32] = 1.0
    distance, share, *_ = next(found._rings(np.array([30.0, 30.0]), maps))
    assert distance < 8
    assert 0.5 <= share < 1


def test_rings_near_a_star_need_more_as_they_hold_few_independent_places(found):
    """Student's distribution asks for more than the threshold there, and not far off."""
    least = found.contrast_curves(0.5)["threshold"]
    assert least[0] > 1.2 * found.threshold
    assert least[-1] == pytest.approx(found.threshold, rel=0.05)


def test_far_curves_have_each_tenth_pixel(found, monkeypatch):
    monkeypatch.setattr("lnocl.significance.EACH_PIXEL", 7)
    distance = found.contrast_curves(0.5)["distance"].value
    assert distance[distance > 7].tolist() == [10, 20, 30, 40, 50]


def test_contrasts_of_detections_are_over_their_star(found):
    [source] = near(found.detections, 52.4, 40.2)
    of_star = found._outcome.star_fluxes[0]
    assert source["contrast"] == pytest.approx(source["flux"].value / of_star)
    assert source["contrast_error"] == pytest.approx(source["flux_error"].value / of_star)


@pytest.mark.exhaustive
def test_a_companion_does_not_limit_the_ring_that_it_lies_in():
    """In the sky it raised the error that points have there, to 12 times."""
    star = point(*STAR, 2e5)
    alone, beside = (
        solve(light, [STAR], n_iter=60, smoothing=0.003).significance().contrast_curves(0.5)
        for light in (star, star + point(46.3, 26.6, 6e3))
    )
    near = alone["distance"].value < 12
    assert alone["distance"][0] == beside["distance"][0]
    ratio = beside["flux50"][: near.sum()] / alone["flux50"][near]
    assert (ratio < 2.0).all()


def test_detected_point_does_not_raise_limits_around_it(found):
    """As part of the sky it raised limits to 50 times within ten pixels."""
    limits, (rows, columns) = found.limit(0.5), np.indices((N, N))
    away = np.hypot(columns - 52.4, rows - 40.2)
    assert found._with_points.scene.n_stars == 1 + (found.detections["kind"] == "point").sum()
    level = np.median(limits[4:10, 50:60])
    assert np.isnan(limits[40, 52])
    beside = (away > 4) & (away < 8)
    assert np.isfinite(limits[beside]).all()
    assert 0.8 * level < np.median(limits[beside]) < 1.3 * level


def test_the_limit_of_a_half_is_about_the_threshold(found):
    flat = np.s_[4:10, 50:60]
    snr = found.limit(0.5)[flat] / found.flux_error[flat]
    assert (abs(snr - found.threshold) < 1.0).all()


def test_limits_near_a_star_are_five_psf_errors_or_more(found, monkeypatch):
    """And, fitted, three above that and what the extended source may be; where the map has a share.

    With half of it they are the geometric mean of the map's and these.
    """
    error, limits = np.zeros(found._map.values.shape), []
    error[20:24, 43:46] = 1e5
    shares = (0, 0, 0), (1, 0, 1), (1, 1.5, 1), (1, 3, 1), (1, 3, 0.5), (1, 3, 0)
    for tried, fitted, share in shares:
        errors = np.array([tried * error, fitted * error, share * (error > 0)])
        monkeypatch.setattr("lnocl.significance.errors_beside", lambda *_, e=errors: e)
        limits.append(replace(found).limit(0.9))
    beside = error[:N, :N] > 0
    for after, least in zip(limits[1:4], (5, 5, 9), strict=True):
        np.testing.assert_allclose(after[beside], (least + 1.2815516) * 1e5)
        np.testing.assert_array_equal(after[~beside], limits[0][~beside])
    np.testing.assert_allclose(limits[4] ** 2, limits[0] * limits[3])
    np.testing.assert_array_equal(limits[5], limits[0])


def test_limits_pass_to_those_of_the_map_towards_three_resolutions():
    """They fell by 1.54 there."""
    counts = np.random.default_rng(0).poisson(SKY + point(*STAR, 1e5)).astype(float)
    observation = lnocl.Observation(counts, PSF, background=SKY, psf_error=0.03)
    result = lnocl.deconvolve(observation, [STAR], stop=None, n_iter=20, engine="numpy")
    found = result.significance()
    of_map = found._beside_points.needed(found._at_threshold, 0.5)[:N, :N]
    over, (rows, columns) = found.limit(0.5) / of_map, np.indices((N, N))
    away = np.hypot(columns - STAR[0], rows - STAR[1]) / found.resolution
    assert np.median(over[(away > 1.2) & (away < 1.8)]) > 1.05
    assert (over[(away > 2.8) & (away <= 3.0)] < 1.1).all()
    assert np.nanmax(over[away > 3.0]) == 1.0


def test_a_jet_limits_points_on_it(found):
    limits = found.limit(0.5)
    assert limits[46, 20] > 3 * limits[6, 55]


@pytest.mark.exhaustive
def test_sources_at_the_limit_are_found_as_often_as_it_says():
    """40 of them, so that the share has an error of 8 %; a limit twice as faint finds few."""
    found = solve(point(*STAR, 1e5), [STAR], 1).significance(false_alarms=0.1)
    table = found.inject(40, 0.5, seed=3)
    assert 0.3 <= table["found"].mean() <= 0.7
    assert found.inject(40, 0.97, seed=4)["found"].mean() > 0.85


def test_sources_that_are_put_in_have_their_counts(result):
    injections = Injections(result._outcome, 0.0)
    rng = np.random.default_rng(0)
    counts = injections._counts(np.array([[20.3, 30.8]]), np.array([1e6]), rng)
    assert counts.shape == (1, N, N)
    np.testing.assert_allclose(counts[0], point(20.3, 30.8, 1e6), atol=1200)
    assert counts.sum() == pytest.approx(1e6, rel=0.01)
    wide = Injections(result._outcome, 4.0)._counts(np.array([[20.3, 30.8]]), np.array([1e6]), rng)
    assert wide.max() < 0.7 * counts.max()
    assert wide.sum() == pytest.approx(1e6, rel=0.01)


def test_places_lie_apart_and_where_they_may():
    weights = np.zeros((50, 60))
    weights[5:40, 5:30], weights[5:40, 30:50] = 3.0, 1.0
    places = random_pixels(weights, 400, np.random.default_rng(2))
    assert (weights[*places.T] > 0).all()
    assert np.mean(weights[*places.T] == 3) == pytest.approx(75 / 95, abs=0.06)
    groups = list(parted(places, 10.0))
    assert sorted(i for group in groups for i in group) == list(range(400))
    for group in groups:
        away = np.hypot(*(places[group][:, None] - places[group]).transpose(2, 0, 1))
        assert (away[np.triu_indices(len(group), 1)] > 10).all()
    assert len(groups[0]) > 5


@pytest.mark.parametrize("has_star", [True, False])
def test_sources_are_put_in_where_curves_are_drawn(found, has_star, monkeypatch):
    """As many at 4 to 8 pixels from a star as at 8 to 16, with the limits of their places."""
    monkeypatch.setattr(Injections, "__init__", lambda *_: None)
    monkeypatch.setattr(Injections, "reconstruct", lambda *_: None)
    monkeypatch.setattr(Significance, "_finds", lambda self, places, _: places[:, 0] > 30)
    if not has_star:
        found = solve(np.zeros((N, N))).significance()
    table = found.inject(800, 0.5, seed=1)
    x, y, distance = (table[name].value for name in ("x", "y", "distance"))
    assert (table["found"] == (x > 30)).all()
    pixels = np.round([y, x]).astype(int)
    assert np.median(table["flux"].value / found.limit(0.5)[*pixels]) == pytest.approx(1, abs=0.05)
    if has_star:
        np.testing.assert_allclose(distance, np.hypot(*(x, y) - found._outcome.scene.stars.T))
        counts = np.histogram(distance, [4, 8, 16])[0]
        assert counts[0] == pytest.approx(counts[1], rel=0.25)
    else:
        assert np.isinf(distance).all()
        assert np.mean(x > 31.5) == pytest.approx(0.5, abs=0.06)


def test_bad_pixels_and_a_finer_sky():
    counts = np.random.default_rng(0).poisson(SKY + point(20.2, 40.6, 900)).astype(float)
    mask = np.zeros((N, N), bool)
    mask[:, 44:] = True
    mask[40, 20] = True
    psf = np.zeros((66, 66))
    rows, columns = np.indices((66, 66)) - 33
    radius = np.hypot(rows, columns) / 2
    psf = np.exp(-(radius**2) / 4.5) + 0.02 * np.exp(-(radius**2) / 50)
    observation = lnocl.Observation(counts, psf, background=SKY, mask=mask, oversample=2)
    result = lnocl.deconvolve(observation, stop=None, n_iter=15, engine="numpy")
    found = result.significance()
    assert found.signal_to_noise.shape == (2 * N, 2 * N)
    assert np.isnan(found.signal_to_noise[:, 100:]).all()
    [source] = near(found.detections, 20.2, 40.6, 1.0)
    assert abs(source["flux"].value - 900) < 3 * source["flux_error"].value
    for axis, at in (("x", 20.2), ("y", 40.6)):
        assert abs(source[axis].value - at) < 0.2


def test_source_common_to_rotated_images_is_detected(result):
    angle = np.deg2rad(30.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    middle = np.full(2, (N - 1) / 2)
    there = turn @ (np.array([24.0, 36.0]) - middle) + middle
    rng = np.random.default_rng(4)
    images = [rng.poisson(SKY + point(*at, 900)) for at in ((24.0, 36.0), there)]
    maps = [np.hstack([t, (middle - t @ middle)[:, None]]) for t in (np.eye(2), turn)]
    observation = lnocl.Observation(np.array(images), PSF, background=SKY, transforms=maps)
    outcome = lnocl.deconvolve(observation, stop=None, n_iter=10, engine="numpy")
    [source] = near(outcome.significance().detections, 24.0, 36.0)
    assert source["flux"].value == pytest.approx(900, abs=3 * source["flux_error"].value)
    assert source["significance"] > 10


@pytest.mark.parametrize("seed", range(3))
def test_a_point_in_images_of_two_scales_is_found_once(seed):
    """Where the deep image's PSF is three times as wide as the other: at 9 standard deviations."""
    rng, sides, place = np.random.default_rng(seed), (N, 22), np.array([30.3, 34.6])
    linear = lnocl.rotations([20.0], (0, 0))[0, :, :2] / 2.8
    maps = np.array([np.eye(2, 3), np.column_stack([linear, (10.5, 10.5) - linear @ (31.5, 31.5)])])
    exposures, means = np.array([1.0, 30.0]), SKY * np.array([1.0, 30.0 * 2.8**2])
    lights = []
    for to_image, side, exposure in zip(maps, sides, exposures, strict=True):
        x, y = to_image[:, :2] @ place + to_image[:, 2]
        rows, columns = np.indices((side, side))
        light = np.exp(-((columns - x) ** 2 + (rows - y) ** 2 / 0.8) / 3.0)
        light += 0.2 * np.exp(-((columns - x - 1.5) ** 2 + (rows - y + 1.0) ** 2) / 3.0)
        lights.append(exposure * light / (3.0 * np.pi * (0.8**0.5 + 0.2)))
    information = sum((p**2).sum() / m for p, m in zip(lights, means, strict=True))
    flux = 9.0 / np.sqrt(information)
    images = [rng.poisson(m + flux * p) * 1.0 for m, p in zip(means, lights, strict=True)]
    y, x = np.mgrid[-8:9, -8:9]
    psf = np.exp(-(x**2 + y**2 / 0.8) / 3.0)
    psf += 0.2 * np.exp(-((x - 1.5) ** 2 + (y + 1.0) ** 2) / 3.0)
    known = {"background": means, "exposure": exposures, "transforms": maps}
    observation = lnocl.Observation(images, [psf, psf], psf_centre="given", **known)
    result = lnocl.deconvolve(observation, stop=None, n_iter=10, engine="numpy")
    [source] = result.significance().detections
    assert source["kind"] == "point"
    assert np.hypot(source["x"].value - place[0], source["y"].value - place[1]) < 1.5
    assert source["flux"].value == pytest.approx(flux, abs=3 * source["flux_error"].value)
    # The level of the sky takes a twelfth of the information.
    assert flux / source["flux_error"].value == pytest.approx(9.0 * np.sqrt(11 / 12), rel=0.06)


@pytest.mark.exhaustive
@pytest.mark.parametrize("mix", ["faint", "depths", "bars", "scales", "coarse"])
def test_images_that_differ_raise_as_many_alarms_as_stated(mix):
    """Of 8 fields, 2 in each; a point is found once in each of the same."""
    scenes = Path(__file__).parents[1] / "benchmarks" / "mixes.py"
    measure = runpy.run_path(str(scenes))["measure"]
    rows = np.array([measure((mix, 2.0, 600 + seed)) for seed in range(8)], float)
    assert rows[:, 0].mean() == pytest.approx(2.0, abs=3 * np.sqrt(2.0 / 8))
    assert (rows[:, 1] == 1).sum() >= 7
    assert (rows[:, 2] == 1).sum() >= 7
    assert np.median(rows[:, 3]) < 1.3 * np.median(rows[:, 4])
    assert 0.85 * 9.0 < rows[:, 5].mean() < 9.3


def test_a_field_in_which_nothing_is_tested_is_refused(result):
    with pytest.raises(InputError, match="nowhere do the images tell a source of width 63 pixels"):
        result.significance(width=63.0)


LIMIT_TITLE = "flux that is found with a probability of 50 %"


def test_the_picture_has_the_map_the_limits_and_the_curves(found):
    figure = found.plot()
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles[0].startswith(f"points: {len(found.detections)} above {found.threshold:.2f}")
    curves = f"limits at {found.threshold:.2f} sigma, near a star by Student's t"
    for title, begin in zip(titles[1:], (LIMIT_TITLE, curves), strict=True):
        assert title.startswith(begin)
    figure.draw_without_rendering()
    maps = [axes for axes in figure.axes if axes.images]
    for each in maps:  # colour bars have labels, not powers of ten alone
        (bar,) = each.child_axes
        low, high = bar.get_ylim()
        assert sum(low <= y <= high for y in bar.get_yticks()) >= 3
    axes = {axes.get_ylabel(): axes for axes in figure.axes}
    curves, magnitudes = axes["contrast"], axes["magnitudes below the star"]
    assert curves.get_xlabel() == "separation (pixels)"
    np.testing.assert_allclose(magnitudes.get_ylim(), -2.5 * np.log10(curves.get_ylim()))
    marked = {(*line.get_xydata()[0],) for line in curves.lines if len(line.get_xydata()) == 1}
    bright = found.detections[found.detections["contrast"] > 0]
    points = set(zip(bright["distance"].value, bright["contrast"], strict=True))
    assert len(points) >= 3
    assert points <= marked
    iwa = found.contrast_curves(0.5)["distance"][0].value
    assert f"inner working angle: {iwa:g} pixels" in curves.get_legend_handles_labels()[1]


def test_one_probability_has_its_curves(found):
    one, listed = found.contrast_curves(0.7), found.contrast_curves([0.7])
    assert one.colnames == listed.colnames
    assert one.colnames[4:] == ["flux70", "contrast70", "magnitudes70"]
    assert (one["flux70"] == listed["flux70"]).all()


def test_a_star_without_light_has_no_curve_in_the_picture():
    observation = lnocl.Observation(np.full((24, 24), 50.0), PSF, background=50.0)
    with ignored_warnings():
        result = lnocl.deconvolve(observation, [(9, 11)], stop=None, n_iter=5, engine="numpy")
    titles = [axes.get_title() for axes in result.significance().plot().axes if axes.get_title()]
    (title,) = titles[1:]
    assert title.startswith(LIMIT_TITLE)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r.significance(width=-1), "width must be a finite number of pixels, 0 or more"),
        (lambda r: r.significance(width=np.inf), "width must be"),
        (lambda r: r.significance(false_alarms=0), "1e-200 to 10, such as 0.01; 0 was"),
        (lambda r: r.significance(false_alarms=11), "1e-200 to 10"),
        (lambda r: r.significance(false_alarms=5e-324), "1e-200 to 10"),
        (
            lambda r: r.significance().contrast_curves(None),
            "completeness must be between 0 and 1; ",
        ),
        (
            lambda r: r.significance().contrast_curves("ab"),
            "completeness must be between 0 and 1; ",
        ),
        (lambda r: r.significance().contrast_curves([[0.5]]), "completeness must be between 0 and"),
        (lambda r: r.significance().limit(1.0), "completeness must be between 0 and 1; 1.0"),
        (lambda r: r.significance().inject(0), "injections must be a whole number, 1 or more"),
        (lambda r: r.significance().inject(3, 0.5, -1), "seed must be a whole number"),
    ],
)
def test_wrong_arguments_are_refused(result, call, message):
    with pytest.raises(InputError, match=message):
        call(result)


def test_the_function_is_that_of_the_method(result, found):
    again = significance(result._outcome, 0.0, 0.01)
    np.testing.assert_array_equal(again.signal_to_noise, found.signal_to_noise)


def test_field_of_equal_psfs_gives_the_detections_of_a_single_psf(result, found):
    field = lnocl.PsfField(np.array([PSF] * 4), [(0, 0), (N, 0), (0, N), (N, N)])
    images = result._outcome.observation.images
    observation = lnocl.Observation(images, field, background=SKY)
    options = {"stop": None, "n_iter": 60, "engine": "numpy"}
    again = lnocl.deconvolve(observation, [STAR], **options).significance()
    for name in ("signal_to_noise", "flux", "flux_error"):
        here, there = getattr(again, name), getattr(found, name)
        np.testing.assert_allclose(here, there, rtol=1e-6, atol=1e-4)
