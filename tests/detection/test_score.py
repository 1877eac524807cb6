"""The score of a source, its noise and its threshold, against matrices, formulae and counts."""

from typing import NamedTuple

import numpy as np
import pytest
import scipy.stats
import turned_scenes
from scenes import blur
from scipy import ndimage

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import Scene
from lnocl.detection.completeness import needed
from lnocl.detection.false_alarms import Rarity, of_student, threshold
from lnocl.detection.maxima import peaks
from lnocl.detection.score import Null
from lnocl.detection.score_map import ScoreMap
from lnocl.detection.score_noise import noise_of

NO_ERRORS = np.zeros(1), np.zeros(0)
ROWS, COLUMNS = np.indices((9, 9)) - 4
CORES = [np.exp(-(ROWS**2 + COLUMNS**2 + 0.3 * k * ROWS * COLUMNS) / 3) for k in (0, 1)]
# Without symmetry, each with a ghost on another side.
PSFS = np.array(
    [core + 0.3 * np.roll(core, (1, 2 - 4 * k), (0, 1)) for k, core in enumerate(CORES)]
)
STARS = [(10.2, 9.7), (14.0, 12.5)]
FLUXES = np.array([3000.0, 800.0])
N = 32


def scene_of(stars=STARS, exposure=1.0, **more):
    rng = np.random.default_rng(3)
    shares = more.get("transmission", np.ones((2, N, N)))
    level = [blur(share, psf) for share, psf in zip(shares, PSFS, strict=True)]
    images = rng.poisson(5.0 + 25.0 * np.array(level)).astype(float)
    observation = lnocl.Observation(images, PSFS, background=5.0, exposure=exposure, **more)
    for j in range(2):
        for s, star in enumerate(Scene(observation, stars).star_field.cutouts[j]):
            images[j][star.window((N, N))] += rng.poisson(FLUXES[s] * star.values.clip(0))
    observation = lnocl.Observation(images, PSFS, background=5.0, exposure=exposure, **more)
    return Scene(observation, stars)


def dark_null(scene, fluxes, moves=False, errors=NO_ERRORS):
    """Return that of stars alone."""
    return Null(Estimate(scene, np.zeros(scene.grid), fluxes), moves, errors)


def matrices(scene):
    """Return what a point at each place, and each star, adds to the images: dense, in electrons."""
    points = np.zeros((2, N, N, N, N))
    share = np.ones(points.shape[:3]) if scene.transmission is None else scene.transmission
    for j in range(2):
        psf = scene.psf(j)
        for y in range(N):
            for x in range(N):
                points[j, :, :, y, x] = share[j, y, x] * np.roll(psf, (y, x), (0, 1))
    stars = np.array([[scene.star_image(j, s) for s in range(2)] for j in range(2)])
    return points.reshape(2 * N * N, N * N), stars.transpose(0, 2, 3, 1).reshape(2 * N * N, 2)


# Dimmed to the right, the second image less; dark in a hole beside the edge.
SHARES = np.linspace(1.0, [0.3, 0.6], N).T[:, None] * np.ones((N, 1))
SHARES[:, 22:29, 3:10] = 0.0


@pytest.mark.parametrize(
    ("sky", "known"),
    [
        (np.zeros((N, N)), {}),
        (np.full((N, N), 25.0), {}),
        (np.full((N, N), 25.0), {"transmission": SHARES}),
    ],
    ids=["dark", "level", "transmission"],
)
def test_score_and_information_are_those_of_matrices(sky, known):
    """Stars and level are projected out of the design, with the weights that the null has."""
    scene = scene_of(**known)
    null = Null(Estimate(scene, sky, FLUXES), False, NO_ERRORS)
    assert not null.is_structured.any()
    found = null.score()
    points, stars = matrices(scene)
    seen = points.sum(axis=1)
    precision = np.concatenate([each.ravel() for each in null._linear.precisions]) * scene.scale
    left = np.concatenate([each.ravel() for each in null._linear.residuals]) * scene.scale
    gram = stars.T @ (precision[:, None] * stars)
    shared = stars.T @ (precision[:, None] * points)
    solved = np.linalg.solve(gram, shared)
    score = points.T @ left - solved.T @ (stars.T @ left)
    information = (points**2).T @ precision - (shared * solved).sum(axis=0)
    flat = points.T @ (seen * precision) - solved.T @ (stars.T @ (seen * precision))
    distance = np.hypot(*(np.minimum(each, N - each) for each in np.indices((N, N))))
    disc = distance <= null.disc
    mean = (
        np.array([np.roll(disc, divmod(k, N), (0, 1)).ravel() for k in range(N * N)]) / disc.sum()
    )
    expected = score - flat * (mean @ score) / (mean @ flat)
    tested = found.is_tested.ravel()
    assert 0.6 * N * N < tested.sum() < N * N
    np.testing.assert_allclose(found.score.ravel()[tested], expected[tested], atol=2e-3)
    # Shares of the level are those of even noise: 1 and 2 - (its own spread).
    level = flat**2 / (mean @ flat) / disc.sum()
    ratio = (information - found.information.ravel())[tested] / level[tested]
    assert ratio.min() > 0.9
    assert ratio.max() < 1.1


@pytest.mark.parametrize("column", [0, 10, N - 1])
def test_where_psfs_vary_a_score_is_that_of_the_psf_of_its_place(column):
    """At nodes but for the size of the disc; between, the information is 1.3 % more here."""
    rng, wider = np.random.default_rng(4), 0.4 * PSFS[0] + 0.6 * PSFS[1]
    images = rng.poisson(30.0, (N, N)).astype(float)
    field = lnocl.PsfField([PSFS[0], wider], [(0, 0), (N - 1, 0)])
    found, expected = (
        dark_null(Scene(each, [], pad=4), np.zeros(0)).score()
        for each in (
            lnocl.Observation(images, psfs, background=30.0, psf_centre="given")
            for psfs in (field, field.at(column, 0))
        )
    )
    rtol = 2e-3 if column in (0, N - 1) else 0.02
    for name in ("score", "information", "values"):
        here, there = (getattr(each, name)[:N, column] for each in (found, expected))
        np.testing.assert_allclose(here, there, rtol=rtol, atol=rtol * abs(there).max())
    assert found.is_tested[:N, :N].mean() > 0.9


def lopsided(dx, dy):
    """Return a PSF of a Gaussian and a ghost beside it."""
    core = turned_scenes.gaussian(dx, dy, np.array([[2.6, 0.5], [0.5, 1.7]]))
    return 0.8 * core + 0.2 * turned_scenes.gaussian(dx - 2.1, dy + 1.4, np.diag([2.0, 3.0]))


def test_scores_of_turned_images_and_their_information_are_explicit_sums():
    """One image as it is, and one turned, of larger pixels and thrice as deep, by formulae.

    Pixels that are shared out widen squares of PSFs by a sixth of a pixel^2, where weights vary.
    """
    n, side, rng = 40, 24, np.random.default_rng(5)
    linear = lnocl.rotations([20.0], (0, 0))[0, :, :2] / 1.7
    maps = np.array([np.eye(2, 3), np.column_stack([linear, (side / 2, 11.0) - linear @ (20, 20)])])
    y, x = np.mgrid[-9:10, -9:10]
    means, exposures = [40.0, 90.0], np.array([1.0, 3.0])
    images = [rng.poisson(m, (k, k)) * 1.0 for m, k in zip(means, (n, side), strict=True)]
    known = {"background": means, "exposure": exposures, "transforms": maps}
    psfs = [lopsided(x, y), lopsided(-y, x)]
    scene = Scene(lnocl.Observation(images, psfs, psf_centre="given", **known), [])
    null = dark_null(scene, np.zeros(0))
    linear = null._linear
    score, information = np.zeros((2, 30))
    places = rng.integers(8, 32, (30, 2))
    for j, psf in enumerate((lopsided, lambda dx, dy: lopsided(-dy, dx))):
        rows, columns = np.indices(scene.image_grid)
        for i, place in enumerate(places):
            at = maps[j, :, :2] @ place + maps[j, :, 2]
            light = exposures[j] / scene.mean_exposure * psf(columns - at[0], rows - at[1])
            score[i] += (light * linear.residuals[j]).sum()
            information[i] += (light**2 * linear.precisions[j]).sum()
    at = places[:, 1], places[:, 0]
    found = null._adjoint(linear.residuals)[at]
    np.testing.assert_allclose(found, score, atol=3e-3 * abs(score).max())
    found = null._sum_of_powers(linear.precisions, 2)[at]
    np.testing.assert_allclose(found, information, rtol=0.02)


@pytest.mark.parametrize("sigma", [1.0, 3.5])
def test_an_image_without_information_changes_nothing(sigma):
    """Sharper or wider than the other, of 1e-7 of its depth."""
    rows, columns = np.indices((25, 25)) - 12
    psfs = [np.exp(-(rows**2 + columns**2) / (2.0 * s**2)) for s in (2.0, sigma)]
    images = np.random.default_rng(0).poisson(100.0, (2, 64, 64)).astype(float)
    images[1] = 100.0
    both = lnocl.Observation(images, psfs, background=[100.0, 100.0], exposure=[1.0, 3e-4])
    alone = lnocl.Observation(images[:1], psfs[0], background=100.0)
    maps = [ScoreMap(dark_null(Scene(each, []), np.zeros(0)), 0.0) for each in (alone, both)]
    one, other = maps
    assert other.threshold(0.01) == pytest.approx(one.threshold(0.01), abs=2e-3)
    np.testing.assert_allclose(other.values, one.values, atol=0.02)
    np.testing.assert_allclose(other.score.correlation, one.score.correlation, atol=1e-3)


@pytest.mark.parametrize(("deep", "sigma"), [(1.0, 3.0), (30.0, 6.0)])
def test_the_curvature_is_that_of_the_noise(deep, sigma):
    """Of images of other depths and widths: squares of differences of neighbours, of ten fields."""
    rows, columns = np.indices((49, 49)) - 24
    psfs = [np.exp(-(rows**2 + 0.6 * columns**2) / (2.0 * s**2)) for s in (1.3, sigma)]
    means = np.array([40.0, 40.0 * deep])
    steps = []
    for seed in range(10):
        images = np.random.default_rng(seed).poisson(means[:, None, None], (2, 80, 80)) * 1.0
        observation = lnocl.Observation(images, psfs, background=means, exposure=[1.0, deep])
        scene = Scene(observation, [])
        score = dark_null(scene, np.zeros(0)).score()
        values = np.where(score.is_tested, score.values, np.nan)
        steps.append([np.nanmean(np.diff(values, axis=axis) ** 2) for axis in (0, 1)])
    # A difference is less than a slope, by the mean of (2 sin(k / 2) / k)^2.
    expected = np.diag(score.curvature[:, :, 40, 40])
    found = np.mean(steps, axis=0)
    assert (found < 1.03 * expected).all()
    assert (found > 0.84 * expected).all()


def test_an_edge_has_alarms_of_its_own():
    """White noise, smoothed by seven pixels: 800 fields of 40 pixels, of which none is periodic."""
    rng, n, sigma, margin = np.random.default_rng(2), 40, 3.0, 12
    least = threshold(0.5, n * n / (2.0 * sigma**2), 4 * n / (np.sqrt(2.0) * sigma))
    found = 0
    for _ in range(800):
        field = rng.standard_normal((n + 2 * margin, n + 2 * margin))
        field = ndimage.gaussian_filter(field, sigma)[margin:-margin, margin:-margin]
        field *= 2.0 * sigma * np.sqrt(np.pi)
        is_peak = field == ndimage.maximum_filter(field, 3, mode="constant", cval=-np.inf)
        found += np.count_nonzero(is_peak & (field > least))
    assert found / 800 == pytest.approx(0.5, abs=3 * np.sqrt(0.5 / 800))


def test_score_of_a_blended_maximum_matches_a_joint_fit():
    """Values of independent noise with a Gaussian's correlation, fitted by all points at once."""
    null = dark_null(scene_of(), FLUXES)
    found, places = ScoreMap(null, 0.0), np.array([[10.0, 10.0], [12.3, 10.6], [9.1, 13.0]])
    gram = found._correlated(places[:, None] - places)
    values = gram @ (5.0, 40.0, 20.0)  # of three points, the first the faintest
    error = np.sqrt(np.linalg.inv(gram)[0, 0])
    assert found._beside(places, values) == pytest.approx(5.0 / error, rel=1e-6)
    assert found._beside(places, gram @ (0.0, 40.0, 20.0)) == pytest.approx(0.0, abs=1e-6)


def test_stars_have_the_information_of_explicit_products():
    """Of two images, one across the edge of the grid, with their places."""
    scene = scene_of([(1.2, 30.4), (6.7, 30.9)])
    null = dark_null(scene, FLUXES, True)
    stars, precisions = null.stars, null._linear.precisions
    laid = np.array([[each.on_grid((N, N)) for each in images] for images in stars._cutouts])
    laid = laid.reshape(2, 2, 3, -1)
    expected = np.einsum("jskn,jn,jtln->kslt", laid, np.reshape(precisions, (2, -1)), laid)
    found = stars._gram(precisions).block(slice(None))
    np.testing.assert_allclose(found, expected.reshape(6, 6), rtol=1e-9)


@pytest.mark.parametrize("turn", [None, 30.0])
def test_a_psf_that_rings_below_the_sky_leaves_no_place_untold(turn):
    """A star of 1e7 through a PSF of 1.5 pixels: the model is negative beside it."""
    rows, columns = np.indices((25, 25)) - 12
    psf = np.exp(-(rows**2 + columns**2) / (2.0 * 0.637**2))
    images = np.random.default_rng(0).poisson(20.0, (1, 64, 64)).astype(float)
    known = {} if turn is None else {"transforms": lnocl.rotations([turn], (31.5, 31.5))}
    scene = Scene(lnocl.Observation(images, psf, background=20.0, **known), [(31.3, 30.6)])
    errors = np.array([0.0, 4.0, 90.0]), np.array([0.03, 0.02])
    null = dark_null(scene, np.array([1e7]), errors=errors)
    found = ScoreMap(null, 0.0)
    assert (found.score.of_psfs >= 0).all()
    assert np.isfinite(found.significance[found.score.is_tested]).all()
    rows, columns = np.indices(scene.grid)
    far = (np.hypot(rows - 30.6, columns - 31.3) > 22) & (rows < 58) & (columns < 58)
    assert found.score.is_tested[far & (rows > 6) & (columns > 6)].mean() > 0.95


def test_sky_without_counts_is_tested():
    """And leaves what lies beside it as it is: there a variance of 0 would be all information."""
    images = np.random.default_rng(0).poisson(0.5, (1, 64, 64)).astype(float)
    images[:, :, 20:] = 0.0
    scene = Scene(lnocl.Observation(images, PSFS[:1]), [])
    found = ScoreMap(dark_null(scene, np.zeros(0)), 0.0)
    assert np.isfinite(found.significance[2:-2, 2:-2]).all()
    assert found.significance[2:-2, 26:-8].max() < 1.5


def test_the_score_is_that_of_units_and_exposures():
    """Twice the exposure on half the flux is the same score, in units of its noise."""
    one, other = (
        ScoreMap(
            dark_null(scene_of(exposure=e), FLUXES / e),
            0.0,
        )
        for e in (1.0, 2.0)
    )
    np.testing.assert_allclose(one.values, other.values, atol=1e-6)
    np.testing.assert_allclose(one.errors, 2.0 * other.errors, rtol=1e-6)


def test_permuted_images_have_the_same_score():
    scene = scene_of()
    observation = scene.observation
    swapped = lnocl.Observation(observation.images[::-1], PSFS[::-1], background=5.0)
    one, other = (
        ScoreMap(dark_null(each, FLUXES), 0.0).values for each in (scene, Scene(swapped, STARS))
    )
    np.testing.assert_allclose(one, other, atol=1e-9)


def test_stars_that_moved_take_more_of_the_information():
    found = [dark_null(scene_of(), FLUXES, moves).score().information for moves in (False, True)]
    held, moved = found
    both = np.isfinite(held) & np.isfinite(moved)
    assert np.isfinite(moved).sum() < np.isfinite(held).sum()
    assert (moved[both] < held[both] * (1 + 1e-3)).all()  # of the level there is a little less
    assert (moved[both] < 0.95 * held[both]).any()


def test_stars_at_one_place_are_one():
    scene = scene_of([STARS[0], STARS[1]])
    scene.move_stars([STARS[0], STARS[0]])
    found = dark_null(scene, FLUXES).score()
    alone = dark_null(scene_of([STARS[0]]), FLUXES[:1]).score()
    assert np.isfinite(found.score).all()
    assert (found.is_tested == alone.is_tested).mean() > 0.95


@pytest.mark.exhaustive
@pytest.mark.parametrize(("degrees", "scale"), [(0.0, 1.0), (20.0, 1.0), (44.0, 1.0), (20.0, 2.0)])
def test_values_of_turned_images_scatter_as_noise_does(degrees, scale):
    """With a PSF that has wings and is cut off, which shears make ring; and fluxes are right."""
    n, angle = 64, np.deg2rad(degrees)
    rows, columns = np.indices((25, 25)) - 12
    radius = np.hypot(rows, columns)
    psf = np.exp(-(radius**2) / 6) + 0.02 * np.exp(-(radius**2) / 50)
    psf /= psf.sum()
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / scale
    middle = np.full(2, (n - 1) / 2)
    maps = [np.hstack([turn, (middle - turn @ middle)[:, None]])]
    place = np.array([38.0, 27.0])
    values, fluxes = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        images = rng.poisson(50.0, (1, n, n)).astype(float)
        observation = lnocl.Observation(images, psf, background=50.0, transforms=maps)
        scene = Scene(observation, [])
        score = dark_null(scene, np.zeros(0)).score()
        values.append(np.where(score.is_tested, score.values, np.nan))
        star = scene.with_star(place).star_image(0, 0)[:n, :n]
        images[0] += rng.poisson(900.0 * star.clip(0))
        found = lnocl.Observation(images, psf, background=50.0, transforms=maps)
        null = dark_null(Scene(found, []), np.zeros(0))
        fluxes.append(ScoreMap(null, 0.0).fluxes[27, 38])
    assert np.nanmean(np.square(values)) == pytest.approx(1.0, abs=0.08)
    assert np.mean(fluxes) == pytest.approx(900.0, rel=0.06)


@pytest.mark.exhaustive
def test_values_scatter_as_noise_does():
    """The variance of 40 fields, near stars and away from them; their mean is 0."""
    values = []
    for seed in range(40):
        images = np.random.default_rng(seed).poisson(30.0, (1, 64, 64)).astype(float)
        scene = Scene(lnocl.Observation(images, PSFS[:1], background=30.0), [(30.3, 33.1)])
        score = dark_null(scene, np.zeros(1)).score()
        values.append(np.where(score.is_tested, score.values, np.nan))
    assert np.nanmean(np.square(values)) == pytest.approx(1.0, abs=0.03)
    near = np.array(values)[:, 28:39, 25:36]
    assert np.nanmean(np.square(near)) == pytest.approx(1.0, abs=0.12)
    assert abs(np.nanmean(values)) < 0.02


def test_bright_source_does_not_bias_the_score_around_it():
    """Its wings are not, nor is it in the level: that would leave a hole of three resolutions."""
    rng = np.random.default_rng(5)
    rows, columns = np.indices((49, 49)) - 24
    radius = np.hypot(rows, columns)
    psf = (np.exp(-(radius**2) / 3) + 0.01 * np.exp(-(radius**2) / 60))[None]
    bright = np.zeros((64, 64))
    bright[8:57, 8:57] = 3e4 * psf[0] / psf.sum()
    observation = lnocl.Observation(rng.poisson(20.0 + bright).astype(float), psf, background=20.0)
    result = lnocl.deconvolve(observation, stop=None, n_iter=100, engine="numpy")
    outcome = result._outcome
    null = Null(Estimate(outcome.scene, outcome.sky, np.zeros(0)), False, NO_ERRORS)
    assert null.is_structured[32, 32]
    assert null.is_structured.mean() < 0.05
    values = ScoreMap(null, 0.0).values
    distance = np.hypot(*(np.indices((64, 64)) - 32))
    ring = values[(distance > 8) & (distance < 13)]
    assert abs(ring.mean()) < 0.35
    assert values[32, 32] > 50


def test_an_estimate_below_the_level_takes_nothing_from_the_variance():
    """Round a bright source it may be dark where the level of the counts is not."""
    images = np.random.default_rng(0).poisson(26.0, (1, 64, 64)).astype(float)
    images[0, 28:37, 28:37] += 3000 * PSFS[0] / PSFS[0].sum()
    scene = Scene(lnocl.Observation(images, PSFS[:1], background=1.0), [])
    sky = np.full((64, 64), 100.0)
    sky[24:41, 24:41] = 0.0
    null = Null(Estimate(scene, sky, np.zeros(0)), False, NO_ERRORS)
    assert null.is_structured[32, 32]
    assert null._linear.variances[0].min() * scene.scale > 10.0


@pytest.mark.parametrize("alarms", [0.1, 1.0])
def test_noise_exceeds_the_threshold_as_often_as_stated(alarms):
    """White Gaussian noise, smoothed: 400 fields, of which nothing is known but its spectrum."""
    rng, n, sigma = np.random.default_rng(1), 64, 2.0
    least = threshold(alarms, n * n / (2.0 * sigma**2))
    found = 0
    for _ in range(400):
        field = ndimage.gaussian_filter(rng.standard_normal((n, n)), sigma, mode="wrap")
        field *= 2.0 * sigma * np.sqrt(np.pi)
        is_peak = field == ndimage.maximum_filter(field, 3, mode="wrap")
        found += np.count_nonzero(is_peak & (field > least))
    assert abs(found / 400 - alarms) < 4 * np.sqrt(alarms / 400) + 0.05 * alarms


def test_a_threshold_falls_with_the_alarms_and_ends_at_1():
    found = [threshold(alarms, 4096.0) for alarms in (1e-3, 0.01, 1.0, 1e6)]
    assert found == sorted(found, reverse=True)
    assert found[-1] == 1.0
    density = 4096 * (2 * np.pi) ** -1.5
    assert density * found[0] * np.exp(-(found[0] ** 2) / 2) == pytest.approx(1e-3)


@pytest.mark.parametrize("level", [0.3, 3.0, 300.0])
def test_rare_counts_are_as_rare_as_those_of_poisson(level):
    """Equal weights: the sum is Poisson, whose tail scipy has; the continuous one lies between."""
    rarity, n = Rarity(np.ones(25)), 25
    mean = n * level
    counts = np.arange(np.ceil(mean + 2.5 * np.sqrt(mean)), np.ceil(mean + 7 * np.sqrt(mean)))
    values = (counts - mean) / np.sqrt(mean)
    found = rarity(values, np.full(values.shape, mean**-0.5))
    low, high = (scipy.stats.norm.isf(scipy.stats.poisson.sf(counts - k, mean)) for k in (1, 0))
    assert (found > low - 0.01).all()
    assert (found < high + 0.01).all()


@pytest.mark.exhaustive
def test_rare_sums_of_counts_are_as_rare_as_simulated():
    """A profile like that of a PSF, whose sums are no whole numbers."""
    profile = PSFS[0].ravel()
    level, n = 2.0, 500_000
    counts = np.random.default_rng(3).poisson(level, (n, profile.size))
    sums = (counts - level) @ profile / np.sqrt(level * (profile**2).sum())
    skewness = (profile**3).sum() / (profile**2).sum() ** 1.5 / np.sqrt(level)
    for value in (2.5, 3.2):
        found = Rarity(profile)(np.array([value]), np.array([skewness]))
        tail = scipy.stats.norm.sf(found[0])
        assert tail == pytest.approx((sums > value).mean(), rel=0.07)


def test_bright_sources_keep_their_order():
    """However rare they are, and however few the counts."""
    values = np.geomspace(2.0, 5000.0, 40)
    for skewness in (0.01, 1.0, 30.0):
        found = Rarity(PSFS[0])(values, np.full(40, skewness))
        assert (np.diff(found) > 0).all()
        for degrees in (12.0, 1e5):
            assert (np.diff(of_student(values, np.full(40, degrees))) > 0).all()


def test_values_without_skewness_are_gaussian():
    values = np.array([-3.0, 0.5, 4.0])
    np.testing.assert_array_equal(Rarity(np.ones(4))(values, np.zeros(3)), values)
    np.testing.assert_array_equal(Rarity(-np.ones(4))(values, np.ones(3)), values)


@pytest.mark.parametrize("degrees", [3.0, 30.0])
def test_values_of_student_are_as_rare(degrees):
    values = np.array([-4.0, 1.0, 5.0])
    expected = scipy.stats.norm.isf(scipy.stats.t.sf(values, degrees))
    np.testing.assert_allclose(of_student(values, np.full(3, degrees)), expected, rtol=1e-9)
    assert np.isfinite(of_student(np.array([1e4]), np.array([1e3]))).all()


@pytest.mark.parametrize("probability", [0.5, 0.9, 0.95])
def test_sources_exceed_a_value_as_often_as_asked(probability):
    values, skewness = np.array([4.0, 5.0]), np.array([0.0, 0.2])
    found = needed(values, skewness, probability)
    exceeds = scipy.stats.norm.sf((values - found - 1.0 / found) / np.sqrt(1.0 + skewness * found))
    np.testing.assert_allclose(exceeds, probability, rtol=1e-6)


class _Score(NamedTuple):
    values: np.ndarray
    of_psfs: np.ndarray
    starlit: np.ndarray
    is_tested: np.ndarray
    correlation: np.ndarray


def noisy(error, told=0.0, shared=1.0, seed=0):
    """A score whose values are independent, near a star whose PSF is wrong."""
    n = 128
    distance = np.hypot(*(np.indices((n, n)) - n // 2))
    light = 1e4 * np.exp(-distance / 4.0)
    u = np.random.default_rng(seed).standard_normal((n, n)) * shared
    u *= np.sqrt(1.0 + error**2 * light)
    correlation = np.zeros((n, n))
    correlation[0, 0] = 1.0
    is_tested = np.ones((n, n), bool)
    score = _Score(u, told**2 * light, light, is_tested, correlation)
    return score, distance / 3, light


@pytest.mark.parametrize("by_median", [False, True])
@pytest.mark.parametrize("error", [0.0, 0.05, 0.3])
def test_rings_show_the_error_of_psfs(error, by_median):
    score, rings, light = noisy(error)
    found = noise_of(score, rings, None if by_median else score.is_tested)
    expected = np.sqrt(1.0 + error**2 * light)
    near = (rings >= 2) & (rings <= 8)
    assert np.median(found.scatter[near] / expected[near]) == pytest.approx(1.0, abs=0.12)
    assert (found.scatter >= 1.0).all()
    assert found.degrees[(rings >= 1) & (rings < 2)].max() < 200
    assert (found.degrees[light < 1.0] == 1e6).all()


def test_noise_of_rings_is_known_as_well_at_all_their_radii():
    """Rings side by side, each with its own degrees, rose by half from one edge to the next."""
    score, rings, light = noisy(0.0)
    found = noise_of(score, rings, score.is_tested)
    is_near = light > 20.0
    radii = np.round(3 * rings).astype(int)
    degrees = np.array([np.median(found.degrees[is_near & (radii == r)]) for r in range(3, 25)])
    assert degrees[0] < 100
    assert (degrees[1:] > 0.8 * degrees[:-1]).all()
    correlation = np.zeros_like(light)
    correlation[:10, :10] = 1.0  # so that a ring tells next to nothing
    found = noise_of(score._replace(correlation=correlation), rings, score.is_tested)
    is_faint = (light > 10.0) & (light < 20.0)
    assert found.degrees[is_faint].min() > 50  # what it adds is known not to be much


def test_score_noise_includes_at_least_the_psf_error_of_the_run():
    score, rings, light = noisy(0.0, told=0.1)
    found = noise_of(score, rings, score.is_tested)
    assert (found.scatter >= np.sqrt(1.0 + 0.01 * light) - 1e-9).all()


def test_noise_that_is_shared_scatters_the_whole_field():
    score, rings, _ = noisy(0.0, shared=1.5)
    found = noise_of(score, rings, score.is_tested)
    assert np.median(found.scatter) == pytest.approx(1.5, rel=0.05)
    score, rings, _ = noisy(0.0, shared=1.0)
    assert np.median(noise_of(score, rings, score.is_tested).scatter) == 1.0


def test_the_peak_of_a_gaussian_is_found_between_pixels():
    rows, columns = np.indices((3, 3)) - 1.0
    middle = np.array([1])
    for dx, dy in ((0.3, -0.2), (-0.45, 0.1)):
        near = np.exp(-((rows - dy) ** 2 + (columns - dx) ** 2) / 4) * 7.0
        moves, values = peaks(near, middle, middle, "wrap")
        np.testing.assert_allclose(moves, [(dx, dy)], atol=1e-12)
        np.testing.assert_allclose(values, 7.0)
        moves, values = peaks(near - 6.0, middle, middle, "wrap")  # of which some are negative
        assert abs(moves - (dx, dy)).max() < 0.1
        assert abs(values - 1.0).max() < 0.1


def test_a_peak_at_an_edge_stays_there():
    values = np.zeros((4, 5))
    values[0, 4], values[1, 4], values[0, 3] = 3.0, 1.0, 2.0
    moves, higher = peaks(values, np.array([0]), np.array([4]), "reflect")
    assert moves.tolist() == [[0.0, 0.0]]
    assert higher.tolist() == [3.0]
