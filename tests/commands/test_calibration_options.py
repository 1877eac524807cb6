"""The command ``lnocl deconvolve`` on frames as a telescope leaves them."""

import hashlib
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from commandline import NUMPY, SHAPE, one_complaint, outcome
from scenes import paper
from wcs_headers import NORTH_UP

from lnocl.commands import cli
from lnocl.io.calibration import Calibration
from lnocl.io.frames import read_frames
from lnocl.io.saved_results import read_result
from lnocl.studies.figures import view_of

pytestmark = pytest.mark.usefixtures("command_folder")


class TestFrames:
    """Two frames as a telescope leaves them: adu per second, an offset, bad pixels."""

    WCS = fits.Header(NORTH_UP | {"BUNIT": "ADU/s"})
    INPUTS = ("f1.fits", "f2.fits", "--psf", "psfs.fits")
    OPTIONS = (
        *("--background", "auto", "level.fits", "--exposure", "EXPTIME", "--gain", "1.7"),
        *("--noise", "ivar=inverse.fits", "--mask", "mask.fits", "dq", "--align", "wcs"),
        *("--saturation", "1000", "--star", "3,12.25", "--stars", "stars.csv", "--refine"),
        *("--mu", "1e-4", "--smoothing", "1e-3", "--solver", "sgp"),
        *("--n-iter", "9", "--stop", "1e-9", "--pad", "2"),
        "--residuals",
    )

    @pytest.fixture(autouse=True)
    def frames(self, command_folder):
        y, x = np.indices((15, 15)) - 7
        smooth = np.exp(-(x**2 + y**2) / 3.0)  # wide enough to be moved between pixels
        fits.writeto("psfs.fits", np.array([smooth, smooth.T**1.2]), overwrite=True)
        for j, (dx, dy, exposure) in enumerate([(0.0, 0.0, 30.0), (1.25, -0.5, 60.0)], 1):
            header = self.WCS.copy()
            header["CRPIX1"] += dx
            header["CRPIX2"] += dy
            header["EXPTIME"] = exposure
            y, x = np.indices(SHAPE)
            counts = fits.getdata(f"{'ab'[j - 1]}.fits")
            for star in [(3.0, 12.25), (7.0, 5.0), (8.5, 4.0)]:
                squares = (x - star[0] - dx) ** 2 + (y - star[1] - dy) ** 2
                counts += 900.0 * np.exp(-0.5 * squares)
            image = counts / 1.7 / exposure
            image[1, j] = 2000.0
            flags = np.zeros(SHAPE, "i2")
            flags[14, j] = 8
            fits.HDUList([fits.PrimaryHDU(image, header), fits.ImageHDU(flags, name="DQ")]).writeto(
                f"f{j}.fits"
            )
        fits.writeto("level.fits", np.full(SHAPE, 3.0))
        fits.writeto("inverse.fits", np.full(SHAPE, 1e3))
        mask = np.zeros(SHAPE, "u1")
        mask[0, 0] = 1
        fits.writeto("mask.fits", mask)
        self.sky = WCS(self.WCS).pixel_to_world(7.0, 5.0)
        Path("stars.csv").write_text("ra,dec\n{!r},{!r}\n".format(*self.at(8.5, 4.0)))
        self.sky_option = ("--star", "{!r}d,{!r}d".format(*self.at(7.0, 5.0)))

    def at(self, x, y):
        position = WCS(self.WCS).pixel_to_world(x, y)
        return float(position.ra.deg), float(position.dec.deg)

    def run(self, *options, output="out.fits"):
        return cli.main(["deconvolve", *self.INPUTS, *NUMPY, *options, "-o", output])

    @pytest.mark.exhaustive
    def test_the_command_in_the_header_makes_the_same_file_bit_by_bit(self, capsys):
        assert self.run(*self.OPTIONS, *self.sky_option) == 0
        captured = capsys.readouterr()
        first, header = outcome("out.fits"), fits.getheader("out.fits")
        words = shlex.split("\n".join(header["HISTORY"]).replace("\\\n", ""))
        words = words[words.index("lnocl") :]
        for option in [*self.OPTIONS, *self.sky_option]:
            if option.startswith("--") and option != "--stars":
                assert option in words
        assert words.count("--star") == 3
        given = words[words.index("--background") + 1 :][:2]
        assert given == ["auto", "level.fits"]
        os.rename("out.fits", "first.fits")
        os.unlink("stars.csv")  # positions are spelled out
        assert cli.main(words[1:]) == 0
        assert capsys.readouterr().out == captured.out
        again = outcome("out.fits")
        names = {
            "PRIMARY",
            "STARS",
            "HISTORY",
            "MODELS",
            "RESIDUALS",
            "ELECTRONS",
            "PLAN",
            "MESSAGES",
            "ESTIMATE",
        }
        assert set(again) == names
        first.pop("MESSAGES")  # less is read from keywords and files
        for name, data in first.items():
            np.testing.assert_equal(again[name], data)
        assert fits.getheader("out.fits")["HISTORY"] == header["HISTORY"]

    @pytest.mark.exhaustive
    def test_command_result_matches_the_library_result_from_the_same_files(self):
        assert self.run(*self.OPTIONS, *self.sky_option, "--quiet") == 0
        known = Calibration(
            background=["auto", "level.fits"],
            noise=["ivar=inverse.fits"],
            exposure=["EXPTIME"],
            mask=["mask.fits", "dq"],
            saturation=1000.0,
            gain=1.7,
            align="wcs",
        )
        observation = read_frames(self.INPUTS[:2], ["psfs.fits"], known).observation
        stars = [(3.0, 12.25)]
        for x, y in [(7.0, 5.0), (8.5, 4.0)]:
            at = SkyCoord(*self.at(x, y), unit="deg")
            stars.append([float(each) for each in WCS(self.WCS).world_to_pixel(at)])
        np.testing.assert_allclose(stars[1:], [(7.0, 5.0), (8.5, 4.0)], atol=1e-6)
        expected = paper(
            observation,
            stars=stars,
            mu=1e-4,
            smoothing=1e-3,
            solver="sgp",
            n_iter=9,
            stop=1e-9,
            pad=2,
            engine="numpy",
            refine_positions=True,
        )
        found = outcome("out.fits")
        np.testing.assert_array_equal(found["PRIMARY"], expected.extended / 1.7)
        table = found["STARS"]
        rms = [(s.core.rms, s.wings.rms, s.halo) for s in expected.star_residuals()]
        assert list(table) == ["x", "y", "flux", "x_error", "y_error", "flux_error", "ra", "dec",
                               "core_rms", "wings_rms", "halo"]  # fmt: skip
        for names, values in [
            (["x", "y"], expected.star_positions.T),
            (["flux"], [expected.star_fluxes / 1.7]),
            (["x_error", "y_error"], expected.star_position_errors.T),
            (["flux_error"], [expected.star_flux_errors / 1.7]),
            (["core_rms", "wings_rms", "halo"], np.transpose(rms)),
        ]:
            np.testing.assert_array_equal([table[name] for name in names], values)
        assert (table["flux_error"] > 0).all()
        sky = SkyCoord(table["ra"], table["dec"], unit="deg")
        back = WCS(self.WCS).world_to_pixel(sky)
        np.testing.assert_allclose(back, [table["x"], table["y"]], atol=1e-6)
        for name, cube in [("MODELS", expected.models()), ("RESIDUALS", expected.residuals())]:
            np.testing.assert_array_equal(found[name], cube.astype("f4"))
        unknown = observation.mask | (found["MODELS"] == 0)
        np.testing.assert_array_equal(np.isnan(found["RESIDUALS"]), unknown)

    @pytest.mark.exhaustive
    def test_units_and_cards_of_the_result(self):
        assert self.run(*self.OPTIONS, *self.sky_option) == 0
        with fits.open("out.fits") as hdus:
            header, table = hdus[0].header, hdus["STARS"].header
            cubes = [hdus[name].header for name in ("MODELS", "RESIDUALS")]
            assert hdus["MODELS"].header["BUNIT"] == "electron"
            assert "BUNIT" not in hdus["RESIDUALS"].header
        assert header["BUNIT"] == "adu/s"
        picture = view_of(read_result("out.fits"))  # all of it is in the unit of the tables
        assert picture.unit == "adu/s"
        np.testing.assert_array_equal(picture.extended, fits.getdata("out.fits"))
        electrons = 1.7 * np.reshape([30.0, 60.0], (2, 1, 1))
        np.testing.assert_allclose(fits.getdata("out.fits", "ELECTRONS"), electrons, rtol=1e-6)
        given = fits.getdata("out.fits", "MODELS") / electrons
        bad = np.isnan(fits.getdata("out.fits", "RESIDUALS"))  # grey in the picture of the model
        np.testing.assert_allclose(picture.models, np.where(bad, np.nan, given), rtol=1e-6)
        numbers = range(1, table["TFIELDS"] + 1)
        named = {table[f"TTYPE{i}"]: table.get(f"TUNIT{i}", "") for i in numbers}
        assert named == {
            **dict.fromkeys(["x", "y", "x_error", "y_error"], "pix"),
            **dict.fromkeys(["flux", "flux_error"], "adu/s"),
            "ra": "deg",
            "dec": "deg",
            **dict.fromkeys(["core_rms", "wings_rms", "halo"], ""),
        }
        np.testing.assert_allclose(WCS(header).world_to_pixel(self.sky), [7.0, 5.0], atol=1e-6)
        for cube in cubes:  # the images are shifted against each other
            assert not WCS(cube, naxis=2).has_celestial
            assert [cube["OFFX2"], cube["OFFY2"]] == [header["OFFX2"], header["OFFY2"]]
        expected = {
            "BKG2": "level.fits",
            "EXP1": 30.0,
            "EXP2": 60.0,
            "GAIN": 1.7,
            "SATURATE": 1000.0,
            "REFINED": True,
            "OFFX1": 0.0,
            "OFFY1": 0.0,
        }
        assert {keyword: header[keyword] for keyword in expected} == expected
        np.testing.assert_allclose([header["OFFX2"], header["OFFY2"]], [1.25, -0.5], atol=1e-6)
        for keyword, path in {
            "ISUM2": "f2.fits",
            "PSUM1": "psfs.fits",
            "BSUM1": "level.fits",
            "NSUM1": "inverse.fits",
            "MSUM1": "mask.fits",
        }.items():
            assert header[keyword] == hashlib.sha256(Path(path).read_bytes()).hexdigest()

    def test_maps_of_exposure_and_read_noise_have_cards_too(self):
        options = ("--gain", "1", "--exposure", "inverse.fits", "--read-noise", "level.fits", "2")
        assert self.run(*options, "--n-iter", "1") == 0
        header = fits.getheader("out.fits")
        assert (header["EXP1"], header["RON1"], header["RON2"]) == (
            "inverse.fits",
            "level.fits",
            2.0,
        )
        assert len(header["ESUM1"]) == len(header["RSUM1"]) == 64

    @pytest.mark.exhaustive
    def test_calibration_steps_are_printed_when_verbose_and_not_when_quiet(self, capsys):
        assert self.run(*self.OPTIONS, *self.sky_option, "--verbose") == 0
        said = capsys.readouterr()
        level = fits.getheader("out.fits")["BKG1"]
        lines = [line.removeprefix("lnocl: ") for line in said.err.splitlines()]
        assert re.search("trust +no: the model does not fit at 3 of 3 stars, ", said.out)
        n = next(k for k, line in enumerate(lines) if line.startswith("stars.csv: ")) + 1
        assert lines[:n] == [
            "image 1: exposure 30 seconds, from EXPTIME",
            "image 2: exposure 60 seconds, from EXPTIME",
            "image 1: 1 pixel masked by the mask",
            "image 2: 1 pixel masked by the mask",
            "f1.fits: 1 pixel with the flag 8 of DQ",
            "f2.fits: 1 pixel with the flag 8 of DQ",
            "image 1: 1 pixel masked by the extension DQ",
            "image 2: 1 pixel masked by the extension DQ",
            "image 1: 1 pixel masked as saturated, at 1000 or above",
            "image 2: 1 pixel masked as saturated, at 1000 or above",
            "image 1: 0 pixels masked by the map of noise",
            "image 2: 0 pixels masked by the map of noise",
            next(line for line in said.err.splitlines() if "(mode of" in line)[7:],
            "image 2: offset 1.250, -0.500 pixels in x, y, from the WCS",
            "stars.csv: 1 star, by ra and dec",
        ]
        assert f"image 1: background {level:.6g} +- " in said.err
        assert re.search(r"star 1 .* [-+.\de ]+ adu/s\n", said.out)
        assert self.run(*self.OPTIONS, *self.sky_option, "--overwrite") == 0
        assert [line.removeprefix("lnocl: ") for line in capsys.readouterr().err.splitlines()] == [
            "image 1: 1 pixel masked by the mask; 1 more like this: --verbose",
            "f1.fits: 1 pixel with the flag 8 of DQ; 1 more like this: --verbose",
            "image 1: 1 pixel masked by the extension DQ; 1 more like this: --verbose",
            "image 1: 1 pixel masked as saturated, at 1000 or above; 1 more like this: --verbose",
            "image 1: 0 pixels masked by the map of noise; 1 more like this: --verbose",
            "stars.csv: 1 star, by ra and dec",
        ]
        assert self.run(*self.OPTIONS, *self.sky_option, "--quiet", "--overwrite") == 0
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("lnocl: warning: the model does not fit at 3 of 3 stars, ")

    @pytest.mark.parametrize(
        "options",
        [("--mask", "out.fits"), ("--noise", "ivar=out.fits"), ("--background", "out.fits"),
         ("--read-noise", "1", "out.fits"), ("--exposure", "out.fits"), ("--stars", "out.fits")],
    )  # fmt: skip
    def test_an_output_that_is_an_input_is_refused(self, capsys, options):
        before = Path("mask.fits").read_bytes()
        Path("out.fits").write_bytes(before)
        assert self.run(*options, "--overwrite") == 2
        message = "the output out.fits is one of the inputs; give it another name"
        assert one_complaint(capsys.readouterr()) == message
        assert Path("out.fits").read_bytes() == before

    def test_without_stars_or_coordinates(self):
        for name in ("f1.fits", "f2.fits"):
            fits.delval(name, "CTYPE1")
            fits.delval(name, "CTYPE2")
        assert self.run("--gain", "1", "--exposure", "1", "--n-iter", "1", "--residuals") == 0
        found = outcome("out.fits")
        columns = ["x", "y", "flux", "flux_error"]
        assert list(found["STARS"]) == [*columns, "core_rms", "wings_rms", "halo"]
        assert found["MODELS"].shape == (2, *SHAPE)
