"""Line and continuum in one fit: runs of several skies, their errors and replicas."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy.nddata import CCDData
from astropy.wcs import WCS
from scenes import paper
from scipy.ndimage import gaussian_filter

import lnocl
from lnocl.core.runs.assessment import assess
from lnocl.core.runs.halves import Snapshot
from lnocl.core.runs.replicas import Replicas
from lnocl.core.scene.scene import Scene
from lnocl.errors import InputError
from lnocl.process import ignored_warnings
from lnocl.result.kept import from_parts, to_parts

SHAPE = 16, 32
STAR, FLUXES = (9, 8), (3e4, 2e4)
WEIGHTS = {"line": [1, 0], "continuum": [1, 1]}
FIXED = {"engine": "numpy", "stop": None, "n_iter": 20}


def blob(x0, y0, width, light):
    y, x = np.indices(SHAPE)
    values = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2 / width**2)
    return light * values / values.sum()


LINE, CONTINUUM = blob(20, 7, 2.0, 4e4), blob(12, 10, 3.5, 6e4)


def psfs_of(n):
    y, x = np.indices((9, 9)) - 4
    shapes = [np.exp(-(x**2 / (2 + 0.3 * j) + y**2 / (2.4 - 0.2 * j)) / 1.4) for j in range(n)]
    return np.array([each / each.sum() for each in shapes])


def models(weights=WEIGHTS, fluxes=FLUXES, background=10.0):
    psfs = psfs_of(len(weights["line"]))
    found = []
    for psf, a, b, flux in zip(psfs, weights["line"], weights["continuum"], fluxes, strict=True):
        sky = a * LINE + b * CONTINUUM
        sky[STAR[1], STAR[0]] += flux
        laid = np.zeros(SHAPE)
        laid[:9, :9] = psf
        spectrum = np.fft.rfft2(np.roll(laid, (-4, -4), (0, 1))) * np.fft.rfft2(sky)
        found.append(np.fft.irfft2(spectrum, SHAPE) + background)
    return np.array(found)


def observe(seed=0, **known):
    images = np.random.default_rng(seed).poisson(models())
    given = {"background": 10.0, "psf_error": 0.0, "components": WEIGHTS, **known}
    return lnocl.Observation(images, psfs_of(2), **given)


@cache
def result(error=0.0):
    options = {**FIXED, "smoothing": 0.01, "pad": 0}
    errors = {"continuum": [error, 0.0]}
    return lnocl.deconvolve(observe(component_errors=errors), [STAR], **options)


def test_bands_that_share_nothing_are_as_they_are_alone():
    images = np.random.default_rng(0).poisson(models())
    psfs, names = psfs_of(2), ("J", "K")
    bands = {name: row for name, row in zip(names, np.eye(2), strict=True)}
    given, options = {"background": 10.0, "psf_error": 0.0}, {"engine": "numpy", "n_iter": 15}
    options |= {"mu": 1e-6}
    joint = lnocl.Observation(images, psfs, components=bands, **given)
    together = paper(joint, [STAR], **options)
    for k in range(2):
        alone = paper(lnocl.Observation(images[k], psfs[k], **given), [STAR], **options)
        # They start from the same level, and the split-gradient method takes its steps pixel-wise.
        np.testing.assert_allclose(together.extended[k], alone.extended, rtol=2e-9)
        assert together.star_fluxes[k] == pytest.approx(alone.star_fluxes[0], rel=2e-9)


def test_line_continuum_and_stars_come_apart():
    found = lnocl.deconvolve(observe(), [STAR], engine="numpy")
    for k, truth in enumerate((LINE.sum(), CONTINUUM.sum())):
        assert abs(found.extended_flux[0][k] - truth) < 3 * found.extended_flux[1][k]
        assert found.extended_flux[1][k] < 0.1 * truth
    assert (abs(found.star_fluxes - FLUXES) < 3 * found.star_flux_errors).all()
    for name, truth in (("line", LINE), ("continuum", CONTINUUM)):
        sky = found.component(name)
        assert np.linalg.norm(sky - truth) < 0.35 * np.linalg.norm(truth)
    with pytest.raises(InputError, match="no component is called 'lines': line, continuum"):
        found.component("lines")


def test_what_is_printed_names_components_and_filters():
    lines = str(result()).splitlines()
    assert lines[0].split()[:2] == ["images", "of"]
    assert [line.split()[0] for line in lines[1:5]] == ["line", "continuum", "line", "continuum"]
    assert "epoch" not in str(result())
    assert "nan" not in str(result())


def test_tables_cards_and_cubes_have_each_component():
    found = result()
    assert repr(found).startswith("<lnocl.Result of 1 star and 32 x 16 pixels after ")
    table = found.to_table()
    assert table["images_of"].tolist() == ["line + continuum", "continuum"]
    assert not {"epoch_label", "variation_error"} & {*table.colnames}
    assert Scene(observe(), table).n_stars == 2  # one in two filters
    card = found._repr_html_()
    assert "in images of line + continuum<br>" in card
    assert "<th style='text-align:left'>continuum</th>" in card
    assert found.doubtful.shape == found.extended.shape


def test_a_cube_has_the_coordinates_of_its_planes():
    wcs = WCS({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 65.0, "CRVAL2": 19.5})
    images = [CCDData(each, unit="electron", wcs=wcs) for each in models()]
    observation = lnocl.Observation(images, psfs_of(2), background=10.0, components=WEIGHTS)
    cube = lnocl.deconvolve(observation, **{**FIXED, "n_iter": 2, "smoothing": 0.0}).to_ccddata()
    assert cube.shape == (2, *SHAPE)
    assert cube.wcs.celestial.wcs.crval.tolist() == [65.0, 19.5]
    assert cube[:1].shape == (1, *SHAPE)


def test_the_order_of_components_does_not_matter():
    turned = {"continuum": WEIGHTS["continuum"], "line": WEIGHTS["line"]}
    options = {**FIXED, "smoothing": 0.01, "pad": 0}
    other = lnocl.deconvolve(observe(components=turned), [STAR], **options)
    np.testing.assert_allclose(other.extended[::-1], result().extended, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(other.star_fluxes, result().star_fluxes, rtol=1e-9)


def test_weights_are_units_of_the_components():
    halved = {"line": [0.5, 0.0], "continuum": [1, 1]}
    options = {**FIXED, "n_iter": 15, "mu": 0.0}
    one, other = (
        paper(observe(components=each), [STAR], **{**options, "stop": None})
        for each in (WEIGHTS, halved)
    )
    np.testing.assert_allclose(other.extended[0], 2.0 * one.extended[0], rtol=1e-9)
    np.testing.assert_allclose(other.extended[1], one.extended[1], rtol=1e-9)


def test_the_error_of_the_light_is_its_scatter():
    outcome = result()._findings
    errors = np.zeros(outcome.scene.n_fluxes)  # of stars, which are as they were found
    model, found = np.array(list(outcome.models())), []
    whole = np.zeros(SHAPE)
    whole[4:12, 15:26] = 1.0
    rng = np.random.default_rng(5)
    for _ in range(300):
        scene = outcome.scene.of_half(outcome.observation.replace(images=rng.poisson(model)))
        scene.scale, scene.unit = outcome.scene.scale, outcome.scene.unit
        drawn = lnocl.core.runs.outcome.Outcome(
            outcome.setup,
            lnocl.core.scene.estimate.Estimate(scene, outcome.sky, outcome.star_fluxes),
            outcome.objectives,
            "",
        )
        found.append(drawn.light().flux(whole, errors))
    fluxes, told = np.array(found).transpose(1, 0, 2)
    covariance = outcome.light().covariance(whole, errors)[1]
    np.testing.assert_allclose(fluxes.std(axis=0), told.mean(axis=0), rtol=0.12)
    assert np.cov(fluxes.T)[0, 1] == pytest.approx(covariance[0, 1], rel=0.25)
    assert covariance[0, 1] < 0  # what the line has the continuum lacks


def test_weights_that_are_off_are_in_the_errors_of_light():
    sure, unsure = result(), result(0.1)
    (_line, continuum), before = sure.extended_flux
    after = unsure.extended_flux[1]
    assert after[0] == pytest.approx(np.hypot(before[0], 0.1 * continuum), rel=1e-6)
    assert after[1] == pytest.approx(before[1], rel=1e-6)
    outcome = unsure._findings
    drawn = [Replicas(outcome, seed)._mixed_otherwise(Replicas(outcome, seed)._model, rng)
             for seed, rng in enumerate(map(np.random.default_rng, range(40)))]  # fmt: skip
    weights = np.array([each.scene.mixing.weights for each in drawn])
    assert 0.06 < weights[:, 0, 1].std() < 0.14
    assert (weights[:, [0, 1, 1], [0, 0, 1]] == [1.0, 0.0, 1.0]).all()


def test_replicas_measure_each_component_and_how_bright_it_is_over_the_continuum():
    from regions import CirclePixelRegion, PixCoord

    regions = [CirclePixelRegion(PixCoord(20, 7), 4)]
    found = result().bootstrap(10, regions=regions)
    names = [each.name for each in found.quantities]
    assert names == [
        "star 1 flux in images of line + continuum",
        "star 1 flux in images of continuum",
        "line region 1",
        "continuum region 1",
        "line / continuum region 1",
    ]
    values, errors = found.values, found.standard_errors
    covariances = found.covariances
    np.testing.assert_allclose(np.diag(covariances)[:2], errors[:2] ** 2, rtol=1e-9)
    assert covariances[2, 3] < 0  # what the line has the continuum lacks
    assert values[4] == pytest.approx(values[2] / values[3])
    assert (errors > 0).all()
    # Ratios follow from the light: a drawn sky has another, and its ratio other errors.
    _star, _same, line, continuum, ratio = found.errors.T
    np.testing.assert_allclose(ratio, (line - values[4] * continuum) / values[3])
    assert found.error_map.shape == (2, *SHAPE)
    # What the star may have more or less of, both components have: so has their ratio.
    of_star = found.shares[2] - values[4] * found.shares[3]
    np.testing.assert_allclose(found.shares[4], of_star / values[3])
    truth = regions[0].to_mask("exact").multiply(LINE).sum()
    assert abs(values[2] - truth) < 3 * errors[2]


def test_the_map_of_line_over_continuum_has_the_scatter_of_replicas():
    found, outcome = result().bootstrap(10), result()._findings

    def smooth(skies):
        return [gaussian_filter(sky, found.resolution / 2.3548, mode="nearest") for sky in skies]

    line, continuum = smooth(result().extended)
    np.testing.assert_allclose(found.ratio_map, [line / continuum], rtol=1e-4)
    drawn = Replicas(outcome, 0, 10).reconstruct(*range(10))
    changes = np.array([smooth(each.found.extended - each.drawn.extended) for each in drawn])
    scatter = (changes[:, 0] - line / continuum * changes[:, 1]).std(axis=0, ddof=1)
    np.testing.assert_allclose(found.ratio_error_map, [scatter / continuum], rtol=1e-3)
    assert found.error_map.shape == found.bias_map.shape == found.share_map.shape == (2, *SHAPE)


def test_errors_begin_with_what_a_file_holds():
    outcome, observation = result()._findings, observe()
    parts = to_parts(outcome, observation)
    held = from_parts(parts, observation, None, "single")
    np.testing.assert_array_equal(held.sky, outcome.sky)
    assert held.scene.penalty == outcome.scene.penalty
    assert held.light().flux(np.ones(SHAPE), np.zeros(2))[0] == pytest.approx(
        outcome.light().flux(np.ones(SHAPE), np.zeros(2))[0]
    )
    other = observe(components={"line": [1, 0], "continuum": [1, 0.9]})
    assert from_parts(parts, other, None, "single") is None


def test_a_run_resumes_bit_for_bit(tmp_path):
    path = tmp_path / "run.fits"
    options = {"engine": "numpy", "smoothing": 0.01, "stop": None}
    lnocl.deconvolve(observe(), [STAR], n_iter=20, checkpoint=path, **options,
                     callback=lambda i, _: i == 7)  # fmt: skip
    again = lnocl.deconvolve(observe(), [STAR], n_iter=20, resume=path, **options)
    whole = lnocl.deconvolve(observe(), [STAR], n_iter=20, **options)
    assert again.n_iter == whole.n_iter
    np.testing.assert_array_equal(again.extended, whole.extended)


def test_each_sky_counts_alike_in_held_out_counts():
    rng = np.random.default_rng(0)
    truth = rng.random((2, *SHAPE))

    def snapshot(k, faint):
        noise = [0.1 * k * rng.standard_normal((2, *SHAPE)) for _ in range(2)]
        lost = 1.0 - 0.8**k
        return Snapshot(k, [faint * (lost * truth / 2 + each) for each in noise], None, None)

    rng = np.random.default_rng(1)
    one = [snapshot(k, np.ones((2, 1, 1))) for k in range(1, 9)]
    rng = np.random.default_rng(1)
    other = [snapshot(k, np.array([1.0, 1e-3])[:, None, None]) for k in range(1, 9)]
    found, of_faint = (assess(each, each[-1], np.s_[:, :]) for each in (one, other))
    assert (found.best, found.chosen) == (of_faint.best, of_faint.chosen)


def test_a_psf_that_is_off_is_mended_in_its_filter_alone():
    y, x = np.indices((9, 9)) - 4
    wrong = np.exp(-(x**2 / 2.3 + y**2 / 2.2) / 2.2)
    psfs = np.array([psfs_of(2)[0], wrong / wrong.sum()])
    images = np.random.default_rng(2).poisson(models(fluxes=(3e6, 3e6)))
    given = {"background": 10.0, "psf_error": 0.03, "components": WEIGHTS}
    observation = lnocl.Observation(images, psfs, **given)
    found = lnocl.deconvolve(observation, [STAR], engine="numpy", n_iter=60)
    before, after = (
        abs(each - psfs_of(2)).sum(axis=(1, 2)) for each in (observation.psfs, found.psfs)
    )
    assert after[1] < 0.5 * before[1]
    assert after[0] < 0.02


@pytest.mark.parametrize("kind", ["halos", "background_error"])
def test_levels_and_halos_are_fitted_filter_by_filter(kind):
    y, x = np.indices(SHAPE)
    halo = 1.0 / (3.0 + np.hypot(x - 25, y - 12))
    amounts = np.array([2e4, 1e4])
    added = amounts[:, None, None] * halo / halo.sum() if kind == "halos" else 4.0
    images = np.random.default_rng(3).poisson(models() + added)
    more = {"halos": halo} if kind == "halos" else {"background_error": 3.0}
    given = {"background": 10.0, "psf_error": 0.0, "components": WEIGHTS, **more}
    found = lnocl.deconvolve(lnocl.Observation(images, psfs_of(2), **given), [STAR],
                             engine="numpy", n_iter=100)  # fmt: skip
    if kind == "halos":
        assert (abs(found.halo_fluxes[0] - amounts) < 3 * found.halo_flux_errors[0]).all()
    else:
        first, second = found._findings.levels_in_words()
        assert first.startswith("`images[0]`: background 1")
        assert second.startswith("`images[1]`: background 1")
    assert abs(found.extended_flux[0][0] - LINE.sum()) < 3 * found.extended_flux[1][0]


def test_levels_are_fitted_where_those_of_one_filter_alone_have_an_error():
    images = np.random.default_rng(3).poisson(models())
    given = {"background": 10.0, "psf_error": 0.0, "components": WEIGHTS}
    observation = lnocl.Observation(images, psfs_of(2), background_error=[0.0, 3.0], **given)
    found = lnocl.deconvolve(observation, [STAR], engine="numpy", n_iter=10)
    (told,) = found._findings.levels_in_words()
    assert told.startswith("`images[1]`: background ")


def test_a_psf_that_filters_share_stays_one_where_it_is_not_mended():
    given = {"background": 10.0, "components": WEIGHTS, "psf_scatter": 0.01 * psfs_of(1)[0]}
    observation = lnocl.Observation(models(), psfs_of(1)[0], **given)
    parts = [([j], observation.of_images([j])) for j in range(2)]
    assert observation.joined(parts).psfs.strides[0] == 0
    parts[0] = [0], parts[0][1].replace(psfs=psfs_of(2)[1])
    joined = observation.joined(parts)
    np.testing.assert_allclose(joined.psfs, psfs_of(2)[::-1], rtol=1e-12)
    np.testing.assert_array_equal(joined.psf_scatter, observation.psf_scatter)


def test_errors_of_psfs_leave_those_of_weights_in_replicas():
    scatter = {"psf_scatter": 1e-9 * psfs_of(2)}
    observation = observe(component_errors={"continuum": [0.3, 0.0]}, **scatter)
    options = {**FIXED, "smoothing": 0.01, "pad": 0}
    outcome = lnocl.deconvolve(observation, [STAR], **options)._findings
    (replica,) = Replicas(outcome, 0).reconstruct(0)
    light, again = (
        each.light.sum(axis=(1, 2)) for each in (replica.found, replica.found_with_psfs)
    )
    np.testing.assert_allclose(again, light, rtol=1e-3)


def test_what_replicas_draw_has_the_weights_that_are_given():
    lights = []
    for error in (0.3, 0.0):
        errors = {"component_errors": {"continuum": [error, 0.0]}, "background_error": 3.0}
        found = lnocl.deconvolve(observe(**errors), [STAR], engine="numpy", n_iter=10)
        assert found._findings.has_levels
        lights.append(Replicas(found._findings, 0).reconstruct(0)[0].drawn.light)
    np.testing.assert_array_equal(*lights)


def test_the_largest_error_of_a_weight_in_a_filter_is_that_of_its_light():
    errors = []
    for each in ([0.1, 0.0, 0.0], [0.0, 0.1, 0.0]):
        images = np.random.default_rng(0).poisson(models()[[0, 0, 1]])
        weights = {"line": [1, 1, 0], "continuum": [1, 1, 1]}
        known = {"components": weights, "component_errors": {"continuum": each}}
        observation = lnocl.Observation(images, psfs_of(2)[[0, 0, 1]], background=10.0, **known)
        options = {**FIXED, "n_iter": 5, "smoothing": 0.01, "pad": 0}
        errors.append(lnocl.deconvolve(observation, **options).extended_flux[1])
    np.testing.assert_allclose(*errors)


def test_units_of_components_do_not_change_what_a_filter_is_smoothed_by():
    found, n = [], np.ones(SHAPE)
    for unit in (1.0, 0.5):
        weights = {"line": [unit, 0.0], "continuum": [1, 1]}
        given = {"components": weights, "exposure": [1.0, 4.0]}
        result = lnocl.deconvolve(observe(**given), [STAR], engine="numpy", stop=None, n_iter=5)
        outcome, scene = result._findings, result._findings.scene
        near = np.sqrt([(3.0 * unit) ** 2 * n, 9.0 * n + 16.0 * n])  # as joined of 3 and 4
        penalty = replace(scene.penalty, near_stars=near)
        estimate = replace(outcome.estimate, scene=scene.penalised(penalty))
        outcome = replace(outcome, estimate=estimate)
        found += [outcome.of_filter(name).scene.penalty for name in scene.mixing.filter_names]
    for each, other in zip(found[:2], found[2:], strict=True):
        assert each.smoothing == pytest.approx(other.smoothing)
        assert each.exposure == 2.5
        np.testing.assert_allclose(each.near_stars, other.near_stars)
    np.testing.assert_allclose([each.near_stars[0, 0] for each in found[:2]], [3.0, 4.0])


def test_start_and_smoothing_are_of_each_sky():
    scene = Scene(observe(), [STAR])
    assert scene.sky_grid == (2, *scene.grid)
    start = scene.start(np.ones((2, *SHAPE)) * [[[3.0]], [[5.0]]], None)[0] * scene.unit
    assert start[0, 3, 3] == pytest.approx(3.0)
    assert start[1, 3, 3] == pytest.approx(5.0)
    with pytest.raises(InputError, match=r"shape \(16, 32\); it must have \(2, 16, 32\)"):
        scene.start(np.ones(SHAPE), None)


def test_a_point_is_found_in_the_images_of_a_filter():
    _y, _x = np.indices((48, 48))
    psf = psfs_of(1)[0]
    rng = np.random.default_rng(4)
    means = np.full((2, 48, 48), 12.0)
    for j, flux in enumerate((4e4, 3e4)):
        means[j, 16:25, 18:27] += flux * psf
    means[0, 28:37, 8:17] += 600.0 * psf  # in the line alone
    weights = {"line": [1, 0], "continuum": [1, 1]}
    given = {"background": 12.0, "psf_error": 0.0, "components": weights}
    observation = lnocl.Observation(rng.poisson(means), psf, **given)
    found = lnocl.deconvolve(observation, [(22, 20)], **{**FIXED, "n_iter": 30})
    points = found.significance(images_of="line + continuum").detections
    assert len(points) == 1
    assert np.hypot(points["x"][0].value - 12, points["y"][0].value - 32) < 0.3
    assert points["flux"][0].value == pytest.approx(600.0, abs=4 * points["flux_error"][0].value)
    assert len(found.significance(images_of="continuum").detections) == 0
    with pytest.raises(InputError, match="give images_of as 'line \\+ continuum' or 'continuum'"):
        found.significance()


def test_messages_of_a_filter_count_images_among_all_and_name_it(log):
    from lnocl.errors import note, of_images

    with of_images([1, 3], "continuum"):
        note("`images[1]` and `psfs[0]`, by `n_iter`")
    note("`images[1]`")
    assert log.messages == ["continuum: image 3 and psf 1, by n_iter", "image 1"]


def test_refinements_of_filters_are_joined_image_by_image():
    from lnocl.core.runs.outcome import PsfRefinement, joined_refinement

    def refinement(names, values, error):
        rest = np.zeros(2), np.zeros(1), np.full((3, 4), error)
        return PsfRefinement(names, np.array(values), (2.0, 1.0), True, error, *rest)

    first = refinement(("shift x", "jitter xx"), [[1.0, 2.0], [3.0, 4.0]], 0.1)
    second = refinement(("jitter xx",), [[5.0]], 0.2)
    found = joined_refinement([[0, 2], [1], [3]], [first, second, None], 2)
    assert found.parameters == ("shift x", "jitter xx")
    assert found.values.tolist() == [[1.0, 2.0], [0.0, 5.0], [3.0, 4.0], [0.0, 0.0]]
    assert found.psf_error == 0.2
    assert found.may_be_faked.shape == (2, 3, 4)
    assert joined_refinement([[0], [1]], [None, None], 2) is None


def test_the_resolution_is_that_of_the_filter_which_resolves_least():
    from lnocl.core.scene.texture import resolution

    scene = Scene(observe(), [STAR])
    alone = [resolution(scene.of_images([j])) for j in range(2)]
    assert resolution(scene) == max(alone) > min(alone)


def test_fluxes_of_many_stars_are_told_with_their_filters():
    stars = [(5, 4), (9, 8), (14, 11), (20, 4), (26, 11)]
    found = lnocl.deconvolve(observe(), stars, **FIXED, smoothing=0.01)
    line = str(found).splitlines()[1]
    assert line.startswith("star 2 (9, 8)")
    assert " in line + continuum; " in line
    assert line.endswith(" in continuum, electrons")


@pytest.mark.exhaustive
@pytest.mark.parametrize("by", [0.5, 2.25])
def test_images_of_a_filter_are_moved_to_where_the_first_see_the_stars(by, log):
    size, psf = 40, np.zeros((40, 40))
    y, x = np.indices((size, size))

    def seen(x0, y0, light, width):
        values = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / 2 / (width**2 + 1.4**2))
        return light * values / values.sum()

    psf = seen(20, 20, 1.0, 0.0)[12:29, 12:29]
    means = [
        20.0 + seen(19 + a, 18 + a, flux, 0.0) + seen(15 + a, 22 + a, 6e4, 3.0) + line
        for a, flux, line in ((0.0, 3e5, seen(27, 24, 4e4, 2.0)), (by, 2e5, 0.0))
    ]
    given = {"background": 20.0, "psf_error": 0.0, "components": WEIGHTS}
    observation = lnocl.Observation(np.random.default_rng(6).poisson(means), psf, **given)
    found = lnocl.deconvolve(observation, [(19, 18)], engine="numpy", n_iter=40)
    offsets = found._findings.observation.offsets
    np.testing.assert_allclose(offsets, [[0, 0], [by, by]], atol=0.06)
    assert any("images moved" in each or "image 1 by" in each for each in log.messages)
    assert abs(found.extended_flux[0][0] - 4e4) < 3 * found.extended_flux[1][0]
    stays = {"engine": "numpy", "n_iter": 3, "mend_images": False, "stop": None}
    with ignored_warnings():  # that the star lies elsewhere
        left = lnocl.deconvolve(observation, [(19, 18)], **stays)
    assert not left._findings.observation.offsets.any()


def test_only_filters_whose_stars_surely_lie_elsewhere_are_moved(monkeypatch):
    from lnocl.core.runs import preparation
    from lnocl.core.runs.outcome import Mended
    from lnocl.core.runs.start import Setup

    observation = observe(offsets=[[1.0, 0.0], [0.0, 0.0]])
    setup = Setup(observation, np.array([STAR]), 0, "sgp", "single", "numpy", None)

    def moved(*places):
        measured = iter([(np.array(place), error) for *place, error in places])
        monkeypatch.setattr(preparation, "_away", lambda _: next(measured))
        found = [Mended(setup)] * len(places)
        return preparation._in_one_place(setup, observation.mixing, found).observation.offsets

    stays = observation.offsets
    np.testing.assert_allclose(
        moved((0.3, 0.2, 0.01), (0.25, 0.9, 0.01)), stays + np.array([[0.0, 0.0], [-0.05, 0.7]])
    )
    np.testing.assert_array_equal(moved((0.3, 0.2, 0.01), (0.25, 0.22, 0.001)), stays)
    np.testing.assert_array_equal(moved((0.3, 0.2, 0.2), (0.25, 0.9, 0.01)), stays)
    np.testing.assert_array_equal(moved((0.0, 0.0, np.inf), (0.25, 0.9, 0.01)), stays)


@pytest.mark.parametrize("seed", range(3))
def test_light_that_one_filter_alone_shows_is_of_no_component(seed):
    """Beside the images of a filter its sky is as bright as it began, and so were components."""
    mask = np.zeros((2, *SHAPE), bool)
    mask[0, :, :14] = True
    images = np.random.default_rng(seed).poisson(models(fluxes=(0.0, 0.0)))
    observation = observe().replace(images=np.where(mask, 0, images), mask=mask)
    result = lnocl.deconvolve(observation, **FIXED | {"n_iter": 100}, smoothing=0.01)
    flux, error = result.extended_flux
    told = np.array([sky[:, 13:].sum() for sky in (LINE, CONTINUUM)])
    # A column at the mask's edge is seen in part.
    edge = np.array([sky[:, 13].sum() for sky in (LINE, CONTINUUM)])
    assert (abs(flux - told + edge / 2.0) < 3.0 * error + edge / 2.0).all()
    noise = result._findings.pixel_noise()
    assert np.isnan(noise[0, :, :8]).all()
    assert np.isfinite(noise[0, :, 16:]).all()
    assert np.isfinite(noise[1]).all()


def test_a_filter_that_no_good_pixel_shows_is_refused():
    mask = np.zeros((2, *SHAPE), bool)
    mask[0] = True
    given = observe().replace(images=np.where(mask, 0, 50), mask=mask)
    with pytest.raises(
        InputError, match=r"^no good pixel shows line \+ continuum: leave its images"
    ):
        lnocl.deconvolve(given, **FIXED)
    mask[0, :, 24:] = False
    given = observe().replace(images=np.where(mask, 0, 50), mask=mask)
    with pytest.raises(
        InputError, match=r"pixel \(0, 0\), where .* no good pixel shows .* a larger"
    ):
        lnocl.deconvolve_tiles(given, tile=24, pad=0, **FIXED)


@pytest.mark.parametrize(
    "known", [{}, {"psf_error": 0.03}, {"background_error": 0.5}], ids=["exact", "psfs", "levels"]
)
@pytest.mark.parametrize("how", [{}, {"smoothing": 0.01}], ids=["auto", "smoothed"])
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_a_star_may_be_seen_in_one_filter_alone(known, how):
    mask = np.zeros((2, *SHAPE), bool)
    mask[0, :, :20] = True
    images = np.where(mask, 0, np.random.default_rng(1).poisson(models()))
    given = observe().replace(images=images, mask=mask, **known)
    stars = [(27, 5), STAR]  # the first of which has no light
    result = lnocl.deconvolve(given, stars, **FIXED, **how)
    assert np.isnan(result.star_fluxes).tolist() == [False, False, True, False]
    assert np.isfinite(result.star_flux_errors[[0, 1, 3]]).all()
    alone = lnocl.deconvolve(given, stars[1:], **FIXED, **how)
    assert np.isnan(alone.star_fluxes).tolist() == [True, False]
    assert np.isfinite(alone.star_flux_errors[1])
