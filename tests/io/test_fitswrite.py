"""FITS out: what of a run a file keeps."""

import os
import subprocess

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.fits.scripts import fitscheck
from astropy.table import QTable
from hypothesis import given
from hypothesis import strategies as st

from lnocl.io import fitswrite
from lnocl.io.parts import Column

IMAGE = np.arange(1.0, 121.0).reshape(10, 12)
HISTORY = np.array([(0, 3.5), (1, 2.5)], dtype=[("iteration", np.int64), ("objective", float)])


def write(path, **changes):
    fitswrite.write_result(
        **{
            "path": str(path),
            "extended": IMAGE,
            "stars": [(3.0, 4.5)],
            "star_fluxes": [17.25],
            "parts": {"HISTORY": HISTORY, **changes.pop("parts", {})},
        }
        | changes
    )
    return str(path)


class TestWriting:
    def test_the_file_holds_the_result_and_opens_without_a_warning(self, tmp_path):
        path = write(tmp_path / "out.fits", cards=[("MU", 0.25, "weight")])
        with fits.open(path, checksum=True) as hdus:
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "STARS", "HISTORY"]
            np.testing.assert_array_equal(hdus[0].data, IMAGE)
            assert hdus[0].header["BUNIT"] == "electron"
            assert hdus[0].header["MU"] == 0.25
            assert hdus[0].header.comments["MU"] == "weight"
        stars = QTable.read(path, hdu="STARS")
        assert [str(stars[name].unit) for name in stars.colnames] == ["pix", "pix", "ct"]
        assert [column.value.item() for column in stars.columns.values()] == [3.0, 4.5, 17.25]
        history = QTable.read(path, hdu="HISTORY")
        assert history.colnames == ["iteration", "objective"]
        np.testing.assert_array_equal(history.as_array(), HISTORY)

    def test_further_columns_of_the_stars(self, tmp_path):
        columns = [
            Column("mag", [17.5], "mag", "by the zero point"),
            Column("ra", np.array([150.25]), "deg", "right ascension, ICRS"),
            Column("x_error", [0], "", "standard error"),
        ]
        path = write(tmp_path / "out.fits", star_columns=columns, unit="electron/s")
        stars = QTable.read(path, hdu="STARS")
        assert stars.colnames == ["x", "y", "flux", "mag", "ra", "x_error"]
        assert [str(stars[name].unit) for name in stars.colnames[:5]] == [
            "pix", "pix", "ct / s", "mag", "deg"
        ]  # fmt: skip
        assert [float(stars[name].value[0]) for name in ("mag", "ra")] == [17.5, 150.25]
        header = fits.getheader(path, "STARS")
        assert header.comments["TTYPE3"] == "electron/s"
        assert header.comments["TTYPE4"] == "by the zero point"
        assert fits.getheader(path)["BUNIT"] == "electron/s"
        assert fitscheck.main(["--compliance", path]) == 0

    def test_cubes_have_their_unit_and_the_coordinates_of_the_image(self, tmp_path):
        cube = np.random.default_rng(2).normal(size=(3, *IMAGE.shape))
        cube[1, 2, 3] = np.nan
        wcs = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 4.5})
        cubes = {"MODELS": cube, "RESIDUALS": 2.0 * cube}
        path = write(tmp_path / "out.fits", wcs=wcs, parts=cubes, cards=[("MU", 0.25, "")])
        with fits.open(path, checksum=True) as hdus:
            assert [hdu.name for hdu in hdus][3:] == ["MODELS", "RESIDUALS"]
            np.testing.assert_array_equal(hdus["MODELS"].data, cube.astype("f4"))
            np.testing.assert_array_equal(hdus["RESIDUALS"].data, (2.0 * cube).astype("f4"))
            assert hdus["MODELS"].header["BUNIT"] == "electron"
            assert "BUNIT" not in hdus["RESIDUALS"].header
            for hdu in hdus[3:]:
                assert hdu.header["CRPIX1"] == 4.5
                assert "MU" not in hdu.header
        assert fitscheck.main(["--compliance", path]) == 0

    def test_cubes_of_shifted_images_have_offsets_in_the_place_of_coordinates(self, tmp_path):
        wcs = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 4.5})
        cubes = {"MODELS": np.ones((2, *IMAGE.shape))}
        maps = np.array([np.eye(2, 3)] * 2)
        maps[1, :, 2] = 7.0, -4.0
        path = write(tmp_path / "out.fits", wcs=wcs, parts=cubes, transforms=maps)
        header = fits.getheader(path, "MODELS")
        assert not {"CTYPE1", "CTYPE2", "CRPIX1"} & set(header)
        assert [header[f"OFF{axis}"] for axis in ("X1", "Y1", "X2", "Y2")] == [0, 0, 7, -4]
        assert header["BUNIT"] == "electron"
        assert fits.getheader(path)["CRPIX1"] == 4.5
        assert fitscheck.main(["--compliance", path]) == 0
        assert "R11_1" not in header
        maps[1, :, :2] = [[0.6, -0.8], [0.8, 0.6]]
        path = write(tmp_path / "turned.fits", wcs=wcs, parts=cubes, transforms=maps)
        header = fits.getheader(path, "MODELS")
        assert [header[f"R{ab}_2"] for ab in ("11", "12", "21", "22")] == [0.6, -0.8, 0.8, 0.6]
        maps[:] = np.eye(2, 3)
        path = write(tmp_path / "same.fits", wcs=wcs, parts=cubes, transforms=maps)
        header = fits.getheader(path, "MODELS")
        assert header["CRPIX1"] == 4.5
        assert "OFFX1" not in header

    @pytest.mark.parametrize("value", ["x" * 300, "it's 'quoted' & more &", "naïve\n☃", "a\\b"])
    def test_strings_of_any_kind_survive_in_cards(self, tmp_path, value):
        path = write(tmp_path / "out.fits", cards=[("DEVICE", value, "")])
        kept = fits.getheader(path)["DEVICE"]
        assert kept.encode("ascii").decode("unicode_escape") == value
        assert fitscheck.main(["--compliance", path]) == 0


NAMES = st.text(
    st.characters(exclude_characters="\0") | st.sampled_from("'\"\\ \n&$é\udcff"), max_size=200
).filter(lambda name: not any("\ud800" <= c <= "\udfff" and c != "\udcff" for c in name))


class TestHistoryLines:
    def test_an_option_stays_on_the_line_of_its_value(self):
        stars = [
            word for x in range(9) for word in ("--star", f"64.30392124261{x},61.8020699660565")
        ]
        lines = fitswrite.history_lines(["lnocl", "deconvolve", "a.fits", *stars])
        assert len(lines) > 4
        assert all(line.split().count("--star") == line.count(",") for line in lines)

    @given(words=st.lists(NAMES, min_size=1, max_size=6))
    def test_history_cards_run_by_a_shell_reproduce_the_arguments(self, words):
        header = fits.Header()
        for line in fitswrite.history_lines(["printf", "%s\\0", *words]):
            assert len(line) <= 72
            assert line.isascii()
            assert line.isprintable()
            header.add_history(line)
        header = fits.Header.fromstring(header.tostring())
        script = "\n".join(header["HISTORY"])
        printed = subprocess.run(["bash", "-c", script], capture_output=True, check=True).stdout
        assert printed == b"".join(os.fsencode(word) + b"\0" for word in words)
