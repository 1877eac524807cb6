"""``lnocl deconvolve --halo``: halos in files, their amounts in the output and in the words."""

import halo_scenes
import numpy as np
import pytest
from astropy.io import fits
from halo_scenes import AMOUNTS, STAR

import lnocl
from lnocl.commands import cli
from lnocl.io.saved_results import read_result


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Write images with halos, their PSFs and the halos; return the beginning of a command."""
    monkeypatch.chdir(tmp_path)
    given = halo_scenes.observation()
    for name, array in (
        ("images", given.images),
        ("psfs", halo_scenes.psfs()),
        ("halos", halo_scenes.speckles()),
        ("mean", halo_scenes.speckles().mean(axis=0)),
        ("small", np.ones((4, 5))),
    ):
        fits.writeto(f"{name}.fits", array)
    words = ["deconvolve", "images.fits", "--psf", "psfs.fits", "--background", "20"]
    words += ["--star", f"{STAR[0]},{STAR[1]}", "--n-iter", "12", "--stop", "none"]
    return [*words, "--engine", "numpy", "-o", "out.fits"]


@pytest.mark.exhaustive
def test_amounts_are_printed_and_in_the_file(command, capsys):
    assert cli.main([*command, "--halo", "halos.fits"]) == 0
    captured = capsys.readouterr()
    (line,) = (each for each in captured.out.splitlines() if each.startswith("halo 1 "))
    assert "electrons in 3 images, with errors of " in line
    found = lnocl.deconvolve(
        halo_scenes.observation(), [STAR], n_iter=12, stop=None, engine="numpy"
    )
    saved = read_result("out.fits")
    table = saved.tables["HALOS"]
    assert table["halo"].tolist() == [1, 1, 1]
    assert table["image"].tolist() == [1, 2, 3]
    np.testing.assert_allclose(table["flux"], found.halo_fluxes[0], rtol=1e-9)
    np.testing.assert_allclose(table["flux_error"], found.halo_flux_errors[0], rtol=1e-6)
    np.testing.assert_allclose(table["flux"], AMOUNTS[0], rtol=0.015)
    assert len(saved.stars) == 1
    words = " ".join(saved.commands().replace("\\\n", "").split())
    assert " --halo halos.fits" in words
    assert saved.header["HSUM1"]
    found.write("other.fits")
    np.testing.assert_allclose(
        read_result("other.fits").tables["HALOS"]["flux"], found.halo_fluxes[0], rtol=1e-12
    )


@pytest.mark.exhaustive
def test_several_halos_one_for_all_images_and_a_level(command, capsys):
    assert cli.main([*command, "--halo", "mean.fits", "--halo", "flat", "--quiet"]) == 0
    table = fits.getdata("out.fits", "HALOS")
    assert table["halo"].tolist() == [1, 1, 1, 2, 2, 2]
    assert cli.main([*command, "--halo", "flat", "--overwrite"]) == 0
    assert "halo 1 " in capsys.readouterr().out


def read_result_names(path):
    """Return the names of the extensions of a file."""
    with fits.open(path) as hdus:
        return [each.name for each in hdus]


@pytest.mark.exhaustive
def test_errors_of_halos_by_replicas(command, capsys):
    assert cli.main([*command, "--halo", "halos.fits", "--quiet"]) == 0
    assert cli.main(["errors", "out.fits", "--bootstrap", "10", "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    with fits.open("out.fits") as hdus:
        (names,) = (each.data["name"] for each in hdus if each.name == "ERRORS")
    assert [name.strip() for name in names][1:] == [f"halo 1 image {j}" for j in (1, 2, 3)]
    assert cli.main(["errors", "out.fits", "--bootstrap", "11", "--quiet"]) == 0
    assert len(fits.getdata("out.fits", "REPLICAS")) == 11


WRONG = {
    "--halo small.fits": "small.fits has the shape (1, 4, 5) and the images (3, 48, 48)",
    "--halo nothing.fits": "nothing.fits",
    "--halo halos.fits --tile 40": "a tile cannot tell the --halo in it from a smooth sky",
}


@pytest.mark.parametrize("words", WRONG)
def test_wrong_uses_are_one_clear_line(command, words, capsys):
    assert cli.main([*command, *words.split()]) in (1, 2)
    errors = [each for each in capsys.readouterr().err.splitlines() if "error: " in each]
    assert len(errors) == 1
    assert WRONG[words] in errors[0]


@pytest.mark.exhaustive
def test_no_halo_leaves_no_table(command):
    assert cli.main([*command, "--quiet"]) == 0
    assert "HALOS" not in read_result_names("out.fits")
