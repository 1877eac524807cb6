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
from commandline import GIVEN, NUMPY, PAPER, run
from scenes import paper

import lnocl
from lnocl.commands import cli
from lnocl.core.opencl import device

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
    def test_the_file_holds_what_the_function_returns(self, inputs, capsys):
        options = (*NUMPY, *self.ARGUMENTS, "--residuals", "-o", "out.fits")
        status = cli.main(["deconvolve", *inputs, *options])
        captured = capsys.readouterr()
        assert (status, captured.err) == (
            0,
            "lnocl: warning: the model does not fit at 1 of 2 stars, (7, 5): give a better PSF, or "
            "try --refine-psfs jitter pixels\n",
        )
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
        objective = expected.history["objective"][-1]
        at_stars = expected.star_residuals()
        parts = expected.fit(), *at_stars[0][:2], *at_stars[1][:2]
        shown = [f"{part.rms:.2f} +- {part.error:.2f}" for part in parts]
        overall, core_1, wings_1, core_2, wings_2 = shown
        darkest = np.quantile(expected.extended, 0.05)
        flux_1, flux_2 = (
            f"{flux:.6g} +- {error:.2g} electrons"
            for flux, error in zip(expected.star_fluxes, expected.star_flux_errors, strict=True)
        )
        assert captured.out.splitlines() == [
            f"7 iterations on numpy, objective {objective:.6g}",
            "all iterations were done",
            f"star at (7, 5): {flux_1}; residuals {core_1} in its core, {wings_1} in its wings, "
            "where noise gives 1",
            f"star at (2, 9): {flux_2}; residuals {core_2} in its core, {wings_2} in its wings, "
            "where noise gives 1",
            "extended source: {:.6g} +- {:.2g} electrons in the whole frame".format(
                *expected.extended_flux
            ),
            f"the extended source is hardly darker anywhere than {darkest:.3g} electrons a pixel: "
            "the background is too low by that, or light fills the frame",
            f"residuals {overall} in all, where noise gives 1",
            "written to out.fits",
        ]

    @pytest.mark.parametrize("background", [25.0, 50.0])
    def test_a_background_too_low_is_said(self, capsys, background):
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
    def test_what_was_tried_is_not_advised(self, capsys):
        inputs = ("a.fits", "b.fits", "--psf", "k1.fits", "--refine-psfs", "pixels")
        assert cli.main(["deconvolve", *inputs, *NUMPY, *self.ARGUMENTS, "-o", "out.fits"]) == 0
        lines = capsys.readouterr().err.splitlines()
        (line,) = (each for each in lines if "warning: the model does not fit" in each)
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
            "--n-iter 7 --stop none --solver sgm --mu 0.001 --smoothing 0.02 --pad 3 "
            "--precision double --engine numpy -o out.fits"
        )

    @pytest.mark.parametrize("n_iter", [1, 30])
    def test_a_run_that_ends_at_once_is_said(self, n_iter, capsys, monkeypatch):
        """But not where one iteration was asked for."""
        if n_iter > 1:
            monkeypatch.setattr("lnocl.core.reference.decide.SUFFICIENT", 1e9)  # no step is enough
        run("--solver", "sgp", "--n-iter", str(n_iter))
        said = "it ended after 0 iterations: there is little but noise" in capsys.readouterr().out
        assert said == (n_iter > 1)

    @pytest.mark.exhaustive
    def test_what_the_device_must_hold_is_said_first(self, capsys):
        assert run("--n-iter", "1", engine=()) == 0
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
        assert capsys.readouterr().out.count("\n") == 6
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
        assert f" on {chosen.name.strip()}, objective" in capsys.readouterr().out
