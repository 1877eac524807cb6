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

pytest.importorskip("matplotlib")


def data_of(page):
    (text,) = re.findall(r'<script id="data" type="application/json">(.*?)</script>', page, re.S)
    return json.loads(text)


def decoded(layer):
    """Return the values of a picture as the page's own script reads them; bad pixels are NaN."""
    from PIL import Image

    codes = np.array(Image.open(io.BytesIO(base64.b64decode(layer["png"]))))[::-1].astype(float)
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
    source = decoded(whole["source"])
    assert abs(source - view.extended).max() < 0.02
    assert data["stars"] == [[10.0, 20.0]]
    # The region of the star begins where its pixels do.
    zoom = data["regions"][1]
    assert (zoom["name"], zoom["source"]["x"], zoom["source"]["y"]) == ("star 1", 0, 0)
    assert decoded(zoom["source"]).shape == (45, 35)


def test_the_offset_of_an_image_moves_its_corner():
    view = make_view(p=2, stars=[(40.0, 30.0)], offsets=np.array([[0.0, 0.0], [5.0, -3.0]]))
    zoom = data_of(make_report(view, "a"))["regions"][1]
    assert (zoom["images"][1][0]["x"], zoom["images"][1][0]["y"]) == (16.0, 6.0)
    assert (zoom["source"]["x"], zoom["source"]["y"]) == (16, 6)


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
    assert decoded(data_of(page)["regions"][0]["source"]).shape[0] == 1


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
        {wicked: [1.0]},
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
            {"MODELS": cube, "RESIDUALS": cube, "MESSAGES": messages(*said)},
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
                     "<td>7.5</td>"):  # fmt: skip
            assert part in page
        assert "/home/me" not in page
        assert "datadata" not in page
        assert len(data_of(page)["regions"]) == 2

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

    def test_a_result_without_models_says_what_it_lacks(self, capsys):
        fitswrite.write_result("b.fits", np.ones((32, 32)), [], [])
        assert cli.main(["report", "b.fits", "-o", "b.html"]) == 0
        page = Path("b.html").read_text()
        assert "The file has no models and residuals: repeat the run with both." in page
        assert data_of(page)["regions"][0]["images"] == []

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
