"""Modes of PSFs: against the scatter that they were drawn with, and from the shell to the fit."""

import warnings

import numpy as np
import pytest
from astropy.io import fits

import lnocl
from lnocl.commands import cli
from lnocl.errors import LnoclWarning
from lnocl.psf import find_modes

N = 33
Y, X = np.indices((N, N)) - N // 2
PSF = np.exp(-(X**2 + Y**2) / 8.0)
PSF /= PSF.sum()
WAYS = np.array([X * PSF, 0.1 * (X**2 - Y**2) * PSF])
DRAWS = np.random.default_rng(0).standard_normal((400, 2)) * (0.05, 0.02)
PSFS = PSF + np.tensordot(DRAWS, WAYS, 1)


def test_modes_are_those_that_psfs_were_drawn_with():
    found = find_modes(7.0 * PSFS, 2)  # of any sum
    for mode, way, scale in zip(found.modes, WAYS, (0.05, 0.02), strict=True):
        sign = np.sign((mode * way).sum())
        np.testing.assert_allclose(sign * mode, scale * way, atol=0.12 * abs(scale * way).max())
    np.testing.assert_allclose(found.mean, PSF, rtol=0, atol=0.01 * PSF.max())
    assert found.share == pytest.approx(1.0)
    squares = (found.modes**2).sum(axis=0)
    np.testing.assert_allclose(found.scatter, np.sqrt(squares), rtol=1e-6, atol=1e-12)


def test_one_mode_is_the_largest():
    one, two = find_modes(PSFS, 1), find_modes(PSFS, 2)
    np.testing.assert_array_equal(one.modes[0], two.modes[0])
    powers = (two.modes**2).sum(axis=(1, 2))
    assert powers[0] > powers[1]
    assert one.share == pytest.approx(powers[0] / powers.sum())


def test_equal_psfs_have_modes_of_nothing():
    found = find_modes([PSF] * 3, 2)
    np.testing.assert_allclose(found.modes, 0.0, atol=1e-17)


REFUSED = [
    (PSF, 1, "give a cube of finite numbers"),
    (np.full((3, 5, 5), np.nan), 1, "give a cube of finite numbers"),
    (np.zeros((3, 5, 5)), 1, "psf 0 has no positive sum"),
    (PSFS[:3], 3, "3 modes of 3 PSFs; give 1 mode or more, and more PSFs than modes"),
    (PSFS[:3], 0, "0 modes of 3 PSFs"),
]


@pytest.mark.parametrize(("psfs", "n", "message"), REFUSED)
def test_invalid_psfs_and_numbers_of_modes_are_refused(psfs, n, message):
    with pytest.raises(lnocl.InputError, match=message):
        find_modes(psfs, n)


class TestInTheShell:
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        rng = np.random.default_rng(1)
        frames = [np.pad(1e7 * psf, 16) for psf in PSFS[:12]]
        fits.writeto("frames.fits", rng.normal(frames, 1.0) + 20.0)

    @pytest.mark.exhaustive
    def test_from_frames_to_a_fit(self, capsys):
        words = ["psf", "frames.fits", "--size", str(N), "--modes", "2", "-o", "psf.fits"]
        assert cli.main(words) == 0
        said = capsys.readouterr().out
        assert "the PSFs differ from their mean by" in said
        assert "written to psf.fits: the mean of 12 PSFs of 33 x 33 pixels" in said
        with fits.open("psf.fits", checksum=True) as hdus:
            assert [hdu.name for hdu in hdus] == ["PRIMARY", "MODES", "SCATTER"]
            assert hdus["MODES"].data.shape == (2, N, N)
            assert hdus[0].header["NMODES"] == 2
            scatter = hdus["SCATTER"].data
            norm = np.linalg.norm(hdus[0].data)
        sky = np.full((64, 64), 30.0)
        sky[16 : 16 + N, 16 : 16 + N] += 1e6 * (PSF + 0.03 * WAYS[1] - 0.02 * WAYS[0])
        fits.writeto("image.fits", np.random.default_rng(2).poisson(sky).astype(float))
        words = ["deconvolve", "image.fits", "--psf", "psf.fits", "--star", "32,32", "-o"]
        words += ["out.fits", "--background", "30", "--engine", "numpy", "--n-iter", "3"]
        words += ["--stop", "none", "--refine-psfs", "modes", "--psf-errors", "modes=psf.fits"]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LnoclWarning)
            assert cli.main([*words, "scatter=psf.fits"]) == 0
        with fits.open("out.fits") as hdus:
            assert hdus["PSFFIT"].data.names == ["image", "modes_1", "modes_2"]
            assert hdus[0].header["PSFERR"] == pytest.approx(
                np.linalg.norm(scatter) / norm, rel=0.1
            )

    @pytest.mark.exhaustive
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (["--modes", "12"], "12 modes of 12 PSFs"),
            (["--modes", "1", "--rotate", "0", "90"], "leave --plot, --rotate and --mask out"),
        ],
    )
    def test_invalid_options_for_modes_are_refused(self, options, message, capsys):
        assert cli.main(["psf", "frames.fits", "--size", "15", "-o", "b.fits", *options]) == 2
        assert message in capsys.readouterr().err
