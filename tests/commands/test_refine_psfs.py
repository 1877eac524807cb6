"""``lnocl deconvolve --refine-psfs``: what is written and said, and what is refused."""

import hashlib
import shlex
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl.commands import cli
from lnocl.core.scene.psf_families import PsfFamilies
from lnocl.io.saved_results import read_result
from lnocl.plotting.beside import draw_beside
from lnocl.studies.figures import view_of

N, STAR = 32, (15, 12)
Y, X = np.indices((N, N))
PSF = np.exp(-((X - 16) ** 2 + (Y - 16) ** 2) / 6.0)
PSF /= PSF.sum()
IDEAL = np.exp(-((X - 16) ** 2 + (Y - 16) ** 2) / 4.0)
MODES = np.array([np.roll(PSF, 1, 0) - PSF, np.roll(PSF, 1, 1) - PSF])
SKY = 200.0 * np.exp(-((X - 15) ** 2) / 6.0 - ((Y - 19) / 5.0) ** 2)
SKY[STAR[::-1]] += 1e5
WORDS = ["deconvolve", "image.fits", "--psf", "psf.fits", "--star", "15,12", "--background", "40",
         "--engine", "numpy", "--n-iter", "20", "--stop", "none"]  # fmt: skip


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    families = PsfFamilies(["jitter"], lnocl.Observation(np.ones((N, N)), PSF))
    (true,) = families.psfs(families.first()._replace(values=np.array([[0.5, 0.1, 0.3]])))
    spectrum = np.fft.rfft2(SKY) * np.fft.rfft2(np.fft.ifftshift(true))
    counts = np.random.default_rng(0).poisson(np.fft.irfft2(spectrum, SKY.shape).clip(0) + 40.0)
    arrays = {"image": counts.astype(float), "psf": PSF, "ideal": IDEAL, "modes": MODES}
    for name, array in arrays.items():
        fits.writeto(f"{name}.fits", array)


def run(*options, output="out.fits"):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.errors.LnoclWarning)
        return cli.main([*WORDS, *options, "-o", output])


@pytest.mark.exhaustive
def test_the_file_has_the_psfs_and_their_parameters(capsys):
    assert run("--refine-psfs", "shift", "jitter") == 0
    assert "lnocl: PSFs refined, shift and jitter fitted: misfit " in capsys.readouterr().err
    observation = lnocl.Observation(fits.getdata("image.fits"), PSF, background=40.0)
    options = {"engine": "numpy", "n_iter": 20, "stop": None, "refine_psfs": ["shift", "jitter"]}
    result = lnocl.deconvolve(observation, [STAR], **options)
    with fits.open("out.fits", checksum=True) as hdus:
        np.testing.assert_array_equal(hdus[0].data, result.extended)
        np.testing.assert_array_equal(hdus["PSFS"].data, result.psfs)
        table = hdus["PSFFIT"].data
        names = ["image", "shift_x", "shift_y", "jitter_xx", "jitter_xy", "jitter_yy"]
        assert list(table.names) == names
        np.testing.assert_array_equal(
            [table[name][0] for name in names[1:]], result.psf_refinement.values[0]
        )
        rings = hdus["PSFERRORS"].data
        np.testing.assert_array_equal(rings["from"][1:], rings["to"][:-1])
        np.testing.assert_array_equal(rings["error"], result.psf_refinement.errors_in_rings)
        np.testing.assert_array_equal(hdus["DOUBTFUL"].data, result.doubtful)
        header = hdus[0].header
    assert [header["REFPSF1"], header["REFPSF2"], header["PSFUSED"]] == ["shift", "jitter", True]
    assert (header["PSFMIS1"], header["PSFMIS2"]) == result.psf_refinement.misfit
    assert header["PSFERR"] == result.psf_refinement.psf_error
    words = shlex.split("\n".join(header["HISTORY"]).replace("\\\n", ""))
    again = words[words.index("lnocl") + 1 :]
    assert cli.main([*again, "--overwrite"]) == 0
    np.testing.assert_array_equal(fits.getdata("out.fits"), result.extended)


@pytest.mark.exhaustive
def test_misfitting_psf_is_refined_when_requested(capsys):
    assert run("--refine-psfs", "jitter") == 0
    assert "lnocl: PSFs refined, jitter fitted: misfit " in capsys.readouterr().err
    assert fits.getheader("out.fits")["PSFUSED"] is True


@pytest.mark.exhaustive
def test_refinement_can_be_turned_off(capsys):
    assert run("--refine-psfs", "none", "--no-refine", "--verbose") == 0
    assert "lnocl: misfit of the PSFs " in capsys.readouterr().err
    header = fits.getheader("out.fits")
    assert (header["PSFUSED"], header["REFPSF1"], header["REFINED"]) == (False, "none", False)


def test_with_a_smoothing_that_is_given_the_file_has_neither():
    assert run("--smoothing", "0") == 0
    with fits.open("out.fits") as hdus:
        assert not {"PSFS", "PSFFIT", "PSFERRORS", "DOUBTFUL"} & {hdu.name for hdu in hdus}
        assert "PSFUSED" not in hdus[0].header


@pytest.mark.exhaustive
def test_files_of_ideal_psfs_and_modes():
    files = ["--psf-errors", "ideal=ideal.fits", "modes=modes.fits"]
    assert run("--refine-psfs", "strehl", "modes", *files) == 0
    with fits.open("out.fits") as hdus:
        assert hdus["PSFFIT"].data.names == ["image", "strehl_power", "modes_1", "modes_2"]
        header = hdus[0].header
    for keyword, path in {"DSUM1": "ideal.fits", "DSUM2": "modes.fits"}.items():
        assert header[keyword] == hashlib.sha256(Path(path).read_bytes()).hexdigest()


@pytest.mark.exhaustive
def test_files_of_pupils_and_scatter():
    fits.writeto("pupil.fits", (np.hypot(X - 16, Y - 16) < 6.0).astype(float))
    fits.writeto("scatter.fits", 0.02 * PSF)
    assert run("--refine-psfs", "pupil", "strehl", "--psf-errors", "pupil=pupil.fits",
               "scatter=scatter.fits") == 0  # fmt: skip
    with fits.open("out.fits") as hdus:
        names = ["image", "strehl_power", *(f"pupil_{i}" for i in range(1, 8))]
        assert hdus["PSFFIT"].data.names == names
        header = hdus[0].header
        assert "--psf-errors pupil=pupil.fits scatter=scatter.fits" in " ".join(
            "\n".join(header["HISTORY"]).replace("\\\n", "").split()
        )
        assert header["PSFERR"] == pytest.approx(0.02, rel=0.1)  # of other PSFs
        assert hdus["DOUBTFUL"].data[STAR[::-1]] == 1


@pytest.mark.exhaustive
def test_doubtful_pixels_are_saved_and_outlined(capsys):
    fits.writeto("scatter.fits", 0.05 * PSF)
    assert run("--psf-errors", "scatter=scatter.fits") == 0
    assert cli.main(["plot", "out.fits", "--output", "figures"]) == 0
    saved = read_result("out.fits")
    np.testing.assert_array_equal(saved.doubtful, fits.getdata("out.fits", "DOUBTFUL") == 1)
    figure = draw_beside({"found": view_of(saved)})
    lines = [type(artist).__name__ for axis in figure.axes[:2] for artist in axis.collections]
    assert lines == 2 * ["QuadContourSet"]


REFUSED = {
    "unknown": (["--refine-psfs", "tilt"], "invalid choice: 'tilt'"),
    "no ideal": (["--refine-psfs", "strehl"], "--refine-psfs strehl needs --psf-errors ideal"),
    "no modes": (["--refine-psfs", "modes"], "--refine-psfs modes needs --psf-errors modes"),
    "a missing file": (
        ["--refine-psfs", "modes", "--psf-errors", "modes=no.fits"], "no.fits cannot be opened",
    ),
    "modes of another shape": (
        ["--psf-errors", "modes=small.fits"], "--psf-errors modes has shape (2, 5, 5)",
    ),
    "two files of modes": (
        ["--psf-errors", "modes=modes.fits", "modes=modes.fits"],
        "the modes are those of all images; give one file of --psf-errors modes",
    ),
    "a file of no kind": (
        ["--psf-errors", "modes.fits"],
        "'modes.fits' is not KIND=FILE; kinds are ideal, pupil, modes, scatter",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("options", "message"), REFUSED.values(), ids=REFUSED)
def test_invalid_refinement_options_are_refused(options, message, capsys):
    fits.writeto("small.fits", np.ones((2, 5, 5)))
    assert run(*options) in (1, 2)
    assert message in capsys.readouterr().err


@pytest.mark.exhaustive
def test_psf_error_left_after_refinement_shows_in_the_verdict(capsys):
    sky = SKY.copy()
    sky[STAR[::-1]] = 3e6
    ripple = 1.0 + 0.15 * np.cos(X * 0.9) * np.cos(Y * 0.7)
    true = PSF * ripple / (PSF * ripple).sum()
    spectrum = np.fft.rfft2(sky) * np.fft.rfft2(np.fft.ifftshift(true))
    counts = np.random.default_rng(0).poisson(np.fft.irfft2(spectrum, sky.shape).clip(0) + 40.0)
    fits.writeto("image.fits", counts.astype(float), overwrite=True)
    assert run("--refine-psfs", "shift") == 0
    assert "the model fits\n" not in capsys.readouterr().out
    assert 0.01 < fits.getheader("out.fits")["PSFERR"] < 0.25
