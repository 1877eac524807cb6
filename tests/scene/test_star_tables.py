"""Positions of stars in tables of astropy."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable, Table
from scenes import paper

import lnocl
from lnocl.core.scene.star_tables import IN_PIXELS, ON_SKY, find_columns
from lnocl.core.scene.stars import check_positions

OBSERVATION = lnocl.Observation(np.ones((16, 16)), np.eye(1))
POSITIONS = [(5.5, 7.0), (9.0, 3.0)]


@pytest.mark.parametrize(
    "table",
    [
        Table(np.array(POSITIONS), names=["xcentroid", "ycentroid"]),
        Table(np.add(POSITIONS, 1), names=["X_IMAGE", "Y_IMAGE"]),
        QTable({"y": [7.0, 3.0] * u.pix, "x": [5.5, 9.0] * u.pix, "id": ["a", "b"]}),
        Table({"x": [5.5, 9.0], "y": [7.0, 3.0], "epoch": [2016.0, 2016.0]}),
    ],
    ids=["photutils", "SExtractor", "quantities", "a date"],
)
def test_stars_may_be_a_table(table):
    np.testing.assert_array_equal(check_positions(table, OBSERVATION), POSITIONS)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (Table({"ra": [1.0], "dec": [2.0]}), "the table stars has no columns x and y, in pixels; "
         "it has ra, dec: rename two, or convert RA and Dec with world_to_pixel of astropy.wcs"),
        (Table(), "the table stars has no columns x and y, in pixels; it has no columns: "),
        (Table({"x": ["a"], "y": [1.0]}), "column x of stars is not a position: "),
        (Table({"x": [1.0], "y": [1.0]}, units=["arcsec"] * 2), "column x of stars is not a pos"),
        (Table({"x": [1.0], "y": [np.nan]}), "column y of stars has rows without a number"),
        (Table({"x": [[1.0, 2.0]], "y": [[1.0, 2.0]]}), "column x of stars has several numbers"),
        (Table({"x": [15.6], "y": [1.0]}), "the star at (15.6, 1) lies outside the images: "),
    ],
)  # fmt: skip
def test_tables_that_hold_no_stars(table, message):
    with pytest.raises(lnocl.InputError) as caught:
        check_positions(table, OBSERVATION)
    assert str(caught.value).startswith(message)


def test_the_table_of_a_result_with_epochs_has_each_star_once():
    given = lnocl.Observation(np.ones((3, 16, 16)), np.eye(1), epochs=["b", "a", "b"])
    result = paper(given, POSITIONS, n_iter=1, engine="numpy")
    assert len(result.to_table()) == 4
    np.testing.assert_array_equal(check_positions(result.to_table(), given), POSITIONS)


def test_no_rows_are_no_stars():
    table = Table({"x": np.zeros(0), "y": np.zeros(0)})
    assert check_positions(table, OBSERVATION).shape == (0, 2)


def test_the_better_columns_are_chosen():
    """Windowed positions are SExtractor's best; those on the sky are as Gaia has them."""
    sextractor = ["X_IMAGE", "Y_IMAGE", "XWIN_IMAGE", "YWIN_IMAGE"]
    assert find_columns(sextractor, IN_PIXELS) == ("XWIN_IMAGE", "YWIN_IMAGE", 1)
    assert find_columns(["x_centroid", "y", "x"], IN_PIXELS) == ("x", "y", 0)
    assert find_columns(["RAJ2000", "DEJ2000", "RA_ICRS", "DE_ICRS"], ON_SKY)[0] == "RA_ICRS"
    assert find_columns(["x", "dec"], [*IN_PIXELS, *ON_SKY]) is None


@pytest.mark.parametrize(
    ("names", "which"),
    [(["x", "y", "X"], "x and X"), (["X_IMAGE", "x_image", "y_image", "id"], "X_IMAGE and x_im")],
)
def test_columns_that_differ_in_case_alone_are_refused(names, which):
    table = Table(np.ones((1, len(names))), names=names)
    with pytest.raises(lnocl.InputError, match=f"has columns {which}.*, either .*; delete or ren"):
        check_positions(table, OBSERVATION)


def test_columns_that_are_not_used_may_differ_in_case_alone():
    table = Table(np.ones((1, 5)), names=["x", "y", "Mag", "mag", "X_IMAGE"])
    assert check_positions(table, OBSERVATION).shape == (1, 2)
