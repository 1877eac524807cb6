"""The command line: what it runs, what it refuses, and what it says."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from scenes import make_psfs

import lnocl
from lnocl import cli, device
from lnocl.errors import DeviceError

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
    "psf count": ({"psf": "three.fits"}, 2, "3 psfs for 1 images"),
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
    "background": (["--background", "-1"], 2, "background must be finite and not negative; -1"),
    "background nan": (["--background", "nan"], 2, "background must be finite"),
    "background inf": (["--background", "-inf"], 2, "background must be finite"),
    "backgrounds": (["--background", "1", "2"], 2, "background has shape (2,)"),
    "read noise": (["--read-noise", "-2.5"], 2, "read_noise must be finite and not negative"),
    "read noise nan": (["--read-noise", "nan"], 2, "read_noise must be finite"),
    "n_iter": (["--n-iter", "0"], 2, "n_iter must be a whole number, 1 or more; 0"),
    "n_iter negative": (["--n-iter", "-3"], 2, "n_iter must be a whole number, 1 or more; -3"),
    "n_iter fraction": (["--n-iter", "1.5"], 2, "argument --n-iter: invalid int value: '1.5'"),
    "pad": (["--pad", "-1"], 2, "pad must be a whole number, 0 or more; -1"),
    "pad large": (["--pad", "5000"], 2, "the largest axis is 8192"),
    "solver": (["--solver", "magic"], 2, "argument --solver: invalid choice: 'magic'"),
    "precision": (["--precision", "half"], 2, "argument --precision: invalid choice: 'half'"),
    "engine": (["--engine", "cuda"], 2, "argument --engine: invalid choice: 'cuda'"),
    "device": (["--device", "0"], 2, "engine numpy uses no device"),
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
             "2 psfs for 1 images; give one, or one for each image"),
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
        *("--mu", "1e-3", "--n-iter", "7", "--pad", "3"),
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
                fits.getdata("cube.fits"), fits.getdata("psfs.fits"), [2.5, 3.0000000000000004], 1.0
            ),
            stars=[(7, 5), (2, 9)],
            mu=1e-3,
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
            "--mu 0.001 --solver sgm --n-iter 7 --pad 3 --precision double --engine numpy "
            "-o out.fits"
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

    @pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
    def test_a_full_stdout_is_one_line(self):
        with open("/dev/full", "w") as full:
            done = outside(*self.ARGUMENTS, "-o", "out.fits", stdout=full)
        assert done.returncode == 1
        assert done.stderr == "lnocl: error: [Errno 28] No space left on device\n"

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
