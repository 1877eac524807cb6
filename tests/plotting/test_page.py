"""The page of a result: complete in itself, small, and with what the file says, escaped."""

import base64
import dataclasses
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from result_views import make_view

from lnocl.commands import cli
from lnocl.io import fitswrite
from lnocl.io.parts import Column
from lnocl.plotting import report
from lnocl.plotting.report import make_report
from lnocl.studies import reports

pytest.importorskip("matplotlib")


def data_of(page):
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)
    return json.loads(text)


def codes_of(layer):
    """Return the codes of a picture, the first row below."""
    from PIL import Image

    return np.array(Image.open(io.BytesIO(base64.b64decode(layer["png"]))))[::-1]


def decoded(layer):
    """Return the values of a picture as the page's own script reads them; bad pixels are NaN."""
    codes = codes_of(layer).astype(float)
    step = (codes - 1) / 254
    low, high, scale = layer["low"], layer["high"], layer["scale"]
    if scale:
        values = low + scale * np.sinh(step * np.arcsinh((high - low) / scale))
    else:
        values = low + step * (high - low)
    return np.where(codes == 0, np.nan, values)


def test_its_pictures_are_the_arrays():
    view = make_view(p=2)
    view.images[0, 3, 4] = view.residuals[0, 3, 4] = np.nan
    data = data_of(make_report(view, "a"))
    whole = data["regions"][0]
    assert [layer["name"] for layer in whole["images"][0]] == ["image", "model", "residuals"]
    for j in range(2):
        for layer, cube in zip(
            whole["images"][j], (view.images, view.models, view.residuals), strict=True
        ):
            low, high = layer["low"], layer["high"]
            shown = decoded(layer)
            np.testing.assert_array_equal(np.isnan(shown), np.isnan(cube[j]))
            # Half a step of asinh, which has 254, is wider where it is steeper.
            tolerance = 0.03 * abs(cube[j].clip(low, high) - low) + 0.01 * (high - low)
            assert np.nanmax(abs(shown - cube[j].clip(low, high)) / tolerance) < 1
    source = decoded(whole["sources"][0])
    assert abs(source - view.extended).max() < 0.02
    assert data["stars"] == [[10.0, 20.0]]
    # The region of the star begins where its pixels do.
    zoom = data["regions"][1]
    assert (zoom["name"], zoom["sources"][0]["x"], zoom["sources"][0]["y"]) == ("star 1", 0, 0)
    assert decoded(zoom["sources"][0]).shape == (45, 35)


def test_the_offset_of_an_image_moves_its_corner():
    view = make_view(p=2, stars=[(40.0, 30.0)], offsets=np.array([[0.0, 0.0], [5.0, -3.0]]))
    zoom = data_of(make_report(view, "a"))["regions"][1]
    assert (zoom["images"][1][0]["x"], zoom["images"][1][0]["y"]) == (16.0, 6.0)
    assert (zoom["sources"][0]["x"], zoom["sources"][0]["y"]) == (16, 6)


@pytest.mark.parametrize("oversample", [1, 2])
def test_doubtful_pixels_are_outlined_on_the_page(oversample):
    doubtful = np.zeros((60 * oversample, 70 * oversample), bool)
    doubtful[20 * oversample : 30 * oversample, 5 * oversample : 9 * oversample] = True
    view = make_view(p=0, doubtful=doubtful, extended=1.0 * doubtful, oversample=oversample)
    for region in data_of(make_report(view, "a"))["regions"]:
        light = decoded(region["sources"][0])
        np.testing.assert_array_equal(codes_of(region["sources"][0]["doubtful"]) == 1, light > 0)
        assert light.any()
    assert "doubtful" not in data_of(make_report(make_view(p=0), "a"))["regions"][0]["sources"][0]


def test_components_and_their_ratio_are_layers_of_one_stretch():
    extended = np.random.default_rng(4).uniform(1.0, 5.0, (2, 60, 70))
    noise = np.full(extended.shape, 0.2)
    noise[1, :20] = 9.0
    view = make_view(p=1, names=["residuals", "continuum"], extended=extended, noise=noise)
    for region in data_of(make_report(view, "a"))["regions"]:
        one, other, ratio = region["sources"]
        assert [each["name"] for each in region["sources"]] == [
            *("residuals", "continuum", "residuals / continuum")
        ]
        assert (one["high"], one["palette"]) == (other["high"], other["palette"])
        assert (ratio["unit"], ratio["label"], ratio["scale"]) == ("", "residuals / continuum", 0)
    there = data_of(make_report(view, "a"))["regions"][0]["sources"]
    for layer, sky in zip(there, extended, strict=False):
        assert abs(decoded(layer) - sky).max() < 0.15
    found = decoded(there[2])
    assert np.isnan(found[:20]).all()
    expected = (extended[0] / extended[1])[20:].clip(0.0, there[2]["high"])
    np.testing.assert_allclose(found[20:], expected, atol=0.01)


def test_stars_of_a_turned_image_are_where_it_sees_them():
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    view = make_view(p=2, stars=[(40.0, 30.0), (45.0, 33.0)], star_fluxes=np.ones(2),
                     turns=np.array([np.eye(2), turn]),
                     offsets=np.array([[0.0, 0.0], [73.0, -12.0]]))  # fmt: skip
    region = data_of(make_report(view, "a"))["regions"][1]
    layer, turned = region["images"][1][0], np.array(region["turned"][1])
    places = [turned @ (*star, 1.0) for star in view.stars]
    corner = layer["x"], layer["y"]
    np.testing.assert_allclose(places[0], view.stars[0])
    first = np.array(view.place(1, view.stars[0])) - (24.0, 24.0)  # the region begins there
    for star, place in zip(view.stars, places, strict=True):
        np.testing.assert_allclose(place - corner, view.place(1, star) - first)


def test_an_image_that_does_not_see_a_star_has_no_picture_of_it():
    view = make_view(p=2, offsets=np.array([[0.0, 0.0], [-400.0, 0.0]]))
    images = data_of(make_report(view, "a"))["regions"][1]["images"]
    assert len(images[0]) == 3
    assert images[1] == []


@pytest.mark.exhaustive
@pytest.mark.parametrize(("p", "side"), [(1, 1400), (4, 800), (20, 300)])
def test_it_is_small_whatever_the_images(p, side):
    page = make_report(make_view(p=p, n_stars=7, shape=(side, side)), "a")
    assert len(page) < 3e6
    step = data_of(page)["regions"][0]["step"]
    assert step > 1
    assert f"blocks of {step} x {step} pixels" in page


def test_a_long_frame_is_shown():
    page = make_report(make_view(p=20, n_stars=0, shape=(2, 60000)), "a")
    assert len(page) < 3e6
    assert decoded(data_of(page)["regions"][0]["sources"][0]).shape[0] == 1


def test_residuals_of_blocks_are_over_the_noise_of_blocks():
    view = make_view(p=1, n_stars=0, shape=(1400, 1400))
    residuals = decoded(data_of(make_report(view, "a"))["regions"][0]["images"][0][2])
    assert np.std(residuals) == pytest.approx(1.0, abs=0.02)


def test_it_needs_no_other_file_and_evaluates_nothing_of_the_result():
    wicked = "</script><script>alert(1)</script><img src=http://example.com/a.png>"
    page = make_report(
        dataclasses.replace(make_view(p=1), unit=wicked),
        wicked,
        [wicked, "", f"warning: {wicked}", wicked],
        {"Stars": {wicked: [wicked]}},
        [("OBJECT", wicked, wicked)],
        wicked,
    )
    assert "<script>alert" not in page
    assert "<img src=http" not in page
    assert page.count("</script>") == 2
    assert len(re.findall(r"<ul class='warning'><li>warning: ", page)) == 1
    links = re.findall(r"""(?:src|href)\s*=\s*["']?([^"'> ]{0,30})""", page)
    assert links
    assert all(link.startswith("data:") for link in links if "example.com" not in link)
    assert "default-src 'none'" in page


def messages(*lines):
    return [Column("message", lines)]


class TestCommand:
    @pytest.fixture(autouse=True)
    def _folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        cube, said = np.ones((1, 32, 32)), ["the model fits", "", "gain 2", "warning: it is noisy"]
        fitswrite.write_result(
            "a.fits",
            np.ones((32, 32)),
            [(3, 4)],
            [7.5],
            {
                "MODELS": cube * np.arange(1, 33),
                "RESIDUALS": cube,
                "ELECTRONS": 2 * cube[:, :1, :1],
                "MESSAGES": messages(*said),
            },
            unit="adu",
            cards=[("OBJECT", "RW Aur", "")],
            commands=[["cd", "/home/me/" + "data" * 30], ["lnocl", "deconvolve", "b.fits"]],
        )

    def test_a_result_becomes_a_page(self, capsys):
        assert cli.main(["report", "a.fits", "-o", "a.html"]) == 0
        assert capsys.readouterr().out == "written to a.html: open it in a browser\n"
        page = Path("a.html").read_text()
        for part in ("<title>a.fits: RW Aur</title>", "lnocl deconvolve b.fits", "the model fits",
                     "<pre>the model fits</pre>",
                     "<ul class='warning'><li>warning: it is noisy", "<li>gain 2</li>",
                     "<th>flux (adu)</th>", "<td>7.50</td>"):  # fmt: skip
            assert part in page
        assert "/home/me" not in page
        assert "datadata" not in page
        whole, _ = data_of(page)["regions"]
        layers = [*whole["images"][0], whole["sources"][0]]
        assert [layer["unit"] for layer in layers] == ["adu", "adu", "sigma", "adu"]
        # 2 electrons are an adu; an image is its model and a residual of one standard deviation.
        image, model, *_ = map(decoded, layers)
        assert (image[0, -1], model[0, -1]) == pytest.approx(((32 + 32**0.5) / 2, 16), rel=0.02)

    def test_a_star_that_was_moved_over_the_edge_is_shown(self):
        cube = np.ones((1, 32, 32))
        said = {"MESSAGES": messages("café \\ tab")}
        fitswrite.write_result("b.fits", cube[0], [(-1, 4)], [7.5], said)
        with fits.open("b.fits", mode="append") as file:
            file.append(fits.ImageHDU(1e308 * cube, name="MODELS"))
            file.append(fits.ImageHDU(np.inf * cube, name="RESIDUALS"))
        assert cli.main(["report", "b.fits", "-o", "b.html"]) == 0
        page = Path("b.html").read_text()
        assert data_of(page)["stars"] == [[-1.0, 4.0]]
        assert "café \\ tab" in page

    def test_report_without_models_names_the_missing_models(self, capsys):
        fitswrite.write_result("b.fits", np.ones((32, 32)), [], [])
        assert cli.main(["report", "b.fits", "-o", "b.html"]) == 0
        page = Path("b.html").read_text()
        assert "The file has no models and residuals: repeat the run with both." in page
        assert data_of(page)["regions"][0]["images"] == []

    def test_verdict_comes_first_and_appears_once(self):
        fault = "the model does not fit at 1 of 1 star, (3, 4): give a better PSF"
        said = ["star 1  7.5 adu", f"trust   no: {fault}", "        a source is not named"]
        said += ["9 steps", "", f"warning: {fault}", "warning: it is noisy"]
        fitswrite.write_result("b.fits", np.ones((8, 8)), [], [], {"MESSAGES": messages(*said)})
        page = reports.report("b.fits")
        assert f"<ul class='trust'><li>no: {fault}</li><li>a source is not named</li></ul>" in page
        assert "<pre>star 1  7.5 adu\n9 steps</pre>" in page
        assert "<ul class='warning'><li>warning: it is noisy</li></ul>" in page

    def test_values_have_errors_and_units_or_are_marked_unknown(self):
        columns = [Column("flux_error", [310.0, np.nan, 25.0, 25.0], "adu"),
                   Column("epoch", [0.0, 1.0, 0.0, 1.0]),
                   Column("ra", np.full(4, 65.4891), "deg")]  # fmt: skip
        parts = {"EPOCHS": [Column("label", ["May", "June"])]}
        places, fluxes = [(3, 4), (3, 4), (9.256, 9), (9.256, 9)], [181726.0, 18e4, 2500.0, np.nan]
        fitswrite.write_result(
            "b.fits", np.ones((16, 16)), places, fluxes, parts, star_columns=columns, unit="adu"
        )
        page = reports.report("b.fits")
        head = "star", "x (pix)", "y (pix)", "flux (adu)", "epoch", "ra (deg)"
        assert "".join(f"<th>{name}</th>" for name in head) in page
        rows = [
            ("1", "3.00", "4.00", "181 730 ± 310", "May", "65.489100"),
            ("1", "3.00", "4.00", "180000, error unknown", "June", "65.489100"),
            ("2", "9.26", "9.00", "2 500 ± 25", "May", "65.489100"),
            ("2", "9.26", "9.00", "unknown, error unknown", "June", "65.489100"),
        ]
        for row in rows:
            assert "".join(f"<td>{cell}</td>" for cell in row) in page

    @pytest.mark.parametrize("unit", ["ct", "electron"])
    def test_electrons_are_named_whatever_the_table_calls_them(self, unit):
        columns = [Column(name, [3.0]) for name in "xy"]
        columns += [Column("flux", [50.0], unit), Column("kind", ["point"])]
        fitswrite.write_result("b.fits", np.ones((8, 8)), [], [], {"DETECTIONS": columns})
        assert "<th>flux (electron)</th>" in reports.report("b.fits")

    def test_page_has_sections_for_measured_tables_only(self):
        regions = [Column("name", ["ring"]), Column("x", [4.0], "pix"), Column("flux", [50.0])]
        regions += [Column("error", [3.0]), Column("unit", ["adu"]), Column("note", [""])]
        errors = [Column("name", ["star 1 flux", "jet flux"]), Column("at", [np.nan, 3.0]),
                  Column("unit", ["adu", "adu"]), Column("note", ["", ""]),
                  Column("value", [9.0, 1.0]), Column("bias", [1.0, 0.0]),
                  Column("error", [2.0, 0.5]), Column("error_noise", [0.0123, 0.5]),
                  Column("low95", [4.1234, 0.0]), Column("share", [np.nan, 1.0])]  # fmt: skip
        parts = {"REGIONS": regions, "ERRORS": errors}
        fitswrite.write_result("b.fits", np.ones((16, 16)), [], [], parts, unit="adu")
        page = reports.report("b.fits")
        titles = ["Can it be trusted?", "Pictures", "Regions", "Errors", "How to make it again"]
        assert re.findall("<h2>(.*?)</h2>", page) == titles
        assert "<td>ring</td><td>4.00</td><td>50.0 ± 3.0</td><td>adu</td></tr>" in page
        row = "star 1 flux", "8.0 ± 2.0", "adu", "0.012", "4.1", "\u2013"
        assert "".join(f"<td>{cell}</td>" for cell in row) in page
        assert "jet flux" not in page  # a slice of a profile, which is drawn
        names = "x", "y", "flux", "kind"
        empty = {"REGIONS": [Column("name", np.array([], "U4"))],
                 "DETECTIONS": [Column(name, np.zeros(0)) for name in names]}  # fmt: skip
        fitswrite.write_result("none.fits", np.ones((16, 16)), [], [], empty)
        page = reports.report("none.fits")
        assert re.findall("<h2>(.*?)</h2>", page)[2:] == ["Detections", "How to make it again"]
        assert "<h2>Detections</h2><p>None.</p>" in page  # they were looked for

    @pytest.mark.parametrize("oversample", [1, 2])
    def test_axes_of_images_with_coordinates_are_in_arcsec(self, oversample):
        turn = np.array([[-np.cos(0.3), np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
        wcs = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 359.9999,
                           "CRVAL2": 60.0, "CRPIX1": 9.0, "CRPIX2": 9.0,
                           "CDELT1": 2.5e-4, "CDELT2": 2.5e-4})  # fmt: skip
        wcs.update({f"PC{i + 1}_{k + 1}": value for (i, k), value in np.ndenumerate(turn)})
        sky = np.ones((16 * oversample, 16 * oversample))
        fitswrite.write_result("b.fits", sky, [(3, 4)], [7.5], wcs=wcs, oversample=oversample)
        found = data_of(reports.report("b.fits"))["arcseconds"]
        np.testing.assert_allclose(found, 0.9 * turn, atol=2e-4)
        assert data_of(reports.report("a.fits"))["arcseconds"] is None

    @pytest.mark.parametrize(
        ("arguments", "status", "message"),
        [
            (["a.fits", "-o", "a.png"], 2, "give it a name ending in .html, not a.png"),
            (["a.fits", "-o", "there.html"], 1, "the output there.html exists"),
            (["no.fits", "-o", "a.html"], 1, "no.fits cannot be opened"),
            (["image.fits", "-o", "a.html"], 1, "image.fits is not a result or truth"),
            (["link.html", "-o", "link.html", "--overwrite"], 2, "is one of the inputs"),
            (["nan.fits", "-o", "a.html"], 2, "nan.fits holds values that are not finite"),
        ],
    )
    def test_refusals(self, arguments, status, message, capsys):
        fits.writeto("image.fits", np.ones((8, 8)))
        fitswrite.write_result("nan.fits", np.full((8, 8), np.nan), [], [])
        shutil.copy("a.fits", "link.html")
        Path("there.html").touch()
        assert cli.main(["report", *arguments]) == status
        captured = capsys.readouterr()
        assert message in captured.err
        assert captured.err.count("\n") == 1
        assert not Path("a.html").exists()


def test_the_whole_frame_is_in_blocks_that_fit():
    small = make_view(p=1, shape=(60, 70))
    assert report.frame_step(small) == 1
    big = dataclasses.replace(small, extended=np.zeros((4000, 4000)))
    assert report.frame_step(big) == 7
