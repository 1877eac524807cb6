"""Observations from FITS files: exposures, backgrounds, noise, masks, offsets."""

import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from astropy.stats import sigma_clipped_stats
from frame_files import IMAGES, MAP, NONE, SHAPE, notes, observe, read, save, save_images
from hypothesis import given
from hypothesis import strategies as st
from wcs_headers import NORTH_UP

import lnocl
from lnocl.core.scene.noise_check import warn_of_noise
from lnocl.errors import FileError, InputError, LnoclWarning, counted
from lnocl.io import sky
from lnocl.io.calibration import Calibration
from lnocl.io.fitsread import Stack
from lnocl.io.frames import read_frames
from lnocl.io.levels import sky_level, sky_noise
from lnocl.io.pixel_scales import warn_of_pixel_scales

pytestmark = pytest.mark.usefixtures("frame_folder")


class TestExposure:
    def test_a_number_numbers_and_a_map(self):
        save_images()
        save("map.fits", MAP)
        np.testing.assert_array_equal(observe(exposure=[7.0]).exposure, [7.0, 7.0])
        np.testing.assert_array_equal(observe(exposure=[7.0, 8.0]).exposure, [7.0, 8.0])
        np.testing.assert_array_equal(observe(exposure=["map.fits"]).exposure, [MAP, MAP])
        mixed = observe(exposure=["map.fits", 5.0]).exposure
        np.testing.assert_array_equal(mixed, [MAP, np.full(SHAPE, 5.0)])

    def test_pixels_without_exposure_are_masked(self, log):
        save_images(BUNIT="e-/s")
        exposure = MAP.copy()
        exposure[2, 3:5] = 0.0
        save("map.fits", exposure)
        observation = observe(exposure=["map.fits"])
        np.testing.assert_array_equal(observation.mask, [exposure == 0] * 2)
        good = exposure > 0
        np.testing.assert_array_equal(observation.images[:, good], (IMAGES * exposure)[:, good])
        assert "image 1: 2 pixels masked without exposure" in notes(log)

    def test_a_keyword_of_each_header(self, log):
        save("1.fits", IMAGES[0], EXPTIME=100.0)
        save("2.fits", IMAGES[1], EXPTIME=200)
        np.testing.assert_array_equal(observe(exposure=["EXPTIME"]).exposure, [100.0, 200.0])
        assert notes(log) == [
            "image 0: exposure 100 seconds, from EXPTIME",
            "image 1: exposure 200 seconds, from EXPTIME",
        ]

    def test_a_keyword_beside_a_number_and_a_map(self):
        save("1.fits", IMAGES[0], EXPTIME=100.0)
        save("2.fits", IMAGES[1])
        save("map.fits", MAP)
        np.testing.assert_array_equal(observe(exposure=["EXPTIME", 2.0]).exposure, [100.0, 2.0])
        save("cube.fits", IMAGES, EXPTIME=3.0)  # which holds for all its images
        found = observe("cube.fits", exposure=["EXPTIME"]).exposure
        np.testing.assert_array_equal(found, [3.0, 3.0])
        mixed = observe(exposure=["EXPTIME", "map.fits"]).exposure
        np.testing.assert_array_equal(mixed, [np.full(SHAPE, 100.0), MAP])

    def test_a_keyword_of_the_primary_header_where_the_image_is_an_extension(self):
        for path, image, time in zip(("1.fits", "2.fits"), IMAGES, (30.0, 40.0), strict=True):
            cards = {"EXPTIME": time, "BUNIT": "ELECTRONS/S"}
            primary = fits.PrimaryHDU(header=fits.Header(cards))
            fits.HDUList([primary, fits.ImageHDU(image)]).writeto(path)
        found = observe(exposure=["EXPTIME"])
        np.testing.assert_array_equal(found.exposure, [30.0, 40.0])
        np.testing.assert_array_equal(found.images, IMAGES * np.reshape([30.0, 40.0], (2, 1, 1)))

    @pytest.mark.parametrize(
        ("name", "right", "wrong"),
        [
            ("exposure", ["s", "sec", ""], ["min", "electron", "ks"]),
            ("background", ["electron", "counts", ""], ["electron/s", "adu", "MJy/sr"]),
            ("read_noise", ["electron", "photons", ""], ["adu", "s"]),
        ],
    )
    def test_maps_in_other_units_are_refused(self, name, right, wrong):
        for path, image in zip(("1.fits", "2.fits"), IMAGES, strict=True):
            save(path, image)
        for unit in right:
            save("map.fits", MAP, BUNIT=unit)
            observe(**{name: ["map.fits"]})
        for unit in wrong:
            save("map.fits", MAP, BUNIT=unit)
            with pytest.raises(InputError, match=rf"{name} map\.fits is in {unit}, and taken in "):
                observe(**{name: ["map.fits"]})

    @pytest.mark.parametrize(
        ("cards", "exposure", "message"),
        [
            ([{"EXPTIME": 1.0}, {}], ["EXPTIME"], "image 1 has no EXPTIME; give exposure as nu"),
            ([{}, {"EXPTIME": 1.0}], ["EXPTIME"], "image 0 has no EXPTIME; give exposure as nu"),
            ([{"EXPTIME": 1.0}, {"EXPTIME": "long"}], ["EXPTIME"],
             "EXPTIME of 2.fits is 'long', not a number"),
            ([{}, {}], ["EXPTIME"],
             "exposure 'EXPTIME' is not a number, a keyword of the images' headers, or a file"),
            ([{"EXPTIME": 1.0}] * 2, ["EXPTIME", 2.0, 3.0],
             "exposure has 3 values for 2 images; give one, or one for each"),
            ([{"EXPTIME": 0.0}] * 2, ["EXPTIME"], "exposure must be finite and more than zero; 0"),
            ([{}, {}], [1.0, 2.0, 3.0], "exposure has shape (3,)"),
        ],
    )  # fmt: skip
    def test_refusals(self, cards, exposure, message):
        for j in range(2):
            save(f"{j + 1}.fits", IMAGES[j], **cards[j])
        with pytest.raises(InputError) as caught:
            observe(exposure=exposure)
        assert message in str(caught.value)


class TestBackground:
    def test_a_number_numbers_a_map_and_a_mixture(self):
        save_images()
        save("map.fits", MAP)
        np.testing.assert_array_equal(observe(background=[7.0]).background, [7.0, 7.0])
        np.testing.assert_array_equal(observe(background=[7.0, 8.0]).background, [7.0, 8.0])
        np.testing.assert_array_equal(observe(background=["map.fits"]).background, [MAP, MAP])
        read_ = read(background=[7.0, "map.fits"])
        np.testing.assert_array_equal(read_.observation.background, [np.full(SHAPE, 7.0), MAP])
        assert read_.background == [7.0, "map.fits"]
        assert len(read_.sha256["background"]) == 1

    def test_auto_is_the_level_in_electrons_with_its_error(self, log):
        images = IMAGES.copy()
        images[:, 4, 4:7] = 1e4
        save_images(images, BUNIT="adu/s")
        found = read(background=["auto"], gain=1.5, exposure=[10.0])
        no_pixel = np.zeros(SHAPE, bool)
        known = [sky_level(j, 15.0 * image, no_pixel) for j, image in enumerate(images)]
        assert found.background == [level for level, _ in known]
        np.testing.assert_array_equal(found.observation.background, found.background)
        np.testing.assert_array_equal(
            found.observation.background_error, [error for _, error in known]
        )
        for j, (level, error) in enumerate(known):
            assert f"image {j}: background {level:.6g} +- {error:.2g} electrons per pixel (" in str(
                notes(log)
            )

    @pytest.mark.filterwarnings("ignore:.* % of image . are masked")
    def test_auto_leaves_bad_pixels_out(self):
        image = np.full(SHAPE, 5.0)
        image[:3], image[3:6], image[6] = np.nan, 90.0, 3000.0
        exposure = np.ones(SHAPE)
        exposure[7:9] = 0.0
        save("1.fits", image, BUNIT="e-/s")
        save("mask.fits", (image == 90.0).astype("u1"))
        save("exposure.fits", exposure)
        with pytest.warns(LnoclWarning, match="not finite"):
            found = read(
                "1.fits",
                background=["auto"],
                mask=["mask.fits"],
                saturation=3000.0,
                exposure=["exposure.fits"],
            )
        assert found.background == [5.0]

    def test_oversubtracted_sky_is_added_back_and_its_noise_measured(self, log):
        save_images(IMAGES - 60.0)
        found = read("1.fits", background=["auto"])
        (level,) = found.background
        assert level == pytest.approx(-9.5, abs=0.5)
        noise = np.sqrt(sigma_clipped_stats(IMAGES[0])[2] ** 2 - max(-9.5 - level, 0.0))
        assert found.read_noise == [pytest.approx(noise)]
        observation, counts = found.observation, IMAGES[0] - 60.0 - level
        np.testing.assert_allclose(observation.images[0], (counts + noise**2).clip(0.0))
        np.testing.assert_allclose(observation.background, noise**2)
        added = f"image 0: its sky was subtracted; {-level:.6g} electrons are added again"
        assert added in notes(log)
        again = read("1.fits", background=found.background, read_noise=found.read_noise)
        np.testing.assert_array_equal(again.observation.images, observation.images)

    def test_auto_where_light_fills_most_of_the_image(self):
        y, x = np.indices((96, 96)) - 40.0
        light = 1000.0 * np.exp(-(x**2 + y**2) / 1000.0)
        save("1.fits", np.random.default_rng(1).poisson(400.0 + light).astype(float))
        found = read("1.fits", background=["auto"], read_noise=["auto"])
        assert 400.0 < found.background[0] < np.median(light) + 400.0 - 20.0
        assert found.read_noise[0] < 20.0
        warn_of_noise(found.observation)  # of which the tests would make an error

    @pytest.mark.parametrize(
        ("background", "message"),
        [
            (["auto"] * 3, "background has 3 values for 2 images; give one, or one for each"),
            (["Auto"], "background 'Auto' is not a number, auto, or a file that exists"),
            (["cube.fits", 1.0], "background cube.fits has the shape (2, 10, 12) and the images"),
            (["oblong.fits"], "background oblong.fits has the shape (1, 12, 10) and the images "
             "(2, 10, 12); give one map that fits all images, or one for each"),
            ([-np.inf], "background must be finite and not negative; -inf"),
        ],
    )  # fmt: skip
    def test_refusals(self, background, message):
        save_images()
        save("map.fits", MAP)
        save("cube.fits", IMAGES)
        save("oblong.fits", MAP.T)
        with pytest.raises(InputError) as caught:
            observe(background=background)
        assert message in str(caught.value)

    def test_auto_of_an_image_without_a_good_pixel(self):
        save_images(np.array([IMAGES[0], np.full(SHAPE, np.nan)]))
        with pytest.raises(InputError, match="image 1 has no good pixel to measure its sky"):
            observe(background=["auto"])


class TestNoise:
    def test_a_number_and_maps_of_read_noise(self):
        save_images()
        save("map.fits", MAP)
        np.testing.assert_array_equal(observe(read_noise=[3.0]).background, [9.0, 9.0])
        observation = observe(read_noise=["map.fits"])
        np.testing.assert_array_equal(observation.background, [MAP**2] * 2)
        np.testing.assert_array_equal(observation.images, IMAGES + MAP**2)
        mixed = observe(read_noise=[2.0, "map.fits"])
        np.testing.assert_array_equal(mixed.background, [np.full(SHAPE, 4.0), MAP**2])
        expected = "read_noise 'none' is not a number, auto, a keyword of the images' headers, or a"
        with pytest.raises(InputError, match=f"{expected} file that exists"):
            observe(read_noise=["none"])

    def test_the_read_noise_may_be_in_the_headers(self, log):
        save_images(RDNOISE=3.0, TEXT="a")
        fits.setval("2.fits", "RDNOISE", value=5)
        found = read(read_noise=["RDNOISE"])
        assert found.read_noise == [3.0, 5.0]
        np.testing.assert_array_equal(found.observation.background, [9.0, 25.0])
        assert notes(log) == [
            "image 0: read noise 3 electrons, from RDNOISE",
            "image 1: read noise 5 electrons, from RDNOISE",
        ]
        with pytest.raises(InputError, match=r"^TEXT of 1\.fits is 'a', not a number; give read"):
            observe(read_noise=["TEXT"])

    @pytest.mark.parametrize(
        ("cards", "known", "factor"),
        [
            ({}, {}, 1.0),
            ({"BUNIT": "adu"}, {"gain": 1.5}, 1.5),
            ({"BUNIT": "e-/s"}, {"exposure": [20.0]}, 20.0),
            ({"BUNIT": "adu/s"}, {"exposure": ["map.fits"], "gain": 2.0}, 2.0 * MAP),
            ({"BUNIT": "electron"}, {"exposure": [20.0]}, 1.0),
        ],
    )
    def test_inverse_variance_is_in_units_of_the_images(self, cards, known, factor):
        save_images(**cards)
        save("map.fits", MAP)
        save("inverse.fits", 1.0 / MAP)
        observation = observe(noise=["ivar=inverse.fits"], **known)
        np.testing.assert_allclose(
            observation.background, [MAP * factor**2] * 2, rtol=1e-14, atol=0
        )

    @pytest.mark.parametrize(
        ("kind", "values"),
        [("ivar", 1.0 / MAP), ("var", MAP), ("rms", np.sqrt(MAP))],
    )
    def test_other_maps_of_the_same_noise(self, log, kind, values):
        save_images(BUNIT="adu")
        values = values.copy()
        values[0, 1], values[2, 3], values[4, 5] = 0.0, np.nan, np.inf
        bad = (values == 0) | ~np.isfinite(values)
        save("map.fits", values)
        found = read(noise=[f"{kind}=map.fits"], gain=1.5)
        np.testing.assert_array_equal(found.observation.mask, [bad, bad])
        background = found.observation.background[0]
        np.testing.assert_allclose(background[~bad], 2.25 * MAP[~bad], rtol=1e-14)
        assert "image 0: 3 pixels masked by the map of noise" in notes(log)
        assert len(found.sha256["noise"]) == 1

    def test_errors_with_those_of_the_counts(self, log):
        """As HST writes them: in counts, the noise of which is in them where there are any."""
        counts = IMAGES.copy()
        counts[0, 0, 0] = -0.5
        errors = np.sqrt(counts.clip(0.0) / 2.0 + MAP)
        errors[1, 5, 5], errors[1, 6, 6] = 0.0, np.sqrt(0.4 * counts[1, 6, 6])
        for j in range(2):
            hdus = [fits.PrimaryHDU(), fits.ImageHDU(counts[j], name="SCI")]
            hdus += [fits.ImageHDU(errors[j], name="ERR")]
            hdus[1].header["BUNIT"] = "adu"
            fits.HDUList(hdus).writeto(f"{j + 1}.fits")
        save("errors.fits", errors)
        for source in ("err", "err=errors.fits"):
            log.clear()
            found = observe(noise=[source], gain=2.0)
            expected = np.array([MAP, MAP]) * 4.0
            expected[1, 6, 6] = 0.0
            bad = errors == 0
            np.testing.assert_array_equal(found.mask, bad)
            np.testing.assert_allclose(found.background[~bad], expected[~bad], rtol=1e-12, atol=0)
            assert notes(log)[-2].endswith(
                "0 pixels whose error is less than the noise of its counts have none"
            )
            assert notes(log)[-1].startswith(
                "image 1: noise apart from that of its counts 2.44 electrons in"
            )
            assert notes(log)[-1].endswith(
                "1 pixel whose error is less than the noise of its counts has none"
            )

    def test_auto_read_noise_is_the_variance_beyond_the_counts(self, log):
        """Of a sky of 50 electrons, 30 of which were subtracted, and a read noise of 8."""
        rng = np.random.default_rng(0)
        images = rng.poisson(50.0, (2, 100, 100)) - 30.0 + rng.normal(0.0, 8.0, (2, 100, 100))
        images[:, 50, 50] = 1e4
        save_images(images)
        found = read(read_noise=["auto"])
        expected = [
            np.sqrt(sigma_clipped_stats(image)[2] ** 2 - np.median(image)) for image in images
        ]
        np.testing.assert_allclose(found.read_noise, expected, rtol=2e-3)
        np.testing.assert_allclose(found.read_noise, np.sqrt(30.0 + 64.0), rtol=0.03)
        assert notes(log)[-1].startswith("image 1: read noise 9.")
        save_images(np.full((2, 8, 8), 100.0))  # with less noise than counts have
        assert read(read_noise=["auto"]).read_noise == [0.0, 0.0]

    def test_errors_that_leave_the_source_out(self):
        save_images()
        save("errors.fits", MAP)
        with pytest.raises(InputError) as caught:
            observe(noise=["err=errors.fits"])
        assert str(caught.value) == (
            "noise err of image 0 is less than the noise of its counts in most pixels; see to gain "
            "and exposure, or give it as rms if it leaves the source out"
        )

    def test_no_errors_and_two_kinds(self):
        save_images()
        save("map.fits", MAP)
        with pytest.raises(InputError) as caught:
            observe(noise=["err"])
        assert str(caught.value) == (
            "1.fits has no extension ERR; give noise as a file, or leave it out"
        )
        with pytest.raises(InputError, match=r"^noise var and rms were given: each describes"):
            observe(noise=["var=map.fits", "rms=map.fits"])
        with pytest.raises(FileError):
            observe(noise=["err", "err=map.fits"])

    def test_refusals(self):
        save_images()
        save("inverse.fits", MAP - 1.5)
        with pytest.raises(InputError, match=r"noise ivar=inverse\.fits has negative"):
            observe(noise=["ivar=inverse.fits"])
        save("inverse.fits", MAP)
        with pytest.raises(InputError, match="give read_noise, or give noise, which includes it"):
            observe(noise=["ivar=inverse.fits"], read_noise=[1.0])
        observe(noise=["ivar=inverse.fits"], read_noise=[0.0])
        save("inverse.fits", MAP[:-1])
        with pytest.raises(InputError, match=r"noise inverse\.fits has the shape"):
            observe(noise=["ivar=inverse.fits"])


def save_with_dq(path, image, flags, **cards):
    extensions = [] if flags is None else [fits.ImageHDU(flags, name="DQ")]
    primary = fits.PrimaryHDU(header=fits.Header(cards))
    fits.HDUList([primary, fits.ImageHDU(image, name="SCI"), *extensions]).writeto(
        path, overwrite=True
    )


class TestMask:
    def test_one_for_all_and_one_for_each(self, log):
        save_images()
        masks = NONE.astype(float)
        masks[0, 1, 2], masks[0, 3, 4], masks[1, 5, 6] = 1.0, np.nan, -7.0
        save("m1.fits", masks[0])
        save("m2.fits", masks[1])
        np.testing.assert_array_equal(observe(mask=["m1.fits"]).mask, [masks[0] != 0] * 2)
        log.clear()
        both = read(mask=["m1.fits", "m2.fits"])
        np.testing.assert_array_equal(both.observation.mask, masks != 0)
        assert len(both.sha256["mask"]) == 2
        assert notes(log) == [
            "image 0: 2 pixels masked by the mask",
            "image 1: 1 pixel masked by the mask",
        ]

    def test_dq_of_each_file_and_a_mask_besides(self, log):
        flags = NONE.astype("i2")
        flags[0, 2, 2], flags[1, 3, 3] = 4, 4096
        for j in range(2):
            save_with_dq(f"{j + 1}.fits", IMAGES[j], flags[j])
        np.testing.assert_array_equal(observe(mask=["dq"]).mask, flags != 0)
        log.clear()
        save("mask.fits", flags[0])
        found = read(mask=["mask.fits", "dq"])
        np.testing.assert_array_equal(found.observation.mask, [flags[0] != 0, flags.any(axis=0)])
        assert notes(log) == [
            "1.fits: the image is HDU 1 (SCI)",
            "2.fits: the image is HDU 1 (SCI)",
            "image 0: 1 pixel masked by the mask",
            "image 1: 1 pixel masked by the mask",
            "1.fits: 1 pixel with the flag 4 of DQ",
            "2.fits: 1 pixel with the flag 4096 of DQ",
            "image 0: 0 pixels masked by the extension DQ",
            "image 1: 1 pixel masked by the extension DQ",
        ]

    def test_dq_of_a_cube(self):
        flags = NONE.astype("i2")
        flags[0, 2, 2], flags[1, 3, 3] = 4, 4096
        save_with_dq("cube.fits", IMAGES, flags)
        save_with_dq("flat.fits", IMAGES, flags[1])
        np.testing.assert_array_equal(observe("cube.fits", mask=["dq"]).mask, flags != 0)
        np.testing.assert_array_equal(observe("flat.fits", mask=["dq"]).mask, [flags[1] != 0] * 2)

    @pytest.mark.parametrize(
        ("words", "bits", "expected"),
        [
            ("JWST NIRCAM NRCALONG", None, [1, 5, 512]),
            ("HST ACS WFC", None, [1, 5, 4, 256, 512]),
            ("HST WFC3 UVIS", None, [1, 5, 4, 256, 512]),
            ("HST WFC3 IR", None, [1, 5, 4, 64, 256]),
            ("HST STIS CCD", None, [1, 5, 4, 16, 64, 256, 512]),
            ("Keck", None, [1, 5, 4, 16, 64, 256, 512]),
            ("HST ACS WFC", "0", [1, 5, 4, 16, 64, 256, 512]),
            ("HST ACS WFC", "256", [1, 5, 4, 16, 64, 512]),
            ("Keck", "~4,64", [5, 4, 64]),
        ],
    )
    def test_flags_that_are_no_fault(self, words, bits, expected):
        sums = [0, 1, 5, 4, 16, 64, 256, 512]
        flags = NONE[0].astype("u4")
        flags[0, : len(sums)] = sums
        keywords = zip(("TELESCOP", "INSTRUME", "DETECTOR"), words.split(), strict=False)
        save_with_dq("1.fits", IMAGES[0], flags, **dict(keywords))
        masked = observe("1.fits", mask=["dq" if bits is None else f"dq:{bits}"]).mask[0]
        assert flags[masked].tolist() == [each for each in sums if each in expected]

    @pytest.mark.parametrize("bits", ["", "a", "3,5", "-1", "1.5", "~", "16 64"])
    def test_invalid_dq_flags_are_refused(self, bits):
        save_with_dq("1.fits", IMAGES[0], NONE[0].astype("i2"))
        with pytest.raises(InputError) as caught:
            observe("1.fits", mask=[f"dq:{bits}"])
        assert str(caught.value) == (
            f"mask dq:{bits} names no flags; give powers of 2, as in dq:16,64, or dq:~1 for all "
            "but 1"
        )

    def test_dq_that_holds_no_flags(self):
        save_with_dq("1.fits", IMAGES[0], NONE[0] + 0.5)
        with pytest.raises(InputError, match=r"^the extension DQ of 1\.fits does not hold whole"):
            observe("1.fits", mask=["dq"])

    def test_much_masked_is_warned_of(self):
        flags = NONE[0].astype("i2")
        flags.ravel()[:12] = 1  # a tenth
        save_with_dq("1.fits", IMAGES[0], flags)
        observe("1.fits", mask=["dq"])
        flags.ravel()[12] = 1
        save_with_dq("1.fits", IMAGES[0], flags)
        with pytest.warns(LnoclWarning, match=r"^11 % of image 0 are masked: the notes say why"):
            observe("1.fits", mask=["dq"])

    def test_dq_that_is_not_there_or_does_not_fit(self):
        save_with_dq("1.fits", IMAGES[0], NONE[0].astype("i2"))
        save_with_dq("2.fits", IMAGES[1], None)
        with pytest.raises(InputError) as caught:
            observe(mask=["dq"])
        assert (
            str(caught.value) == "2.fits has no extension DQ; give mask as a file, or leave it out"
        )
        save_with_dq("3.fits", IMAGES[1], NONE[1].T.astype("i2"))
        with pytest.raises(InputError) as caught:
            observe("1.fits", "3.fits", mask=["dq"])
        assert str(caught.value) == (
            "the extension DQ of 3.fits has the shape (12, 10), its image (10, 12); give mask as "
            "a file"
        )

    def test_saturation_is_in_units_of_the_images(self, log):
        save_images(BUNIT="adu")
        level = IMAGES.max()
        observation = observe(gain=7.0, saturation=level)
        np.testing.assert_array_equal(observation.mask, level == IMAGES)
        expected = [(image == level).sum() for image in IMAGES]
        assert notes(log) == [
            f"image {j}: {counted(count, 'pixel')} masked as saturated, at {level:g} or above"
            for j, count in enumerate(expected)
        ]

    def test_default_mask_is_empty_and_not_reported(self, log):
        save_images()
        assert not observe().mask.any()
        assert notes(log) == []

    @pytest.mark.filterwarnings("ignore:.* % of image . are masked")
    @given(data=st.data())
    def test_a_pixel_is_bad_for_any_reason(self, data):
        bits = st.lists(st.booleans(), min_size=12, max_size=12)
        flags, dq, high, unknown = (np.array(data.draw(bits)).reshape(1, 3, 4) for _ in range(4))
        bad = flags | dq | high | unknown
        image = np.where(high, 100.0, 5.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            hdus = [fits.PrimaryHDU(image[0]), fits.ImageHDU(dq[0].astype("i2"), name="DQ")]
            fits.HDUList(hdus).writeto("image.fits", overwrite=True)
        save("flags.fits", flags[0].astype("i2"))
        save("inverse.fits", np.where(unknown, 0.0, 0.25)[0])
        known = {
            "mask": ["dq", "flags.fits"],
            "saturation": 100.0,
            "noise": ["ivar=inverse.fits"],
        }
        if bad.all():
            with pytest.raises(InputError, match="all pixels are masked"):
                observe("image.fits", **known)
        else:
            observation = observe("image.fits", **known)
            np.testing.assert_array_equal(observation.mask, bad)
            np.testing.assert_array_equal(observation.background[~bad], 4.0)


class TestOffsets:
    def test_by_the_wcs(self, log):
        save("1.fits", IMAGES[0], **NORTH_UP)
        save("2.fits", IMAGES[1], **(NORTH_UP | {"CRPIX1": 7.25, "CRPIX2": 7.5}))
        with pytest.warns(LnoclWarning, match=r"2.fits lies \(1.25, -0.50\) .*: give align wcs"):
            np.testing.assert_array_equal(observe().offsets, 0.0)
        np.testing.assert_allclose(observe(align="wcs").offsets, [(0, 0), (1.25, -0.5)], atol=1e-6)
        assert notes(log) == ["image 1: offset 1.250, -0.500 pixels in x, y, from the WCS"]

    def test_turned_images_are_warned_of(self):
        save("1.fits", IMAGES[0], **NORTH_UP)
        turned = {"PC1_1": 0.8, "PC1_2": 0.6, "PC2_1": -0.6, "PC2_2": 0.8}
        save("2.fits", IMAGES[1], **NORTH_UP, **turned)
        with pytest.warns(LnoclWarning, match="2.fits is turned by 36.87 degrees against 1.fits"):
            assert not observe().is_turned

    def test_turned_images_by_the_wcs(self, log):
        save("1.fits", IMAGES[0], **NORTH_UP)
        turned = {"PC1_1": 0.8, "PC1_2": 0.6, "PC2_1": -0.6, "PC2_2": 0.8}
        save("2.fits", IMAGES[1], **NORTH_UP, **turned)
        observation = observe(align="wcs")
        np.testing.assert_array_equal(observation.turns[0], np.eye(2))
        np.testing.assert_allclose(observation.turns[1], [[0.8, -0.6], [0.6, 0.8]], atol=1e-6)
        assert notes(log) == ["image 1: turned by 36.870 degrees, from the WCS"]

    @pytest.mark.parametrize("kind", ["keyword", "numbers", "text", "fits"])
    def test_field_rotation(self, kind):
        for name, image, angle in zip(("1.fits", "2.fits"), IMAGES, (10.0, 25.0), strict=True):
            save(name, image, PARANG=angle)
        Path("angles.txt").write_text("10.0\n25.0\n", encoding="ascii")
        fits.writeto("angles.fits", np.array([10.0, 25.0]))
        given = {
            "keyword": ["PARANG"],
            "numbers": [10.0, 25.0],
            "text": ["angles.txt"],
            "fits": ["angles.fits"],
        }
        observation = observe(angle=given[kind], centre=(4.0, 3.0))
        expected = lnocl.rotations([-10.0, -25.0], (4.0, 3.0))
        np.testing.assert_allclose(observation.transforms, expected, atol=1e-12)

    @pytest.mark.parametrize(
        ("given", "message"),
        [
            ({"angle": ["PARANG"]}, "1.fits has no PARANG in its header, and there is no such"),
            ({"angle": [1.0, 2.0, 3.0]}, "3 angles for 2 images; give a keyword, a file of the"),
            ({"angle": ["few.txt"]}, "few.txt has 3 angles for 2 images"),
            ({"angle": ["words.txt"]}, "words.txt must hold numbers alone, an angle a line"),
            ({"angle": ["image.fits"]}, "image.fits must hold a finite angle for each image"),
            ({"angle": [1.0], "align": "wcs"}, "give angle or align, not both"),
        ],
    )
    def test_wrong_angles(self, given, message):
        save("1.fits", IMAGES[0])
        save("2.fits", IMAGES[1])
        save("image.fits", IMAGES[0])
        Path("few.txt").write_text("1 2 3", encoding="ascii")
        Path("words.txt").write_text("north up", encoding="ascii")
        with pytest.raises(lnocl.LnoclError) as caught:
            observe(**given)
        assert str(caught.value).startswith(message)

    def test_a_cube_has_one_wcs(self):
        save("cube.fits", IMAGES, **NORTH_UP)
        with pytest.raises(InputError) as caught:
            observe("cube.fits", align="wcs")
        assert str(caught.value) == (
            "cube.fits is a cube, with one WCS for all its images; to align them give a file for "
            "each"
        )


# Pixels of 0.05 arcsec.
SCALE = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 10.0, "CRVAL2": 70.0,
         "CDELT1": -0.05 / 3600, "CDELT2": 0.05 / 3600}  # fmt: skip


class TestPixelScales:
    def said(self, psf_cards, image_cards=None, **calibration):
        for path, image in zip(("1.fits", "2.fits"), IMAGES, strict=True):
            save(path, image, **(SCALE if image_cards is None else image_cards))
        save("psf.fits", np.ones((3, 3)), **psf_cards)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            observe(**calibration)
        return [str(each.message) for each in caught]

    @pytest.mark.parametrize(
        "cards",
        [
            {"PIXELSCL": 0.0125},
            {"PIXSCALE": 0.0125},  # of Tiny Tim
            SCALE | {"CDELT1": -0.0125 / 3600, "CDELT2": 0.0125 / 3600},
        ],
        ids=["PIXELSCL", "PIXSCALE", "WCS"],
    )
    def test_psf_with_another_pixel_scale_is_reported(self, cards):
        (message,) = self.said(cards)
        assert message == (
            "the pixels of psf 0 are of 0.0125 arcsec, those of its image of 0.05: give "
            "oversample 4, or rebin it to the image's pixels, by 4"
        )

    @pytest.mark.parametrize(
        "cards",
        [{}, {"PIXELSCL": 0.0505}, SCALE, {"PIXELSCL": "fine"}, {"PIXELSCL": 0.0}],
        ids=["none", "PIXELSCL", "WCS", "a text", "0"],
    )
    def test_others_are_not(self, cards):
        assert self.said(cards) == []

    def test_psf_finer_than_the_detector_is_reported(self):
        (message,) = self.said({"OVERSAMP": 4})
        assert message == (
            "psf 0 is sampled 4 times finer than the detector, by OVERSAMP in its header: give "
            "oversample 4, or bin it to the image's pixels"
        )
        assert self.said({"OVERSAMP": 1}) == []
        assert self.said({"OVERSAMP": 4}, oversample=4) == []
        (message,) = self.said({"OVERSAMP": 4}, oversample=2)
        assert message.endswith("give oversample 4, or bin it to 2 times finer")
        (message,) = self.said({"OVERSAMP": 4, "PIXELSCL": 0.0125})
        assert "rebin it to the image's pixels, by 4" in message

    def test_lnocl_simulates_milliarcseconds(self):
        header = fits.Header([("PIXSCALE", 12.5, "mas per pixel")])
        assert sky.pixel_scale(header) == 0.0125

    @pytest.mark.parametrize(("scale", "is_other"), [(0.05, False), (0.0125, False), (0.03, True)])
    def test_grids_are_for_the_pixels_of_one_camera(self, scale, is_other):
        """They are on its pixels, or as many times finer as the grid is."""
        header = fits.Header({"PIXELSCL": scale})
        stacks = (
            Stack(IMAGES, [fits.Header(SCALE)], [], []),
            Stack(np.ones((1, 3, 3)), [header], [], []),
        )
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            warn_of_pixel_scales(*stacks, [SimpleNamespace(oversampling=np.array([4, 4]))], 1)
        assert [str(each.message) for each in caught] == [
            "the pixels of psf 0 are of 0.03 arcsec, those of its image of 0.05: give the grid of "
            "this camera"
        ] * is_other

    def test_images_without_coordinates_tell_nothing(self):
        assert self.said({"PIXELSCL": 0.0125}, {}) == []


def test_observations_have_the_error_of_psfs_that_is_given():
    save_images()
    assert observe(psf_error=0.07).psf_error == 0.07


def test_sources_that_fill_a_frame_are_no_read_noise():
    y, x = np.indices((128, 128))
    rng = np.random.default_rng(4)
    places = rng.uniform(4, 124, (40, 2))
    light = sum(3000 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 4.0) for a, b in places)
    counts = rng.poisson(200.0 + light) + rng.normal(0, 10.0, x.shape)
    found = sky_noise(0, counts, np.zeros(x.shape, bool))
    assert found == pytest.approx(10.0, rel=0.1)
    _, median, scatter = sigma_clipped_stats(counts)
    assert np.sqrt(scatter**2 - median) > 11.2  # what it was taken for


class TestTheScatterOfPsfs:
    PSF = np.arange(1.0, 10.0).reshape(3, 3)

    def save(self, path, scatter=None, psf=PSF):
        hdus = [fits.PrimaryHDU(psf)]
        if scatter is not None:
            hdus.append(fits.ImageHDU(scatter, name="SCATTER"))
        fits.HDUList(hdus).writeto(path, overwrite=True)

    def read(self, *psfs, **known):
        save_images()
        known = {"psf_error": 0.03, **known}
        paths = ["1.fits", "2.fits"]
        return read_frames(paths, psfs or ["made.fits"], Calibration(**known)).observation

    def test_it_is_read_with_the_psf_and_in_its_unit(self, log):
        self.save("made.fits", 0.1 * self.PSF)
        np.testing.assert_allclose(self.read().psf_scatter, [self.PSF / 450] * 2)
        told = "SCATTER, the error of the pixels of PSFs, is taken from 1 file of PSFs"
        assert notes(log).count(told) == 1

    def test_cubes_have_cubes(self):
        psfs = np.array([self.PSF, self.PSF.T])
        self.save("made.fits", 0.1 * psfs / 45.0, psfs / 45.0)
        np.testing.assert_allclose(self.read().psf_scatter, 0.1 * psfs / 45.0)

    def test_files_with_it_and_without_may_be_mixed(self, log):
        self.save("made.fits", self.PSF / 450)
        self.save("other.fits")
        found = self.read("other.fits", "made.fits").psf_scatter
        np.testing.assert_allclose(found, [np.zeros((3, 3)), self.PSF / 45 / 450])
        assert any("from 1 of 2 files of PSFs" in line for line in notes(log))

    def test_psfs_of_several_shapes_have_it_about_their_centres(self):
        save_images(**NORTH_UP)
        self.save("made.fits", np.ones((5, 5)), np.ones((5, 5)))
        self.save("other.fits", np.ones((3, 3)), np.ones((3, 3)))
        known = Calibration(psf_error=0.03, align="wcs")
        found = read_frames(["1.fits", "2.fits"], ["made.fits", "other.fits"], known)
        other = np.pad(np.full((3, 3), 1 / 9), 1)
        np.testing.assert_allclose(found.observation.psf_scatter, [np.full((5, 5), 1 / 25), other])

    @pytest.mark.parametrize("known", [{"psf_error": 0.0}, {"psf_errors": ["scatter=map.fits"]}])
    def test_exact_psfs_and_another_that_is_given_leave_it(self, known, log):
        self.save("made.fits", 0.1 * self.PSF)
        save("map.fits", 0.2 * self.PSF)
        found = self.read(**known).psf_scatter
        np.testing.assert_allclose(found, [0.2 * self.PSF] * 2 if "psf_errors" in known else found)
        assert len(found) == 2 * ("psf_errors" in known)
        assert not any("SCATTER, the error" in line for line in notes(log))

    def test_one_of_another_shape_is_left_out_and_named(self):
        self.save("made.fits", np.ones((5, 5)))
        with pytest.warns(LnoclWarning, match=r"made.fits\[0\] has a SCATTER that is not"):
            assert not len(self.read("made.fits[0]").psf_scatter)
