"""``lnocl deconvolve`` on images that are turned: rolls by their coordinates, field rotation."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from matplotlib.figure import Figure
from scenes import named
from turned_scenes import gaussian

import lnocl
from lnocl.commands import cli
from lnocl.errors import InputError
from lnocl.io.fitsread import Stack
from lnocl.io.places import read_epochs
from lnocl.io.saved_results import read_result
from lnocl.plotting.result import draw_result
from lnocl.studies.figures import view_of

N = 48
CENTRE = np.array([24.0, 24.0])
BLOB, STAR = np.array([33.0, 15.0]), np.add(CENTRE, (0.2, -0.3))
ANGLES = [0.0, 12.0, 140.0]


@pytest.fixture
def frames(tmp_path, monkeypatch):
    """Write three rolls of one sky, and their PSF."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(6)
    y, x = np.indices((N, N))
    for j, each in enumerate(lnocl.rotations(ANGLES, CENTRE)):
        mean = np.full((N, N), 10.0)
        for at, flux, width in ((STAR, 2e4, 2.0), (BLOB, 3e4, 8.0)):
            there = each[:, :2] @ at + each[:, 2]
            mean += flux * gaussian(x - there[0], y - there[1], width * np.eye(2))
        a = np.radians(ANGLES[j])
        wcs = WCS(naxis=2)
        wcs.wcs.ctype = ["RA---TAN", "DEC--TAN"]
        wcs.wcs.crpix = CENTRE + 1
        wcs.wcs.crval = [80.0, 20.0]
        turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
        wcs.wcs.cd = np.diag([-1e-5, 1e-5]) @ turn.T
        header = wcs.to_header()
        header.update({"PARANG": -ANGLES[j], "BUNIT": "electron"})
        fits.writeto(f"{j}.fits", rng.poisson(mean).astype("f4"), header)
    v, u = np.indices((21, 21)) - 10
    fits.writeto("psf.fits", gaussian(u, v, 2.0 * np.eye(2)))
    return [f"{j}.fits" for j in range(3)]


@pytest.mark.parametrize(
    "places",
    named(
        {
            "wcs": ("--align", "wcs"),
            "angle": ("--angle", "PARANG"),
            "centre": ("--angle", "PARANG", "--centre", "24,24"),
        },
        "wcs",
    ),
)
def test_rolls(frames, places, capsys):
    command = ["deconvolve", *frames, "--psf", "psf.fits", "--background", "10", "--n-iter", "40"]
    command += ["--star", f"{STAR[0]},{STAR[1]}", "--stop", "none", "--engine", "numpy"]
    command += [*places, "--residuals", "-o", "out.fits"]
    assert cli.main(command) == 0
    capsys.readouterr()
    with fits.open("out.fits") as hdus:
        extended, header = hdus[0].data, hdus[0].header
        light = extended[5:26, 23:44]
        y, x = np.indices(light.shape)
        middle = np.array([(light * x).sum(), (light * y).sum()]) / light.sum() + (23, 5)
        np.testing.assert_allclose(middle, BLOB, atol=0.15)
        assert hdus["STARS"].data["flux"] == pytest.approx(2e4, rel=0.03)
        assert ("CRVAL1" in header) == (places[0] == "--align")
        residuals = hdus["RESIDUALS"].data
        assert abs(residuals.std(axis=(1, 2)) - 1.0).max() <= 0.1
    saved = read_result("out.fits")
    expected = lnocl.rotations(ANGLES, CENTRE)
    np.testing.assert_allclose(saved.turns, expected[:, :, :2], atol=1e-6)
    np.testing.assert_allclose(saved.offsets, expected[:, :, 2], atol=2e-4)
    view = view_of(saved)
    assert isinstance(draw_result(view), Figure)
    there = np.array(view.place(2, STAR))
    image = view.images[2]
    y, x = np.unravel_index(int(image.argmax()), image.shape)
    assert np.hypot(x - there[0], y - there[1]) <= 1.0


def test_a_centre_is_in_pixels(frames, capsys):
    command = ["deconvolve", *frames, "--psf", "psf.fits", "--angle", "PARANG", "-o", "out.fits"]
    assert cli.main([*command, "--centre", "4h20m,19d"]) == 2
    assert "'4h20m,19d' is not X,Y in pixels" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_epochs(frames, capsys):
    """Three nights, the star's flux in each in the table, and one line and one circle for it."""
    command = ["deconvolve", *frames, "--psf", "psf.fits", "--background", "10", "--n-iter", "40"]
    command += ["--star", f"{STAR[0]},{STAR[1]}", "--stop", "none", "--engine", "numpy"]
    command += ["--align", "wcs", "--epoch", "each", "--residuals", "-o", "out.fits"]
    assert cli.main(command) == 0
    said = capsys.readouterr().out
    assert said.startswith("epoch  star 1 (24.2, 23.7)  electrons, ")
    assert [line.split()[0] for line in said.splitlines()[1:5]] == ["0", "1", "2", "mean"]
    stars = fits.getdata("out.fits", "STARS")
    assert stars["epoch"].tolist() == [0, 1, 2]
    assert stars["flux"] == pytest.approx(2e4, rel=0.04)
    assert len(view_of(read_result("out.fits")).stars) == 1


def test_images_of_a_night_are_one_epoch_with_the_date_of_its_first():
    hours = (23, 27, 71.9, 60.1, 73)  # from the first of March on
    headers = [fits.Header({"MJD-OBS": 61100 + hour / 24}) for hour in hours]
    stack = Stack(np.zeros((5, 2, 2)), headers, [], [], [f"{j}.fits" for j in range(5)])
    labels = read_epochs(stack, ["night"])
    assert labels == ["2026-03-01", "2026-03-01", "2026-03-03", "2026-03-03", "2026-03-04"]
    del headers[3]["MJD-OBS"]
    with pytest.raises(InputError, match=r"3\.fits has no date in its header; give epoch each"):
        read_epochs(stack, ["night"])


@pytest.mark.exhaustive
def test_epochs_by_a_keyword(frames, capsys):
    for path, night in zip(frames, ("2026-01-01", "2026-01-02", "2026-01-01"), strict=True):
        fits.setval(path, "DATE-OBS", value=night)
    command = ["deconvolve", *frames, "--psf", "psf.fits", "--stop", "none", "--n-iter", "1"]
    command += ["--star", "24,24", "--align", "wcs", "--engine", "numpy", "-o", "out.fits"]
    assert cli.main([*command, "--epoch", "DATE-OBS"]) == 0
    assert fits.getdata("out.fits", "STARS")["epoch"].tolist() == [0, 1]
    assert cli.main([*command, "--epoch", "NIGHT", "--overwrite"]) == 2
    assert "0.fits has no NIGHT in its header; give --epoch each" in capsys.readouterr().err
    assert cli.main([*command, "--epoch", "1", "2", "--overwrite"]) == 2
    assert "2 epochs for 3 images; give each, a keyword, or a label" in capsys.readouterr().err
