"""The command line: what it refuses, and in which words."""

import os
from pathlib import Path

import pytest
from commandline import NUMPY, one_complaint, outside, run

import lnocl
from lnocl.commands import cli
from lnocl.errors import DeviceError
from lnocl.opencl import device

pytestmark = pytest.mark.usefixtures("command_folder")

BAD_FILES = {
    "missing": ({"image": "no.fits"}, 1, "no.fits cannot be opened: No such file"),
    "folder": ({"image": "."}, 1, ". cannot be opened: Is a directory"),
    "not FITS": ({"image": "text.fits"}, 1, "text.fits is not a FITS file"),
    "truncated": ({"image": "cut.fits"}, 1, "cut.fits is truncated"),
    "no image": ({"image": "table.fits"}, 1, "table.fits holds no image"),
    "one dimension": ({"image": "line.fits"}, 2, "line.fits has an image of 1 dimension"),
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
    "nan psf": ({"psf": "nanpsf.fits"}, 2, "psf 1 is not finite in 1 pixel, the first at (0, 0)"),
    "output exists": ({"output": "there.fits"}, 1, "there.fits exists; give another name"),
    "no folder": ({"output": "no/out.fits"}, 1, "the folder of the output no/out.fits does not"),
    "output is input": (
        {"output": "a.fits", "engine": (*NUMPY, "--overwrite")},
        2,
        "a.fits is one of the inputs",
    ),
    "output is the file of an input": (
        {"image": "a.fits[0]", "output": "a.fits", "engine": (*NUMPY, "--overwrite")},
        2,
        "a.fits is one of the inputs",
    ),
    "no such extension": ({"image": "a.fits[SCI]"}, 2, "a.fits has no image extension SCI; it has"),
    "missing, named": ({"image": "no.fits[1]"}, 1, "no.fits cannot be opened: No such file"),
}

BAD_ARGUMENTS = {
    "star outside": (["--star", "12,5"], 2, "the star at (12, 5) lies outside"),
    "star below": (["--star", "-1,3"], 2, "the star at (-1, 3) lies outside"),
    "star nan": (["--star", "nan,3"], 2, "the star at (nan, 3) lies outside"),
    "star infinite": (["--star", "-inf,3"], 2, "the star at (-inf, 3) lies outside"),
    "star of one": (["--star", "3"], 2, "argument --star: '3' is not X,Y"),
    "star of words": (["--star", "x,y"], 2, "argument --star: 'x,y' is not X,Y"),
    "mu negative": (["--mu", "-1"], 2, "--mu must be"),
    "mu negative power": (["--mu", "-1e-3"], 2, "--mu must be"),
    "mu nan": (["--mu", "nan"], 2, "--mu must be"),
    "mu minus nan": (["--mu", "-nan"], 2, "--mu must be"),
    "mu a word": (["--mu", "little"], 2, "argument --mu: invalid float value: 'little'"),
    "smoothing a word": (
        ["--smoothing", "little"],
        2,
        "--smoothing 'little' is not known; give a number or auto",
    ),
    "smoothing negative": (["--smoothing", "-1"], 2, "--smoothing must be"),
    "background": (["--background", "nan"], 2, "--background must be finite and not negative; nan"),
    "background nan": (["--background", "nan"], 2, "--background must be finite"),
    "background inf": (["--background", "-inf"], 2, "--background must be finite"),
    "backgrounds": (["--background", "1", "2"], 2, "--background has shape (2,)"),
    "read noise": (["--read-noise", "-2.5"], 2, "--read-noise must be finite and not negative"),
    "read noise nan": (["--read-noise", "nan"], 2, "--read-noise must be finite"),
    "n_iter": (["--n-iter", "0"], 2, "--n-iter must be a whole number, 1 or more; 0"),
    "n_iter negative": (["--n-iter", "-3"], 2, "--n-iter must be a whole number, 1 or more; -3"),
    "n_iter fraction": (["--n-iter", "1.5"], 2, "argument --n-iter: invalid int value: '1.5'"),
    "pad": (["--pad", "-1"], 2, "--pad must be a whole number, 0 or more, or auto; -1"),
    "pad large": (["--pad", "5000"], 2, "the largest axis is 8192"),
    "solver": (["--solver", "magic"], 2, "argument --solver: invalid choice: 'magic'"),
    "precision": (["--precision", "half"], 2, "argument --precision: invalid choice: 'half'"),
    "engine": (["--engine", "cuda"], 2, "argument --engine: invalid choice: 'cuda'"),
    "device": (["--device", "0"], 2, "--engine numpy uses no device; leave --device '0' out"),
    "read noise a word": (
        ["--read-noise", "some"],
        2,
        "--read-noise 'some' is not a number, auto, a keyword of the images'",
    ),
    "background a word": (
        ["--background", "Auto"],
        2,
        "--background 'Auto' is not a number, auto, or a",
    ),
    "exposure a word": (
        ["--exposure", "TEXP"],
        2,
        "--exposure 'TEXP' is not a number, a keyword of",
    ),
    "exposure zero": (["--exposure", "0"], 2, "--exposure must be finite and more than zero; 0"),
    "gain": (["--gain", "-1"], 2, "--gain must be more than 0; -1 was given"),
    "gain nan": (["--gain", "nan"], 2, "--gain must be more than 0; nan was given"),
    "gain a word": (["--gain", "GAIN"], 2, "a.fits has no GAIN in its header; give --gain as a "),
    "saturation": (
        ["--saturation", "nan"],
        2,
        "argument --saturation: 'nan' is not a finite number",
    ),
    "zero point": (
        ["--zero-point", "inf"],
        2,
        "argument --zero-point: 'inf' is not a finite number",
    ),
    "align": (["--align", "stars"], 2, "argument --align: invalid choice: 'stars'"),
    "inverse variance": (["--inverse-variance", "no.fits"], 1, "no.fits cannot be opened"),
    "mask": (
        ["--mask", "dq"],
        2,
        "a.fits has no extension DQ; give --mask as a file, or leave it out",
    ),
    "error": (["--error", "err"], 2, "a.fits has no extension ERR; give --error as a file, or "),
    "two kinds of noise": (
        ["--rms", "a.fits", "--error", "a.fits"],
        2,
        "give --rms, or give --error: each is all there is of noise",
    ),
    "good bits": (["--good-bits", "16"], 2, "--good-bits are flags of the extension DQ; give --m"),
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
