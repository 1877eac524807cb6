"""``lnocl deconvolve --component``: several skies in files, and what is made of them."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS
from commandline import one_complaint

import lnocl
from lnocl.commands import cli
from lnocl.io.saved_results import read_result

N = 30
STAR, FLUXES = (10, 12), (9000.0, 7000.0)
COORDINATES = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 30.0, "CRVAL2": 10.0,
               "CDELT1": -1e-4, "CDELT2": 1e-4, "CRPIX1": 12.0, "CRPIX2": 12.0}  # fmt: skip
COMPONENTS = ["--component", "H\u03b1=1,0", "--component", "continuum=1"]
NAMES = ["H\u03b1", "continuum"]
FILTERS = ["H\u03b1 + continuum", "continuum"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Write images in a line and beside it, of a star, light in the line and light in both."""
    folder, rng = tmp_path_factory.mktemp("line"), np.random.default_rng(2)
    y, x = np.indices((9, 9)) - 4
    psf = np.exp(-(x**2 + y**2) / 3.0)
    psf /= psf.sum()
    for j, (name, flux) in enumerate(zip(("on", "off"), FLUXES, strict=True)):
        mean = np.full((N, N), 30.0)
        mean[8:17, 6:15] += flux * psf
        mean[8:17, 12:21] += 4000.0 * psf  # in both
        mean[2:11, 4:13] += (2500.0 + 3000.0 * (j == 0)) * psf
        fits.writeto(folder / f"{name}.fits", 1.0 * rng.poisson(mean), fits.Header(COORDINATES))
    fits.writeto(folder / "psf.fits", psf)
    (folder / "a.reg").write_text("image\ncircle(9,7,3) # text={knot}\n")
    (folder / "box.reg").write_text("image\nbox(12,13,12,5,0) # text={jet}\n")
    return folder


@pytest.fixture
def words(files, monkeypatch):
    monkeypatch.chdir(files)
    words = ["deconvolve", "on.fits", "off.fits", "--psf", "psf.fits", "--background", "30"]
    words += ["--star", f"{STAR[0]},{STAR[1]}", "--n-iter", "30", "--stop", "none", "--pad", "0"]
    words += ["--smoothing", "0.01", "--psf-error", "0", "--engine", "numpy"]
    return [*words, "-o", "out.fits", "--overwrite", *COMPONENTS]


@pytest.fixture
def result(words):
    assert cli.main([*words, "--quiet", "--residuals"]) == 0


def test_it_is_what_the_library_makes_of_the_files(words, result, capsys):
    images, psf = [fits.getdata(f"{name}.fits") for name in ("on", "off")], fits.getdata("psf.fits")
    components = {NAMES[0]: [1, 0], NAMES[1]: [1, 1]}
    given = {"background": 30.0, "psf_error": 0.0, "components": components}
    found = lnocl.deconvolve(
        lnocl.Observation(images, psf, **given),
        [STAR],
        **{"n_iter": 30, "stop": None, "pad": 0, "smoothing": 0.01, "engine": "numpy"},
    )
    saved = read_result("out.fits")
    np.testing.assert_allclose(saved.extended, found.extended, rtol=1e-12)
    assert saved.extended.shape == saved.noise.shape == (2, N, N)
    assert (saved.component_names, saved.epoch_labels) == (NAMES, FILTERS)
    assert len(saved.stars) == 2
    table = Table.read("out.fits", "COMPONENTS")
    np.testing.assert_allclose(table["flux"], found.extended_flux[0], rtol=1e-9)
    np.testing.assert_allclose(table["flux_error"], found.extended_flux[1], rtol=1e-6)
    words = [word for line in saved.command_words() for word in line]
    assert [words[i + 1] for i, word in enumerate(words) if word == "--component"] == COMPONENTS[
        1::2
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        wcs = WCS(fits.getheader("out.fits")).celestial
    assert (wcs.naxis, wcs.wcs.crval.tolist()) == (2, [30.0, 10.0])


def test_the_answer_names_components_and_filters(words, capsys):
    assert cli.main(words) == 0
    out = capsys.readouterr().out
    assert [line.strip().split("  ")[0] for line in out.splitlines()[1:5]] == [*FILTERS, *NAMES]
    assert "epoch" not in out


@pytest.mark.exhaustive
def test_errors_of_regions_are_of_each_component_and_their_ratio(result, capsys):
    pytest.importorskip("regions", reason="regions is not installed")
    errors = ["errors", "out.fits", "--regions", "a.reg", "--profiles", "box.reg", "--bootstrap"]
    assert cli.main([*errors, "10"]) == 0
    names = ["H\u03b1 knot", "continuum knot", "H\u03b1 / continuum knot"]
    of_stars = [f"star 1 flux in images of {each}" for each in FILTERS]
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[1:6]] == [*names, *of_stars]
    assert re.fullmatch(r".* knot: -?[\d.]+ \+- [\d.]+ \(-?[\d.]+ to -?[\d.]+\)", lines[3])
    with fits.open("out.fits") as hdus:
        assert [hdus[name].data.shape for name in ("ERROR", "BIAS", "SHARE")] == [(2, N, N)] * 3
        ratio, error = hdus["RATIO"].data, hdus["RATIOERR"].data
        assert ratio.shape == error.shape == (1, N, N)
        assert (error[np.isfinite(ratio)] > 0).all()
        regions = hdus["REGIONS"].data
        assert regions["unit"].tolist() == ["electron", "electron", ""]
        np.testing.assert_allclose(regions["x"], 8.0)
        assert regions["flux"][0] > regions["flux"][1] > 1000
        np.testing.assert_array_equal(hdus[0].data, read_result("out.fits").extended)
    assert cli.main([*errors, "11"]) == 0  # goes on from those there
    assert cli.main([*errors, "12", "--seed", "1"]) == 2
    assert "of the regions H" in capsys.readouterr().err
    pytest.importorskip("matplotlib")
    assert cli.main(["plot", "out.fits", "-o", "figures", "--overwrite"]) == 0
    assert "result_profile_1.png" in capsys.readouterr().out


@pytest.mark.exhaustive
def test_sources_are_told_in_images_of_one_filter(result, capsys):
    detect = ["detect", "out.fits", "--quiet"]
    assert cli.main(detect) == 2
    assert one_complaint(capsys.readouterr()).endswith(
        "give --images-of as 'H\u03b1 + continuum' or 'continuum'"
    )
    assert cli.main([*detect, "--images-of", "line"]) == 2
    assert "'line' is no filter of this result: give --images-of as" in one_complaint(
        capsys.readouterr()
    )
    assert cli.main(["detect", "out.fits", "--images-of", FILTERS[0]]) == 0
    assert f" in images of {FILTERS[0]} above " in capsys.readouterr().out
    assert fits.getheader("out.fits", "SIGNAL")["IMAGESOF"] == "H\\u03b1 + continuum"
    assert fits.getdata("out.fits", "SIGNAL").shape == (N, N)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--component", "X"], "--component: 'X' is not NAME=WEIGHT,WEIGHT,..., such as line=1,0"),
        (["--component", "=1"], "--component: '=1' is not NAME=WEIGHT,WEIGHT,..., such as line="),
        (["--component", "a=1,,1"], "'a=1,,1' is not NAME=WEIGHT,WEIGHT,..., such as line=1,0"),
        (["--component", "continuum=1"], "--component has 'continuum' twice; give each component"),
        (["--component", "c=1,1,1"], "--component 'c' has 3 weights for 2 images; give one"),
        (
            ["--component", "c=LAMBDA"],
            "--component 'c' has the weight 'LAMBDA', and on.fits has no",
        ),
    ],
)
def test_what_cannot_be_is_refused(words, capsys, more, told):
    assert cli.main([*words, "--quiet", *more]) == 2
    assert told in one_complaint(capsys.readouterr())


def test_tiles_have_the_components_of_the_whole(words, capsys):
    more, found = ["--spectral-smoothing", "0.5", "--n-iter", "300", "--mu", "1e-3"], []
    for tile in ([], ["--tile", "24"]):
        assert cli.main([*words, "--quiet", *more, *tile]) == 0, capsys.readouterr().err
        found.append(read_result("out.fits"))
    whole, tiles = found
    assert tiles.component_names == NAMES
    difference = abs(tiles.extended - whole.extended)
    assert 0.0 < difference.max() < 5e-3 * whole.extended.max()
    np.testing.assert_allclose(tiles.noise, whole.noise, rtol=0.03)


def test_its_stars_are_taken_once_each(words, result, capsys):
    again = [word for word in words if word not in COMPONENTS]
    again[again.index("--star") : again.index("--star") + 2] = ["--stars", "out.fits"]
    again[again.index("out.fits", again.index("-o"))] = "again.fits"
    assert cli.main(again) == 0
    assert len(read_result("again.fits").stars) == 1


def test_a_table_of_targets_has_components(words, capsys):
    row = {"name": "a", "images": "on.fits off.fits", "psf": "psf.fits", "background": "30"}
    row |= {"star": "10,12", "component": " ".join(COMPONENTS[1::2]), "n_iter": "3"}
    row |= {"stop": "none", "engine": "numpy", "smoothing": "0.01", "psf_error": "0"}
    Table([row]).write("targets.csv", overwrite=True)
    assert cli.main(["batch", "targets.csv", "-o", "batch", "--overwrite", "--quiet"]) == 0
    assert read_result("batch/a.fits").component_names == NAMES


def test_a_run_resumes(words, result):
    whole = read_result("out.fits").extended
    assert cli.main([*words, "--quiet", "--checkpoint", "checkpoint"]) == 0
    assert cli.main([*words, "--quiet", "--resume", "checkpoint"]) == 0
    np.testing.assert_array_equal(read_result("out.fits").extended, whole)


@pytest.mark.exhaustive
def test_a_report_has_a_picture_and_a_row_for_each_component(result, capsys):
    pytest.importorskip("matplotlib")
    assert cli.main(["report", "out.fits", "-o", "out.html", "--overwrite"]) == 0
    page = Path("out.html").read_text("utf-8")
    assert "<h2>Components</h2>" in page
    assert "<th>images of</th>" in page
    assert "<th>epoch</th>" not in page


@pytest.mark.parametrize("part", ["COMPONENTS", "EPOCHS"])
def test_a_file_without_its_names_is_refused(result, capsys, part):
    with fits.open("out.fits") as hdus:
        del hdus[part]
        hdus.writeto("damaged.fits", overwrite=True)
    assert cli.main(["report", "damaged.fits", "-o", "damaged.html"]) == 1
    assert "damaged.fits is not a result" in one_complaint(capsys.readouterr())


def test_the_slices_of_a_cube_have_a_sky_each(files, tmp_path, monkeypatch, capsys):
    """There is no star, so that there are filters without fluxes."""
    monkeypatch.chdir(tmp_path)
    images = [fits.getdata(files / f"{name}.fits") for name in ("on", "off")]
    header = fits.Header({"CTYPE3": "WAVE", "BUNIT": "electron"})
    fits.writeto("cube.fits", np.array(images), header)
    given = ["--psf", str(files / "psf.fits"), "--background", "30", "--engine", "numpy"]
    how = [*given, "--stop", "none", "--n-iter", "3", "--component", "each"]
    how += ["--spectral-smoothing", "0.5", "--smoothing", "0.1"]
    assert cli.main(["deconvolve", "cube.fits", *how, "-o", "out.fits"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[:2]] == ["image"] * 2
    saved = read_result("out.fits")
    assert saved.extended.shape == (2, N, N)
    assert cli.main(["plot", "out.fits", "-o", "pictures"]) == 0
