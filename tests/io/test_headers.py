"""Values of headers."""

from astropy.io import fits

from lnocl.io.headers import observed_cards


def test_observation_keywords_are_copied_from_the_first_image():
    header = fits.Header({"OBJECT": "RW Aur", "EXPTIME": 30.0, "FILTER": 7, "OBSERVER": "A"})
    primary = fits.Header({"TELESCOP": "HST", "FILTER": "of the file", "DETECTOR": "WFC"})
    header["DATE-OBS"] = None
    header["INSTRUME"] = True
    assert observed_cards(header, primary) == [
        ("OBJECT", "RW Aur", "of the first image"),
        ("TELESCOP", "HST", "of the first image"),
        ("INSTRUME", True, "of the first image"),
        ("FILTER", 7, "of the first image"),
        ("EXPTIME", 30.0, "of the first image"),
    ]
