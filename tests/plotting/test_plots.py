"""The figures show the right data, and refuse to be drawn without matplotlib."""

import sys

import numpy as np
import pytest

from lnocl.errors import LnoclError
from lnocl.plotting.curves import draw_costs, draw_errors, draw_magnitudes
from lnocl.plotting.figure import save_figure
from lnocl.plotting.overview import draw_overview
from lnocl.plotting.profiles import draw_bands, draw_profiles
from lnocl.plotting.psf import PSF_FLOOR, draw_star_psf
from lnocl.plotting.sources import Frame, Source, draw_objects

pytest.importorskip("matplotlib")

STAR = (20, 24)
FRAME = Frame(STAR, 5.0)


def jet(scale=1.0):
    """Return a jet that starts at the star and goes up, shape (64, 48)."""
    y, x = np.mgrid[:64, :48]
    return scale * 1e3 * np.exp(-0.5 * ((x - STAR[0]) / 3.0) ** 2) / (1 + np.exp(STAR[1] - y))


TRUTH = Source("truth", jet())
WITH_STAR = jet(0.8)
WITH_STAR[STAR[1], STAR[0]] += 1e7
FOUND = [Source("RLM", WITH_STAR, holds_star=True), Source("MC-RL", jet(1.1))]
CURVE = {
    "iteration": np.array([10.0, 20.0, 30.0]),
    "rho": np.array([0.5, 0.2, 0.3]),
    "rho_star": np.array([0.6, 0.5, 0.4]),
    "magnitude": np.array([13.2, 13.1, 13.0]),
}


def lines(axis):
    return {line.get_label(): line.get_data() for line in axis.lines}


def panels(figure):
    """Return the images of a figure, colour bars apart."""
    return [axis.images[0] for axis in figure.axes if axis.images]


def test_objects_are_shown_on_the_stretch_of_the_truth():
    shown = panels(draw_objects(TRUTH, FOUND, FRAME))
    assert len(shown) == 6
    assert {image.norm.vmax for image in shown} == {TRUTH.extended.max()}
    titles = [image.axes.get_title() for image in shown]
    assert titles == ["truth", "RLM", "MC-RL"] * 2
    np.testing.assert_array_equal(shown[1].get_array(), WITH_STAR)


def test_the_star_does_not_set_the_stretch_where_there_is_no_truth():
    shown = panels(draw_objects(None, FOUND, FRAME))
    assert shown[0].norm.vmax == pytest.approx(1.1e3)


def test_axes_are_in_mas_from_the_star_or_in_pixels():
    near = panels(draw_objects(TRUTH, FOUND, FRAME))[-1].axes
    assert near.get_xlabel() == "x from star (mas)"
    assert near.get_ylim() == (-80, 160)
    # The pixel of the star is centred on 0.
    left, right, bottom, top = near.images[0].get_extent()
    assert (left, right, bottom, top) == (-102.5, 137.5, -122.5, 197.5)
    whole = panels(draw_objects(TRUTH, FOUND[1:], Frame()))[-1].axes
    assert whole.get_xlabel() == "x (pixels)"
    assert whole.get_xlim() == (-0.5, 47.5)


def test_errors_are_in_percent_with_their_minimum_marked():
    left, right = draw_errors({"MC-RL": CURVE}).axes
    np.testing.assert_allclose(lines(left)["MC-RL"][1], [50, 20, 30])
    np.testing.assert_allclose(lines(right)["MC-RL"][1], [60, 50, 40])
    (x, y) = left.lines[1].get_data()
    assert (x.tolist(), y.tolist()) == ([20.0], [20.0])


def test_magnitudes_are_bright_upwards():
    (axis,) = draw_magnitudes({"RLM": CURVE}, 13.0).axes
    assert axis.yaxis_inverted()
    assert set(lines(axis)) == {"RLM", "truth"}
    (axis,) = draw_magnitudes({"RLM": CURVE}, None).axes
    assert set(lines(axis)) == {"RLM"}


@pytest.mark.parametrize(("kind", "expected"), [("flux", 10.0), ("width", 0.0)])
def test_profiles_and_their_errors(kind, expected):
    # So low a threshold that both jets are as wide.
    figure = draw_profiles(kind, TRUTH, FOUND, FRAME, near=20, threshold=1e-12)
    near, rest, near_error, rest_error = figure.axes
    np.testing.assert_array_equal(lines(near)["MC-RL"][0], 5.0 * np.arange(-20, 20))
    for axis in (near_error, rest_error):
        values = lines(axis)["MC-RL"][1]
        np.testing.assert_allclose(values[np.isfinite(values)], expected, atol=1e-9)
    masked = np.isnan(lines(near)["RLM"][1])
    assert np.flatnonzero(masked).tolist() == [19, 20, 21]
    assert lines(rest)["RLM"][0][0] == 5.0 * 20


@pytest.mark.parametrize("kind", ["flux", "width"])
@pytest.mark.parametrize("star", [(20, 4), (20, 62)])
def test_profiles_of_a_star_in_the_dark_or_at_the_edge(kind, star):
    light = jet()
    light[:30] = 0.0
    dark = Source("truth", light)
    figure = draw_profiles(kind, dark, FOUND, Frame(star), near=20, threshold=1.0)
    assert all(len(lines(axis)["MC-RL"][0]) for axis in figure.axes)


def test_the_overview_has_a_panel_for_each_and_two_profiles(tmp_path):
    figure = draw_overview(TRUTH, Source("image", jet()), FOUND, FRAME, 20)
    assert len(panels(figure)) == 4
    save_figure(figure, str(tmp_path / "overview.png"))
    raw = (tmp_path / "overview.png").read_bytes()
    assert raw.startswith(b"\x89PNG")
    assert len(raw) < 200_000


@pytest.mark.exhaustive
def test_more_results_than_colours_are_drawn(tmp_path):
    many = [Source(f"MC-RL mu={i}", jet()) for i in range(8)]
    assert len(draw_profiles("flux", TRUTH, many, FRAME, 20, 100.0).axes) == 4
    save_figure(draw_objects(TRUTH, many, FRAME), str(tmp_path / "objects.png"))
    assert (tmp_path / "objects.png").stat().st_size < 200_000


def test_pyplot_is_left_alone():
    draw_objects(TRUTH, FOUND, FRAME)
    assert "matplotlib.pyplot" not in sys.modules


def test_without_matplotlib_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(LnoclError, match=r"pip install matplotlib$"):
        draw_errors({"RLM": CURVE})


@pytest.mark.parametrize("angle", [0.0, 30.0])
def test_a_psf_is_shown_beside_the_frame_that_it_was_made_from(angle):
    y, x = np.mgrid[:61, :70]
    frame = np.exp(-((x - 30) ** 2 + (y - 28) ** 2) / 8.0) - 0.01
    bad = np.zeros(frame.shape, bool)
    bad[28, 31] = True
    psf = frame[18:39, 20:41]
    figure = draw_star_psf(frame, bad, [(30.0, 28.0)], [psf], [angle])
    left, right = panels(figure)
    assert left.get_array().mask[28, 31]
    assert left.get_array().mask.sum() == 1
    assert left.get_extent() == [-30.5, 39.5, -28.5, 32.5]
    np.testing.assert_array_equal(right.get_array(), (psf / psf.max()).clip(PSF_FLOOR))
    assert right.get_extent() == [-10.5, 10.5, -10.5, 10.5]
    crop = np.array(left.axes.lines[0].get_data())
    # What was at -angle in the frame is along x in the PSF.
    turn = np.exp(-1j * np.radians(angle))
    np.testing.assert_allclose((crop[0] + 1j * crop[1])[2], (10.5 + 10.5j) * turn)
    np.testing.assert_array_equal(lines(figure.axes[2])["along x"][1], psf[10] / psf.max())
    np.testing.assert_array_equal(lines(figure.axes[2])["along y"][1], psf[:, 10] / psf.max())
    assert (right.axes.get_title() == "PSF") == (angle == 0)


def test_several_psfs_are_shown_in_a_row_each():
    frame = np.arange(900.0).reshape(30, 30)
    psfs = [frame[5:16, 5:16], frame[6:17, 6:17]]
    figure = draw_star_psf(frame, frame < 0, [(12.0, 12.0), (15.0, 9.0)], psfs, [0.0, 90.0])
    images = panels(figure)
    assert len(images) == 4
    for image, psf in zip(images[1::2], psfs, strict=True):
        np.testing.assert_array_equal(image.get_array(), psf / psf.max())
    assert [image.axes.get_title() for image in images[1::2]] == [
        "PSF",
        "PSF, rotated by 90 degrees",
    ]


BAD = r"$\bad{$"  # a formula to matplotlib, which it cannot read
BAND = {name: [1.0, 2.0] for name in ("at", "value", "bias", "low68", "high68", "low95", "high95")}


@pytest.mark.parametrize(
    "draw",
    [
        lambda: draw_objects(TRUTH, [Source(BAD, jet(), note=BAD)], FRAME),
        lambda: draw_profiles("flux", TRUTH, [Source(BAD, jet())], FRAME, 8, 0.1),
        lambda: draw_errors({BAD: CURVE}),
        lambda: draw_magnitudes({BAD: CURVE}, None),
        lambda: draw_costs(
            {BAD: {name: np.ones(2) for name in ("seconds", "deviation", "front")}}, "all rows"
        ),
        lambda: draw_bands(BAD, BAND, BAND, BAD),
    ],
    ids=["objects", "profiles", "errors", "magnitudes", "costs", "bands"],
)
def test_words_of_users_and_files_are_no_formulas(draw):
    from matplotlib.text import Text

    figure = draw()
    assert any("bad" in each.get_text() for each in figure.findobj(Text))
    figure.draw_without_rendering()
