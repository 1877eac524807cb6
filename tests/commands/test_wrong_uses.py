"""Wrong uses that newcomers made, each with the lines that say what to type next.

wrong_uses.txt has them; they were read by somebody who knew nothing of the code. A line that ends
in "..." may go on.
"""

import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from commandline import gaussian

from lnocl.commands import cli

USES = re.findall(
    r"^\$ lnocl (.+)\n((?:[^$\n].*\n?)+)",
    (Path(__file__).parent / "wrong_uses.txt").read_text(),
    re.MULTILINE,
)
N = 64
WCS = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 65.0, "CRVAL2": 19.5,
       "CRPIX1": 32.0, "CRPIX2": 32.0, "CDELT1": -2e-5, "CDELT2": 2e-5}  # fmt: skip


def save(name, data, **cards):
    fits.writeto(f"{name}.fits", data, fits.Header(cards))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder of files, few of which are right."""
    here = tmp_path_factory.mktemp("wrong")
    chance, before = np.random.default_rng(1), os.getcwd()
    os.chdir(here)
    psf = gaussian(31, 15, 15)
    light = 60.0 + 2e5 * gaussian(N, 32, 30) + 3e4 * gaussian(N, 20, 44, 4.0)
    image = chance.poisson(light).astype("f4")
    save("image", image, BUNIT="electron", EXPTIME=300.0, **WCS)
    save("psf", psf)
    save("rate", image / 300, BUNIT="electron/s", EXPTIME=300.0)
    save("mjy", image / 5000, BUNIT="MJy/sr")
    save("adu", image / 2.5, BUNIT="adu", GAIN=2.5)
    save("nounit", image / 300)
    save("subtracted", image - 60)
    save("off_psf", gaussian(31, 17, 14))
    save("wide_psf", gaussian(31, 15, 15, 3.0))
    save("zero_psf", 0.0 * psf)
    save("nan_psf", np.where(psf == psf.max(), np.nan, psf))
    save("neg_psf", psf - 1.5 * psf.mean())
    save("energy", np.stack([image] * 3), CTYPE3="ENERGY")
    save("rgb", np.stack([image] * 3, -1))
    save("cube4", np.stack([image[None]] * 2))
    save("other", image[:50])
    save("rms", np.full((N, N), 5.0, "f4"))
    save("ivm", np.full((N, N), 1e4, "f4"))
    save("negrms", np.full((N, N), -5.0, "f4"))
    save("mask_inv", np.ones((N, N), "i2"))
    save("smallmask", np.zeros((5, 5), "i2"))
    chips = [fits.ImageHDU(image, name="SCI", ver=version) for version in (1, 2)]
    fits.HDUList([fits.PrimaryHDU(), *chips]).writeto("chips.fits")
    flags = (chance.random((N, N)) < 0.3).astype("i2") * 4
    science = fits.ImageHDU(image, fits.Header({"BUNIT": "electron"}), name="SCI")
    fits.HDUList([fits.PrimaryHDU(), science, fits.ImageHDU(flags, name="DQ")]).writeto("dq.fits")
    Path("nocol.csv").write_text("foo,bar\n1,2\n")
    Path("else.csv").write_text("x,y,ra,dec\n33,31,65.1,19.5\n")
    Path("text.txt").write_text("hello\n")
    Path("trunc.fits").write_bytes(Path("image.fits").read_bytes()[:6000])
    os.chdir(before)
    return here


def is_said(line, said):
    said = [" ".join(each.split()) for each in said]  # columns are as wide as their texts
    if line.endswith("..."):
        return any(each.startswith(line.removesuffix("...")) for each in said)
    return line in said


def test_there_are_forty_and_more():
    assert len(USES) >= 40


# Runs that are made are CI's.
CASES = [
    pytest.param(
        command,
        lines,
        id=command,
        marks=[] if "lnocl: error: " in lines else [pytest.mark.exhaustive],
    )
    for command, lines in USES
]


@pytest.mark.parametrize(("command", "lines"), CASES)
def test_wrong_use_is_explained_with_a_remedy(command, lines, folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    words = shlex.split(command.replace(";", r"\;"))
    if words[0] == "deconvolve" and "--device" not in words:
        words += ["--engine", "numpy"]  # which builds no programs
    if words[0] == "deconvolve" and "--star" in words:
        words += ["--psf-error", "0.03"]  # the default
    status = cli.main(words)
    captured = capsys.readouterr()
    said = captured.err.splitlines() + captured.out.splitlines()
    for line in lines.splitlines():
        assert is_said(line, said), said
    assert (status > 0) == ("lnocl: error: " in lines)
    # Nothing is written but the output, and no file that was there is changed.
    written = {path.name for path in folder.iterdir()} - set(before)
    assert written <= {"out.fits"}
    assert ("out.fits" in written) == (status == 0)
    Path("out.fits").unlink(missing_ok=True)
    after = {path.name: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert after == before
