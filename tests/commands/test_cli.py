"""The command line: what it runs, what it refuses, and what it says."""

import hashlib
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from scenes import make_psfs

import lnocl
from lnocl.commands import cli
from lnocl.errors import DeviceError
from lnocl.io.frames import Calibration, read_frames
from lnocl.opencl import device
from lnocl.runs.progress import Bar

SHAPE = (16, 12)
NUMPY = ("--engine", "numpy")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in a folder with two images, their PSFs, and files that are no use."""
    monkeypatch.chdir(tmp_path)
    chance = np.random.default_rng(1)
    images = chance.poisson(20.0, (2, *SHAPE)).astype(float)
    images[:, 5, 7] += 400.0
    psfs = make_psfs(2, (7, 7))
    nan_psf = psfs[0].copy()
    nan_psf[0, 0] = np.nan
    arrays = {
        "a": images[0],
        "b": images[1],
        "cube": images,
        "oblong": images[0].T,
        "line": images[0, 0],
        "four": images[None],
        "nan": np.full(SHAPE, np.nan),
        "k1": psfs[0],
        "k2": psfs[1],
        "psfs": psfs,
        "three": psfs[[0, 1, 0]],
        "zero": np.zeros((7, 7)),
        "nanpsf": nan_psf,
        "negative": psfs[0] - 1e-3,
    }
    header = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 15.25})
    for name, array in arrays.items():
        fits.writeto(f"{name}.fits", array, header)
    Path("text.fits").write_text("no FITS at all\n" * 400)
    Path("cut.fits").write_bytes(Path("a.fits").read_bytes()[:3000])
    fits.BinTableHDU.from_columns([fits.Column("a", "D", array=[1.0])]).writeto("table.fits")
    Path("there.fits").write_bytes(b"old")
    return tmp_path


def run(*arguments, image="a.fits", psf="k1.fits", engine=NUMPY, output="out.fits"):
    """Deconvolve for one iteration unless the arguments say otherwise."""
    images = [image] if isinstance(image, str) else image
    return cli.main(
        ["deconvolve", *images, "--psf", psf, "--n-iter", "1", "-o", output, *engine, *arguments]
    )


def one_complaint(captured):
    """Return the message of the one error on stderr; lines before it may only be warnings."""
    assert captured.out == ""
    *warned, error = captured.err.splitlines()
    assert all(line.startswith("lnocl: warning: ") for line in warned)
    assert error.startswith("lnocl: error: ")
    return error.removeprefix("lnocl: error: ")


BAD_FILES = {
    "missing": ({"image": "no.fits"}, 1, "no.fits cannot be opened: No such file"),
    "folder": ({"image": "."}, 1, ". cannot be opened: Is a directory"),
    "not FITS": ({"image": "text.fits"}, 1, "text.fits is no FITS file"),
    "truncated": ({"image": "cut.fits"}, 1, "cut.fits is truncated"),
    "no image": ({"image": "table.fits"}, 1, "table.fits holds no image"),
    "one dimension": ({"image": "line.fits"}, 2, "line.fits has an image of 1 dimensions"),
    "four dimensions": ({"image": "four.fits"}, 2, "four.fits has an image of 4 dimensions"),
    "all masked": ({"image": "nan.fits"}, 2, "all pixels are masked"),
    "other shape": (
        {"image": ("a.fits", "oblong.fits")},
        2,
        "oblong.fits has the shape (12, 16) and a.fits (16, 12); they must be the same",
    ),
    "missing psf": ({"psf": "no.fits"}, 1, "no.fits cannot be opened"),
    "psf count": ({"psf": "three.fits"}, 2, "3 psfs for 1 image"),
    "zero psf": ({"psf": "zero.fits"}, 2, "sum"),
    "nan psf": ({"psf": "nanpsf.fits"}, 2, "psfs hold values that are not finite"),
    "output exists": ({"output": "there.fits"}, 1, "there.fits exists; give another name"),
    "no folder": ({"output": "no/out.fits"}, 1, "the folder of the output no/out.fits does not"),
    "output is input": (
        {"output": "a.fits", "engine": (*NUMPY, "--overwrite")},
        2,
        "a.fits is one of the inputs",
    ),
}

BAD_ARGUMENTS = {
    "star outside": (["--star", "12,5"], 2, "the star at (12, 5) lies outside"),
    "star below": (["--star", "-1,3"], 2, "the star at (-1, 3) lies outside"),
    "star nan": (["--star", "nan,3"], 2, "the star at (nan, 3) lies outside"),
    "star infinite": (["--star", "-inf,3"], 2, "the star at (-inf, 3) lies outside"),
    "star of one": (["--star", "3"], 2, "argument --star: '3' is not X,Y"),
    "star of words": (["--star", "x,y"], 2, "argument --star: 'x,y' is not X,Y"),
    "mu negative": (["--mu", "-1"], 2, "mu must be"),
    "mu negative power": (["--mu", "-1e-3"], 2, "mu must be"),
    "mu nan": (["--mu", "nan"], 2, "mu must be"),
    "mu minus nan": (["--mu", "-nan"], 2, "mu must be"),
    "mu a word": (["--mu", "little"], 2, "mu 'little' is not known; give a number or auto"),
    "smoothing negative": (["--smoothing", "-1"], 2, "smoothing must be"),
    "background": (["--background", "-1"], 2, "background must be finite and not negative; -1"),
    "background nan": (["--background", "nan"], 2, "background must be finite"),
    "background inf": (["--background", "-inf"], 2, "background must be finite"),
    "backgrounds": (["--background", "1", "2"], 2, "background has shape (2,)"),
    "read noise": (["--read-noise", "-2.5"], 2, "read_noise must be finite and not negative"),
    "read noise nan": (["--read-noise", "nan"], 2, "read_noise must be finite"),
    "n_iter": (["--n-iter", "0"], 2, "n_iter must be a whole number, 1 or more; 0"),
    "n_iter negative": (["--n-iter", "-3"], 2, "n_iter must be a whole number, 1 or more; -3"),
    "n_iter fraction": (["--n-iter", "1.5"], 2, "argument --n-iter: invalid int value: '1.5'"),
    "pad": (["--pad", "-1"], 2, "pad must be a whole number, 0 or more, or auto; -1"),
    "pad large": (["--pad", "5000"], 2, "the largest axis is 8192"),
    "solver": (["--solver", "magic"], 2, "argument --solver: invalid choice: 'magic'"),
    "precision": (["--precision", "half"], 2, "argument --precision: invalid choice: 'half'"),
    "engine": (["--engine", "cuda"], 2, "argument --engine: invalid choice: 'cuda'"),
    "device": (["--device", "0"], 2, "engine numpy uses no device"),
    "read noise a word": (
        ["--read-noise", "some"],
        2,
        "read noise 'some' is not a number, or a file",
    ),
    "background a word": (
        ["--background", "Auto"],
        2,
        "background 'Auto' is not a number, auto, or a",
    ),
    "exposure a word": (["--exposure", "TEXP"], 2, "exposure 'TEXP' is not a number, a keyword of"),
    "exposure zero": (["--exposure", "0"], 2, "exposure must be finite and more than zero; 0"),
    "gain": (["--gain", "-1"], 2, "the gain must be a number more than 0; -1 was given"),
    "gain a word": (["--gain", "GAIN"], 2, "argument --gain: 'GAIN' is no finite number"),
    "saturation": (["--saturation", "nan"], 2, "argument --saturation: 'nan' is no finite number"),
    "zero point": (["--zero-point", "inf"], 2, "argument --zero-point: 'inf' is no finite number"),
    "align": (["--align", "stars"], 2, "argument --align: invalid choice: 'stars'"),
    "inverse variance": (["--inverse-variance", "no.fits"], 1, "no.fits cannot be opened"),
    "mask": (["--mask", "dq"], 2, "a.fits has no extension DQ; give a mask file, or leave dq out"),
    "sky": (["--star-sky", "1,2,3"], 2, "'1,2,3' is not RA,DEC in degrees, or as hh:mm:ss,dd"),
    "sky far off": (["--star-sky", "195,2"], 2, "the star at RA, Dec 195.00000 2.00000 lies in"),
    "sky off": (["--star-sky", "15.25,-3"], 2, "lies outside the images: x must be in [0, 11]"),
    "star table": (["--stars", "no.csv"], 1, "no.csv cannot be read as a table: No such file"),
    "star table without": (["--stars", "table.fits"], 2, "neither columns x and y nor ra and dec;"),
    "abbreviation": (["--over"], 2, "unrecognized arguments: --over"),
}


class TestRefusals:
    @pytest.mark.parametrize(("given", "status", "message"), BAD_FILES.values(), ids=BAD_FILES)
    def test_bad_file(self, capsys, given, status, message):
        before = sorted(os.listdir())
        assert run(**given) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == before
        assert Path("there.fits").read_bytes() == b"old"

    @pytest.mark.parametrize(
        ("given", "status", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS
    )
    def test_bad_argument(self, capsys, given, status, message):
        before = sorted(os.listdir())
        assert run(*given) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == before

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ([], "the following arguments are required: COMMAND; see lnocl --help"),
            (["deconvole"], "invalid choice: 'deconvole'"),
            (["deconvolve"], "required: IMAGE, --psf, -o/--output; see lnocl deconvolve --help"),
            (["deconvolve", "a.fits", "--psf", "k1.fits", "k2.fits", "-o", "o.fits", *NUMPY],
             "2 psfs for 1 image; give one, or one for each image"),
            (["deconvolve", "a.fits", "--psf", "k1.fits", "nan.fits", "-o", "o.fits", *NUMPY],
             "nan.fits has the shape (16, 12) and k1.fits (7, 7)"),
            (["devices", "all"], "unrecognized arguments: all"),
        ],
    )  # fmt: skip
    def test_wrong_use(self, capsys, arguments, message):
        assert cli.main(arguments) == 2
        assert message in one_complaint(capsys.readouterr())
        assert not Path("o.fits").exists()

    def test_the_output_is_checked_before_the_inputs(self, capsys):
        assert run(image="no.fits", output="there.fits") == 1
        assert "there.fits exists" in one_complaint(capsys.readouterr())

    @pytest.mark.parametrize("error", [DeviceError("no device"), lnocl.InputError("which one")])
    def test_the_device_is_chosen_before_the_inputs_are_read(self, capsys, monkeypatch, error):
        def refuse(spec):
            assert spec == "5:7"
            raise error

        monkeypatch.setattr(device, "choose", refuse)
        assert run("--device", "5:7", image="no.fits", engine=()) == error.exit_status
        assert one_complaint(capsys.readouterr()) == str(error)

    @pytest.mark.parametrize("command", [["devices"], ["deconvolve"]])
    def test_no_platform(self, command):
        arguments = ["a.fits", "--psf", "k1.fits", "-o", "out.fits"]
        done = outside(
            *command, *(arguments if command == ["deconvolve"] else []), OCL_ICD_VENDORS="/no"
        )
        assert done.returncode == 1
        assert done.stderr.startswith("lnocl: error: no OpenCL device was found")
        assert done.stderr.count("\n") == 1
        assert done.stdout == ""
        assert not Path("out.fits").exists()

    def test_an_unknown_device(self, capsys):
        assert run("--device", "no such platform", engine=()) == 2
        assert "'no such platform' fits no OpenCL device" in one_complaint(capsys.readouterr())
        assert not Path("out.fits").exists()

    def test_names_never_break_the_line(self, capsys):
        assert run(image="two\nlines \x1b[31m\udcff.fits") == 1
        message = "two lines \\x1b[31m\\udcff.fits cannot be opened"
        assert message in one_complaint(capsys.readouterr())

    @pytest.mark.parametrize(
        ("error", "status", "message"),
        [
            (KeyboardInterrupt(), 130, "interrupted"),
            (MemoryError(), 1, "not enough memory"),
            (OSError(28, "No space left on device"), 1, "No space left on device"),
        ],
    )
    def test_what_stops_a_run_is_one_line(self, capsys, monkeypatch, error, status, message):
        def fail(*arguments, **parameters):
            raise error

        monkeypatch.setattr("lnocl.commands.deconvolve.deconvolve", fail)
        assert run() == status
        assert message in one_complaint(capsys.readouterr())
        assert not Path("out.fits").exists()

    def test_a_mistake_of_ours_keeps_its_traceback(self, monkeypatch):
        monkeypatch.setattr(
            "lnocl.commands.deconvolve.deconvolve", lambda *arguments, **parameters: 1 / 0
        )
        with pytest.raises(ZeroDivisionError):
            run()


def outside(*arguments, stdout=subprocess.PIPE, **environment):
    """Run the command line in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "lnocl", *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        check=False,
        env=os.environ | {"PYTHONUNBUFFERED": ""} | environment,
    )


class TestDeconvolve:
    ARGUMENTS = (
        *(
            "--background",
            "2.5",
            "3.0000000000000004",
            "--read-noise",
            "1",
            "--star",
            "7,5",
            "--star",
            "2,9",
        ),
        *("--mu", "1e-3", "--smoothing", "0.02", "--n-iter", "7", "--pad", "3"),
    )

    @pytest.mark.parametrize(
        "inputs",
        [
            ["a.fits", "b.fits", "--psf", "k1.fits", "k2.fits"],
            ["a.fits", "b.fits", "--psf", "psfs.fits"],
            ["cube.fits", "--psf", "k1.fits", "k2.fits"],
            ["a.fits", "b.fits", "--psf", "k1.fits", "--psf", "k2.fits"],
        ],
    )
    def test_the_file_holds_what_the_function_returns(self, inputs, capsys):
        status = cli.main(["deconvolve", *inputs, *NUMPY, *self.ARGUMENTS, "-o", "out.fits"])
        captured = capsys.readouterr()
        assert (status, captured.err) == (0, "")
        expected = lnocl.deconvolve(
            lnocl.Observation(
                fits.getdata("cube.fits"),
                fits.getdata("psfs.fits"),
                background=[2.5, 3.0000000000000004],
                read_noise=1.0,
            ),
            stars=[(7, 5), (2, 9)],
            mu=1e-3,
            smoothing=0.02,
            n_iter=7,
            pad=3,
            engine="numpy",
        )
        with fits.open("out.fits", checksum=True) as hdus:
            np.testing.assert_array_equal(hdus[0].data, expected.extended)
            assert hdus[0].header["CRVAL1"] == 15.25
            np.testing.assert_array_equal(hdus["STARS"].data["x"], [7.0, 2.0])
            np.testing.assert_array_equal(hdus["STARS"].data["y"], [5.0, 9.0])
            np.testing.assert_array_equal(hdus["STARS"].data["flux"], expected.star_fluxes)
            np.testing.assert_array_equal(
                hdus["HISTORY"].data["objective"], expected.history["objective"]
            )
        objective = expected.history["objective"][-1]
        assert captured.out.splitlines() == [
            f"7 iterations on numpy, objective {objective:.6g}",
            f"star at (7, 5): {expected.star_fluxes[0]:.6g} electrons",
            f"star at (2, 9): {expected.star_fluxes[1]:.6g} electrons",
            f"extended source: {expected.extended.sum():.6g} electrons",
            "written to out.fits",
        ]

    def test_every_parameter_is_in_the_header(self):
        inputs = ("a.fits", "b.fits", "--psf", "k1.fits")
        assert cli.main(["deconvolve", *inputs, *NUMPY, *self.ARGUMENTS, "-o", "out.fits"]) == 0
        header = fits.getheader("out.fits")
        expected = {
            "CREATOR": f"lnocl {lnocl.__version__}",
            "SOLVER": "sgm",
            "NITER": 7,
            "STOPPED": "n_iter",
            "MU": 1e-3,
            "SMOOTHIN": 0.02,
            "PAD": 3,
            "PRECISIO": "double",
            "ENGINE": "numpy",
            "DEVICE": "numpy",
            "BKG1": 2.5,
            "BKG2": 3.0000000000000004,
            "RON1": 1.0,
        }
        assert {keyword: header[keyword] for keyword in expected} == expected
        assert {len(header[name]) for name in ("ISUM1", "ISUM2", "PSUM1")} == {64}
        assert "".join(header["HISTORY"]).replace("\\", "") == (
            f"cd {os.getcwd()}lnocl deconvolve a.fits b.fits --psf k1.fits "
            "--background 2.5 3.0000000000000004 --read-noise 1.0 --star 7.0,5.0 --star 2.0,9.0 "
            "--mu 0.001 --smoothing 0.02 --solver sgm --n-iter 7 --pad 3 --precision double "
            "--engine numpy -o out.fits"
        )

    def test_negative_psf_pixels_are_kept_and_announced(self, capsys):
        assert run(psf="negative.fits") == 0
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert lines[0].startswith("lnocl: warning: ")
        assert lines[0].endswith("psf pixels are negative and were kept")

    def test_what_the_device_must_hold_is_said_first(self, capsys):
        assert run("--n-iter", "1", engine=()) == 0
        name = re.escape(device.describe(device.choose().device))
        assert re.match(rf"lnocl: {name}: the scene takes [\d.]+ MiB\n", capsys.readouterr().err)

    def test_quiet_says_nothing_but_warnings(self, capsys):
        assert run("--quiet", psf="negative.fits") == 0
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("lnocl: warning: ")
        assert captured.err.count("\n") == 1

    def test_overwrite(self):
        assert run("--overwrite", output="there.fits") == 0
        assert fits.getdata("there.fits").shape == SHAPE

    @pytest.mark.parametrize("name", ["a 'b' \"c\" &\nd.fits", "naïve☃.fits", "\udcff.fits", "-x"])
    def test_names_of_any_kind_are_read_written_and_repeated(self, name, capsys):
        Path(name).write_bytes(Path("a.fits").read_bytes())
        options = ("--psf", "k1.fits", "--n-iter", "1", *NUMPY, f"-oout-{name}")
        assert cli.main(["deconvolve", *options, "--", name]) == 0
        assert capsys.readouterr().out.count("\n") == 3
        first = fits.getdata(f"out-{name}")
        script = "\n".join(fits.getheader(f"out-{name}")["HISTORY"])
        os.unlink(f"out-{name}")
        python = f'lnocl() {{ {shlex.quote(sys.executable)} -m lnocl "$@"; }}'
        subprocess.run(["bash", "-ec", f"{python}\n{script}"], capture_output=True, check=True)
        np.testing.assert_array_equal(fits.getdata(f"out-{name}"), first)

    def test_on_the_device_that_is_recorded(self, capsys):
        assert run(engine=("--precision", "double"), output="cl.fits") == 0
        assert run(output="np.fits") == 0
        chosen = device.choose(None).device
        header = fits.getheader("cl.fits")
        assert header["DEVICE"] == device.describe(chosen)
        assert f"--device {device.spec_of(chosen)} " in "".join(header["HISTORY"])
        np.testing.assert_allclose(fits.getdata("cl.fits"), fits.getdata("np.fits"), rtol=1e-10)
        assert device.describe(chosen) in capsys.readouterr().out


def outcome(path):
    """Return everything in a result that a run computes."""
    with fits.open(path, checksum=True) as hdus:
        return {
            hdu.name: hdu.data if hdu.is_image else {n: hdu.data[n] for n in hdu.columns.names}
            for hdu in hdus
        }


class TestFrames:
    """Two frames as a telescope leaves them: adu per second, an offset, bad pixels."""

    WCS = fits.Header(
        {
            "CTYPE1": "RA---TAN",
            "CTYPE2": "DEC--TAN",
            "CRPIX1": 6.0,
            "CRPIX2": 8.0,
            "CRVAL1": 150.0,
            "CRVAL2": 30.0,
            "CDELT1": -1e-5,
            "CDELT2": 1e-5,
            "BUNIT": "ADU/s",
        }
    )
    INPUTS = ("f1.fits", "f2.fits", "--psf", "psfs.fits")
    OPTIONS = (
        *("--background", "auto", "level.fits", "--exposure", "EXPTIME", "--gain", "1.7"),
        *("--inverse-variance", "inverse.fits", "--mask", "mask.fits", "dq", "--align", "wcs"),
        *("--saturation", "1000", "--star", "3,12.25", "--stars", "stars.csv", "--refine"),
        *("--mu", "1e-4", "--smoothing", "1e-3", "--solver", "sgp"),
        *("--n-iter", "9", "--stop", "1e-9", "--pad", "2"),
        *("--zero-point", "-2.5", "--models", "--residuals"),
    )

    @pytest.fixture(autouse=True)
    def frames(self, folder):
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
        self.sky_option = ("--star-sky", "{!r},{!r}".format(*self.at(7.0, 5.0)))

    def at(self, x, y):
        position = WCS(self.WCS).pixel_to_world(x, y)
        return float(position.ra.deg), float(position.dec.deg)

    def run(self, *options, output="out.fits"):
        return cli.main(["deconvolve", *self.INPUTS, *NUMPY, *options, "-o", output])

    def test_the_command_in_the_header_makes_the_same_file_bit_by_bit(self, capsys):
        assert self.run(*self.OPTIONS, *self.sky_option) == 0
        captured = capsys.readouterr()
        first, header = outcome("out.fits"), fits.getheader("out.fits")
        words = shlex.split("\n".join(header["HISTORY"]).replace("\\\n", ""))
        words = words[words.index("lnocl") :]
        for option in [*self.OPTIONS, *self.sky_option]:
            if option.startswith("--") and option not in ("--star-sky", "--stars"):
                assert option in words
        assert words.count("--star") == 3
        given = words[words.index("--background") + 1 :][:2]
        assert given == [repr(header["BKG1"]), "level.fits"]
        os.rename("out.fits", "first.fits")
        os.unlink("stars.csv")  # positions are spelled out
        assert cli.main(words[1:]) == 0
        assert capsys.readouterr().out == captured.out
        again = outcome("out.fits")
        assert set(again) == {"PRIMARY", "STARS", "HISTORY", "MODELS", "RESIDUALS"}
        for name, data in first.items():
            np.testing.assert_equal(again[name], data)
        assert fits.getheader("out.fits")["HISTORY"] == header["HISTORY"]

    def test_it_is_what_the_library_makes_of_the_files(self):
        assert self.run(*self.OPTIONS, *self.sky_option, "--quiet") == 0
        known = Calibration(
            background=["auto", "level.fits"],
            inverse_variance=["inverse.fits"],
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
        expected = lnocl.deconvolve(
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
        np.testing.assert_array_equal(found["PRIMARY"], expected.extended)
        table = found["STARS"]
        assert list(table) == ["x", "y", "flux", "x_error", "y_error", "flux_error", "mag", "ra",
                               "dec"]  # fmt: skip
        for names, values in [
            (["x", "y"], expected.star_positions.T),
            (["flux"], [expected.star_fluxes]),
            (["x_error", "y_error"], expected.star_position_errors.T),
            (["flux_error"], [expected.star_flux_errors]),
        ]:
            np.testing.assert_array_equal([table[name] for name in names], values)
        assert (table["flux_error"] > 0).all()
        np.testing.assert_allclose(table["mag"], -2.5 - 2.5 * np.log10(table["flux"]), atol=1e-12)
        sky = SkyCoord(table["ra"], table["dec"], unit="deg")
        back = WCS(self.WCS).world_to_pixel(sky)
        np.testing.assert_allclose(back, [table["x"], table["y"]], atol=1e-6)
        for name, cube in [("MODELS", expected.models()), ("RESIDUALS", expected.residuals())]:
            np.testing.assert_array_equal(found[name], cube.astype("f4"))
        unknown = observation.mask | (found["MODELS"] == 0)
        np.testing.assert_array_equal(np.isnan(found["RESIDUALS"]), unknown)

    def test_units_and_cards_of_the_result(self):
        assert self.run(*self.OPTIONS, *self.sky_option) == 0
        with fits.open("out.fits") as hdus:
            header, table = hdus[0].header, hdus["STARS"].header
            coordinates = [WCS(hdus[name].header, naxis=2) for name in ("MODELS", "RESIDUALS")]
            assert hdus["MODELS"].header["BUNIT"] == "electron"
            assert "BUNIT" not in hdus["RESIDUALS"].header
        assert header["BUNIT"] == "electron/s"
        named = {table[f"TTYPE{i}"]: table[f"TUNIT{i}"] for i in range(1, table["TFIELDS"] + 1)}
        assert named == {
            **dict.fromkeys(["x", "y", "x_error", "y_error"], "pix"),
            **dict.fromkeys(["flux", "flux_error"], "ct/s"),
            "mag": "mag",
            "ra": "deg",
            "dec": "deg",
        }
        for wcs in coordinates:
            x, y = wcs.world_to_pixel(self.sky)
            np.testing.assert_allclose([x, y], [7.0, 5.0], atol=1e-6)
        expected = {
            "BKG2": "level.fits",
            "EXP1": 30.0,
            "EXP2": 60.0,
            "GAIN": 1.7,
            "SATLEVEL": 1000.0,
            "ZEROPT": -2.5,
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
            "VSUM1": "inverse.fits",
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

    def test_what_was_done_is_said_unless_it_is_quiet(self, capsys):
        assert self.run(*self.OPTIONS, *self.sky_option) == 0
        said = capsys.readouterr()
        level = fits.getheader("out.fits")["BKG1"]
        assert [line.removeprefix("lnocl: ") for line in said.err.splitlines()] == [
            "exposure from EXPTIME: 30, 60 seconds",
            "image 1: 1 pixels masked by the mask",
            "image 2: 1 pixels masked by the mask",
            "image 1: 1 pixels masked by the extension DQ",
            "image 2: 1 pixels masked by the extension DQ",
            "image 1: 1 pixels masked as saturated, at 1000 or above",
            "image 2: 1 pixels masked as saturated, at 1000 or above",
            "image 1: 0 pixels masked without inverse variance",
            "image 2: 0 pixels masked without inverse variance",
            next(line for line in said.err.splitlines() if "sigma-clipped" in line)[7:],
            "image 2: offset 1.250, -0.500 pixels in x, y, from the WCS",
            "stars.csv: 1 stars",
        ]
        assert f"image 1: background {level:.6g} electrons per pixel" in said.err
        assert "electrons per second" in said.out
        assert self.run(*self.OPTIONS, *self.sky_option, "--quiet", "--overwrite") == 0
        assert capsys.readouterr() == ("", "")

    @pytest.mark.parametrize(
        "options",
        [("--mask", "out.fits"), ("--inverse-variance", "out.fits"), ("--background", "out.fits"),
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
        assert self.run("--gain", "1", "--exposure", "1", "--zero-point", "25", "--refine",
                        "--n-iter", "1", "--models") == 0  # fmt: skip
        found = outcome("out.fits")
        assert list(found["STARS"]) == ["x", "y", "flux", "x_error", "y_error", "flux_error", "mag"]
        assert found["MODELS"].shape == (2, *SHAPE)

    def test_the_result_is_plotted(self, capsys):
        pytest.importorskip("matplotlib")
        assert self.run(*self.OPTIONS, *self.sky_option) == 0
        capsys.readouterr()
        assert cli.main(["plot", "out.fits", "-o", "figures"]) == 0
        written = capsys.readouterr().out
        assert "figures/objects.png" in written
        assert Path("figures/objects.png").stat().st_size > 1000


class TestProcess:
    ARGUMENTS = ("deconvolve", "a.fits", "--psf", "k1.fits", "--n-iter", "1", *NUMPY)

    def test_an_error_is_one_line_and_no_traceback(self):
        done = outside(*self.ARGUMENTS, "--mu", "-1", "-o", "out.fits")
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert done.stderr.startswith("lnocl: error: mu must be")

    def test_version_and_help_load_nothing_heavy(self):
        for option in ("--version", "--help"):
            script = (
                "import sys; from lnocl.cli import main\n"
                f"try: main(['{option}'])\n"
                "finally: print(sorted({'astropy', 'pyopencl', 'scipy'} & set(sys.modules)))"
            )
            done = subprocess.run(
                [sys.executable, "-c", script], capture_output=True, text=True, check=True
            )
            *_, loaded = done.stdout.splitlines()
            assert loaded == "[]"
        assert outside("--version").stdout == f"lnocl {lnocl.__version__}\n"

    def test_a_reader_that_left_is_no_error(self):
        reading, writing = os.pipe()
        os.close(reading)
        done = outside(*self.ARGUMENTS, "-o", "out.fits", stdout=writing)
        os.close(writing)
        assert (done.returncode, done.stderr) == (0, "")
        assert fits.getdata("out.fits").shape == SHAPE

    def test_a_signal_while_an_error_is_told_ends_it_at_once(self):
        script = (
            "import os, signal, sys\n"
            "from lnocl.commands import cli\n"
            "from lnocl.commands import messages\n"
            "messages.fail = lambda *_: os.kill(os.getpid(), signal.SIGTERM)\n"
            "sys.exit(cli.main(['deconvolve', 'no.fits', '--psf', 'k1.fits', '-o', 'out.fits']))\n"
        )
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (-signal.SIGTERM, "")

    @pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
    def test_a_full_stdout_is_one_line(self):
        with open("/dev/full", "w") as full:
            done = outside(*self.ARGUMENTS, "-o", "out.fits", stdout=full)
        assert done.returncode == 1
        assert done.stderr == "lnocl: error: [Errno 28] No space left on device\n"

    @pytest.mark.parametrize("closed", ["2>&-", ">&-", "<&- >&- 2>&-"])
    @pytest.mark.parametrize(("mu", "status"), [("0", 0), ("-1", 2)])
    def test_nothing_is_said_where_a_stream_is_closed(self, closed, mu, status):
        words = ["lnocl", *self.ARGUMENTS, "--mu", mu, "-o", "out.fits"]
        done = self.with_closed(closed, "-m", *words)
        assert done.returncode == status
        assert ("Traceback" in done.stderr, os.path.exists("out.fits")) == (False, status == 0)

    def with_closed(self, closed, *words):
        command = shlex.join([sys.executable, *words])
        return subprocess.run(["bash", "-c", f"{command} {closed}"], capture_output=True, text=True)

    @pytest.mark.parametrize("command", [["--help"], ["--version"], ["devices"]])
    def test_nor_by_what_says_nothing_else(self, command):
        assert self.with_closed(">&-", "-m", "lnocl", *command).returncode == 0

    def test_no_file_gets_the_number_of_a_closed_stream(self):
        script = (
            "import os; from lnocl.cli import main\n"
            "main(['devices']); print(os.open(os.devnull, os.O_RDONLY) > 2)"
        )
        done = self.with_closed("<&- 2>&-", "-c", script)
        assert done.stdout.splitlines()[-1] == "True"

    def test_a_library_s_bar_where_stderr_is_closed(self, monkeypatch):
        monkeypatch.setattr(sys, "stderr", None)
        with Bar(1, progress=True) as bar:
            bar.show(1, lambda: "done", last=True)

    @pytest.mark.parametrize(
        "command",
        [["selftest"], ["deconvolve", "a.fits", "--psf", "k1.fits", "--stop", "held-out",
                        "--n-iter", "100000", "--precision", "double", "-o", "out.fits"]],
    )  # fmt: skip
    def test_sigterm_ends_any_command_in_one_line_and_cleans_up(self, tmp_path, command):
        kernels = tmp_path / "kernels"
        kernels.mkdir()
        process = subprocess.Popen(
            [sys.executable, "-m", "lnocl", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=os.environ | {"TMPDIR": str(kernels)},
        )
        # What each says first, before the first iteration.
        (process.stdout if command == ["selftest"] else process.stderr).readline()
        assert len(list(kernels.glob("lnocl-kernels-*"))) == 1
        process.send_signal(signal.SIGTERM)
        _, complaint = process.communicate()
        assert (process.returncode, complaint) == (143, "lnocl: error: terminated\n")
        assert list(kernels.iterdir()) == []
        assert not Path("out.fits").exists()

    def test_signals_do_again_what_they_did(self):
        before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
        assert run() == 0
        assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before

    def test_it_runs_in_a_thread_which_hears_no_signals(self):
        statuses = []
        thread = threading.Thread(target=lambda: statuses.append(run("--quiet")))
        thread.start()
        thread.join()
        assert statuses == [0]

    def test_a_stdout_of_ascii_shows_what_it_can(self):
        done = outside(*self.ARGUMENTS, "-o", "naïve.fits", PYTHONIOENCODING="ascii")
        assert done.stderr == ""
        assert done.stdout.endswith("written to na\\xefve.fits\n")

    def test_a_progress_bar_stays_off_a_stderr_that_is_no_terminal(self):
        assert outside(*self.ARGUMENTS, "-o", "out.fits").stderr == ""


class TestDevices:
    def test_it_lists_what_was_found_and_what_is_used_and_why(self, capsys):
        assert cli.main(["devices"]) == 0
        *listed, used = capsys.readouterr().out.splitlines()
        found = device.find_devices()
        assert listed == [f"{device.spec_of(each)} {device.describe(each)}" for each in found]
        choice = device.choose(None)
        assert used == (
            f"lnocl uses {device.spec_of(choice.device)} unless told otherwise: {choice.reason}"
        )
