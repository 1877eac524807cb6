"""The command line on public data (see ../shared/data/README.md), and what it leaves to repeat it.

The data are no part of the project; without them these tests skip.
"""

import hashlib
import importlib.util
import os
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.io.fits.scripts import fitscheck
from astropy.table import QTable
from astropy.wcs import WCS
from commandline import GIVEN, PAPER, without_progress

from lnocl.commands.cli import main
from lnocl.errors import LnoclWarning
from lnocl.psf.make import make_psf

DATA = Path(__file__).parents[3] / "shared" / "data"

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(not DATA.is_dir(), reason="the real data are not at ../shared/data"),
]

engines = pytest.mark.parametrize("engine", ["opencl", "numpy"])


# The quasar's file has no coordinates; these have its scale, and stand for those of any image.
COORDINATES = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CRPIX1": 60.5,
    "CRPIX2": 60.5,
    "CRVAL1": 188.30825,
    "CRVAL2": -31.6042167,
    "CD1_1": -0.04 / 3600 * np.cos(0.3),
    "CD1_2": 0.04 / 3600 * np.sin(0.3),
    "CD2_1": 0.04 / 3600 * np.sin(0.3),
    "CD2_2": 0.04 / 3600 * np.cos(0.3),
}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def check_file(path):
    """Check what every output must be: whole, and opened without a warning (warnings raise)."""
    assert fitscheck.main(["--compliance", str(path)]) == 0
    with fits.open(path, checksum=True) as hdus:
        names = ["PRIMARY", "STARS", "HISTORY", "PLAN", "MESSAGES", "ESTIMATE"]
        assert [hdu.name for hdu in hdus] == names
        assert np.isfinite(hdus[0].data).all()
        assert (hdus[0].data >= 0).all()
        WCS(hdus[0].header)
    for name in ("STARS", "HISTORY"):
        QTable.read(path, hdu=name)


@engines
def test_ngc7027_has_the_published_error_at_the_published_iteration(engine):
    """Richardson-Lucy from a flat start, in Prato et al.'s benchmark: 0.1361 at iteration 146."""
    image, psf, truth = (
        DATA / "ngc7027" / f"NGC7027_255_{name}.fits" for name in ("gn", "psf", "obj")
    )
    options = ("--background", "1", "--n-iter", "146", "--engine", engine, *PAPER)
    assert main(["deconvolve", str(image), "--psf", str(psf), *options, "-o", "out.fits"]) == 0
    check_file("out.fits")
    expected = fits.getdata(truth)
    error = np.linalg.norm(fits.getdata("out.fits") - expected) / np.linalg.norm(expected)
    assert error == pytest.approx(0.1361, abs=3e-4)


class TestLensedQuasar:
    """Four point images on a faint ring: the main job on one real image."""

    STARS = ((77, 73), (47, 56), (55, 77), (73, 48))
    IMAGE = "a real image, 'sky' & all of " + "a very long name" * 5 + ".fits"

    @pytest.fixture
    def arguments(self):
        """Make counts of the rates, with the noise of the sky as a background of 26.9."""
        where = DATA / "hst-lensed-quasar"
        rates, header = fits.getdata(where / "quasar_F814W_sci.fits", header=True)
        seconds = fits.getdata(where / "quasar_F814W_exptime.fits")
        header.update(COORDINATES | {"BUNIT": "ELECTRONS"})
        fits.writeto(self.IMAGE, rates * seconds + 26.9, header)
        stars = [word for x, y in self.STARS for word in ("--star", f"{x},{y}")]
        psf = str(where / "quasar_F814W_psf.fits")
        return ["deconvolve", self.IMAGE, "--psf", psf, "--background", "26.9", *stars, *PAPER,
                "--psf-error", "0", "--n-iter", "60", "--mu", "1e-7", "--pad", "4"]  # fmt: skip

    @engines
    def test_lensed_quasar_has_the_measured_fluxes_and_the_wcs_of_the_image(
        self, arguments, engine, capsys
    ):
        assert main([*arguments, "--engine", engine, "-o", "out.fits"]) == 0
        # None of the noise, though it was drizzled. The PSF is twice as wide as the stars.
        told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
        assert all("does not fit at 4 of 4 stars" in line or "light lies" in line for line in told)
        check_file("out.fits")
        with fits.open("out.fits") as hdus:
            extended, stars, history, *_ = (hdu.data for hdu in hdus)
            kept = WCS(hdus[0].header)
        assert extended.shape == (120, 120)
        assert extended.sum() > 0
        pixels = np.array([[0.0, 0.0], [119.0, 3.0], [60.0, 119.0]])
        np.testing.assert_allclose(
            kept.all_pix2world(pixels, 0),
            WCS(fits.getheader(self.IMAGE)).all_pix2world(pixels, 0),
            rtol=1e-12,
        )
        np.testing.assert_array_equal(np.column_stack([stars["x"], stars["y"]]), self.STARS)
        np.testing.assert_allclose(stars["flux"], self.photometry(arguments[3]), rtol=0.02)
        np.testing.assert_array_equal(history["iteration"], np.arange(61))
        assert (np.diff(history["objective"]) < 0).all()

    def photometry(self, psf_path):
        """Return the light within 8 pixels of each star, over the share the PSF has there."""

        def within(image, x, y):
            rows, columns = np.indices(image.shape)
            return image[np.hypot(rows - y, columns - x) < 8].sum()

        counts = fits.getdata(self.IMAGE) - 26.9
        share = within(fits.getdata(psf_path), 30, 30)
        return [within(counts, x, y) / share for x, y in self.STARS]

    @engines
    def test_the_header_repeats_the_run(self, arguments, engine):
        """The commands in the HISTORY cards, run by a shell, make the same file again."""
        assert main([*arguments, "--engine", engine, "-o", "out.fits"]) == 0
        header = fits.getheader("out.fits")
        inputs = {"ISUM1": self.IMAGE, "PSUM1": arguments[3]}
        for keyword, path in inputs.items():
            assert header[keyword] == hashlib.sha256(Path(path).read_bytes()).hexdigest()
        Path("out.fits").rename("first.fits")
        script = "\n".join(header["HISTORY"])
        python = f'lnocl() {{ {shlex.quote(sys.executable)} -m lnocl "$@"; }}'
        subprocess.run(
            ["bash", "-ec", f"{python}\n{script}"], cwd="/", capture_output=True, check=True
        )
        with fits.open("first.fits") as first, fits.open("out.fits") as again:
            for one, other in zip(first, again, strict=True):
                if one.name == "MESSAGES":  # less is read from keywords and files
                    continue
                assert one.header.get("DATASUM") == other.header.get("DATASUM")
                assert one.data.tobytes() == other.data.tobytes()
            cards = [
                [
                    (keyword, value)
                    for keyword, value in hdus[0].header.items()
                    if keyword not in ("DATE", "CHECKSUM")
                ]
                for hdus in (first, again)
            ]
            assert cards[0] == cards[1]


class TestAltair:
    """A Fizeau frame of a star, its core clipped: four PSFs at four angles from one."""

    FRAME = DATA / "lbti-fizeau-altair" / "lm_180507_009030.fits"

    @staticmethod
    def fringes(psf):
        """Return frequency, in cycles a pixel, and angle, degrees, of the side lobe of the MTF."""
        k = len(psf)
        window = np.exp(-0.5 * np.add.outer(*[(np.arange(k) - k // 2) ** 2 / 20.0**2] * 2))
        n = 1024
        spectrum = np.abs(np.fft.fft2(psf * window, s=(n, n)))
        fy, fx = np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)
        f = np.hypot(fx, fy)
        spectrum[(f < 1 / 8) | (f > 1 / 4)] = 0
        iy, ix = np.unravel_index(spectrum.argmax(), spectrum.shape)
        return f[iy, ix], np.degrees(np.arctan2(fy[iy, 0], fx[ix])) % 180

    def test_the_example_makes_four_psfs(self, tmp_path):
        """The shell script, with this lnocl in its path."""
        pytest.importorskip("matplotlib")
        program = tmp_path / "bin" / "lnocl"
        program.parent.mkdir()
        program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m lnocl "$@"\n')
        program.chmod(0o755)
        script = Path(__file__).parents[2] / "examples" / "real" / "altair_psfs.sh"
        path = f"{program.parent}{os.pathsep}{os.environ['PATH']}"
        done = subprocess.run(
            ["sh", script, DATA],
            capture_output=True, text=True, check=False, env=os.environ | {"PATH": path},
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert without_progress(done.stderr).splitlines() == [
            "lnocl: warning: 24 saturated pixels of the PSF were repaired, and hold 15.46 % of its "
            "flux: its core is a guess"
        ]
        assert done.stdout.splitlines()[-2:] == [
            "written to altair_psfs.fits: 4 PSFs of 144 x 144 pixels, the star's centre at "
            "(72, 72)",
            "drew altair_psfs.png",
        ]
        assert fitscheck.main(["--compliance", "altair_psfs.fits"]) == 0
        psfs = fits.getdata("altair_psfs.fits")
        assert psfs.shape == (4, 144, 144)
        np.testing.assert_allclose(psfs.sum(axis=(1, 2)), 1, rtol=1e-12)
        frequency, first = self.fringes(psfs[0])
        for psf, angle in zip(psfs, (0, 45, 90, 135), strict=True):
            f, found = self.fringes(psf)
            assert f == pytest.approx(frequency, rel=0.01)
            assert (found - first - angle + 90) % 180 == pytest.approx(90, abs=1)

    def test_the_example_without_the_data_says_so(self, tmp_path):
        script = Path(__file__).parents[2] / "examples" / "real" / "altair_psfs.sh"
        done = subprocess.run(["sh", script, tmp_path], capture_output=True, text=True, check=True)
        assert done.stdout.startswith("skipped: ")
        assert not list(tmp_path.iterdir())

    def test_the_clipped_core_is_repaired_with_a_warning(self):
        frame = fits.getdata(self.FRAME)
        with pytest.warns(LnoclWarning, match="24 saturated pixels .* its core is a guess"):
            star = make_psf(frame, size=160, saturation=57000.0)
        assert star.psf.max() * star.flux > 57000
        assert star.centre == pytest.approx((202.5, 202.5), abs=0.1)


class TestChandra:
    """PSF images that are not centred, and one that is sharper than its pixels."""

    @pytest.mark.parametrize(
        ("name", "centroid"), [("4683", (22.94, 21.65)), ("4684", (23.24, 23.09))]
    )
    def test_the_centres_that_were_published_are_found(self, name, centroid):
        path = DATA / "chandra-sgra-pair" / f"chandra-psf-obs-id-{name}.fits.gz"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LnoclWarning)
            star = make_psf(fits.getdata(path), background=0.0)
            again = make_psf(star.psf, background=0.0)
        assert star.centre == pytest.approx(centroid, abs=0.1)
        assert again.centre == pytest.approx([k // 2 for k in star.psf.shape], abs=0.05)


def run(*words):
    """Run deconvolve quietly on files and words; return residuals, model sum, objective, table."""
    words = [str(word) for word in words]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        what = ["--residuals", "--quiet", "--overwrite", "-o", "out.fits"]
        assert main(["deconvolve", *PAPER, *GIVEN, *words, *what]) == 0
        with fits.open("out.fits") as hdus:
            return (
                hdus["RESIDUALS"].data,
                hdus["MODELS"].data.sum(),
                hdus["HISTORY"].data["objective"][-1],
                hdus["STARS"].data.copy(),
                hdus[0].data,
            )


@pytest.fixture(scope="module")
def example():
    """Return examples/real/real.py as a module."""
    path = Path(__file__).parents[2] / "examples" / "real" / "real.py"
    spec = importlib.util.spec_from_file_location("real", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class TestExamples:
    """What docs/validation/real.md says of examples/real/*.sh."""

    @pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
    def test_refined_stars_halve_the_residuals_of_the_lensed_quasar(self, example):
        """With a PSF of the four images themselves; the file's is twice as wide as they are."""
        where = DATA / "hst-lensed-quasar"
        sci, exptime = (where / f"quasar_F814W_{name}.fits" for name in ("sci", "exptime"))
        example.stars_psf(sci, exptime, "psf.fits")
        stars = [word for x, y in example.IMAGES for word in ("--star", f"{x},{y}")]
        words = [sci, "--psf", "psf.fits", "--exposure", exptime, "--background", 0,
                 "--read-noise", 5.187, "--pad", 4, *stars]  # fmt: skip
        for how, whole, refined in [
            (["--n-iter", 30], 3.31, 0.95),
            (["--smoothing", 0.0328, "--n-iter", 300], 3.04, 0.98),
        ]:
            rms = []
            for refine in ([], ["--refine"]):
                residuals, _, _, table, extended = run(*words, *how, *refine)
                rms.append(np.sqrt(np.nanmean(residuals[0, 40:80, 40:80] ** 2)))
            assert rms == pytest.approx([whole, refined], rel=0.02)
            assert table["flux"].sum() == pytest.approx(440, rel=0.01)
            assert (table["x_error"] < 0.01).all()
        # The ring, smoothed: the faintest of 24 sectors is above the sky.
        rows, columns = np.indices(extended.shape)
        x, y = columns - 64, rows - 61.5
        radius, sector = np.hypot(x, y), np.floor(np.degrees(np.arctan2(y, x)) % 360 / 15)
        sky = extended[(radius > 30) & (radius < 50)].mean()
        brightest = [
            max(extended[(sector == s) & (abs(radius - r) < 1)].mean() for r in range(11, 22))
            for s in range(24)
        ]
        assert min(brightest) > 2 * sky

    @pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
    @pytest.mark.filterwarnings("ignore::astropy.wcs.FITSFixedWarning")
    def test_two_images_together_are_better_where_they_are_aligned(self, example, capsys):
        """The whole field, seen from as far between the pixels of the sky with each offset."""
        where = DATA / "chandra-sgra-pair"
        for name in ("4683", "4684"):
            example.centred_psf(
                where / f"chandra-psf-obs-id-{name}.fits.gz", f"psf_{name}.fits", 43
            )
        images = [where / f"chandra-counts-obs-id-{name}.fits.gz" for name in ("4683", "4684")]
        psfs = ["psf_4683.fits", "psf_4684.fits"]
        run(*images, "--psf", *psfs, "--pad", 24, "--n-iter", 1, "--align", "wcs")
        capsys.readouterr()
        example.offsets("out.fits", *images, *psfs, 5)
        lines = capsys.readouterr().out.splitlines()
        aligned, minus, plus, wrong = (
            [float(part.rsplit(" ", 1)[1]) for part in line.split(",")[-3:]] for line in lines
        )
        assert minus[0] - aligned[0] == pytest.approx(55, abs=3)
        assert plus[0] - aligned[0] == pytest.approx(84, abs=3)
        assert wrong[0] - minus[0] == pytest.approx(194, abs=3)
        assert aligned[1] < 0.993 * min(minus[1], plus[1]) < 0.98 * wrong[1]
        assert [each[2] for each in (aligned, minus, plus, wrong)] == pytest.approx(
            [1] * 4, abs=2e-4
        )

    def test_the_point_has_nearly_all_counts(self, example):
        """1831 less a background of 0.0025 in each of 147 x 169 pixels."""
        where = DATA / "chandra-pg1634-point"
        counts = where / "pg1634_counts_0.25pix.fits"
        example.pixel_psf(where / "pg1634_psf_0.25pix.fits", "psf.fits")
        words = ["--background", 0.0025, "--star", "89,76", "--n-iter", 30, "--refine"]
        _, _, _, table, extended = run(counts, "--psf", "psf.fits", *words)
        above = 1831 - 0.0025 * 147 * 169
        assert table["flux"].item() == pytest.approx(0.986 * above, rel=0.005)
        assert extended.sum() == pytest.approx(81, abs=8)
        assert 0.05 < table["x_error"].item() < 0.1

    @pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
    def test_the_quasar_is_between_pixels(self, example):
        where = DATA / "hst-quasar-j0005"
        example.centred_psf(where / "sci_psf.fits", "psf.fits", 63)
        words = [where / "sci_J0005-0006.fits", "--psf", "psf.fits", "--noise",
                 f"ivar={where / 'ivm_J0005-0006.fits'}", "--exposure", "EXPTIME", "--pad", 16,
                 "--background", 0, "--star", "64,64", "--solver", "sgp",
                 "--n-iter", 10]  # fmt: skip
        whole, refined = run(*words), run(*words, "--refine")
        assert refined[2] == pytest.approx(0.316 * whole[2], rel=0.02)
        assert refined[3]["flux"].item() == pytest.approx(130.5, abs=0.5)
        assert (refined[3]["x"].item(), refined[3]["y"].item()) == pytest.approx(
            (64.112, 63.516), abs=0.01
        )

    @pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
    def test_a_spitzer_mosaic(self, example):
        image = DATA / "spitzer-glimpse" / "spitzer_glimpse_irac2_l18.fits"
        example.star_psf(image, "psf.fits", "442,344", 33)
        words = ["--gain", 31.306, "--background", "auto", "--pad", 16, "--star", "442,344"]
        residuals, *_, table, extended = run(image, "--psf", "psf.fits", *words, "--n-iter", 3)
        assert np.isnan(residuals).sum() == 3
        assert extended.shape == (513, 1025)
        # Five pixels round the star hold its light, but for that share of the PSF that is outside.
        frame, psf = fits.getdata(image), fits.getdata("psf.fits")
        rows, columns = np.indices(frame.shape)
        inside = np.hypot(columns - 442.27, rows - 344.25) < 5
        rows, columns = np.indices(psf.shape) - 16
        share = psf[np.hypot(columns, rows) < 5].sum()
        light = np.sum(frame[inside] - 3.396)
        assert table["flux"].item() == pytest.approx(light / share, rel=0.1)
