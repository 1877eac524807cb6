"""The command line: what it refuses, and in which words."""

import os
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commandline import NUMPY, one_complaint, outside, run

import lnocl
from lnocl.commands import cli
from lnocl.core.opencl import device
from lnocl.errors import DeviceError

pytestmark = pytest.mark.usefixtures("command_folder")

# Status 1 where a file is at fault, else 2. wrong_uses.txt has what else is refused.
BAD_FILES = {
    "folder": ({"image": "."}, 1, ". cannot be opened: Is a directory"),
    "no image": ({"image": "table.fits"}, 1, "table.fits holds no image"),
    "one dimension": ({"image": "line.fits"}, 2, "line.fits has an image of 1 dimension"),
    "all masked": ({"image": "nan.fits"}, 2, "all pixels are masked"),
    "missing psf": ({"psf": "no.fits"}, 1, "no.fits cannot be opened"),
    "psf count": ({"psf": "three.fits"}, 2, "3 psfs for 1 image"),
    "output exists": ({"output": "there.fits"}, 1, "there.fits exists; give another name"),
    "output is the file of an input": (
        {"image": "a.fits[0]", "output": "a.fits", "engine": (*NUMPY, "--overwrite")},
        2,
        "a.fits is one of the inputs",
    ),
    "missing, named": ({"image": "no.fits[1]"}, 1, "no.fits cannot be opened: No such file"),
}

# Options, all of which have the status 2, and the message, which names the option that was typed.
BAD_ARGUMENTS = {
    "--star -1,3": "the star at (-1, 3) lies outside",
    "--star nan,3": "the star at (nan, 3) lies outside",
    "--star 3": "argument --star: '3' is neither X,Y in pixels nor RA,DEC with units, as in 65d,",
    "--star x,y": "argument --star: 'x,y' is neither X,Y",
    "--star 1,2,3": "argument --star: '1,2,3' is neither X,Y",
    "--star 195d,2d": "the star at RA, Dec 195.00000 2.00000 lies in",
    "--star 15.25d,-3d": "lies outside the images: x must be in [0, 11]",
    "--stars table.fits": "neither columns x and y nor ra and dec;",
    "--mu -1e-3": "--mu must be a number, finite and not negative; -0.001 was given",
    "--mu -nan": "--mu must be",
    "--mu little": "argument --mu: invalid float value: 'little'",
    "--smoothing nan": "--smoothing must be a number, finite",
    "--smoothing little": "--smoothing 'little' is not known; give a number or auto",
    "--background -inf": "--background must be finite and not negative",
    "--background 1 2": "--background has shape (2,)",
    "--background Auto": "--background 'Auto' is not a number, auto, or a",
    "--read-noise -2.5": "--read-noise must be finite and not negative",
    "--read-noise some": "--read-noise 'some' is not a number, auto, a keyword of the images'",
    "--read-noise 1e200": "the square of --read-noise must be finite",
    "--read-noise oblong.fits": "--read-noise oblong.fits has the shape",
    "--exposure 0": "--exposure must be finite and more than zero; 0 was",
    "--gain nan": "--gain must be more than 0; nan was given",
    "--gain GAIN": "a.fits has no GAIN in its header; give --gain as a ",
    "--saturation nan": "argument --saturation: 'nan' is not a finite number",
    "--noise ivar=negative.fits": "--noise negative.fits has the shape",
    "--noise err": "a.fits has no extension ERR; give --noise as a file, or ",
    "--noise rms=a.fits err=a.fits": "--noise rms and err were given: each describes the whole",
    "--noise a.fits": "--noise: 'a.fits' is not KIND=FILE; kinds are ivar, var, rms, err",
    "--noise rms": "argument --noise: 'rms' is not KIND=FILE",
    "--mask dq:16": "a.fits has no extension DQ; give --mask as a file, or",
    "--n-iter 1.5": "argument --n-iter: invalid int value: '1.5'",
    "--n-iter 3000000000": "--n-iter must be 16777214 at most; 3000",
    "--stop 2": "--stop 2.0 is not known; give held-out, discrepancy, none",
    "--pad -1": "--pad must be a whole number, 0 or more, or auto; -1 was given",
    "--pad 5000": "with --pad 5000 need a grid of (10016, 10012); the largest axis is 8192",
    "--engine cuda": "argument --engine: invalid choice: 'cuda'",
    "--device 0": "--engine numpy uses no device; leave --device '0' out",
    "--over": "unrecognized arguments: --over",
}


class TestRefusals:
    @pytest.mark.parametrize(("given", "status", "message"), BAD_FILES.values(), ids=BAD_FILES)
    def test_bad_file(self, capsys, given, status, message):
        before = sorted(os.listdir())
        assert run(**given) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == before
        assert Path("there.fits").read_bytes() == b"old"

    @pytest.mark.parametrize(("options", "message"), BAD_ARGUMENTS.items(), ids=BAD_ARGUMENTS)
    def test_bad_argument(self, capsys, options, message):
        before = sorted(os.listdir())
        assert run(*options.split()) == 2
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

    @pytest.mark.exhaustive
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

    def test_names_never_break_the_line(self, capsys):
        assert run(image="two\nlines \x1b[31m\udcff.fits") == 1
        message = "two lines \\x1b[31m\\udcff.fits cannot be opened"
        assert message in one_complaint(capsys.readouterr())

    @pytest.mark.parametrize(
        ("error", "status", "message"),
        [
            (KeyboardInterrupt(), 130, "interrupted"),
            (MemoryError(), 1, "not enough memory"),
            (RuntimeError("can't start new thread"), 1, "not enough memory"),
            (OSError(28, "No space left on device"), 1, "No space left on device"),
        ],
    )
    def test_interrupts_and_system_errors_are_reported_in_one_line(
        self, capsys, monkeypatch, error, status, message
    ):
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


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["simulate", "truth.fits", "-o", "."], "./truth.fits"),
        (["simulate", "image_2.fits", "-o", ".", "--angle", "0", "90"], "./image_2.fits"),
        (["plot", "result.png", "-o", "."], "./result.png"),
        (["batch", "targets.csv", "-o", "."], "{here}/summary.ecsv"),
    ],
)
def test_files_in_a_folder_of_outputs_that_are_inputs_stay(words, name, capsys):
    """Whatever they are called, and however they are linked."""
    for each in ("truth.fits", "image_2.fits", "result.png"):
        fits.writeto("sky.fits", np.ones((32, 32)), overwrite=True)
        os.rename("sky.fits", each)
    os.link("a.fits", "summary.ecsv")
    Path("targets.csv").write_text("images,psf\na.fits,k1.fits\n")
    before = {path: path.read_bytes() for path in Path().glob("*.*")}
    assert cli.main([*words, "--overwrite"]) == 2
    complaint = one_complaint(capsys.readouterr())
    assert f"the output {name.format(here=os.getcwd())} is one of the inputs" in complaint
    assert {path: path.read_bytes() for path in Path().glob("*.*")} == before
