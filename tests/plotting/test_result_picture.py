"""The picture of a result shows what the result has, in memory and from its file."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from result_views import make_view
from scenes import Recipe

from lnocl.io.saved_results import read_result
from lnocl.plotting.light_curves import light_curves
from lnocl.plotting.result import (
    MAX_SIGMA,
    MOST_SKIES,
    MOST_STARS,
    OUTLINED,
    Region,
    draw_result,
    image_limits,
    worst_image,
)
from lnocl.result import view_of
from lnocl.studies import figures

pytest.importorskip("matplotlib")


def panels(figure):
    """Return the images of a figure by the titles of their panels, colour bars apart."""
    parts = [axis for part in figure.subfigs for axis in part.axes]
    return [(axis.get_title(), axis.images[0]) for axis in parts if axis.images]


@pytest.fixture(scope="module")
def result():
    made = Recipe((40, 36), n_images=2, n_stars=2, masked=0.1).make()
    return made.deconvolve(engine="numpy", n_iter=3)


def test_a_row_for_the_frame_and_one_for_each_star():
    shown = panels(draw_result(make_view(p=1, n_stars=2)))
    assert [title for title, _ in shown] == [
        *("image, whole frame", "model", "residuals / noise", "extended source"),
        *("image, star 1", "model", "residuals / noise", "extended source"),
        *("image, star 2", "model", "residuals / noise", "extended source"),
    ]


def test_panels_show_image_model_residuals_and_extended_source():
    view = make_view(p=1)
    (_, image), (_, model), (_, residuals), (_, extended), *zoom = panels(draw_result(view))
    np.testing.assert_array_equal(image.get_array(), view.images[0])
    np.testing.assert_array_equal(model.get_array(), view.models[0])
    np.testing.assert_array_equal(residuals.get_array(), view.residuals[0])
    np.testing.assert_array_equal(extended.get_array(), view.extended)
    assert (image.norm.vmin, image.norm.vmax) == (model.norm.vmin, model.norm.vmax)
    assert (residuals.norm.vmin, residuals.norm.vmax) == (-MAX_SIGMA, MAX_SIGMA)
    # The star at (10, 20), and 16 pixels round it, cut at the frame.
    np.testing.assert_array_equal(zoom[0][1].get_array(), view.images[0][4:37, :27])
    assert zoom[0][1].get_extent() == [-0.5, 26.5, 3.5, 36.5]


@pytest.mark.exhaustive
def test_the_image_of_the_largest_residuals_is_shown():
    view = make_view(p=3)
    view.residuals[1, 50:, 60:] = 40.0  # far from the star
    view.residuals[2, 20, 10] = 40.0
    assert worst_image(view, Region("whole frame")) == 1
    assert worst_image(view, Region("star 1", (10.0, 20.0), 5)) == 2
    titles = [title for title, _ in panels(draw_result(view))]
    assert titles[0] == "image 2 of 3, whole frame"
    assert titles[4] == "image 3 of 3, star 1"


def test_an_image_that_does_not_see_a_star_is_not_shown_for_it():
    view = make_view(p=2, offsets=np.array([[0.0, 0.0], [-40.0, 0.0]]))
    view.residuals[1] = 99.0
    assert worst_image(view, Region("star 1", (10.0, 20.0), 5)) == 0


def test_regions_follow_the_offsets():
    view = make_view(p=1, offsets=np.array([[7.0, -3.0]]))
    zoom = panels(draw_result(view))[4][1]
    np.testing.assert_array_equal(zoom.get_array(), view.images[0][1:34, 1:34])


def test_bad_pixels_are_grey_and_change_no_stretch():
    view = make_view(p=1)
    before = image_limits(view.images[0])
    view.images[0, 5, 5] = view.residuals[0, 5, 5] = np.nan
    _, image = panels(draw_result(view))[0]
    assert image.get_array().mask[5, 5]
    assert image_limits(view.images[0])[2] == pytest.approx(before[2], rel=0.01)
    assert image_limits(np.full((3, 3), np.nan)) == (0.0, 1.0, 1.0)


@pytest.mark.exhaustive
@pytest.mark.parametrize("scale", [0.0, 1e-320, 1e-20, 1e200])
def test_any_unit_is_drawn(scale, tmp_path):
    view = make_view(p=1)
    draw_result(dataclasses.replace(view, extended=scale * view.extended)).savefig(
        tmp_path / "a.png"
    )


def test_a_unit_is_no_formula():
    draw_result(dataclasses.replace(make_view(p=0), unit=r"$\bad{$")).draw_without_rendering()


@pytest.mark.exhaustive
@pytest.mark.parametrize("value", [0.0, 5.0])
def test_a_flat_image_and_an_empty_source_are_drawn(value, tmp_path):
    flat = np.full((1, 60, 70), value)
    view = make_view(p=1, images=flat, models=flat, extended=np.zeros((60, 70)))
    draw_result(view).savefig(tmp_path / "flat.png")


@pytest.mark.exhaustive
def test_of_many_stars_the_first_and_the_brightest_are_enlarged():
    view = make_view(p=1, n_stars=9)
    view.star_fluxes[8] = 100.0
    view.star_fluxes[:3] = 0.0, np.nan, 0.5  # those named before a table, however faint
    figure = draw_result(view)
    titles = [title for title, _ in panels(figure) if title.startswith("image")]
    assert titles[1:] == [f"image, star {s}" for s in (1, 2, 3, 4, 5, 9)]
    assert len(titles) == 1 + MOST_STARS
    assert "enlarged: 6 of 9 stars" in figure.subfigs[0].get_suptitle()


def test_rounding_is_not_taken_for_noise():
    few = np.zeros((32, 32))
    few[::7, ::5] = 20.0
    rounded = few + 1e-7 * np.random.default_rng(1).normal(size=few.shape)
    assert image_limits(few)[2] == pytest.approx(0.02)
    assert image_limits(rounded)[2] == pytest.approx(0.02)
    assert image_limits(rounded * 0.0 + np.arange(32.0))[2] == pytest.approx(1.4826 * 8.0)


def test_pictures_have_the_unit_of_the_tables():
    axes = draw_result(make_view(p=1, unit="adu")).subfigs[0].axes
    labels = [axis.child_axes[0].get_ylabel() for axis in axes[:4]]
    assert labels == ["adu per pixel", "adu per pixel", "sigma", "adu per pixel"]


def test_numbers_of_stars_are_read_on_any_colour():
    (number,) = draw_result(make_view(p=1)).subfigs[0].axes[0].texts
    (edge,) = number.get_path_effects()
    assert (number.get_color(), edge._gc["foreground"]) == ("white", "black")


@pytest.mark.parametrize(
    ("labels", "places", "shown"),
    [
        (["60735.25", "60736", "60740"], [60735.25, 60736.0, 60740.0], None),
        (["2025-03-01", "2025-03-02T12:00:00", "2025-04-01"], [20148.0, 20149.5, 20179.0], None),
        (["first", "second", "third"], [0.0, 1.0, 2.0], ["first", "second", "third"]),
        (["1", "nan", "3"], [0.0, 1.0, 2.0], ["1", "nan", "3"]),
        (["03-03", "03-04", "03-07"], [0.0, 1.0, 2.0], ["03-03", "03-04", "03-07"]),
    ],
)
def test_light_curves_are_below(labels, places, shown):
    fluxes = np.array([[183600.0, 224400.0, 204000.0], [0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    curves = light_curves(fluxes.ravel(), np.full(9, 0.5), labels, "electron")
    axis = draw_result(make_view(p=1, light_curves=curves)).subfigs[-1].axes[0]
    assert axis.get_title().startswith("light curves")
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("epoch", "flux / mean")
    drawn = [container.lines[0].get_ydata() for container in axis.containers]
    np.testing.assert_allclose(drawn, [[0.9, 1.1, 1.0], [0.5, 1.0, 1.5]])  # one has no light
    at = axis.xaxis.convert_units(axis.containers[0].lines[0].get_xdata())
    np.testing.assert_allclose(at, places)
    if shown:
        assert [text.get_text() for text in axis.get_xticklabels()] == shown
    assert [text.get_text() for text in axis.get_legend().texts] == [
        "star 1, mean 204 000 electron",
        "star 3, mean 2 electron",
    ]
    assert light_curves(np.ones(2), np.ones(2), ["0"], "") is None


def test_of_many_labels_of_epochs_some_are_on_the_axis():
    labels = [f"n{k:02d}" for k in range(11)]
    curves = light_curves(np.ones(11), np.full(11, 0.1), labels, "electron")
    axis = draw_result(make_view(p=1, light_curves=curves)).subfigs[-1].axes[0]
    assert [text.get_text() for text in axis.get_xticklabels()] == labels[::2]


@pytest.mark.exhaustive
def test_stars_are_circled_in_image_and_source():
    figure = draw_result(make_view(p=1, offsets=np.array([[2.0, 0.0]])))
    whole = figure.subfigs[0].axes[:4]
    marks = [[line.get_data()[0][0] for line in axis.lines] for axis in whole]
    assert marks == [[12.0, 12.0], [], [], [10.0, 10.0]]
    assert [text.get_text() for text in whole[0].texts] == ["1"]


def test_doubtful_pixels_are_outlined_and_named_in_the_panel_title():
    doubtful = np.zeros((60, 70), bool)
    doubtful[15:25, 5:15] = True
    titles = [title for title, _ in panels(draw_result(make_view(p=1, doubtful=doubtful)))]
    assert titles[3] == "extended source\nred: perhaps the PSF's error alone"


@pytest.mark.parametrize("shape", [(60, 70), (1, 70), (60, 1)])
def test_an_outline_leaves_the_enlarged_part_as_it_is(shape):
    view = make_view(p=1, shape=shape, stars=[(0.0, 0.0)], doubtful=np.ones(shape, bool))
    for _, image in panels(draw_result(view)):
        left, right, bottom, top = image.get_extent()
        assert image.axes.get_xlim() == (left, right)
        assert image.axes.get_ylim() == (bottom, top)


@pytest.mark.exhaustive
def test_the_choice_is_that_of_held_out_counts_or_the_objective():
    def curve(view):
        (axis,) = draw_result(view).subfigs[1].axes
        assert axis.get_xlabel() == f"iteration (dotted: {view.n_iter}, the result)"
        assert not axis.texts  # on which the legend may lie
        return axis.get_ylabel(), {line.get_label(): line.get_ydata() for line in axis.lines}

    name, found = curve(make_view())
    assert name == "objective J"
    assert next(iter(found.values())).tolist() == [8.0, 7.0, 6.0]  # after the start
    table = {"smoothing": [0.0, 0.0, 3.0], "iteration": [1, 2, 1], "error": [0.5, 0.25, 0.4]}
    table = {key: np.array(column) for key, column in table.items()}
    name, found = curve(make_view(held_out=table))
    assert name == "estimated error (%)"
    assert found["0"].tolist() == [50.0, 25.0]
    assert found["3"].tolist() == [40.0]


@pytest.mark.exhaustive
@pytest.mark.parametrize("objectives", [[7.0], [7.0, np.nan], [7.0, -1.0], []])
def test_a_run_without_a_curve_is_drawn(objectives, tmp_path):
    history = {"iteration": np.arange(len(objectives)), "objective": np.array(objectives)}
    figure = draw_result(make_view(history=history if objectives else {}, n_iter=0))
    figure.savefig(tmp_path / "a.png")
    assert not figure.subfigs[1].axes[0].lines


def test_from_a_file_it_is_the_same(result, tmp_path):
    path = tmp_path / "result.fits"
    result.write(path)
    before = panels(result.plot())
    after = panels(draw_result(figures.view_of(read_result(str(path)))))
    assert [title for title, _ in before] == [title for title, _ in after]
    for (_, one), (_, other) in zip(before, after, strict=True):
        assert one.get_extent() == other.get_extent()
        np.testing.assert_allclose(one.get_array(), other.get_array(), rtol=1e-5, atol=1e-5)
    bad = result._outcome.scene.observation.mask
    assert bad.any()
    for cube in (view_of(result).images, view_of(result).models):
        np.testing.assert_array_equal(np.isnan(cube), bad)
    held = view_of(result), figures.view_of(read_result(str(path)))
    assert held[0].n_iter == held[1].n_iter == 3
    assert held[0].stars == held[1].stars
    np.testing.assert_array_equal(*(view.history["objective"] for view in held))


def test_without_models_the_source_alone_is_shown():
    none = np.zeros((0, 60, 70))
    view = make_view(p=0, n_stars=5, images=none, models=none, residuals=none)
    shown = panels(draw_result(view))
    assert [title for title, _ in shown] == [
        "extended source, whole frame",
        *(f"extended source, star {s}" for s in range(1, 6)),
    ]


@pytest.mark.exhaustive
def test_colour_bars_are_as_high_as_their_panels_and_their_ticks_apart():
    figure = draw_result(make_view(p=1))
    figure.canvas.draw()
    for axis in (axis for axis in figure.subfigs[0].axes if axis.images):
        (bar,) = axis.child_axes
        panel, beside = axis.get_window_extent(), bar.get_window_extent()
        assert (panel.y0, panel.y1) == pytest.approx((beside.y0, beside.y1), abs=1)
        labels = [each.get_window_extent() for each in bar.get_yticklabels() if each.get_text()]
        assert all(low.y1 <= high.y0 for low, high in pairwise(sorted(labels, key=lambda b: b.y0)))


def make_skies(k=2, **changes):
    names = ["line", "continuum", *(f"slice {i}" for i in range(2, k))]
    extended = np.random.default_rng(4).uniform(1.0, 5.0, (k, 60, 70))
    extended[0] *= 3.0
    noise = np.full(extended.shape, 0.2)
    noise[:, 30:] = np.nan  # not observed
    given = {"names": names, "extended": extended, "noise": noise}
    return make_view(p=1, **{**given, **changes})


def test_components_are_beside_each_other_on_one_stretch_with_their_ratio():
    view = make_skies()
    shown = panels(draw_result(view))
    assert [title for title, _ in shown] == [
        *("image, whole frame", "model", "residuals / noise"),
        *("line, whole frame", "continuum, whole frame"),
        "line / continuum, whole frame\ngrey: within noise",
        *("image, star 1", "model", "residuals / noise"),
        *("line, star 1", "continuum, star 1", "line / continuum, star 1\ngrey: within noise"),
    ]
    line, continuum, ratio = (image for _, image in shown[3:6])
    np.testing.assert_array_equal(line.get_array(), view.extended[0])
    assert line.norm.vmax == continuum.norm.vmax == view.extended[0].max()
    found = np.ma.filled(ratio.get_array(), np.nan)
    np.testing.assert_array_equal(found[:30], view.extended[0, :30] / view.extended[1, :30])
    assert np.isnan(found[30:]).all()


def test_a_ratio_is_blank_where_a_component_is_within_noise():
    view = make_skies(noise=np.full((2, 60, 70), 1.0))
    (ratio,) = view.ratios().values()
    np.testing.assert_array_equal(np.isfinite(ratio), (view.extended > 3.0).all(axis=0))
    assert not make_skies(names=["J", "K"]).ratios()
    assert not make_skies(noise=None).ratios()


def test_a_ratio_that_is_nowhere_known_is_drawn():
    view = make_skies(noise=np.full((2, 60, 70), np.nan))
    ratios = [image for title, image in panels(draw_result(view)) if title.startswith("line / ")]
    assert [np.isfinite(np.ma.filled(each.get_array(), np.nan)).any() for each in ratios] == [
        False,
        False,
    ]


def test_of_many_components_the_first_are_shown():
    figure = draw_result(make_skies(20))
    skies = [title for title, _ in panels(figure) if title.endswith(", whole frame")][1:]
    assert len(skies) == MOST_SKIES
    assert skies[-1] == "slice 8, whole frame"
    (said,) = (part.get_suptitle() for part in figure.subfigs if part.get_suptitle())
    assert said == "the first 9 of 39 components and ratios"


def test_without_images_components_have_their_row():
    view = make_skies(images=np.zeros((0, 60, 70)), stars=[], star_fluxes=np.zeros(0))
    assert [title.partition("\n")[0] for title, _ in panels(draw_result(view))] == [
        *("line, whole frame", "continuum, whole frame", "line / continuum, whole frame")
    ]


def test_doubtful_pixels_are_those_of_each_component():
    doubtful = np.zeros((2, 60, 70), bool)
    doubtful[1, 10:20, 10:20] = True
    shown = panels(draw_result(make_skies(doubtful=doubtful)))
    assert [OUTLINED in title for title, _ in shown[3:5]] == [False, True]
