"""Observations from FITS files: the units of the images, gain and exposure."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from frame_files import IMAGES, notes, observe, read, save, save_images
from hypothesis import given
from hypothesis import strategies as st

from lnocl.core.scene import units
from lnocl.errors import InputError, LnoclWarning

pytestmark = pytest.mark.usefixtures("frame_folder")

ELECTRONS = ["ELECTRONS", "electron", "Electrons", "COUNTS", "count", "ct", "cts", "e-", "E-", "e",
             "photon", "electron/pix", "e-/pixel", "", "  "]  # fmt: skip
RATES = ["ELECTRONS/S", "electron/s/pix", "electron/s", "counts/s", "Counts/sec", "COUNTS/SECOND",
         "e-/s", "e- s-1", "e/s", "electron s^-1", "electrons per second", "cps"]  # fmt: skip
DIGITAL = ["DN", "adu", "ADU", "dn", "DN/pixel"]
DIGITAL_RATES = ["ADU/s", "adu s-1", "DN/s", "DN/sec", "DN/s/pix"]
LIGHT = ["MJy/sr", "mJy", "10**-20 erg/s/cm2"]
OTHERS = [*LIGHT, "UNKNOWN", "total nonsense", "(", "[e-]",
          "5", "1000", "%"]  # fmt: skip


class TestTheUnitOfTheSky:
    """That of the images, where they have one that measures anything."""

    @pytest.mark.parametrize(
        ("unit", "known", "name", "electrons"),
        [
            ("", {}, "electron", 1.0),
            ("", {"gain": 2.0}, "electron", 1.0),
            ("", {"exposure": [20.0]}, "electron/s", 1.0),
            ("ELECTRONS", {}, "electron", 1.0),
            ("ELECTRONS", {"exposure": [20.0]}, "electron/s", 1.0),
            ("e-/s", {"exposure": [20.0]}, "electron/s", 1.0),
            ("photon", {}, "ph", 1.0),
            ("counts", {}, "ct", 1.0),
            ("kct", {}, "kct", 1000.0),
            ("ct/ms", {"exposure": [20.0]}, "ct/ms", 1000.0),
            ("DN", {"gain": 2.0}, "adu", 2.0),
            ("DN/s", {"gain": 2.0, "exposure": [20.0]}, "adu/s", 2.0),
            ("MJy/sr", {"gain": 30.0}, "MJy/sr", 30.0),
            ("MJy/sr", {"gain": 30.0, "exposure": [20.0]}, "MJy/sr", 30.0),
            ("%", {"gain": 30.0}, "electron", 1.0),
            ("total nonsense", {"gain": 30.0}, "electron", 1.0),
        ],
    )
    def test_it_has_a_name_and_electrons(self, unit, known, name, electrons):
        save_images(BUNIT=unit)
        frames = read(**known)
        assert (frames.unit, frames.electrons) == (name, electrons)


class TestUnits:
    @pytest.mark.parametrize("unit", ELECTRONS)
    def test_counts_are_taken_as_they_are_and_times_the_gain(self, unit):
        save_images(BUNIT=unit)
        np.testing.assert_array_equal(observe().images, IMAGES)
        np.testing.assert_array_equal(observe(exposure=[20.0]).images, IMAGES)
        if "e" not in unit.lower():
            np.testing.assert_array_equal(observe(gain=2.5).images, 2.5 * IMAGES)

    @pytest.mark.parametrize("unit", RATES)
    def test_counts_per_second_are_times_the_exposure(self, unit):
        save_images(BUNIT=unit)
        observation = observe(exposure=[20.0, 30.0])
        expected = IMAGES * np.array([20.0, 30.0])[:, None, None]
        np.testing.assert_array_equal(observation.images, expected)
        np.testing.assert_array_equal(observation.exposure, [20.0, 30.0])
        if "e" not in unit.lower():
            both = observe(exposure=[20.0, 30.0], gain=2.0)
            np.testing.assert_array_equal(both.images, 2.0 * expected)
        with pytest.raises(InputError, match=r"1\.fits holds counts per time; give exposure"):
            observe()

    def test_electrons_times_a_gain_are_warned_of(self):
        save_images(BUNIT="electron")
        with pytest.warns(LnoclWarning, match="1.fits is in electron by BUNIT, and is taken times"):
            np.testing.assert_array_equal(observe(gain=2.5).images, 2.5 * IMAGES)

    @pytest.mark.parametrize("sky", [0.0, 400.0])
    @pytest.mark.parametrize("gain", [None, 2.0])
    def test_rates_without_a_unit_are_known_by_their_noise(self, log, sky, gain):
        counts = np.random.default_rng(1).normal(sky, 23.0, (1, 40, 40))
        each = 2000.0 * (gain or 1.0)
        save_images(counts / each)
        found = read("1.fits", exposure=[2000.0], gain=gain, background=["auto"])
        assert found.unit == "electron/s"
        added = min(found.background[0], 0.0)
        raw = found.observation.images - found.observation.read_noise[0] ** 2
        assert np.median(raw) == pytest.approx(np.median(counts) - added, abs=0.1)
        assert "1.fits has no BUNIT: by its noise it is in" in log.text

    def test_bad_pixels_of_an_exposure_map_tell_nothing_of_the_unit(self):
        """The noise of resampled electrons is a third of that of counts."""
        counts = np.random.default_rng(1).normal(100.0, 33.0**0.5, (1, 40, 48))
        save_images(counts)
        exposure, mask = np.full((40, 48), 2000.0), np.zeros((40, 48))
        exposure[3, 5:8], mask[3, 5:8] = np.nan, 1
        save("exposure.fits", exposure)
        save("mask.fits", mask)
        found = read("1.fits", exposure=["exposure.fits"], mask=["mask.fits"])
        good = mask == 0
        np.testing.assert_array_equal(found.observation.images[0][good], counts[0][good])

    def test_the_gain_may_be_in_the_headers(self, log):
        save_images(BUNIT="adu", EGAIN=2.5)
        found = read(gain="EGAIN")
        np.testing.assert_array_equal(found.observation.images, 2.5 * IMAGES)
        assert (found.gain, found.electrons, found.unit) == (2.5, 2.5, "adu")
        assert notes(log) == ["image 0: gain 2.5, from EGAIN", "image 1: gain 2.5, from EGAIN"]

    def test_invalid_and_unequal_gains_in_headers_are_refused(self):
        save_images(BUNIT="adu", EGAIN=2.5, TEXT="a", ZERO=0.0)
        with pytest.raises(InputError, match=r"^1\.fits has no GAIN in its header; give gain as a"):
            observe(gain="GAIN")
        with pytest.raises(InputError, match=r"^TEXT of 1\.fits is 'a', not a number; give gain"):
            observe(gain="TEXT")
        with pytest.raises(InputError, match=r"^gain must be more than 0; 0 was given"):
            observe(gain="ZERO")
        with fits.open("2.fits", mode="update") as file:
            file[0].header["EGAIN"] = 3.0
        with pytest.raises(InputError) as caught:
            observe(gain="EGAIN")
        assert str(caught.value) == (
            "the images have several gains: EGAIN of 1.fits is 2.5, of 2.fits 3; convert them to "
            "electrons"
        )

    @pytest.mark.parametrize("unit", [*DIGITAL, *DIGITAL_RATES, *OTHERS])
    def test_other_units_need_the_gain(self, unit):
        save_images(BUNIT=unit)
        with pytest.raises(InputError) as caught:
            observe(exposure=[20.0])
        of_light = unit in LIGHT
        assert str(caught.value) == (
            f"1.fits is in {unit}, not in counts; give gain, the electrons in one of these units: "
            "a number, "
            + (
                "the exposure in seconds over the value of one electron per second"
                if of_light
                else "or a keyword of its header such as GAIN"
            )
        )
        expected = IMAGES * (40.0 if of_light or unit in DIGITAL_RATES else 2.0)
        np.testing.assert_array_equal(observe(exposure=[20.0], gain=2.0).images, expected)

    @pytest.mark.parametrize("unit", ["MJy/sr", "adu/s", "adu"])
    @pytest.mark.parametrize("word", ["ERR", "VAR_POISSON", "file"])
    def test_it_follows_from_the_noise(self, log, unit, word):
        """Of a sky, read noise and a source whose variance all but the noise of the pixels has."""
        means = 400.0 + 4e4 * np.exp(-np.hypot(*(np.indices((40, 40)) - 20.0)) / 3.0)
        images = np.random.default_rng(4).poisson(means, (2, 40, 40)) / np.reshape(
            [100.0, 100.0 if unit == "adu" else 50.0], (2, 1, 1)
        )
        for j, each in enumerate([100.0, 100.0 if unit == "adu" else 50.0]):
            variance = (means + 144.0) / each**2
            extra = {"VAR_POISSON": variance, "ERR": np.sqrt(variance)}
            hdus = [fits.PrimaryHDU(images[j], fits.Header({"BUNIT": unit}))]
            if word != "file":
                hdus.append(fits.ImageHDU(extra[word], name=word))
            fits.HDUList(hdus).writeto(f"{j + 1}.fits")
            save(f"e{j}.fits", extra["ERR"])
        known = {"noise": ["err=e0.fits", "err=e1.fits"]} if word == "file" else {}
        found = read(**known)
        assert found.unit == unit
        raw = found.observation.images - (found.observation.background if known else 0.0)
        np.testing.assert_allclose(raw.sum(axis=(1, 2)), means.sum(), rtol=0.02)
        assert "electrons in its unit, by " in log.text

    def test_errors_of_counts_alone_give_the_gain_and_no_other_noise(self):
        means = 400.0 + 4e4 * np.exp(-np.hypot(*(np.indices((40, 40)) - 20.0)) / 3.0)
        image = np.random.default_rng(4).poisson(means) / 100.0
        save("1.fits", image, BUNIT="MJy/sr")
        save("err.fits", np.sqrt(image / 100.0).astype("f4") * 0.999)
        found = observe("1.fits", noise=["err=err.fits"])
        assert np.median(found.background) < 1.0

    @pytest.mark.parametrize(
        ("unit", "why"),
        [
            *((unit, "a logarithm; give the image in lin") for unit in ("mag", "MAG/arcsec**2",
                                                                       "mag(AB)", "ABmag", "dex")),
            *((unit, "that of maps of interferometers and d") for unit in ("JY/BEAM", "mJy/beam",
                                                                        "Jy beam-1")),
        ],
    )  # fmt: skip
    @pytest.mark.parametrize("known", [{}, {"gain": 2.0}, {"gain": 2.0, "exposure": [9.0]}])
    def test_units_that_no_gain_makes_counts_are_refused(self, unit, why, known):
        save_images(BUNIT=unit)
        with pytest.raises(InputError) as caught:
            observe(**known)
        assert str(caught.value).startswith(f"1.fits is in {unit}, {why}")

    @pytest.mark.parametrize(
        ("unit", "known", "said"),
        [
            ("adu", {}, "; its header has EGAIN 2.5: give gain=EGAIN"),
            ("adu/s", {}, "; its header has EGAIN 2.5 and EXPTIME 30: give gain=EGAIN exposure=EX"),
            ("electron/s", {}, "; its header has EXPTIME 30: give exposure=EXPTIME"),
            ("adu/s", {"gain": 2.0}, "; its header has EXPTIME 30: give exposure=EXPTIME"),
            ("", {}, "its unit is taken to be electrons; its header has EGAIN 2.5: give gain=EG"),
            ("", {"gain": "EGAIN"}, "its unit is taken to be counts"),
        ],
    )
    def test_gain_and_exposure_keywords_in_the_header_are_suggested(self, log, unit, known, said):
        save_images(BUNIT=unit, GAIN=0.0, EGAIN=2.5, EXPTIME=30.0)
        if unit:
            with pytest.raises(InputError) as caught:
                observe(**known)
            assert said in str(caught.value)
        else:
            observe(**known)
            assert said in log.text
            assert ("give gain" in log.text) == (not known)

    def test_images_in_several_units_are_refused(self):
        save("1.fits", IMAGES[0], BUNIT="electron")
        save("2.fits", IMAGES[1], BUNIT="ADU")
        with pytest.raises(InputError) as caught:
            observe(gain=2.0)
        assert str(caught.value) == (
            "the images have several units: 1.fits has electron, 2.fits has adu; convert them to "
            "one"
        )
        save("1.fits", IMAGES[0])
        with pytest.raises(InputError, match=r"1\.fits has no unit, 2\.fits has adu"):
            observe(gain=2.0)
        save("2.fits", IMAGES[1], BUNIT="E-")
        save("1.fits", IMAGES[1], BUNIT="ELECTRONS")
        observe()

    @pytest.mark.parametrize(
        ("unit", "factor"),
        [("Mct", 1e6), ("mct", 1e-3), ("Mct/S", 1e6), ("kct", 1e3), ("KCT", 1e3), ("Mphoton", 1e6)],
    )
    def test_prefixes_are_those_of_the_case_as_written(self, unit, factor):
        save_images(BUNIT=unit)
        np.testing.assert_allclose(observe(exposure=[1.0]).images, factor * IMAGES, rtol=1e-15)

    @pytest.mark.parametrize("unit", ["MCT", "MCt", "mCT", "MElectron/s", "MPHOTON", "electron/MS"])
    def test_prefixes_that_may_be_two_are_refused(self, unit):
        save_images(BUNIT=unit)
        with pytest.raises(InputError, match=f"1.fits is in {unit}, not in counts; give gain"):
            observe(exposure=[1.0])

    @pytest.mark.parametrize("unit", ["-1", "1e400 ct", "4t448", "2u14", "1,", "mag(ct)"])
    def test_text_that_is_not_a_unit(self, unit):
        assert isinstance(units.parse(unit), u.UnrecognizedUnit)
        assert units.count_of(units.parse(unit)) is None

    @given(text=st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=12))
    def test_no_text_of_a_header_breaks_it(self, text):
        unit = units.parse(text)
        assert (unit is None) == (not text.strip())
        if unit is not None:
            assert isinstance(unit, u.UnitBase)
            counts = units.count_of(unit)
            assert counts is None or counts[0] > 0
