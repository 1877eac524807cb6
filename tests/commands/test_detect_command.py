"""``lnocl detect`` and ``lnocl limit``: what they write, say and refuse."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commandline import gaussian, one_complaint

from lnocl.commands import cli, deconvolve
from lnocl.io.parts import read_parts

N = 64
WCS = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 15.25, "CRVAL2": -3.0,
       "CRPIX1": 32.0, "CRPIX2": 32.0, "CDELT1": -1e-4, "CDELT2": 1e-4}  # fmt: skip
MAPS = ["LIMIT50", "LIMIT90", "LIMIT95"]


@pytest.fixture(autouse=True)
def result(tmp_path, monkeypatch):
    """A star at (20.3, 40.1) and a source that is not named, at (45, 18.6)."""
    monkeypatch.chdir(tmp_path)
    light = 50.0 + 3e4 * gaussian(N, 20.3, 40.1) + 3e3 * gaussian(N, 45.0, 18.6)
    counts = np.random.default_rng(1).poisson(light).astype(float)
    fits.writeto("image.fits", counts, fits.Header(WCS))
    fits.writeto("psf.fits", gaussian(25, 12, 12))
    words = ["deconvolve", "image.fits", "--psf", "psf.fits", "--background", "50"]
    words += ["--star", "20.3,40.1", "--stop", "none", "--n-iter", "15", "--engine", "numpy"]
    assert cli.main([*words, "--residuals", "-o", "out.fits", "--quiet"]) == 0


@pytest.mark.parametrize("output", ["found.ecsv", "found.csv", "found.fits"])
def test_detections_are_printed_written_and_added_to_the_result(output, capsys):
    assert cli.main(["detect", "out.fits", "-o", output]) == 0
    captured = capsys.readouterr()
    assert "warning" not in captured.err
    said = captured.out.splitlines()
    assert said[0].startswith("1 detection above 4.")
    assert (
        "which noise exceeds 0.01 times in such a field (87.7 % of it was tested for a point)"
        in (said[0])
    )
    assert said[1].startswith(("1: (44.9", "1: (45.0"))
    assert " pixels from star 1, signal-to-noise " in said[1]
    assert re.search(r"flux [23] \d{3} \+- \d{1,3} electron$", said[1])
    assert said[-2:] == ["added to out.fits", f"written to {output}"]
    table = Table.read(output)
    assert table["kind"].tolist() == ["point"]
    assert abs(table["flux"][0] - 3000) < 4 * table["flux_error"][0]
    assert table["ra"][0] == pytest.approx(15.25 - 14e-4, abs=2e-5)
    assert table["separation"][0] == pytest.approx(0.36 * table["distance"][0])
    held = read_parts("out.fits", ["DETECTIONS", "SIGNAL"])
    found, cards = held["DETECTIONS"]
    assert cards["THRESHOL"] == pytest.approx(float(said[0].split()[3]), abs=0.01)
    assert found["x"][0] == pytest.approx(table["x"][0])
    assert found["kind"].tolist() == ["point"]
    assert held["SIGNAL"].values[19, 45] > 10
    assert cards["FLUXUNIT"] == "electron"
    with fits.open("out.fits") as hdus:
        assert [hdu.name for hdu in hdus][-2:] == ["DETECTIONS", "SIGNAL"]
        assert hdus["SIGNAL"].header["CRVAL1"] == 15.25
        assert hdus["DETECTIONS"].header["FALSALRM"] == 0.01


@pytest.mark.exhaustive
def test_detections_and_limits_begin_at_once(monkeypatch, capsys):
    """They are those of a file of before, which has to make its run again."""
    commands = ["detect", "out.fits"], ["limit", "out.fits", "--injections", "4"]
    found = []
    for solve in (None, deconvolve.solve):
        monkeypatch.setattr(deconvolve, "solve", solve)
        for command in commands:
            assert cli.main(command) == 0
        found.append({name: fits.getdata("out.fits", name) for name in ("SIGNAL", "LIMITS", *MAPS)})
        found[-1]["said"] = capsys.readouterr().out
        with fits.open("out.fits", mode="update") as hdus:
            for name in {"ESTIMATE", "SIGNAL", "LIMITS"} & {hdu.name for hdu in hdus}:
                del hdus[name]
    np.testing.assert_equal(found[1], found[0])


@pytest.mark.exhaustive
def test_detections_replace_those_that_are_there(capsys):
    for alarms in ("0.01", "1"):
        assert cli.main(["detect", "out.fits", "--false-alarms", alarms, "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    with fits.open("out.fits") as hdus:
        names = [hdu.name for hdu in hdus]
        assert names.count("DETECTIONS") == 1
        assert hdus["DETECTIONS"].header["FALSALRM"] == 1.0


@pytest.mark.exhaustive
def test_limits_are_printed_written_added_and_checked_by_injections(capsys):
    words = ["limit", "out.fits", "-o", "limits.ecsv", "--injections", "11"]
    assert cli.main(words) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("a point of ")
    assert said[0].endswith("at 0.01 false alarms in the field")
    end = said.index("added to out.fits")
    assert said[end:] == ["added to out.fits", "written to limits.ecsv"]
    put_in = [line for line in said if " put in" in line]
    assert put_in[0].startswith("of 6 sources put in at the limit of 50 %, ")
    assert any(" put in within " in line and "of a star at the limit" in line for line in put_in)
    assert any(line.startswith("of 5 sources put in at the limit of 90 %, ") for line in put_in)
    table = Table.read("limits.ecsv")
    assert {"star", "distance", "flux50", "contrast90", "magnitudes95"} <= set(table.colnames)
    assert (table["flux95"] > table["flux50"]).all()
    held = read_parts("out.fits", ["LIMIT50"])
    assert held["LIMIT50"].values.shape == (N, N)
    with fits.open("out.fits") as hdus:
        assert [hdu.name for hdu in hdus][-4:] == ["LIMITS", *MAPS]
        assert hdus["LIMIT50"].header["BUNIT"] == "electron"


def test_zero_injections_inject_no_sources(capsys):
    assert cli.main(["limit", "out.fits", "--injections", "0"]) == 0
    assert "put in" not in capsys.readouterr().out


def test_limits_are_printed_at_round_distances(capsys):
    assert cli.main(["limit", "out.fits", "--injections", "0", "-o", "limits.ecsv"]) == 0
    said = capsys.readouterr().out.splitlines()
    (names, units), rows = (line.split() for line in said[1:3]), said[4:-2]
    assert names[:4] == ["star", "distance", "separation", "threshold"]
    assert units == ["pix", "arcsec", "mag"]
    table, shown = (
        Table.read("limits.ecsv"),
        [dict(zip(names, row.split(), strict=True)) for row in rows],
    )
    assert [float(row["distance"]) for row in shown[-4:]] == [5, 10, 20, 50]
    assert float(shown[0]["distance"]) == table["distance"][0]
    for row in shown:
        [of_curve] = table[table["distance"] == float(row["distance"])]
        assert float(row["separation"]) == pytest.approx(0.36 * of_curve["distance"], rel=5e-3)
        for name in ("contrast50", "magnitudes50", "contrast90"):
            assert float(row[name]) == pytest.approx(of_curve[name], rel=1e-2)


@pytest.mark.exhaustive
def test_limit_too_faint_for_injected_sources_is_reported(capsys, monkeypatch):
    from lnocl.significance import Significance

    before = Significance.limit
    monkeypatch.setattr(Significance, "limit", lambda *args: before(*args) / 4)
    assert cli.main(["limit", "out.fits", "--injections", "40"]) == 0
    assert "the limit of 90 % is too faint: of 20 sources put in" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_pictures_and_the_report_show_them(capsys):
    pytest.importorskip("matplotlib")
    assert cli.main(["detect", "out.fits", "--plot", "found.png"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "drew found.png"
    words = ["limit", "out.fits", "--plot", "limits.png", "--injections", "0"]
    assert cli.main(words) == 0
    for name in ("found.png", "limits.png"):
        assert Path(name).read_bytes().startswith(b"\x89PNG")
    assert cli.main(["report", "out.fits", "-o", "page.html"]) == 0
    page = Path("page.html").read_text()
    assert "<h2>Detections</h2>" in page
    assert "<th>detection</th><th>x (pix)</th>" in page
    assert "<th>flux (electron)</th>" in page
    assert "<td>point</td>" in page
    assert "<h2>Limits</h2>" in page
    assert "<th>magnitudes 50 % (mag)</th>" in page


def test_a_report_without_them_has_no_section():
    pytest.importorskip("matplotlib")
    assert cli.main(["report", "out.fits", "-o", "page.html"]) == 0
    page = Path("page.html").read_text()
    assert re.findall("<h2>(.*?)</h2>", page)[2:] == [
        "Stars",
        "How the iteration was chosen",
        "How to make it again",
    ]


@pytest.mark.exhaustive
@pytest.mark.parametrize("unit", ["adu", "MJy / sr"])
def test_fluxes_are_in_the_unit_of_the_images(unit, capsys):
    with fits.open("image.fits", mode="update") as hdus:
        hdus[0].data /= 10.0
        hdus[0].header["BUNIT"] = unit
    words = ["deconvolve", "image.fits", "--psf", "psf.fits", "--background", "5", "--gain", "10"]
    words += ["--star", "20.3,40.1", "--stop", "none", "--n-iter", "15", "--engine", "numpy"]
    assert cli.main([*words, "-o", "adu.fits", "--quiet"]) == 0
    assert cli.main(["detect", "adu.fits", "-o", "found.ecsv"]) == 0
    said = capsys.readouterr().out
    assert f" {unit}" in said
    table = Table.read("found.ecsv")
    assert abs(table["flux"][0] - 300) < 4 * table["flux_error"][0]
    assert fits.getheader("adu.fits", "DETECTIONS")["FLUXUNIT"] == unit.replace(" ", "")


@pytest.mark.exhaustive
def test_a_star_without_light_has_no_limit_beside_it(capsys):
    pytest.importorskip("matplotlib")
    fits.writeto("flat.fits", np.full((N, N), 50.0))
    words = ["deconvolve", "flat.fits", "--psf", "psf.fits", "--background", "50", "--star", "9,11"]
    words += ["--stop", "none", "--n-iter", "5", "--engine", "numpy", "-o", "dark.fits", "--quiet"]
    assert cli.main(words) == 0
    assert cli.main(["limit", "dark.fits", "--injections", "0", "--plot", "limits.png"]) == 0
    assert "\nstar 1 has no light, and nothing is faint beside it\n" in capsys.readouterr().out
    assert cli.main(["report", "dark.fits", "-o", "page.html"]) == 0


@pytest.mark.exhaustive
def test_a_file_that_is_not_standard_gets_its_detections(capsys):
    """One that lacks its last padding, and has a card that astropy does not write."""
    with fits.open("out.fits") as hdus:
        where, size = hdus[-1].fileinfo(), hdus[-1].size
    content = bytearray(Path("out.fits").read_bytes()[: where["datLoc"] + size])
    at = content.index(b"DATE    =")
    content[at : at + 80] = b"date    = 'one day".ljust(80)
    Path("out.fits").write_bytes(content)
    for command in (["detect", "out.fits"], ["limit", "out.fits", "--injections", "0"]):
        assert cli.main(command) == 0
    captured = capsys.readouterr()
    assert "1 detection above" in captured.out
    assert "Traceback" not in captured.err


def test_a_result_whose_stars_are_gone_is_another(capsys):
    with fits.open("out.fits", mode="update") as hdus:
        hdus["STARS"].data = hdus["STARS"].data[:0]
    assert cli.main(["detect", "out.fits"]) == 2
    assert "the run of out.fits gives another result now" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_a_command_without_its_folder_is_made_where_one_is(capsys):
    content = Path("out.fits").read_bytes()
    at = content.index(b"HISTORY cd")
    Path("out.fits").write_bytes(content[:at] + b"HISTORY cd".ljust(80) + content[at + 80 :])
    assert cli.main(["detect", "out.fits"]) == 0
    assert "1 detection above" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["detect", "out.fits", "--width", "-2"], "--width must be a finite number of pixels"),
        (
            ["detect", "out.fits", "--false-alarms", "0"],
            "--false-alarms must be the number",
        ),
        (["detect", "out.fits", "-o", "found.reg"], "the table of detections is ECSV, CSV or FITS"),
        (["limit", "out.fits", "-o", "found.reg"], "the table of limits is ECSV, CSV or FITS"),
        (["limit", "out.fits", "--injections", "-3"], "--injections must be a whole number"),
        (["detect", "out.fits", "--plot", "found.pdf"], "the picture is a PNG file"),
        (["detect", "image.fits"], "is not a result or truth written by lnocl"),
    ],
)
def test_wrong_words_are_refused_before_the_run(words, message, capsys):
    assert cli.main(words) != 0
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "output"),
    [
        (["detect"], ["-o", "image.fits"]),
        (["detect"], ["-o", "hard.fits"]),
        (["limit", "--injections", "0"], ["-o", "link.fits"]),
        (["limit", "--injections", "0"], ["-o", "out.fits"]),
        (["detect"], ["--plot", "link.png"]),
    ],
)
def test_the_images_of_the_run_are_not_replaced(command, output, capsys, tmp_path, monkeypatch):
    """From another folder too, whose names are not those of the run's."""
    os.link("image.fits", "hard.fits")
    os.symlink("image.fits", "link.fits")
    os.symlink("psf.fits", "link.png")
    os.mkdir("other")
    monkeypatch.chdir("other")
    before = {path: path.read_bytes() for path in sorted(tmp_path.glob("*.*"))}
    flag, name = output
    words = [*command, "../out.fits", flag, f"../{name}", "--overwrite"]
    monkeypatch.setattr("lnocl.commands.deconvolve.read", None)
    assert cli.main(words) == 2
    assert one_complaint(capsys.readouterr()) == (
        f"the output ../{name} is one of the inputs; give it another name"
    )
    assert {path: path.read_bytes() for path in sorted(tmp_path.glob("*.*"))} == before
