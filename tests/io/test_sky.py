"""Positions on the sky and tables of stars, against astropy, and offsets by the WCS."""

import codecs
import logging

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import MaskedColumn, QTable, Table
from astropy.wcs import WCS
from hypothesis import given
from hypothesis import strategies as st
from wcs_headers import PLAIN, SIP_TERMS

from lnocl.errors import FileError, InputError, LnoclWarning
from lnocl.io import places, sky, star_files
from lnocl.io.headers import make_wcs

SHAPE = (16, 12)
SCALE = 1e-5


def header(angle=0.0, scale=SCALE, mirror=False, **changes):
    """Return a header whose x axis is turned by an angle in degrees."""
    cos, sin = scale * np.cos(np.radians(angle)), scale * np.sin(np.radians(angle))
    turned = {"CD1_1": -cos, "CD1_2": sin, "CD2_1": sin, "CD2_2": cos}
    if mirror:
        turned |= {"CD1_1": cos, "CD2_1": -sin}
    return fits.Header(PLAIN | turned | changes)


def with_sip(**changes):
    return header(**(SIP_TERMS | changes))


GALACTIC = {"CTYPE1": "GLON-TAN", "CTYPE2": "GLAT-TAN"}
SOLAR = {"CTYPE1": "HPLN-TAN", "CTYPE2": "HPLT-TAN"}
HEADERS = {
    "TAN": header(),
    "turned": header(angle=37.0),
    "SIP": with_sip(),
    "galactic": header(**GALACTIC),
    "FK5": header(RADESYS="FK5", EQUINOX=1975.0),
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in a folder of its own."""
    monkeypatch.chdir(tmp_path)


class TestOffsets:
    @given(dx=st.floats(-9, 9), dy=st.floats(-12, 12), angle=st.floats(0, 360))
    def test_another_reference_pixel_is_the_offset(self, dx, dy, angle):
        headers = [header(angle), header(angle, CRPIX1=6.0 + dx, CRPIX2=8.0 + dy)]
        found = sky.transforms(headers, ["a", "b"], [SHAPE, SHAPE])[:, :, 2]
        np.testing.assert_allclose(found, [(0, 0), (dx, dy)], atol=1e-6)

    @given(dx=st.floats(-9, 9), dy=st.floats(-12, 12))
    def test_so_is_another_reference_value(self, dx, dy):
        # A telescope that points dx to the left in the image sees everything dx to the right.
        at = WCS(header()).pixel_to_world(5.0 - dx, 7.0 - dy)
        headers = [header(), header(CRVAL1=at.ra.deg, CRVAL2=at.dec.deg)]
        found = sky.transforms(headers, ["a", "b"], [SHAPE, SHAPE])[:, :, 2]
        np.testing.assert_allclose(found[1], (dx, dy), atol=1e-3)

    def test_with_sip_as_stars_in_the_middle_move(self):
        mild = {"A_2_0": 3e-4, "B_0_2": -3e-4}
        headers = [with_sip(**mild), with_sip(**mild, CRPIX1=8.5, CRPIX2=7.25)]
        found = sky.transforms(headers, ["a", "b"], [SHAPE, SHAPE])[:, :, 2]
        np.testing.assert_allclose(found[1], (2.5, -0.75), atol=1e-6)
        at = WCS(headers[0]).pixel_to_world(3.0, 9.0)
        headers[1] = with_sip(**mild, CRVAL1=at.ra.deg, CRVAL2=at.dec.deg)
        x, y = np.meshgrid([3.5, 5.5, 7.5], [5.5, 7.5, 9.5])
        stars = WCS(headers[0]).pixel_to_world(x, y)
        moved = np.array(WCS(headers[1]).world_to_pixel(stars)) - (x, y)
        found = sky.transforms(headers, ["a", "b"], [SHAPE, SHAPE])[:, :, 2]
        np.testing.assert_allclose(found[1], moved.mean(axis=(1, 2)), atol=1e-3)

    def test_small_rotation_is_neglected(self):
        # 0.5 degrees move the corners by 7.5 pixels times 0.0087.
        found = sky.transforms([header(), header(angle=0.5)], ["a", "b"], [SHAPE, SHAPE])
        np.testing.assert_array_equal(found[1, :, :2], np.eye(2))
        np.testing.assert_allclose(found[1, :, 2], 0.0, atol=0.1)

    @pytest.mark.parametrize(
        "turn",
        [{"angle": 1.0}, {"angle": 180.0}, {"mirror": True}, {"angle": 9.0, "scale": 2.5 * SCALE}],
    )
    def test_a_turn_is_that_of_the_coordinates(self, turn):
        headers = [header(), header(**turn, CRPIX1=6.5, CRPIX2=7.25)]
        found = sky.transforms(headers, ["a", "b"], [SHAPE, SHAPE])[1]
        points = np.array([(2.0, 3.0), (9.0, 1.5), (5.0, 11.0)])
        there = WCS(headers[1]).world_to_pixel(WCS(headers[0]).pixel_to_world(*points.T))
        np.testing.assert_allclose(
            points @ found[:, :2].T + found[:, 2], np.transpose(there), atol=1e-4
        )

    @pytest.mark.parametrize(
        ("other", "message"),
        [
            (with_sip(A_2_0=1e-2), "b.fits is rotated by 0.00 degrees and scaled by 0.9999 "
             "relative to a.fits, and after rotation, scale and shift pixels are up to 0.17 off: "
             "images are never resampled; cut them to where it is less"),
            (fits.Header(), "b.fits has no sky coordinates (WCS) that can be used; leave align"),
            (header(**SOLAR), "b.fits has no sky coordinates (WCS) that can be used"),
            (header(CRVAL1=152.0), "b.fits shows another part of the sky than a.fits, by its sky "
             "coordinates; leave one of them out"),
            (header(CRPIX1=18.0), "b.fits shows another part of the sky than a.fits"),
            (header(CRPIX2=-9.0), "b.fits shows another part of the sky than a.fits"),
            (header(CRVAL1=330.0, CRVAL2=-30.0), "b.fits shows another part of the sky than a.fit"),
            (with_sip(CRVAL1=150.01), "b.fits shows another part of the sky than a.fits"),
        ],
    )  # fmt: skip
    def test_refusals(self, other, message):
        with pytest.raises(InputError) as caught:
            sky.transforms([header(), other], ["a.fits", "b.fits"], [SHAPE, SHAPE])
        assert message in str(caught.value)


class TestPositions:
    @pytest.mark.parametrize("given", HEADERS.values(), ids=HEADERS)
    def test_there_and_back_as_astropy_has_it(self, given):
        positions = np.array([(0.0, 0.0), (5.25, 7.5), (11.0, 15.0)])
        wcs = sky.celestial_wcs(given, "a.fits")
        degrees = sky.to_sky(positions, given)
        expected = WCS(given).pixel_to_world(*positions.T).icrs
        np.testing.assert_allclose(degrees, np.array([expected.ra.deg, expected.dec.deg]).T)
        texts = [f"{ra!r}d,{dec!r}d" for ra, dec in degrees.tolist()]
        found = sky.to_pixels(sky.parse_sky(texts), wcs, "a.fits")
        np.testing.assert_allclose(found, positions, atol=1e-6)

    @given(ra=st.floats(0, 359.99), dec=st.floats(-89.99, 89.99), sep=st.sampled_from(": "))
    def test_degrees_and_sexagesimal_are_the_same(self, ra, dec, sep):
        position = SkyCoord(ra, dec, unit="deg")
        ra_text = position.ra.to_string("hour", sep=sep, precision=6)
        dec_text = position.dec.to_string("deg", sep=sep, precision=6)
        found = sky.parse_sky([f"{ra:.12f}d,{dec:.12f}d", f"{ra_text},{dec_text}"])
        assert found.separation(position).arcsec.max() < 2e-4

    @pytest.mark.parametrize(
        "text",
        ["", "1", "15.25,-3:30:00", "x,y", "10d,95d", "25:00:00,3:00:00", "1,2,3", "nand,5d",
         "infd,5d", "10d,", ",10d", "1:61:00,5:00:00", "15.25,-3.5d", "10d,5d,3d"],
    )  # fmt: skip
    def test_invalid_positions_are_refused(self, text):
        with pytest.raises(InputError) as caught:
            sky.parse_sky(["1d,2d", text])
        assert str(caught.value) == (
            f"{text!r} is neither X,Y in pixels nor RA,DEC with units, as in 65d,19.5d or "
            "4:20:00,19:30:00"
        )

    @pytest.mark.parametrize("given", [header(), with_sip()])
    def test_position_outside_the_projection_is_refused(self, given):
        wcs = sky.celestial_wcs(given, "a.fits")
        coordinates = sky.parse_sky(["150d,30d", "330d,-30d"])
        with pytest.raises(InputError) as caught:
            sky.to_pixels(coordinates, wcs, "a.fits")
        assert str(caught.value) == (
            "the star at RA, Dec 330.00000 -30.00000 lies in another part of the sky than a.fits"
        )

    @pytest.mark.parametrize(
        "given",
        [fits.Header(), fits.Header({"CTYPE1": "LINEAR", "CTYPE2": "LINEAR"}), header(**SOLAR),
         header(CD1_1=0.0, CD2_2=0.0, CD1_2=0.0, CD2_1=0.0), header(RADESYS="GAPPT")],
    )  # fmt: skip
    def test_header_without_a_usable_celestial_wcs_is_refused(self, given):
        assert not sky.has_celestial(given)
        with pytest.raises(InputError) as caught:
            sky.celestial_wcs(given, "a.fits")
        assert str(caught.value) == (
            "a.fits has no sky coordinates (WCS) that can be used; give positions in pixels"
        )


POSITIONS = np.array([(2.5, 3.0), (7.0, 11.25)])
ICRS = WCS(header()).pixel_to_world(*POSITIONS.T)


def stars(path, given=None):
    return star_files.read_stars(path, header() if given is None else given, "a.fits")


def save(path, text):
    with open(path, "w") as stream:
        stream.write(text)
    return path


class TestTables:
    @pytest.mark.parametrize("name", ["t.csv", "t.ecsv", "t.fits", "t.vot"])
    @pytest.mark.parametrize("kind", [Table, QTable])
    def test_pixels_in_any_format(self, caplog, name, kind):
        caplog.set_level(logging.INFO, "lnocl")
        unit = 1 if name == "t.csv" else u.pix
        kind({"id": ["a", "b"], "X": POSITIONS[:, 0] * unit, "y": POSITIONS[:, 1] * unit}).write(
            name, **({"format": "votable"} if name == "t.vot" else {})
        )
        np.testing.assert_array_equal(stars(name, fits.Header()), POSITIONS)
        said = [record.getMessage() for record in caplog.records]
        assert said == [f"{name}: 2 stars, by X and y"]

    @pytest.mark.parametrize("name", ["t.ecsv", "t.fits"])
    @pytest.mark.parametrize("unit", [u.deg, u.rad, u.hourangle, u.arcsec])
    @pytest.mark.parametrize("kind", [Table, QTable])
    def test_the_sky_in_any_unit(self, name, unit, kind):
        if (name, unit) == ("t.fits", u.hourangle):
            pytest.skip("FITS has no such unit")
        kind({"RA": ICRS.ra.to(unit), "Dec": ICRS.dec.to(u.deg)}).write(name)
        np.testing.assert_allclose(stars(name), POSITIONS, atol=1e-4)

    def test_the_sky_without_a_unit_is_in_degrees(self):
        Table({"ra": ICRS.ra.deg, "dec": ICRS.dec.deg}).write("t.csv")
        np.testing.assert_allclose(stars("t.csv"), POSITIONS, atol=1e-6)

    @pytest.mark.parametrize(
        ("date", "years"),
        [({"DATE-OBS": "2024-01-01T00:00:00"}, 8.0), ({"MJD-AVG": 58849.0}, 4.0)],
    )
    def test_stars_of_gaia_are_moved_to_the_date_of_the_image(self, caplog, date, years):
        caplog.set_level(logging.INFO, "lnocl")
        table = Table({"ra": ICRS.ra.deg, "dec": ICRS.dec.deg, "ref_epoch": [2016.0, 2016.0]})
        table["pmra"] = np.ma.MaskedArray([-50.0, 7.0], [False, True])  # mas a year
        table["pmdec"] = np.ma.MaskedArray([30.0, 7.0], [False, True])
        table.write("t.ecsv")
        found = stars("t.ecsv", header(**date)) - POSITIONS
        moved = SkyCoord(
            ICRS.ra + np.array([-0.05, 0.0]) * years * u.arcsec / np.cos(ICRS.dec),
            ICRS.dec + np.array([0.03, 0.0]) * years * u.arcsec,
        )
        expected = np.transpose(WCS(header()).world_to_pixel(moved)) - POSITIONS
        np.testing.assert_allclose(found, expected, atol=2e-3 * abs(expected).max())
        assert abs(expected[0]).max() > 1
        assert "t.ecsv: moved by proper motions to" in caplog.text

    @pytest.mark.parametrize(
        ("columns", "cards", "lacking"),
        [
            ({"ref_epoch": [2016.0, 2016.0]}, {}, "the image has no date"),
            ({"ref_epoch": [2016.0, 2016.0]}, {"DATE-OBS": "long ago"}, "the image has no date"),
            ({}, {"DATE-OBS": "2024-01-01"}, "there is no column ref_epoch"),
        ],
    )
    def test_unusable_proper_motions_are_reported(self, caplog, columns, cards, lacking):
        caplog.set_level(logging.INFO, "lnocl")
        motions = {"pmra": [1e3, 1e3], "pmdec": [1e3, 1e3]}
        Table({"ra": ICRS.ra.deg, "dec": ICRS.dec.deg, **motions, **columns}).write("t.ecsv")
        np.testing.assert_allclose(stars("t.ecsv", header(**cards)), POSITIONS, atol=1e-6)
        assert f"t.ecsv: its proper motions are not heeded, as {lacking}" in caplog.text

    @pytest.mark.parametrize("given", [header(), fits.Header()], ids=["wcs", "no wcs"])
    def test_pixels_go_before_the_sky(self, given):
        table = Table({"ra": ICRS.ra.deg, "dec": ICRS.dec.deg, "x": POSITIONS[:, 0] + 0.6})
        table["y"] = POSITIONS[:, 1]
        table.write("t.csv")
        np.testing.assert_array_equal(stars("t.csv", given), np.add(POSITIONS, (0.6, 0)))

    def test_pixels_of_another_image_are_refused(self):
        table = Table({"ra": ICRS.ra.deg, "dec": ICRS.dec.deg, "x": POSITIONS[:, 0]})
        table["y"] = POSITIONS[:, 1] + (0.0, 1.1)
        table.write("t.csv")
        with pytest.raises(InputError) as caught:
            stars("t.csv")
        assert str(caught.value) == (
            "t.csv has its star in row 1 at 7.00, 12.35 by x and y, which a.fits has at 7.00, "
            "11.25 by ra and dec: delete the columns that are wrong"
        )

    @pytest.mark.parametrize(
        ("names", "origin"),
        [
            ("x_centroid y_centroid", 0),  # photutils, by age
            ("xcentroid ycentroid", 0),
            ("x_fit y_fit", 0),
            ("x_peak y_peak", 0),
            ("X_IMAGE Y_IMAGE", 1),  # SExtractor
            ("XWIN_IMAGE YWIN_IMAGE", 1),
            ("XPSF_IMAGE YPSF_IMAGE", 1),
        ],
    )
    def test_pixels_as_others_name_them(self, caplog, names, origin):
        caplog.set_level(logging.INFO, "lnocl")
        Table((POSITIONS + origin), names=names.split()).write("t.fits")
        np.testing.assert_array_equal(stars("t.fits"), POSITIONS)
        note = ", the first pixel 1" * origin
        assert caplog.messages == [f"t.fits: 2 stars, by {names.replace(' ', ' and ')}{note}"]

    @pytest.mark.parametrize(
        "names",
        ["RA_ICRS DE_ICRS", "_RAJ2000 _DEJ2000", "RAJ2000 DEJ2000", "ALPHA_J2000 DELTA_J2000",
         "ALPHAWIN_J2000 DELTAWIN_J2000", "ra dec"],
    )  # fmt: skip
    def test_the_sky_as_others_name_it(self, names):
        Table([ICRS.ra, ICRS.dec], names=names.split()).write("t.vot", format="votable")
        np.testing.assert_allclose(stars("t.vot"), POSITIONS, atol=1e-6)

    def test_stars_outside_the_image_are_left_out(self):
        sized = header(NAXIS1=12, NAXIS2=16)
        save("t.csv", "x,y\n1,2\n-0.5,-0.5\n11.4,15.4\n-0.6,3\n11.5,3\n3,15.5\n")
        with pytest.warns(LnoclWarning) as caught:
            found = stars("t.csv", sized)
        np.testing.assert_array_equal(found, [(1, 2), (-0.5, -0.5), (11.4, 15.4)])
        assert str(caught[0].message) == (
            "3 of 6 stars of t.csv lie outside a.fits and are left out"
        )
        with pytest.raises(InputError) as refused:
            stars(save("t.csv", "x,y\n12,2\n"), sized)
        assert str(refused.value) == (
            "t.csv has no star on a.fits: see whether it is of the same field"
        )

    def test_coordinates_in_one_column(self):
        """As photutils writes them; in another frame."""
        QTable({"sky_centroid": ICRS.galactic, "flux": [1.0, 2.0]}).write("t.ecsv")
        np.testing.assert_allclose(stars("t.ecsv"), POSITIONS, atol=1e-6)

    def test_a_table_of_sextractor(self):
        text = "#   1 NUMBER     Running object number\n#   2 X_IMAGE    Position along x [pixel]\n"
        text += "#   3 Y_IMAGE    Position along y [pixel]\n    1   3.5000   4.0000\n"
        np.testing.assert_array_equal(stars(save("test.cat", text)), [(2.5, 3.0)])

    @pytest.mark.parametrize("name", ["t.txt", "t.dat", "stars"])
    def test_plain_text_of_any_name(self, name):
        save(name, "x y mag\n1 2.5 17\n3 4 18\n")
        np.testing.assert_array_equal(stars(name), [(1, 2.5), (3, 4)])

    @pytest.mark.parametrize("name", ["t.csv", "t.ecsv", "t.dat"])
    def test_a_mark_of_the_encoding_as_excel_writes_it(self, name):
        Table({"x": [1, 3], "y": [2.5, 4], "id": ["\xe9", "b"]}).write(
            name, format="ascii.csv" if name == "t.csv" else "ascii.ecsv"
        )
        with open(name, "r+b") as stream:
            text = stream.read()
            stream.seek(0)
            stream.write(codecs.BOM_UTF8 + text)
        np.testing.assert_array_equal(stars(name), [(1, 2.5), (3, 4)])

    def test_units_in_other_words(self):
        columns = [fits.Column("x", "D", unit="pixels", array=[1.0]),
                   fits.Column("y", "D", unit="PIXEL", array=[2.0])]  # fmt: skip
        fits.BinTableHDU.from_columns(columns).writeto("t.fits")
        np.testing.assert_array_equal(stars("t.fits"), [(1, 2)])

    @pytest.mark.parametrize("name", ["t.ecsv", "t.fits", "t.csv"])
    @pytest.mark.parametrize("kind", [float, int])
    def test_rows_without_a_number(self, name, kind):
        if (name, kind) == ("t.fits", int):
            pytest.skip("FITS masks no whole numbers here")
        x = MaskedColumn([1, 2], mask=[False, True], dtype=kind)
        Table({"x": x, "y": [1.0, 2.0]}).write(name)
        with pytest.raises(InputError) as caught:
            stars(name)
        assert str(caught.value) == f"column x of {name} has rows without a number"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            (
                "x,mag\n1,2\n",
                "t.csv has neither columns x and y nor ra and dec; it has x, mag: rename two of",
            ),
            ("", "t.csv has neither columns x and y nor ra and dec; it has no columns"),
            ("no table\nat all\n", "t.csv has neither columns x and y nor ra and dec; it has no"),
            (
                "x,y\na,2\n",
                "column x of t.csv is not a position: could not convert string to float",
            ),
            ("x,y\nnan,2\n", "column x of t.csv has rows without a number"),
            ("x,y\n2,inf\n", "column y of t.csv has rows without a number"),
            ("ra,dec\n10,95\n", "column dec of t.csv has rows beyond 90 degrees"),
            ("ra,dec\n330,-30\n", "the star at RA, Dec 330.00000 -30.00000 lies in another part"),
            ("x,y\n", "t.csv has no row; give one a star, or leave --stars out for none"),
        ],
    )
    def test_tables_that_hold_no_stars(self, text, message):
        with pytest.raises(InputError) as caught:
            stars(save("t.csv", text))
        assert message in str(caught.value)

    @pytest.mark.parametrize(
        ("column", "message"),
        [
            ([1.0] * u.arcsec, "is not a position: 'arcsec'"),
            (np.ones((1, 2)), "has several numbers in a row"),
        ],
    )
    def test_columns_that_are_no_positions(self, column, message):
        Table({"x": column, "y": column}).write("t.ecsv")
        with pytest.raises(InputError, match=rf"column x of t\.ecsv {message}"):
            stars("t.ecsv")

    def test_the_sky_of_an_image_without_any(self):
        save("t.csv", "ra,dec\n150,30\n")
        with pytest.raises(InputError, match=r"a\.fits has no sky coordinates .* in pixels"):
            stars("t.csv", fits.Header())

    def test_files_that_are_no_table(self, tmp_path):
        fits.writeto("image.fits", np.ones((3, 3)))
        save("uneven.csv", "x,y\n1,2,3,4\n")
        (tmp_path / "bytes.dat").write_bytes(bytes(range(128, 256)))
        for path, reason in {
            "no.csv": "No such file or directory",
            "no.dat": "No such file or directory",
            ".": "Is a directory",
            "image.fits": "No table found",
            "uneven.csv": "Number of header columns (2) inconsistent with data columns",
            "bytes.dat": "",
        }.items():
            with pytest.raises(FileError) as caught:
                stars(path)
            assert str(caught.value).startswith(f"{path} cannot be read as a table: {reason}")


@pytest.mark.parametrize("keyword", ["CRPIX1", "CRVAL2", "CDELT1", "CD1_2", "PC2_2"])
def test_texts_for_numbers_are_refused(keyword):
    """Astropy reads the rest, and puts stars elsewhere."""
    damaged = header(**{keyword: "3.0"})
    with pytest.raises(InputError, match=rf"{keyword} is the text '3\.0'; write it as a number"):
        make_wcs(damaged)
    with pytest.raises(InputError, match=r"a\.fits has no sky coordinates"):
        sky.celestial_wcs(damaged, "a.fits")


def test_angles_of_a_file_are_in_its_unit(tmp_path):
    path = str(tmp_path / "angles.fits")
    for unit, expected in (("rad", np.degrees([0.5, -1.0])), ("deg", [0.5, -1.0])):
        fits.writeto(path, np.array([0.5, -1.0]), fits.Header({"BUNIT": unit}), overwrite=True)
        np.testing.assert_allclose(places.read_angles(path)[0], expected, rtol=1e-14)
    fits.writeto(path, np.array([0.5, -1.0]), fits.Header({"BUNIT": "pix"}), overwrite=True)
    with pytest.raises(InputError, match="angle must be in degrees, not in pix"):
        places.read_angles(path)
