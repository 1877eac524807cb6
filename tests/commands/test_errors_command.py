"""``lnocl errors``: what it writes and refuses."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from commandline import one_complaint

import lnocl
from lnocl.commands import cli, errors
from lnocl.commands.again import RerunOfFile
from lnocl.errors import InputError
from lnocl.plotting.profiles import draw_bands

pytest.importorskip("regions", reason="regions is not installed")

REGIONS = "image\ncircle(30,30,6) # text={round}\nbox(20,40,12,8,0)\ncircle(9,9,0.9) # text={dot}\n"
NAMES = ["star 1 flux", "round", "region 2", "dot"]
WCS = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 30.0, "CDELT1": -1e-4,
       "CDELT2": 1e-4}  # fmt: skip
ERRORS = ["errors", "out.fits", "--regions", "jet é.reg", "--bootstrap"]
EXTENSIONS = ["ERRORS", "REGIONS", "ERROR", "BIAS", "SHARE", "REPLICAS", "REPLSUMS"]


@pytest.fixture
def words(small_command):
    """Return the words that deconvolve, in their folder, with regions."""
    Path("jet é.reg").write_text(REGIONS)
    return [*small_command, "--engine", "numpy", "--n-iter", "6", "-o", "out.fits"]


@pytest.fixture
def result(words):
    """Make a result."""
    assert cli.main(words) == 0


def held(path="out.fits"):
    with fits.open(path) as hdus:
        return {hdu.name: hdu.copy() for hdu in hdus}


def same_errors(one, other):
    for name in EXTENSIONS:
        assert np.array(one[name].data).tobytes() == np.array(other[name].data).tobytes(), name


def test_errors_are_added_to_the_file(words, capsys):
    for name, value in WCS.items():
        fits.setval("images.fits", name, value=value)
    assert cli.main(words) == 0
    assert cli.main([*ERRORS, "10"]) == 0
    said = capsys.readouterr().out
    first = "errors by 10 replicas, of regions without what PSFs have wrong, less their bias; in "
    assert f"{first}brackets 95 %:\nround: " in said
    assert "below the resolution: do not trust its error)" in said
    number = r"-?\d[\d ]*(\.\d+)?"  # to the digits of its error, without an exponent
    shown = rf"round: {number} \+- {number} electron \({number} to {number}; has light"
    assert re.search(shown, said)
    found = held()
    assert list(found)[-len(EXTENSIONS) :] == EXTENSIONS
    table = found["ERRORS"].data
    assert table["name"].tolist() == NAMES
    assert table["note"].tolist() == ["", "", "", "below the resolution"]
    assert (table["error"] > 0).all()
    assert (table["low95"] < table["low68"]).all()
    assert (table["high95"] > table["high68"]).all()
    assert table["value"][0] == found["STARS"].data["flux"][0]
    light = found["PRIMARY"].data[35:43, 13:25].sum()
    assert table["value"][2] == pytest.approx(light, rel=0.2)  # its edges halve pixels
    header = found["ERROR"].header
    assert (header["NREPL"], header["SEED"], header["BUNIT"]) == (10, 0, "electron")
    for name in ("ERROR", "BIAS"):
        assert found[name].data.shape == (64, 64)
        for card in WCS:
            assert found[name].header[card] == found["PRIMARY"].header[card]
    regions = found["REGIONS"].data
    assert regions["pixels"][1] == pytest.approx(96)
    assert regions["unit"].tolist() == 3 * ["electron"]
    np.testing.assert_allclose(regions["flux"], (table["value"] - table["bias"])[1:], rtol=1e-12)
    for name in ("name", "error", "note"):
        assert regions[name].tolist() == table[name][1:].tolist()
    assert lnocl.io.saved_results.read_result("out.fits").extended.shape == (64, 64)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_regions_are_printed_before_stars_and_in_full(capsys, monkeypatch):
    monkeypatch.setattr("lnocl.commands.errors.MAX_LISTED", 2)
    assert cli.main([*ERRORS, "10"]) == 0
    first, *lines = capsys.readouterr().out.splitlines()
    assert first.startswith("errors by 10 replicas")
    assert [line.partition(": ")[0] for line in lines] == [
        *NAMES[1:], "and 1 more in the table ERRORS", "added to out.fits",
    ]  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.usefixtures("quick_figures", "result")
def test_profiles_are_drawn_with_their_errors(capsys):
    pytest.importorskip("matplotlib")
    Path("p.reg").write_text("image\nbox(30,34,40,6,10) # text={jet}\nbox(30,34,6,20,0)")
    assert cli.main([*ERRORS, "10", "--profiles", "p.reg"]) == 0
    assert "jet flux" not in capsys.readouterr().out  # they are many
    table = held()["ERRORS"].data
    along = table[np.isfinite(table["at"])]
    assert [name for name in dict.fromkeys(along["name"])] == [
        "jet flux", "jet width", "region 2 flux", "region 2 width",
    ]  # fmt: skip
    assert len(along) == 2 * (40 + 20)
    assert set(along["unit"][along["name"] == "jet width"]) == {"pix"}
    assert cli.main(["plot", "out.fits", "-o", "figures"]) == 0
    said = capsys.readouterr().out
    for k in (1, 2):
        assert f"drew figures/result_profile_{k}.png" in said
        assert Path(f"figures/result_profile_{k}.png").exists()
    (flux, width) = [along[along["name"] == f"jet {kind}"] for kind in ("flux", "width")]
    figure = draw_bands("jet", {"": (flux, width)}, "electron")
    bands = figure.axes[0].collections
    assert [each.get_label() for each in bands] == ["95 %", "68 %"]
    outer = bands[0].get_datalim(figure.axes[0].transData)
    assert (outer.y0, outer.y1) == pytest.approx((flux["low95"].min(), flux["high95"].max()))


@pytest.mark.exhaustive
def test_errors_go_on_bit_for_bit_as_if_computed_at_once(words):
    """The command in the header says where files are, names beyond ASCII and all."""
    os.rename("psfs.fits", "pśf.fits")
    words[words.index("psfs.fits")] = "pśf.fits"
    assert cli.main(words) == 0
    assert cli.main([*ERRORS, "12"]) == 0
    expected = held()
    assert cli.main([*ERRORS, "10", "--overwrite"]) == 0
    folder = os.getcwd()
    os.mkdir("elsewhere")
    os.rename("jet é.reg", "elsewhere/jet é.reg")
    os.chdir("elsewhere")
    try:
        elsewhere = [word.replace("out.fits", f"{folder}/out.fits") for word in ERRORS]
        assert cli.main([*elsewhere, "12", "--quiet"]) == 0
    finally:
        os.chdir(folder)
    same_errors(held(), expected)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_a_result_without_errors_is_given_them(capsys):
    before, headers = Path("out.fits").read_bytes(), held()
    assert cli.main(["errors", "out.fits", "--bootstrap", "10", "--seed", "4"]) == 0
    assert capsys.readouterr().out.endswith("added to out.fits\n")
    found = held()
    assert found["ERRORS"].data["name"].tolist() == NAMES[:1]
    assert found["ERROR"].header["SEED"] == 4
    # What was there is there, comments of columns too.
    for name, hdu in headers.items():
        assert [
            card.comment for card in found[name].header.cards if card.keyword[:5] == "TTYPE"
        ] == [card.comment for card in hdu.header.cards if card.keyword[:5] == "TTYPE"]
    with fits.open("out.fits") as now:
        now[0].writeto("first.fits", overwrite=True, checksum=True)
    assert len(before) < Path("out.fits").stat().st_size
    np.testing.assert_array_equal(found["PRIMARY"].data, fits.getdata("first.fits"))


@pytest.mark.exhaustive
def test_errors_are_in_the_unit_of_the_result(words):
    """Per second, of images in electrons with an exposure; and go on in it."""
    fits.setval("images.fits", "BUNIT", value="adu")
    assert cli.main([*words, "--gain", "4", "--exposure", "2"]) == 0
    assert cli.main([*ERRORS, "10"]) == 0
    first = held()
    unit = first["PRIMARY"].header["BUNIT"]
    assert unit == "adu/s"
    assert first["ERROR"].header["BUNIT"] == unit
    assert first["ERRORS"].data["unit"][0] == unit
    table = first["ERRORS"].data
    light = first["PRIMARY"].data[35:43, 13:25].sum()
    assert table["value"][2] == pytest.approx(light, rel=0.2)
    # The map is of replicas in electrons.
    sums, n = first["REPLSUMS"].data, 10
    scatter = np.sqrt((sums[1] - sums[0] ** 2 / n) / (n - 1))
    np.testing.assert_allclose(first["ERROR"].data, scatter / 4, rtol=1e-9)
    assert cli.main([*ERRORS, "11", "--quiet"]) == 0
    replicas = held()["REPLICAS"].data["errors"]
    np.testing.assert_array_equal(replicas[:10], first["REPLICAS"].data["errors"])
    assert len(replicas) == 11


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_names_beyond_ascii_are_escaped():
    Path("jet é.reg").write_text("image\ncircle(30,30,6) # text={knöt ★}\n")
    assert cli.main([*ERRORS, "10"]) == 0
    assert held()["ERRORS"].data["name"][1] == r"kn\xf6t \u2605"
    assert cli.main([*ERRORS, "11", "--quiet"]) == 0
    assert len(held()["REPLICAS"].data) == 11


@pytest.mark.exhaustive
def test_without_stars_and_regions_pixels_have_errors(words):
    words[words.index("--star") : words.index("--star") + 2] = []
    assert cli.main(words) == 0
    assert cli.main(["errors", "out.fits", "--bootstrap", "10", "--quiet"]) == 0
    assert cli.main(["errors", "out.fits", "--bootstrap", "12", "--quiet"]) == 0
    found = held()
    assert len(found["ERRORS"].data) == 0
    assert len(found["REPLICAS"].data) == 12
    assert (found["ERROR"].data > 0).all()


def forget_the_run():
    """Leave a file as those of before, without what the run has found."""
    with fits.open("out.fits", mode="update") as hdus:
        del hdus["ESTIMATE"]


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_run_is_repeated_only_where_the_file_lacks_its_estimate(monkeypatch, capsys):
    assert cli.main([*ERRORS, "10"]) == 0
    assert "the run is made again" not in capsys.readouterr().err
    expected = held()
    forget_the_run()
    assert cli.main([*ERRORS, "10", "--overwrite"]) == 0
    said = capsys.readouterr().err.splitlines()
    line = "lnocl: out.fits does not hold what its run has found: the run is made again"
    assert said.count(line) == 1
    same_errors(held(), expected)
    monkeypatch.setattr("lnocl.commands.deconvolve.solve", None)
    with fits.open("out.fits", mode="append") as hdus:
        hdus.append(expected["ESTIMATE"])
    assert cli.main([*ERRORS, "10", "--overwrite"]) == 0
    same_errors(held(), expected)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_another_seed_is_refused_before_a_run_is_made_again(monkeypatch, capsys):
    assert cli.main([*ERRORS, "10", "--quiet"]) == 0
    forget_the_run()
    monkeypatch.setattr("lnocl.commands.deconvolve.solve", None)
    assert cli.main([*ERRORS, "12", "--seed", "5"]) == 2
    assert "has replicas with --seed 0" in one_complaint(capsys.readouterr())


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_replicas_of_a_run_that_rounds_otherwise_are_continued():
    assert cli.main([*ERRORS, "10", "--quiet"]) == 0
    with fits.open("out.fits", mode="update") as hdus:
        hdus["ERRORS"].data["value"] *= 1.0 + 1e-8
    assert cli.main([*ERRORS, "11", "--quiet"]) == 0
    assert len(held()["REPLICAS"].data) == 11


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
@pytest.mark.parametrize("n", [0, 3])
def test_a_table_of_other_than_one_row_holds_no_run(n, capsys):
    forget_the_run()
    columns = [fits.Column(name, "D", array=np.ones(n)) for name in ("digest", "sky")]
    with fits.open("out.fits", mode="append") as hdus:
        hdus.append(fits.BinTableHDU.from_columns(columns, name="ESTIMATE"))
    assert cli.main([*ERRORS, "10"]) == 0
    assert capsys.readouterr().err.count(": the run is made again") == 1


def test_replicas_are_made_on_the_device_of_the_run(words, monkeypatch):
    """It is named in the command, and may have been chosen among several."""
    monkeypatch.setattr("lnocl.commands.deconvolve._device_spec", lambda arguments: "0:7")
    assert cli.main(words) == 0
    assert RerunOfFile.read("out.fits", quiet=True).outcome().setup.device == "0:7"


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_a_run_that_was_interrupted_has_errors_but_is_not_made_again(capsys):
    fits.setval("out.fits", "STOPPED", value="interrupt")
    assert cli.main([*ERRORS, "10", "--quiet"]) == 0
    forget_the_run()
    capsys.readouterr()
    assert cli.main([*ERRORS, "10"]) == 2
    assert "the run of out.fits was interrupted, and its command" in capsys.readouterr().err
    Path("out.fits").rename("out.fits.gz")
    assert cli.main(["errors", "out.fits.gz"]) != 0


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_overwrite_begins_anew():
    assert cli.main([*ERRORS, "10"]) == 0
    expected = held()
    for seed, more in (("5", []), ("5", ["--overwrite"]), ("0", ["--overwrite"])):
        status = cli.main([*ERRORS, "10", "--quiet", "--seed", seed, *more])
        assert status == (0 if more else 2)
    np.testing.assert_array_equal(
        held()["REPLICAS"].data["errors"], expected["REPLICAS"].data["errors"]
    )


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_replicas_written_by_another_command_are_preserved(monkeypatch, capsys):
    """Of the same replicas the more are kept, and those of something else are not replaced."""
    for words, name in ((["12"], "more"), (["10", "--seed", "5"], "other")):
        assert cli.main([*ERRORS, *words, "--overwrite", "--quiet"]) == 0
        Path("out.fits").rename(f"{name}.fits")
        Path("out.fits").write_bytes(Path(f"{name}.fits").read_bytes())
    assert cli.main([*ERRORS, "10", "--overwrite", "--quiet"]) == 0
    before, write = Path("out.fits").read_bytes(), errors._write
    for name, status in (("more", 0), ("other", 1)):
        Path("out.fits").write_bytes(before)
        there = Path(f"{name}.fits").read_bytes()

        def others_first(*given, there=there):
            Path("out.fits").write_bytes(there)
            write(*given)

        monkeypatch.setattr(errors, "_write", others_first)
        assert cli.main([*ERRORS, "11", "--quiet"]) == status
        assert Path("out.fits").read_bytes() == there
    assert "out.fits has got replicas of another --seed or of other" in capsys.readouterr().err


WRONG_USES = [
    (["--bootstrap", "9"], 2, "--bootstrap must be a whole number, 10 or more"),
    (["--seed", "-3"], 2, "--seed must be a whole number, 0 or more; -3 was given"),
    (["--regions", "nix.reg"], 1, "nix.reg is not there: give a file of regions, such as DS9"),
    (["--regions", "empty.reg"], 1, "empty.reg holds no regions"),
    (["--regions", "beyond.reg"], 2, "region 1 (circle) lies outside the image of 64 x 64"),
    (["--regions", "sky.reg"], 2, "the image has no sky coordinates (WCS) that can be"),
    (["--regions", "other.reg"], 2, "has replicas with --seed 0 of the regions round, region 2"),
    (
        ["--bootstrap", "20"],
        2,
        "out.fits has replicas with --seed 0 of the regions round, region 2",
    ),
]


@pytest.mark.exhaustive
@pytest.mark.usefixtures("result")
def test_wrong_uses_are_one_line_and_leave_the_file(capsys):
    Path("empty.reg").write_text("")
    Path("beyond.reg").write_text("image\ncircle(300,3,2)")
    Path("sky.reg").write_text('icrs\ncircle(10,10,1")')
    Path("other.reg").write_text("image\ncircle(30,30,6)")
    assert cli.main([*ERRORS, "10"]) == 0
    before = Path("out.fits").read_bytes()
    capsys.readouterr()
    for change, status, message in WRONG_USES:
        assert cli.main(["errors", "out.fits", *change]) == status, change
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
    assert Path("out.fits").read_bytes() == before


@pytest.mark.usefixtures("result")
def test_result_of_changed_images_is_refused(capsys):
    images = fits.getdata("images.fits")
    fits.writeto("images.fits", images[:, ::-1], overwrite=True)
    assert cli.main(["errors", "out.fits"]) == 2
    said = capsys.readouterr().err
    assert "holds of its run is of other images, or of another version of lnocl: the run" in said
    assert "the run of out.fits gives another result now: its images, PSFs or" in said
    Path("images.fits").unlink()
    assert cli.main(["errors", "out.fits", "--quiet"]) == 1
    assert "images.fits" in capsys.readouterr().err


def test_a_file_of_no_command_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = fits.HDUList([fits.PrimaryHDU(np.ones((8, 8)))])
    columns = [fits.Column(name, "D", array=[1.0]) for name in ("x", "y", "flux")]
    made.append(fits.BinTableHDU.from_columns(columns, name="STARS"))
    made.writeto("bare.fits")
    assert cli.main(["errors", "bare.fits"]) == 2
    assert "bare.fits has no command of lnocl deconvolve in its header" in capsys.readouterr().err


def test_replicas_of_tiles_are_refused(words, capsys):
    assert cli.main([*words, "--tile", "64"]) == 0
    assert cli.main([*ERRORS, "10"]) == 2
    assert "out.fits was made in tiles, and this is of one run" in capsys.readouterr().err


@pytest.mark.system
def test_killed_errors_go_on_bit_for_bit(words, monkeypatch):
    assert cli.main(words) == 0
    assert cli.main([*ERRORS, "40"]) == 0
    expected = held()
    assert cli.main(words) == 0
    program = (
        "import sys\nfrom lnocl.commands import cli, running\nrunning.WRITE_EVERY = 0.0\n"
        "sys.exit(cli.main(sys.argv[1:]))"
    )
    options = [*ERRORS, "40", "--quiet"]
    killed = 0
    for pause in (0.02, 0.3, 0.6):
        process = subprocess.Popen([sys.executable, "-c", program, *options])
        while process.poll() is None and "REPLICAS" not in held():
            time.sleep(0.01)
        time.sleep(pause)
        killed += process.poll() is None
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert killed
    n = len(held()["REPLICAS"].data)
    assert n >= 2
    assert cli.main(options) == 0
    same_errors(held(), expected)


def test_another_flux_of_a_star_is_another_run():
    sky = np.ones((4, 5))
    saved = SimpleNamespace(path="a.fits", extended=sky, star_fluxes=np.array([7.0]))
    again = RerunOfFile(saved, SimpleNamespace(electrons=2.0), None, None)
    found = {"observation": SimpleNamespace(sky_shape=(4, 5), skies_shape=(4, 5)), "sky": 2.0 * sky}
    again._refuse_another(SimpleNamespace(fluxes_of_stars=np.array([14.0]), **found))
    with pytest.raises(InputError, match="gives another result now"):
        again._refuse_another(SimpleNamespace(fluxes_of_stars=np.array([14.1]), **found))
