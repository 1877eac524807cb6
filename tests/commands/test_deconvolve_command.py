"""The command ``lnocl deconvolve``: what it runs, writes and says."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commandline import GIVEN, NUMPY, PAPER, one_complaint, run
from scenes import paper

import lnocl
from lnocl.commands import cli
from lnocl.core.opencl import device
from lnocl.result.summary import with_error

pytestmark = pytest.mark.usefixtures("command_folder")


class TestDeconvolve:
    ARGUMENTS = (
        *("--background", "2.5", "3.0000000000000004", "--read-noise", "1"),
        *("--star", "7,5", "--star", "2,9"),
        *PAPER,
        *GIVEN,
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
    def test_result_file_matches_the_deconvolve_function(self, inputs, capsys):
        options = (*NUMPY, *self.ARGUMENTS, "--residuals", "-o", "out.fits")
        status = cli.main(["deconvolve", *inputs, *options])
        captured = capsys.readouterr()
        assert (status, captured.err) == (0, "")
        expected = paper(
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
        darkest = np.quantile(expected.extended, 0.05)
        pairs = zip(expected.star_fluxes, expected.star_flux_errors, strict=True)
        fluxes = [with_error(*each) for each in (*pairs, expected.extended_flux)]
        width = max(len(each.partition(" +-")[0]) for each in fluxes)
        flux_1, flux_2, light = (
            each.rjust(width + len(each) - len(each.partition(" +-")[0])) for each in fluxes
        )
        assert captured.out.splitlines() == [
            f"star 1 (7, 5)  {flux_1} electrons",
            f"star 2 (2, 9)  {flux_2} electrons",
            f"extended       {light} electrons in the frame",
            "trust          no: the model does not fit at 1 of 2 stars, (7, 5): give a better PSF, "
            "or try --refine-psfs jitter pixels",
            f"               the extended source is hardly darker anywhere than {darkest:.3g} "
            "electrons a pixel: the background is too low by that, or light fills the frame",
            "7 iterations, all that were allowed; out.fits",
        ]

    def test_verbose_run_prints_residuals_and_objective_to_stderr(self, capsys):
        """On stderr, and always in the file."""
        assert run("--verbose") == 0
        said = capsys.readouterr().err.splitlines()
        with fits.open("out.fits") as hdus:
            held = hdus["MESSAGES"].data["message"].tolist()
            objective = hdus["HISTORY"].data["objective"][-1]
        for words in ("residuals, 1 for noise alone: ", f"objective {objective:.6g} on numpy"):
            assert sum(line.startswith(f"lnocl: {words}") for line in said) == 1
            assert sum(line.startswith(words) for line in held) == 1
        assert run("--overwrite") == 0
        assert "objective" not in "".join(capsys.readouterr())

    def test_quiet_and_verbose_exclude_each_other(self, capsys):
        assert run("--quiet", "--verbose") == 2
        complaint = "--quiet and --verbose exclude each other: give one of them"
        assert one_complaint(capsys.readouterr()) == complaint

    @pytest.mark.parametrize("background", [25.0, 50.0])
    def test_background_too_low_is_reported(self, capsys, background):
        image = np.random.default_rng(0).poisson(50.0, (32, 32)).astype(float)
        fits.writeto("flat.fits", image)
        arguments = ["--background", str(background), "--n-iter", "5", "--stop", "none"]
        inputs = ("flat.fits", "--psf", "k1.fits")
        assert cli.main(["deconvolve", *inputs, *NUMPY, *arguments, "-o", "out.fits"]) == 0
        said = [
            line for line in capsys.readouterr().out.splitlines() if "background is too" in line
        ]
        assert len(said) == (background < 50)
        if said:
            darkest = float(
                re.search(r"darker anywhere than ([\d.]+) electrons a pixel", said[0])[1]
            )
            assert 15 < darkest < 25

    @pytest.mark.exhaustive
    def test_verdict_does_not_advise_a_refinement_already_made(self, capsys):
        inputs = ("a.fits", "b.fits", "--psf", "k1.fits", "--refine-psfs", "pixels")
        assert cli.main(["deconvolve", *inputs, *NUMPY, *self.ARGUMENTS, "-o", "out.fits"]) == 0
        lines = capsys.readouterr().out.splitlines()
        (line,) = (each for each in lines if "no: the model does not fit" in each)
        assert line.endswith(": give a better PSF")

    def test_every_parameter_is_in_the_header(self):
        inputs = ("a.fits", "b.fits", "--psf", "k1.fits")
        assert cli.main(["deconvolve", *inputs, *NUMPY, *self.ARGUMENTS, "-o", "out.fits"]) == 0
        header = fits.getheader("out.fits")
        expected = {
            "CREATOR": f"lnocl {lnocl.__version__}",
            "PSFCENTR": "given",
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
            f"cd {os.getcwd()}lnocl deconvolve a.fits b.fits --psf k1.fits --psf-centre given "
            "--background 2.5 3.0000000000000004 --read-noise 1.0 --star 7.0,5.0 --star 2.0,9.0 "
            "--n-iter 7 --stop none --solver sgm --mu 0.001 --smoothing 0.02 "
            "--spectral-smoothing 0.0 --pad 3 --precision double --engine numpy -o out.fits"
        )

    @pytest.mark.parametrize("n_iter", [1, 30])
    def test_run_that_ends_without_an_iteration_is_reported(self, n_iter, capsys, monkeypatch):
        """But not where one iteration was asked for."""
        if n_iter > 1:
            monkeypatch.setattr("lnocl.core.reference.decide.SUFFICIENT", 1e9)  # no step is enough
        run("--solver", "sgp", "--n-iter", str(n_iter))
        said = "it ended after 0 iterations: there is little but noise" in capsys.readouterr().out
        assert said == (n_iter > 1)

    @pytest.mark.exhaustive
    def test_memory_estimate_is_the_first_verbose_line(self, capsys):
        assert run("--n-iter", "1", "--verbose", engine=()) == 0
        name = re.escape(device.describe(device.choose().device))
        assert re.match(
            rf"lnocl: {name}: the scene takes [\d.]+ MiB there, and up to \d+ MiB of the host",
            capsys.readouterr().err,
        )

    def test_quiet_says_nothing_but_warnings(self, capsys):
        assert run("--quiet", psf="negative.fits") == 0
        captured = capsys.readouterr()
        assert captured.out == ""
        of_psf, of_fit = captured.err.splitlines()
        assert of_psf.startswith("lnocl: warning: ")
        assert of_psf.endswith(" of the light of a PSF at most")
        assert of_fit == "lnocl: warning: the model does not fit: see to background, noise and gain"

    @pytest.mark.exhaustive
    @pytest.mark.parametrize(
        "name",
        [
            "-a 'b' \"c\" &\nd.fits",
            pytest.param("naïve☃.fits", marks=pytest.mark.exhaustive),
            pytest.param("\udcff.fits", marks=pytest.mark.exhaustive),
        ],
    )
    def test_names_of_any_kind_are_read_written_and_repeated(self, name, capsys):
        Path(name).write_bytes(Path("a.fits").read_bytes())
        options = ("--psf", "k1.fits", "--n-iter", "1", *PAPER, *NUMPY, f"-oout-{name}")
        assert cli.main(["deconvolve", *options, "--", name]) == 0
        assert capsys.readouterr().out.count("\n") == 4
        first = fits.getdata(f"out-{name}")
        script = "\n".join(fits.getheader(f"out-{name}")["HISTORY"])
        os.unlink(f"out-{name}")
        python = f'lnocl() {{ {shlex.quote(sys.executable)} -m lnocl "$@"; }}'
        subprocess.run(["bash", "-ec", f"{python}\n{script}"], capture_output=True, check=True)
        np.testing.assert_array_equal(fits.getdata(f"out-{name}"), first)

    def test_on_the_device_that_is_recorded(self, capsys):
        assert run(engine=(), output="cl.fits") == 0
        assert run(output="np.fits") == 0
        chosen = device.choose(None).device
        header = fits.getheader("cl.fits")
        assert header["DEVICE"] == device.describe(chosen)
        assert f"--device {device.spec_of(chosen)} " in "".join(header["HISTORY"])
        np.testing.assert_allclose(fits.getdata("cl.fits"), fits.getdata("np.fits"), rtol=1e-5)
