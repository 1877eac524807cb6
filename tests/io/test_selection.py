"""The image of a file with several HDUs: which it is, how it is named, and what is refused."""

import logging

import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st

from lnocl.errors import InputError
from lnocl.io import fitsread
from lnocl.io.names import parse_name
from lnocl.io.selection import AUXILIARY

IMAGE, OTHER, THUMBNAIL = np.full((10, 12), 1.0), np.full((10, 12), 2.0), np.full((3, 4), 3.0)
CUBE = np.full((2, 10, 12), 4.0)


def save(path, *hdus):
    """Write a file from its primary image, or None, and pairs of name and image."""
    primary, *extensions = hdus
    hdus = [fits.PrimaryHDU(primary)]
    hdus += [fits.ImageHDU(image, name=name) for name, image in extensions]
    fits.HDUList(hdus).writeto(path)
    return str(path)


CHOSEN = {
    "SCI after ERR": ([None, ("ERR", OTHER), ("SCI", IMAGE)], "HDU 2 (SCI)"),
    "SCI beside an image in the primary": ([OTHER, ("SCI", IMAGE)], "HDU 1 (SCI)"),
    "SCI after a thumbnail": ([THUMBNAIL, ("", OTHER), ("SCI", IMAGE)], "HDU 2 (SCI)"),
    "SCI in lower case": ([None, ("err", OTHER), ("sci", IMAGE)], "HDU 2 (SCI)"),
    "another name after ERR": ([None, ("ERR", OTHER), ("DATA", IMAGE)], "HDU 2 (DATA)"),
    "no name, after variances": ([None, ("VAR_POISSON", OTHER), ("", IMAGE)], "HDU 2"),
    "the only image, though a mask": ([None, ("MASK", IMAGE)], "HDU 1 (MASK)"),
    "two dimensions before one": ([None, ("A", np.ones(5)), ("B", IMAGE)], "HDU 2 (B)"),
    "the primary": ([IMAGE], None),
    "the primary, its flags and a PSF": ([IMAGE, ("DQ", OTHER), ("PSF", THUMBNAIL)], None),
    "the primary before images of its size": ([IMAGE, ("", OTHER), ("MODELS", CUBE)], None),
}


@pytest.mark.parametrize("case", CHOSEN)
def test_the_image_is(tmp_path, caplog, case):
    hdus, named = CHOSEN[case]
    path = save(tmp_path / "a.fits", *hdus)
    caplog.set_level(logging.INFO, "lnocl")
    np.testing.assert_array_equal(fitsread.read_stack([path]).data, IMAGE[None])
    said = [f"{path}: the image is {named}"] if named else []
    assert [record.getMessage() for record in caplog.records] == said


AMBIGUOUS = {
    "two SCI": (
        [None, ("SCI", IMAGE), ("ERR", OTHER), ("SCI", OTHER)],
        "HDU 1 (SCI) of 10 x 12 pixels, HDU 3 (SCI) of 10 x 12 pixels",
    ),
    "a thumbnail and an image": (
        [THUMBNAIL, ("", IMAGE)],
        "HDU 0 of 3 x 4 pixels, HDU 1 of 10 x 12 pixels",
    ),
    "two chips": (
        [None, ("CHIP1", IMAGE), ("WHT", OTHER), ("CHIP2", IMAGE)],
        "HDU 1 (CHIP1) of 10 x 12 pixels, HDU 3 (CHIP2) of 10 x 12 pixels",
    ),
    "errors and flags alone": (
        [None, ("ERR", IMAGE), ("DQ", OTHER)],
        "HDU 1 (ERR) of 10 x 12 pixels, HDU 2 (DQ) of 10 x 12 pixels",
    ),
}


# How the first of them is named, where not by its number.
WORDS = {"two chips": "CHIP1", "errors and flags alone": "ERR"}


@pytest.mark.parametrize("case", AMBIGUOUS)
def test_several_that_may_be_meant_are_refused(tmp_path, case):
    hdus, named = AMBIGUOUS[case]
    path = save(tmp_path / "a.fits", *hdus)
    with pytest.raises(InputError) as caught:
        fitsread.read_stack([path])
    assert str(caught.value) == (
        f"{path} holds 2 images that may be meant: {named}; name the one to use, as in "
        f"'{path}[{WORDS.get(case, named[4])}]'"
    )


def test_of_two_chips_the_version_is_named_and_that_of_an_hdu_is_heeded(tmp_path):
    path = chips(tmp_path / "a.fits")
    with pytest.raises(InputError, match=r"as in '\S+a.fits\[SCI,1\]'$"):
        fitsread.read_stack([path])
    np.testing.assert_array_equal(fitsread.read_extension(f"{path}[1]", "DQ"), 10.0 * OTHER)
    np.testing.assert_array_equal(fitsread.read_extension(f"{path}[3]", "DQ"), 10.0 * IMAGE)


def test_two_extensions_of_one_name_are_refused(tmp_path):
    path = save(tmp_path / "a.fits", None, ("SCI", IMAGE), ("DQ", OTHER), ("DQ", IMAGE))
    with pytest.raises(InputError, match=r"HDU 2 \(DQ\) of 10 x 12 pixels, HDU 3 \(DQ\)"):
        fitsread.read_extension(path, "DQ")


def chips(path):
    """Write a file of two chips with flags, as a camera of HST does."""
    hdus = [fits.PrimaryHDU()]
    for version, image in ((1, OTHER), (2, IMAGE)):
        hdus += [
            fits.ImageHDU(image, name="SCI", ver=version),
            fits.ImageHDU(10.0 * image, name="DQ", ver=version),
        ]
    fits.HDUList(hdus).writeto(path)
    return str(path)


@pytest.mark.parametrize("part", ["[SCI,2]", "[sci, 2]", "[3]"])
def test_the_one_that_is_named(tmp_path, part):
    path = chips(tmp_path / "a.fits")
    found = fitsread.read_stack([path + part])
    np.testing.assert_array_equal(found.data, IMAGE[None])
    assert found.sha256 == [fitsread._read_file(f"{path}[1]")[2]]
    assert fitsread.read_keyword(path + part, found.header, "SIMPLE") is True


def test_extension_with_the_version_of_the_named_image_is_read(tmp_path):
    path = chips(tmp_path / "a.fits")
    np.testing.assert_array_equal(fitsread.read_extension(f"{path}[SCI,2]", "DQ"), 10.0 * IMAGE)
    assert fitsread.read_extension(f"{path}[SCI,2]", "ERR") is None


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("[SCI,3]", "has no image extension SCI,3; it has HDU 1 (SCI), HDU 2 (DQ), HDU 3 (SCI), "),
        ("[ERR]", "has no image extension ERR; it has HDU 1 (SCI), "),
        ("[0]", "has no image HDU 0; it has HDU 1 (SCI), "),
        ("[5]", "has no image HDU 5; it has HDU 1 (SCI), "),
        ("[SCI]", "holds 2 images that may be meant: HDU 1 (SCI) of 10 x 12 pixels, HDU 3 (SCI) "),
    ],
)
def test_names_that_the_file_lacks(tmp_path, part, message):
    path = chips(tmp_path / "a.fits")
    with pytest.raises(InputError) as caught:
        fitsread.read_stack([path + part])
    assert str(caught.value).startswith(f"{path} {message}")


def test_a_file_that_is_called_so(tmp_path):
    save(tmp_path / "a.fits", OTHER)
    path = save(tmp_path / "a.fits[0]", IMAGE)
    np.testing.assert_array_equal(fitsread.read_stack([path]).data, IMAGE[None])


def test_a_psf_as_the_detector_sees_it(tmp_path):
    """Of the four that STPSF writes."""
    names = "DET_SAMP", "OVERDIST", "DET_DIST"
    path = save(tmp_path / "a.fits", CUBE[0], *zip(names, (OTHER, CUBE[0], IMAGE), strict=True))
    np.testing.assert_array_equal(fitsread.read_stack([path]).data, IMAGE[None])
    np.testing.assert_array_equal(fitsread.read_stack([f"{path}[DET_SAMP]"]).data, OTHER[None])


@given(st.text("a[]0,. S", max_size=12))
def test_any_name_has_a_file(name):
    found = parse_name(name)
    assert name.startswith(found.file)
    assert found.is_chosen == (found.file != name)


@pytest.mark.parametrize(
    ("names", "are_auxiliary"),
    [
        ("ERR DQ WHT CON CTX VAR_POISSON VAR_RNOISE VAR_FLAT AREA WAVELENGTH PIXELDQ", True),
        ("SAMP TIME D2IMARR WCSDVARR MASK UNCERT PSFIMAGE STAT ERRS QUAL VARIANCE IVM", True),
        ("SCI DATA IMAGE COUNTS B V R CHIP1 STATION VARIABLE CONTINUUM TIMES2", False),
    ],
)
def test_auxiliary_names(names, are_auxiliary):
    for name in names.split():
        assert bool(AUXILIARY.fullmatch(name)) == are_auxiliary
