"""The command ``lnocl psf``: what it writes, what it says, and what it refuses."""

import hashlib
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
from astropy.wcs import WCS
from scenes import named
from wcs_headers import NORTH_UP

import lnocl
from lnocl.commands import cli
from lnocl.io.calibration import Calibration
from lnocl.io.frames import read_frames
from lnocl.psf import examine, make_psf, make_psfs

SHAPE = (61, 70)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]]


def star(x, y, peak=9000.0, width=2.0):
    return peak * np.exp(-((X - x) ** 2 + (Y - y) ** 2) / (2 * width**2))


FRAME = 40 + star(30.3, 28.8) + star(50, 45, 1500.0) + np.random.default_rng(4).normal(0, 3, SHAPE)
BAD = np.zeros(SHAPE)
BAD[29, 31] = 2
BAD[35, 25] = np.nan
BAD[36, 25] = -1


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arrays = {
        "star": FRAME,
        "cube": [FRAME, FRAME],
        "one": [FRAME],
        "mask": BAD,
        "oblong": BAD.T,
        "masks": [BAD, BAD],
        "none": np.ones(SHAPE),
        "nan": np.full(SHAPE, np.nan),
        "sharp": star(30.4, 28.6, width=0.4),
    }
    for name, array in arrays.items():
        fits.writeto(f"{name}.fits", np.array(array), fits.Header({"BUNIT": "adu"}))
    Path("there.fits").write_bytes(b"old")
    Path("there.png").write_bytes(b"old")
    Path("link.png").symlink_to("out.fits")
    return tmp_path


def run(*options, frame="star.fits", output="out.fits"):
    made = [] if output is None else ["-o", output]
    return cli.main(["psf", frame, *made, *options])


def test_a_star_is_named_by_its_place_on_the_sky_too():
    for name, value in NORTH_UP.items():
        fits.setval("star.fits", name, value=value)
    there = WCS(fits.getheader("star.fits")).pixel_to_world(50, 45)
    place = f"{float(there.ra.deg)!r}d,{float(there.dec.deg)!r}d"
    assert run("--star", place, "--size", "15", output="sky.fits") == 0
    assert run("--star", "50,45", "--size", "15", output="pixels.fits") == 0
    np.testing.assert_array_equal(fits.getdata("sky.fits"), fits.getdata("pixels.fits"))
    assert place in "".join(fits.getheader("sky.fits")["HISTORY"]).replace("\\\n", "")


def complaint(captured):
    assert captured.out == ""
    *warned, error = captured.err.splitlines()
    assert all(line.startswith("lnocl: warning: ") for line in warned)
    assert error.startswith("lnocl: error: ")
    return error.removeprefix("lnocl: error: ")


OPTIONS = {
    "nothing": ([], {}),
    "star": (["--star", "49,46"], {"position": (49, 46)}),
    "mask": (["--mask", "mask.fits"], {"mask": BAD != 0}),
    "saturation": (["--saturation", "8000"], {"saturation": 8000.0}),
    "background": (["--background", "41.5"], {"background": 41.5}),
    "negative background": (["--background", "-3"], {"background": -3.0}),
    "auto": (["--background", "auto"], {}),
    "no recentring": (["--no-recentre"], {"recentre": False}),
    "rotation": (["--rotate", "-30"], {"rotate": -30.0}),
    "size": (["--size", "20"], {"size": 20}),
    "clipping": (["--clip-negative"], {"clip_negative": True}),
    "all": (
        [
            *("--star", "49,46", "--mask", "mask.fits", "--saturation", "1400"),
            *("--background", "41.5", "--rotate", "30", "--size", "15", "--clip-negative"),
        ],
        {
            "position": (49, 46), "mask": BAD != 0, "saturation": 1400.0, "background": 41.5,
            "rotate": 30.0, "size": 15, "clip_negative": True,
        },
    ),
}  # fmt: skip


class TestWhatItMakes:
    @pytest.mark.filterwarnings("ignore::lnocl.errors.LnoclWarning")
    @pytest.mark.parametrize("option", named(OPTIONS, *list(OPTIONS)[:3]))
    def test_each_option_is_that_of_the_function(self, capsys, option):
        given, meant = option
        assert run(*given) == 0
        expected = make_psf(FRAME, **meant)
        psf = fits.getdata("out.fits")
        np.testing.assert_array_equal(psf, expected.psf)
        k = len(psf)
        assert capsys.readouterr().out.splitlines() == [
            *expected.steps,
            f"written to out.fits: a PSF of {k} x {k} pixels, the star's centre at "
            f"({k // 2}, {k // 2})",
        ]

    @pytest.mark.exhaustive
    def test_several_angles_give_a_cube(self, capsys):
        assert run("--rotate", "0", "45", "90", "135", "--size", "20") == 0
        expected = make_psfs(FRAME, [0, 45, 90, 135], size=20)
        np.testing.assert_array_equal(
            fits.getdata("out.fits"), [each.psf for each in expected]
        )  # fmt: skip
        lines = []
        for j, (each, angle) in enumerate(zip(expected, (0, 45, 90, 135), strict=True), 1):
            lines += [f"PSF {j} of 4, at {angle} degrees:", *each.own_steps]
        assert capsys.readouterr().out.splitlines() == [
            *expected[0].shared_steps,
            *lines,
            "written to out.fits: 4 PSFs of 20 x 20 pixels, the star's centre at (10, 10)",
        ]
        assert [line.partition(":")[0] for line in expected[0].shared_steps] == [
            "star", "background", "bad pixels", "centre", "neighbours", "star 1 of 2",
            "star 2 of 2", "effective PSF",
        ]  # fmt: skip

    @pytest.mark.exhaustive
    def test_without_a_size_all_angles_have_the_largest_common_one(self):
        assert run("--rotate", "0", "45") == 0
        assert fits.getdata("out.fits").shape[1:] == make_psf(FRAME, rotate=45).psf.shape

    def test_a_cube_of_one_image_will_do(self):
        assert run(frame="one.fits") == 0
        assert fits.getdata("out.fits").ndim == 2

    @pytest.mark.exhaustive
    def test_deconvolve_takes_it(self, capsys):
        assert run("--size", "21", "--rotate", "0", "90", "--clip-negative", "--quiet") == 0
        image = (
            "deconvolve",
            "cube.fits",
            "--gain",
            "1",
            "--psf",
            "out.fits",
            "--background",
            "40",
        )
        options = ("--star", "30.3,28.8", "--star", "50,45", "--engine", "numpy", "--n-iter", "30")
        options += ("--stop", "none", "--quiet")
        assert cli.main([*image, *options, "-o", "sky.fits"]) == 0
        assert "the noise of image 2 is not that of its counts" in capsys.readouterr().err
        flux = fits.getdata("sky.fits", "STARS")["flux"]
        expected = 2 * np.pi * 4 * np.array([9000.0, 1500.0])
        np.testing.assert_allclose(flux, expected, rtol=0.05)

    def test_several_stars_give_one_effective_psf_and_its_scatter(self, capsys):
        assert run("--star", "30,29", "--star", "50,45", "--size", "15") == 0
        expected = make_psf(FRAME, [(30, 29), (50, 45)], 15)
        with fits.open("out.fits", checksum=True) as hdus:
            np.testing.assert_array_equal(hdus[0].data, expected.psf)
            np.testing.assert_array_equal(hdus["SCATTER"].data, expected.scatter)
            assert hdus[0].header["NSTARS"] == 2
            assert hdus[0].header["PSFERROR"] == expected.error < 0.03
        said = capsys.readouterr().out.splitlines()
        assert said[:-1] == list(expected.steps)
        assert [line.partition(":")[0] for line in said] == [
            "star", "star", "background", "bad pixels", "centre", "centre", "star 1 of 2",
            "star 2 of 2", "effective PSF", "crop", "negative pixels", "normalised",
            "written to out.fits",
        ]  # fmt: skip
        words = shlex.split("\n".join(fits.getheader("out.fits")["HISTORY"]).replace("\\\n", ""))
        assert words.count("--star") == 2

    @pytest.mark.parametrize(("given", "others"), [(None, []), (None, ["plain.fits"]), (0.2, [])])
    def test_the_error_of_the_width_is_read_again_unless_one_is_given(self, capsys, given, others):
        assert run("--star", "30,29", "--star", "50,45", "--size", "15", output="psf.fits") == 0
        fits.writeto("plain.fits", fits.getdata("psf.fits"))
        capsys.readouterr()
        psfs = ["psf.fits", *others]
        read = read_frames(["star.fits"] * len(psfs), psfs, Calibration(psf_error=given, gain=1.0))
        made = fits.getheader("psf.fits")["PSFERROR"]
        expected = given or max(made, 0.03 if others else 0.0)
        assert read.observation.psf_error == expected

    @pytest.mark.parametrize(("word", "why"), [("wide", "not a number"), (0.7, "from 0 to 0.3")])
    def test_invalid_error_of_the_width_is_refused(self, word, why):
        header = fits.Header({"PSFERROR": word})
        fits.writeto("odd.fits", make_psf(FRAME, (30, 29), 15).psf, header)
        with pytest.raises(lnocl.InputError, match=why):
            read_frames(["star.fits"], ["odd.fits"], Calibration(psf_error=None, gain=1.0))

    @pytest.mark.exhaustive
    def test_the_scatter_is_written_and_read_again_unless_psfs_are_exact(self, capsys):
        """Of one star too; and all that is asked of the result has it."""
        assert run("--star", "30,29", "--size", "15", output="psf.fits") == 0
        expected = make_psf(FRAME, (30, 29), 15)
        np.testing.assert_array_equal(fits.getdata("psf.fits", "SCATTER"), expected.scatter)
        errors, limits = [], []
        for error in ("0.01", "0"):
            words = ["deconvolve", "star.fits", "--psf", "psf.fits", "--star", "50,45", "-o"]
            words += ["sky.fits", "--overwrite", "--gain", "1", "--background", "40", "--stop"]
            words += ["none", "--engine", "numpy", "--n-iter", "3", "--psf-error", error]
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", lnocl.LnoclWarning)
                assert cli.main(words) == 0
                said = capsys.readouterr().err
                assert cli.main(["limit", "sky.fits", "--injections", "0"]) == 0
            assert ("SCATTER, the error of the pixels of PSFs, is taken" in said) == (error != "0")
            errors.append(fits.getdata("sky.fits", "STARS")["flux_error"][0])
            limits.append(capsys.readouterr().out)
        assert errors[0] > errors[1]
        assert all("is found with a probability of 50 %" in said for said in limits)

    def test_stars_in_several_files_give_one_effective_psf(self, capsys):
        names, chance = [], np.random.default_rng(3)
        for n, x, y, flux in [(31, 15.3, 14.8, 4e6), (35, 18.6, 16.1, 9e6), (33, 16.1, 16.4, 3e6)]:
            rows, columns = np.indices((n, n))
            light = flux * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8.0) / (8.0 * np.pi)
            names.append(f"cut{n}.fits")
            fits.writeto(names[-1], chance.poisson(light + n).astype(float))
        assert cli.main(["psf", *names, "-o", "out.fits", "--size", "21"]) == 0
        assert "3 frames: their stars are laid side by side" in capsys.readouterr().out
        psf, header = fits.getdata("out.fits"), fits.getheader("out.fits")
        rows, columns = np.indices((21, 21)) - 10.0
        true = np.exp(-(rows**2 + columns**2) / 8.0) / (8.0 * np.pi)
        assert abs(psf - true).max() < 0.005 * true.max()
        assert (header["NSTARS"], len({header[f"ISUM{j}"] for j in (1, 2, 3)})) == (3, 3)
        assert cli.main(["psf", *names, "-o", "no.fits", "--star", "3,4"]) == 2
        assert "the brightest star of each is taken" in capsys.readouterr().err

    def test_a_table_of_stars_is_as_good_as_their_positions(self, capsys):
        Path("stars.csv").write_text("x,y\n30,29\n50,45\n")
        assert run("--stars", "stars.csv", "--size", "15") == 0
        assert run("--star", "30,29", "--star", "50,45", "--size", "15", output="two.fits") == 0
        np.testing.assert_array_equal(fits.getdata("out.fits"), fits.getdata("two.fits"))
        assert "--stars stars.csv" in str(fits.getheader("out.fits")["HISTORY"])
        capsys.readouterr()
        assert run("--stars", "stars.csv", "--check", output=None) == 2
        assert complaint(capsys.readouterr()) == "--check makes nothing; leave --stars out"

    def test_several_stars_at_several_angles_give_two_cubes(self):
        assert run("--star", "30,29", "--star", "50,45", "--size", "9", "--rotate", "0", "90") == 0
        expected = make_psfs(FRAME, [0, 90], [(30, 29), (50, 45)], 9)
        np.testing.assert_array_equal(fits.getdata("out.fits"), [e.psf for e in expected])
        scatters = [e.scatter for e in expected]
        np.testing.assert_array_equal(fits.getdata("out.fits", "SCATTER"), scatters)


class TestCheck:
    def check(self, capsys, psf, **cards):
        fits.writeto("psf.fits", psf, fits.Header(cards))
        assert run("--check", frame="psf.fits", output=None) == 0
        assert not Path("out.fits").exists()
        return capsys.readouterr().out.splitlines()

    def test_a_psf_is_looked_at(self, capsys):
        psf = star(35.0, 30.0)
        assert self.check(capsys, psf, PIXELSCL=0.05) == [
            "pixels: 0.05 arcsec, by its header",
            *examine(psf).lines(),
            "nothing speaks against it by itself",
        ]

    def test_oversampled_and_off_centre_psfs_are_reported(self, capsys):
        psf = star(33.0, 30.0)
        said = self.check(capsys, psf, OVERSAMP=4)
        assert said[0] == "its header has OVERSAMP 4: bin it to pixels of the detector"
        assert said[-1] == (
            "it is 2.00 pixels off its centre, and is refused: take --psf-centre fit"
        )

    def test_all_of_a_cube_are(self, capsys):
        said = self.check(capsys, np.array([star(35.0, 30.0), star(36.0, 30.0)]))
        assert [line for line in said if line.startswith("PSF")] == ["PSF 1 of 2:", "PSF 2 of 2:"]
        assert "nothing" in said[7]
        assert "1.00 pixels off" in said[15]


class TestAStarOfTheTable:
    def test_is_left_out_where_it_is_the_target(self):
        Path("stars.csv").write_text("x,y\n30.3,28.8\n50,45\n")
        assert run("--stars", "stars.csv", "--without", "31,27", "--size", "15") == 0
        header = fits.getheader("out.fits")
        assert header["NSTARS"] == 1
        assert (header["CENTREX"], header["CENTREY"]) == pytest.approx((50, 45), abs=0.1)
        assert "--without 31.0,27.0" in str(header["HISTORY"]).replace("\\\n", "")

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["--stars", "stars.csv", "--without", "10,10"], "has no star within 5 pixels of"),
            (["--stars", "one.csv", "--without", "30,29"], "leaves no star: give other stars"),
        ],
    )
    def test_star_to_exclude_that_is_missing_or_the_only_one_is_refused(
        self, capsys, options, message
    ):
        Path("stars.csv").write_text("x,y\n30.3,28.8\n50,45\n")
        Path("one.csv").write_text("x,y\n30.3,28.8\n")
        assert run(*options, "--size", "15") == 2
        assert message in capsys.readouterr().err


class TestTheFile:
    def test_psf_header_records_the_steps_and_the_command(self):
        options = ("--mask", "mask.fits", "--saturation", "8900", "--rotate", "0", "30")
        assert run(*options, "--size", "21", "--star", "30,29", "--clip-negative") == 0
        assert fitscheck.main(["--compliance", "out.fits"]) == 0
        stars = make_psfs(
            FRAME, [0, 30], (30, 29), 21, mask=BAD != 0, saturation=8900.0, clip_negative=True
        )
        with fits.open("out.fits", checksum=True) as hdus:
            header = hdus[0].header
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "SCATTER"]
            np.testing.assert_array_equal(hdus[1].data, [star.scatter for star in stars])
        expected = {
            "CREATOR": f"lnocl {lnocl.__version__}",
            "CENTREX": stars[0].centre[0],
            "CENTREY": stars[0].centre[1],
            "BKG": stars[0].background,
            "NSTARS": 1,
            "NBAD": 3,
            "SATURATE": 8900.0,
            "RECENTRE": True,
            "CLIPPED": True,
            "ANGLE1": 0.0,
            "ANGLE2": 30.0,
            "FLUX1": stars[0].flux,
            "FLUX2": stars[1].flux,
            "ISUM1": hashlib.sha256(Path("star.fits").read_bytes()).hexdigest(),
            "MSUM1": hashlib.sha256(Path("mask.fits").read_bytes()).hexdigest(),
        }
        assert {name: header[name] for name in expected} == expected
        assert "BUNIT" not in header
        notes = [line for line in header["HISTORY"] if line.startswith("# ")]
        text = " ".join(line.removeprefix("# ") for line in notes)
        for step in (*stars[0].steps, *stars[1].steps, "PSF 2 of 2, at 30 degrees:"):
            assert step in text
        commands = [line for line in header["HISTORY"] if not line.startswith("# ")]
        assert "".join(commands).replace("\\", "") == (
            f"cd {os.getcwd()}lnocl psf star.fits --star 30.0,29.0 --size 21 --background auto "
            "--mask mask.fits --saturation 8900.0 --rotate 0.0 30.0 --clip-negative -o out.fits"
        )

    def test_psf_header_omits_steps_that_were_not_requested(self):
        assert run("--no-recentre", "--background", "40", "--clip-negative") == 0
        header = fits.getheader("out.fits")
        assert not {"SATURATE", "MSUM1", "ANGLE2", "FLUX2"} & set(header)
        assert (header["RECENTRE"], header["CLIPPED"], header["NBAD"]) == (False, True, 0)
        assert (
            "".join(header["HISTORY"])
            .replace("\\", "")
            .endswith(
                "lnocl psf star.fits --background 40.0 --rotate 0.0 --no-recentre --clip-negative "
                "-o out.fits"
            )
        )

    @pytest.mark.system
    @pytest.mark.parametrize("name", ["-o ' b.fits", "naïve☃\n.fits"])
    def test_the_history_run_by_a_shell_makes_the_same_file(self, name):
        Path("star.fits").rename(name)
        Path("mask.fits").rename("-mask.fits")
        options = ["--rotate", "-0.1", "33.3", "--size", "21", "--mask=-mask.fits"]
        assert cli.main(["psf", *options, "-oout.fits", "--", name]) == 0
        script = "\n".join(fits.getheader("out.fits")["HISTORY"])
        first = Path("out.fits").read_bytes()
        os.unlink("out.fits")
        python = f'lnocl() {{ {shlex.quote(sys.executable)} -m lnocl "$@"; }}'
        subprocess.run(
            ["bash", "-ec", f"{python}\n{script}"], cwd="/", capture_output=True, check=True
        )
        assert Path("out.fits").read_bytes() == first

    def test_overwrite(self):
        assert run("--overwrite", output="there.fits") == 0
        assert fits.getdata("there.fits").ndim == 2

    def test_a_write_that_fails_leaves_nothing(self, capsys, monkeypatch):
        def fail(descriptor):
            raise OSError(28, "No space left on device")

        before = sorted(os.listdir())
        monkeypatch.setattr(os, "fsync", fail)
        assert run() == 1
        assert (
            complaint(capsys.readouterr()) == "out.fits cannot be written: No space left on device"
        )
        assert sorted(os.listdir()) == before


class TestMessages:
    def test_quiet_says_nothing_but_warnings(self, capsys):
        assert run("--quiet") == 0
        assert capsys.readouterr() == ("", "")
        assert run("--quiet", "--saturation", "8000", "--overwrite") == 0
        captured = capsys.readouterr()
        assert captured.out == ""
        (line,) = captured.err.splitlines()
        assert line.startswith("lnocl: warning: ")
        assert line.endswith("its core is a guess")

    def test_the_extension_with_the_frame_is_named(self, capsys):
        extension = fits.ImageHDU(FRAME, name="SCI")
        fits.HDUList([fits.PrimaryHDU(), extension]).writeto("sci.fits")
        assert run("--size", "21", frame="sci.fits") == 0
        assert "lnocl: sci.fits: the image is HDU 1 (SCI)\n" in capsys.readouterr().err
        assert run("--size", "21", "--quiet", "--overwrite", frame="sci.fits") == 0
        assert capsys.readouterr() == ("", "")

    def test_several_angles_warn_once(self, capsys):
        assert run("--rotate", "0", "20", "45", "--background", "0", frame="sharp.fits") == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("lnocl: warning: the PSF rings: ")
        assert line.endswith("its pixels stay as they are without recentring and rotation")

    def test_the_largest_crop_is_called_so(self, capsys):
        assert run(frame="sharp.fits") == 0
        k = len(fits.getdata("out.fits"))
        assert f"crop: {k} x {k} pixels, the largest square there is; " in capsys.readouterr().out


class TestPicture:
    @pytest.fixture(autouse=True)
    def _matplotlib(self):
        pytest.importorskip("matplotlib")

    @pytest.mark.exhaustive
    def test_it_is_drawn(self, capsys, monkeypatch):
        from lnocl.plotting.psf import draw_star_psf

        drawn = []

        def draw(*arguments):
            drawn.append(arguments)
            return draw_star_psf(*arguments)

        monkeypatch.setattr("lnocl.plotting.psf.draw_star_psf", draw)
        assert run("--plot", "a.PNG", "--rotate", "0", "45", "--mask", "mask.fits") == 0
        assert capsys.readouterr().out.splitlines()[-1] == "drew a.PNG"
        assert Path("a.PNG").read_bytes().startswith(b"\x89PNG")
        assert "--plot" not in "".join(fits.getheader("out.fits")["HISTORY"])
        ((frame, bad, centres, psfs, angles),) = drawn
        header = fits.getheader("out.fits")
        np.testing.assert_array_equal(bad, BAD != 0)
        np.testing.assert_array_equal(frame[~bad], (FRAME - header["BKG"])[~bad])
        assert centres == ((header["CENTREX"], header["CENTREY"]),)
        np.testing.assert_array_equal(psfs, fits.getdata("out.fits"))
        assert angles == [0, 45]

    @pytest.mark.exhaustive
    def test_overwrite(self):
        assert run("--plot", "there.png", "--overwrite") == 0
        assert Path("there.png").read_bytes().startswith(b"\x89PNG")

    def test_without_matplotlib_it_says_so_before_it_reads(self, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        assert run("--plot", "a.png", frame="no.fits") == 1
        assert complaint(capsys.readouterr()) == (
            "pictures need matplotlib, which is not installed: pip install matplotlib"
        )
        assert run() == 0
        assert not Path("a.png").exists()


REFUSED = {
    "missing": ({"frame": "no.fits"}, [], 1, "no.fits cannot be opened: No such file"),
    "cube": ({"frame": "cube.fits"}, [], 2, "cube.fits holds 2 images; give a file with one"),
    "all bad": ({"frame": "nan.fits"}, [], 2, "all pixels of the frame are bad"),
    "output exists": ({"output": "there.fits"}, [], 1, "there.fits exists; give another name"),
    "output is input": (
        {"output": "star.fits"}, ["--overwrite"], 2, "star.fits is one of the inputs",
    ),
    "output is mask": (
        {"output": "mask.fits"}, ["--overwrite", "--mask", "mask.fits"], 2,
        "mask.fits is one of the inputs",
    ),
    "a star twice": ({}, ["--star", "30,29", "--star", "30.2,29"], 2, "is given twice"),
    "several as they are": (
        {}, ["--star", "30,29", "--star", "50,45", "--no-recentre"], 2, "must be recentred",
    ),
    "no output": ({"output": None}, [], 2, "give -o PSF.fits for the PSF, or --check"),
    "a check that makes": ({}, ["--check"], 2, "--check makes nothing; leave -o out"),
    "a check with a size": ({"output": None}, ["--check", "--size", "9"], 2, "leave --size out"),
    "a check of no numbers": (
        {"frame": "nan.fits", "output": None}, ["--check"], 2, "must be one image of finite numbers"
    ),
    "star outside": ({}, ["--star", "70,3"], 2, "position (70, 3) is outside the frame"),
    "star at the edge": ({}, ["--star", "0,3", "--no-recentre"], 2, "at the edge of the frame"),
    "no star": ({}, ["--star", "5,8", "--background", "40"], 2, "no star is found within 16"),
    "star of one": ({}, ["--star", "3"], 2, "argument --star: '3' is neither X,Y"),
    "mask missing": ({}, ["--mask", "no.fits"], 1, "no.fits cannot be opened"),
    "mask shape": (
        {}, ["--mask", "oblong.fits"], 2,
        "--mask oblong.fits has the shape (70, 61) and its image (61, 70); give one that fits",
    ),
    "masks": ({}, ["--mask", "masks.fits"], 2, "--mask masks.fits has the shape (2, 61, 70)"),
    "saturation": ({}, ["--saturation", "-1"], 2, "--saturation must be positive; -1 was given"),
    "saturation nan": ({}, ["--saturation", "nan"], 2, "'nan' is not a finite number"),
    "background": ({}, ["--background", "sky"], 2, "--background is 'sky'; give a number or"),
    "background inf": ({}, ["--background", "-inf"], 2, "--background is -inf; give one finite"),
    "angle": ({}, ["--rotate", "0", "inf"], 2, "--rotate is inf; give one finite number"),
    "angle of words": ({}, ["--rotate", "x"], 2, "argument --rotate: invalid float value: 'x'"),
    "size": ({}, ["--size", "2"], 2, "--size must be a whole number, 3 or more; 2 was given"),
    "size large": ({}, ["--size", "60"], 2, "reaches beyond the frame; give a size of 59 or less"),
    "size rotated": ({}, ["--size", "50", "--rotate", "0", "45"], 2, "rotated by 45 degrees"),
    "picture name": ({}, ["--plot", "a.pdf"], 2, "a name ending in .png, not a.pdf"),
    "picture exists": ({}, ["--plot", "there.png"], 1, "there.png exists; give another name"),
    "picture is output": ({}, ["--plot", "link.png"], 2, "link.png is the output too"),
    "output is a picture": (
        {"output": "x.png"}, [], 2,
        "the output is a FITS file; give it a name ending in .fits, not x.png",
    ),
    "picture is input": (
        {"frame": "there.png"}, ["--plot", "there.png", "--overwrite"], 2, "one of the inputs",
    ),
    "picture folder": ({}, ["--plot", "no/a.png"], 1, "the folder of the output no/a.png"),
    "pictures": ({}, ["--plot", "a.png", "--rotate", *"1" * 17], 2, "draws 16 PSFs at most"),
    "abbreviation": ({}, ["--sat", "3"], 2, "unrecognized arguments: --sat"),
}  # fmt: skip


def contents():
    return {path: os.path.exists(path) and Path(path).read_bytes() for path in os.listdir()}


@pytest.mark.parametrize(("where", "options", "status", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_input_is_refused_and_changes_no_file(capsys, where, options, status, message):
    before = contents()
    assert run(*options, **where) == status
    assert message in complaint(capsys.readouterr())
    assert contents() == before


@pytest.mark.parametrize("options", [["--plot", "there.png"], ["-o", "there.fits"]])
def test_outputs_are_checked_before_the_frame_is_read(capsys, options):
    assert run(*options, frame="no.fits") in (1, 2)
    assert "no.fits" not in complaint(capsys.readouterr())


def test_wrong_use(capsys):
    assert cli.main(["psf"]) == 2
    assert complaint(capsys.readouterr()) == (
        "the following arguments are required: FRAME; see lnocl psf --help"
    )


@pytest.mark.exhaustive
def test_the_help_loads_nothing_heavy():
    script = (
        "import sys; from lnocl.commands.cli import main\n"
        "try: main(['psf', '--help'])\n"
        "finally: print(sorted({'astropy', 'pyopencl', 'scipy', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.splitlines()[-1] == "[]"
