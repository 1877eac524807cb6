"""What a notebook shows of observations and results."""

import base64
import io
import sys

import numpy as np
import pytest
from scenes import Recipe

import lnocl
from lnocl.notebook import block_means, html_card, thumbnail


def pixels(content):
    from matplotlib.image import imread

    return imread(io.BytesIO(base64.b64decode(content)))


def test_a_thumbnail_has_y_upwards_and_bad_pixels_grey():
    pytest.importorskip("matplotlib")
    image = np.zeros((30, 20))
    image[25, 3] = 100.0
    image[5, 10] = np.nan
    shown = pixels(thumbnail(image))
    assert shown.shape[:2] == (30, 20)
    assert np.unravel_index(shown[..., 0].argmax(), (30, 20)) == (30 - 1 - 25, 3)
    np.testing.assert_allclose(shown[30 - 1 - 5, 10, :3], 150 / 255)


def test_a_large_image_is_shown_in_blocks():
    pytest.importorskip("matplotlib")
    assert pixels(thumbnail(np.ones((1000, 300)))).shape[:2] == (250, 75)


def test_means_of_blocks_leave_bad_pixels_out():
    image = np.arange(20.0).reshape(4, 5)
    image[0, 0] = image[2:, 2:4] = np.nan
    expected = [[(1 + 5 + 6) / 3, 5.0, 6.5], [13.0, np.nan, 16.5]]
    np.testing.assert_allclose(block_means(image, 2), expected)


@pytest.mark.parametrize("shape", [(10, 5000), (5000, 10), (1, 257)])
def test_a_long_image_is_shown(shape):
    pytest.importorskip("matplotlib")
    step = -(-max(shape) // 256)
    expected = tuple(-(-n // step) for n in shape)
    assert pixels(thumbnail(np.ones(shape))).shape[:2] == expected


@pytest.mark.parametrize("value", [0.0, 5.0, np.nan])
def test_flat_and_unknown_images_are_shown(value):
    pytest.importorskip("matplotlib")
    assert pixels(thumbnail(np.full((9, 8), value))).shape[:2] == (9, 8)


def test_texts_are_escaped():
    page = html_card("<b>", {"<i>": "<script>\nnext"}, np.ones((4, 4)))
    assert "<script>" not in page
    assert "&lt;script&gt;<br>next" in page
    assert "&lt;i&gt;" in page


def test_without_matplotlib_the_table_is_there(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page = html_card("a", {"b": "c"}, np.ones((4, 4)))
    assert "<img" not in page
    assert "<td style='text-align:left'>c</td>" in page


def test_observation_repr_shows_its_shapes_exposures_and_mask():
    made = Recipe((16, 12), n_images=2, background="each", read_noise=3.0, masked=0.25).make()
    page = made.observation(exposure=[10.0, 30.0])._repr_html_()
    for words in ("2 of 12 x 16 pixels", "10 to 30", "bad pixels", "8 x 7 pixels"):
        assert words in page


def test_result_repr_shows_iterations_and_star_fluxes():
    made = Recipe((16, 12), n_stars=2).make()
    result = made.deconvolve(n_iter=2, engine="numpy")
    page = result._repr_html_()
    assert "2 (n_iter)" in page
    for (x, y), flux in zip(result.star_positions, result.star_fluxes, strict=True):
        assert f"({x:.2f}, {y:.2f}): {flux:.5g}" in page


class TestWrite:
    @pytest.fixture
    def result(self):
        made = Recipe((16, 12), n_images=2, n_stars=2).make()
        return made.deconvolve(made.observation(exposure=[2.0, 4.0]), n_iter=2, engine="numpy")

    def test_the_file_has_the_result(self, result, tmp_path):
        from astropy.io import fits

        header = fits.Header({"OBJECT": "RW Aur", "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"})
        result.write(tmp_path / "a.fits", header=header)
        with fits.open(tmp_path / "a.fits", checksum=True) as file:
            np.testing.assert_array_equal(file[0].data, result.extended)
            assert file[0].header["BUNIT"] == "electron/s"
            assert file[0].header["OBJECT"] == "RW Aur"
            assert file[0].header["CTYPE1"] == "RA---TAN"
            assert file[0].header["NITER"] == 2
            np.testing.assert_array_equal(file["STARS"].data["flux"], result.star_fluxes)
            np.testing.assert_array_equal(
                file["HISTORY"].data["objective"], result.history["objective"]
            )
            models, residuals = file["MODELS"].data, file["RESIDUALS"].data
            np.testing.assert_array_equal(models, result.models().astype("f4"))
            np.testing.assert_array_equal(residuals, result.residuals().astype("f4"))

    @pytest.mark.filterwarnings("ignore:psf 0 is undersampled")
    def test_errors_of_refined_stars_are_columns(self, tmp_path):
        from astropy.table import Table

        made = Recipe((24, 24), n_stars=1, smooth=True).make()
        result = made.deconvolve(n_iter=3, engine="numpy", refine_positions=True)
        result.write(tmp_path / "a.fits")
        table, stars = Table.read(tmp_path / "a.fits", hdu="STARS"), result.to_table()
        assert table.colnames == [*stars.colnames, "core_rms", "wings_rms", "halo"]
        for name in stars.colnames:
            np.testing.assert_array_equal(table[name], stars[name].value)

    def test_refusals(self, result, tmp_path):
        (tmp_path / "there.fits").write_text("kept")
        with pytest.raises(lnocl.FileError, match=r"there.fits exists"):
            result.write(tmp_path / "there.fits")
        assert (tmp_path / "there.fits").read_text() == "kept"
        with pytest.raises(lnocl.InputError, match=r"a name ending in \.fits"):
            result.write(tmp_path / "a.txt")
        result.write(tmp_path / "there.fits", overwrite=True)
