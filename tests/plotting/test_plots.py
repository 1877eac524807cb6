"""The figures show the right data, and refuse to be drawn without matplotlib."""

import sys

import numpy as np
import pytest
from result_views import make_view

from lnocl.errors import LnoclError
from lnocl.plotting.beside import draw_beside
from lnocl.plotting.profiles import draw_bands
from lnocl.plotting.psf import PSF_FLOOR, draw_star_psf

pytest.importorskip("matplotlib")


def lines(axis):
    return {line.get_label(): line.get_data() for line in axis.lines}


def panels(figure):
    """Return the images of a figure, colour bars apart."""
    return [axis.images[0] for axis in figure.axes if axis.images]


def views():
    """Return two results of one star, which is a part of the first as its brightest pixel."""
    with_star = make_view(p=0, stars=[], star_fluxes=np.zeros(0))
    with_star.extended[20, 10] = 1e7
    return {"RLM": with_star, "MC-RL": make_view(p=0)}


def test_results_are_shown_on_one_stretch_whole_and_round_the_star():
    both = views()
    shown = panels(draw_beside(both))
    assert [image.axes.get_title() for image in shown] == 2 * ["RLM", "MC-RL"]
    np.testing.assert_array_equal(shown[0].get_array(), both["RLM"].extended)
    # The star at (10, 20), and 16 pixels round it, cut at the frame.
    np.testing.assert_array_equal(shown[2].get_array(), both["RLM"].extended[4:37, :27])
    # The star in one of them does not set the stretch.
    tops = [image.norm.vmax for image in shown]
    whole, near = both["MC-RL"].extended.max(), both["MC-RL"].extended[4:37, :27].max()
    assert tops == [whole, whole, near, near]


def test_results_without_stars_or_light_are_shown_whole():
    dark = make_view(p=0, stars=[], star_fluxes=np.zeros(0), extended=np.zeros((60, 70)))
    shown = panels(draw_beside({"a": dark, "b": dark}))
    assert len(shown) == 2


def test_pyplot_is_left_alone():
    draw_beside(views())
    assert "matplotlib.pyplot" not in sys.modules


def test_missing_matplotlib_raises_an_error_with_its_install_command(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(LnoclError, match=r"pip install matplotlib$"):
        draw_beside(views())


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
        lambda: draw_beside({BAD: make_view(p=0)}),
        lambda: draw_bands(BAD, {BAD: (BAND, BAND)}, BAD),
    ],
    ids=["beside", "bands"],
)
def test_words_of_users_and_files_are_no_formulas(draw):
    from matplotlib.text import Text

    figure = draw()
    assert any("bad" in each.get_text() for each in figure.findobj(Text))
    figure.draw_without_rendering()
