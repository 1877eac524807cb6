"""``lnocl batch``: tables of targets, what becomes of each, and what is done again."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commandline import GIVEN, PAPER, one_complaint, outcome

from lnocl.commands import cli, deconvolve
from lnocl.commands.targets import read_targets
from lnocl.result.summary import with_error

pytestmark = pytest.mark.usefixtures("command_folder")

HEADER = "name,images,psf,star,n_iter,engine,psf_centre,solver,stop,smoothing,pad,residuals"
COMMON = "numpy,given,sgm,none,0,0,"


def write_targets(*rows, path="targets.csv"):
    Path(path).write_text("\n".join([HEADER, *(f"{row},{COMMON}" for row in rows)]) + "\n")


def batch(*arguments):
    return cli.main(["batch", "targets.csv", "-o", "out", *arguments])


def summary():
    table = Table.read("out/summary.ecsv")
    return {name: dict(zip(table.colnames, row, strict=True)) for name, *row in
            zip(table["name"], *table.columns.values(), strict=True)}  # fmt: skip


GOOD = ('one,a.fits,k1.fits,"7,5 3.5,2",3', 'two,a.fits b.fits,k1.fits k2.fits,"7,5",2')


@pytest.mark.exhaustive
def test_batch_results_match_the_deconvolve_command(capsys):
    write_targets(*GOOD)
    assert batch() == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert said.out.endswith(
        "\n2 targets: 2 done\nin 2 of the 2 that are done the model has faults, which the column "
        f"verdict says\nwritten to {os.path.abspath('out/summary.ecsv')}\n"
    )
    assert sorted(os.listdir("out")) == [
        "one.fits", "one.json", "one.log", "summary.ecsv", "two.fits", "two.json", "two.log",
    ]  # fmt: skip
    engine = "--engine", "numpy"
    alone = ["deconvolve", "a.fits", "b.fits", "--psf", "k1.fits", "k2.fits", "--star", "7,5",
             "--n-iter", "2", "-o", "alone.fits", *engine, *PAPER, *GIVEN]  # fmt: skip
    assert cli.main(alone) == 0
    np.testing.assert_equal(outcome("out/two.fits"), outcome("alone.fits"))
    assert len(fits.getdata("out/one.fits", "STARS")) == 2
    found = summary()
    assert [each["status"] for each in found.values()] == ["done", "done"]
    assert [each["n_iter"] for each in found.values()] == [3, 2]
    log = Path("out/one.log").read_text()
    assert log.startswith(f"$ cd {os.getcwd()}; {found['one']['command']}\n")
    assert "\n3 iterations, all that were allowed; " in log


def test_summary_gives_fluxes_errors_and_the_verdict_of_each_target(capsys):
    flat = np.random.default_rng(0).poisson(50.0, (32, 32)).astype(float)
    fits.writeto("flat.fits", flat, fits.Header({"BUNIT": "electron"}))
    write_targets("lost,gone.fits,k1.fits,,1", GOOD[0], "flat,flat.fits,k1.fits,,9")
    assert batch("--quiet") == 1
    found = summary()
    alone = ["a.fits", "--psf", "k1.fits", "--star", "7,5", "--star", "3.5,2", "--n-iter", "3"]
    command = ["deconvolve", *alone, "--engine", "numpy", *PAPER, *GIVEN, "-o", "alone.fits"]
    assert cli.main(command) == 0
    one, said = found["one"], capsys.readouterr().out
    assert f" {with_error(one['star_flux'], one['star_flux_error'])} electrons\n" in said
    light = with_error(one["extended_flux"], one["extended_flux_error"])
    assert f" {light} electrons in the frame\n" in said
    assert one["residual_rms"] == fits.getval("alone.fits", "RESIDRMS")
    assert one["verdict"].startswith("the model does not fit at ")
    fault = one["verdict"].partition("; ")[0].replace("refine_psfs", "--refine-psfs")
    assert f" no: {fault}\n" in said
    assert found["flat"]["verdict"] == "the model fits"
    assert np.isnan(found["flat"]["star_flux"])
    assert np.isnan(found["lost"]["residual_rms"])
    assert batch() == 1  # those that are done are not done again
    said = capsys.readouterr().out
    assert "in 1 of the 2 that are done the model has faults" in said
    rows = [line.split() for line in said.splitlines()[2:4]]
    assert [(row[0], *row[-2:]) for row in rows] == [
        ("one", "has", "faults"),
        ("flat", "electron", "fits"),
    ]
    assert rows[0][1:3] == ["{star_flux:.6g}".format(**one), "{star_flux_error:.2g}".format(**one)]
    assert summary()["one"] == one


def test_the_order_of_columns_does_not_matter():
    """An option of several values would take the images that follow it."""
    Path("targets.csv").write_text("refine_psfs,psf,name,images\njitter,k1.fits,one,a.fits\n")
    (target,) = read_targets("targets.csv")
    assert target.words == ("a.fits", "--refine-psfs", "jitter", "--psf", "k1.fits")
    assert not target.fault


def test_a_table_of_excel_begins_with_a_mark_of_its_encoding():
    write_targets(*GOOD)
    Path("targets.csv").write_text(Path("targets.csv").read_text(), encoding="utf-8-sig")
    assert [target.name for target in read_targets("targets.csv")] == ["one", "two"]


def test_a_bad_target_is_a_row_and_stops_no_other(capsys):
    write_targets(
        "lost,gone.fits,k1.fits,,2", GOOD[0], "bad,a.fits,k1.fits,,two", "flagged,a.fits,k1.fits,,2"
    )
    text = Path("targets.csv").read_text()
    Path("targets.csv").write_text(text.removesuffix(",\n") + ",maybe\n")
    assert batch() == 1
    said = capsys.readouterr()
    assert "4 targets: 1 done, 3 failed" in said.out
    assert said.err == (
        "lnocl: error: 3 targets of 4 failed, the first, lost: gone.fits cannot be opened: No such "
        "file or directory\n"
    )
    found = summary()
    assert found["one"]["status"] == "done"
    assert "argument --n-iter: invalid int value: 'two'" in found["bad"]["message"]
    assert found["flagged"]["message"] == "--residuals is true or false; 'maybe' was given"
    assert "lnocl: error: gone.fits cannot be opened" in Path("out/lost.log").read_text()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("n" * 300 + ",a.fits,k1.fits,,2", "its name 'nnn.*' cannot be that of a file; give anoth"),
        ("\u00e9" * 126 + ",a.fits,k1.fits,,2", "its name .* cannot be that of a file; give anoth"),
        ("," + "i" * 300 + ".fits,k1.fits,,2", "its name 'iii.*' cannot be that of a file; give a"),
        ("a\0b,a.fits,k1.fits,,2", "its name 'a.x00b' cannot be that of a file; give another in"),
        ("nul,a\0.fits,k1.fits,,2", "one of its values has a NUL character, which no command"),
    ],
)
def test_names_that_no_file_has_stop_no_other_target(row, message):
    write_targets(row, GOOD[0])
    assert batch("--quiet") == 1
    failed, done = summary().values()
    assert re.match(message, failed["message"])
    assert done["status"] == "done"


def test_the_longest_name_of_a_file():
    name = "n" * 250
    write_targets(f"{name},a.fits,k1.fits,,2")
    assert batch("--quiet") == 0
    assert os.path.exists(f"out/{name}.fits")


@pytest.mark.exhaustive
def test_finished_targets_are_skipped_when_the_batch_is_repeated(capsys):
    write_targets("late,c.fits,k1.fits,,2", *GOOD)
    assert batch("--quiet") == 1
    before = {name: os.stat(f"out/{name}").st_mtime_ns for name in ("one.fits", "one.json")}
    os.link("a.fits", "c.fits")
    capsys.readouterr()
    assert batch() == 0
    assert "3 targets: 3 done (2 of them before)" in capsys.readouterr().out
    assert before == {name: os.stat(f"out/{name}").st_mtime_ns for name in before}
    assert summary()["late"]["status"] == "done"
    assert batch("--overwrite", "--quiet") == 0
    assert os.stat("out/one.fits").st_mtime_ns != before["one.fits"]


@pytest.mark.exhaustive
def test_outputs_of_other_commands_are_not_overwritten(capsys):
    write_targets(*GOOD)
    assert batch("--quiet") == 0
    made = Path("out/one.fits").read_bytes()
    Path("out/three.fits").write_bytes(b"mine")
    write_targets(GOOD[0].removesuffix("3") + "4", GOOD[1], "three,a.fits,k1.fits,,1")
    assert batch() == 1
    said = capsys.readouterr()
    assert "3 targets: 1 done, 2 failed (1 of them before)" in said.out
    messages = {name: each["message"] for name, each in summary().items()}
    remedy = "; give another name, or --overwrite"
    assert messages["one"].endswith(f"one.fits is of another command{remedy}")
    assert messages["three"].endswith(f"three.fits exists{remedy}")
    assert Path("out/one.fits").read_bytes() == made
    assert Path("out/three.fits").read_bytes() == b"mine"
    assert batch("--overwrite", "--quiet") == 0
    assert summary()["one"]["n_iter"] == 4


@pytest.mark.exhaustive
def test_job_arrays_share_the_targets():
    rows = [f"t{k},a.fits,k1.fits,,1" for k in range(5)]
    write_targets(*rows)
    assert batch("--array", "2/3", "--quiet") == 0
    assert [each["status"] for each in summary().values()] == [
        "waiting", "done", "waiting", "waiting", "done"
    ]  # fmt: skip
    assert batch("--array", "1/3", "--quiet") == 0
    assert batch("--array", "3/3", "--quiet") == 0
    assert {each["status"] for each in summary().values()} == {"done"}


@pytest.mark.parametrize(
    ("option", "values", "message"),
    [
        ("--array", ["0/3", "4/3", "1", "a/b", "1/0"], "is not I/N with 1 <= I <= N"),
        ("--parallel", ["0", "-2", "many", "1.5"], "is neither a number of processes"),
    ],
)
def test_invalid_array_parts_and_process_counts_are_refused(option, values, message, capsys):
    write_targets(*GOOD)
    for value in values:
        assert batch(option, value) == 2
        assert f"'{value}' {message}" in one_complaint(capsys.readouterr())


@pytest.mark.parametrize("ending", ["ecsv", "csv", "fits"])
def test_tables_give_the_same_commands_in_every_format(ending):
    table = Table(
        {
            "images": ["a.fits", "'with blank.fits' b.fits[SCI]", "c.fits"],
            "psf": ["k.fits", "k.fits", "k.fits"],
            "star": ["", "1,2 3.5,-4", ""],
            "n-iter": np.ma.array([1, 2, 3], mask=[False, True, False]),
            "mu": [0.0, np.nan, 1e-7],
            "residuals": [True, False, True],
            "refine": ["true", "no", ""],
            "saturation": [60000.0, 60000.5, 1e5],
        }
    )
    table.write(f"t.{ending}", overwrite=True)
    targets = read_targets(f"t.{ending}")
    assert [each.name for each in targets] == ["a", "with blank", "c"]
    assert [each.words for each in targets] == [
        ("a.fits", "--psf", "k.fits", "--n-iter", "1", "--mu", "0", "--residuals",
         "--refine", "--saturation", "60000"),
        ("with blank.fits", "b.fits[SCI]", "--psf", "k.fits", "--star", "1,2", "--star", "3.5,-4",
         "--no-refine", "--saturation", "60000.5"),
        ("c.fits", "--psf", "k.fits", "--n-iter", "3", "--mu", "1e-07", "--residuals",
         "--saturation", "100000"),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "t.csv does not exist"),
        ("images,psf\n", "t.csv has no row; give one a target"),
        ("psf\nk1.fits\n", "t.csv has no column images; give the files of each target there"),
        ("images,n_itre\na.fits,3\n", "column 'n_itre' of t.csv is no option that a target may"),
        ("images,output\na.fits,b.fits\n", "column 'output' of t.csv is no option that a target"),
        ("images\na.fits\n./a.fits\n", "t.csv has 2 targets called 'a', whose outputs would repl"),
        ("images,psf\na.fits,k\nb,c,d\n", "t.csv cannot be read as a table"),
    ],
)
def test_tables_that_are_no_use_are_refused(text, message, capsys):
    if text is not None:
        Path("t.csv").write_text(text)
    assert cli.main(["batch", "t.csv", "-o", "out"]) in (1, 2)
    assert message in one_complaint(capsys.readouterr())
    assert not os.path.exists("out")


def test_a_table_of_another_format_is_refused(capsys):
    Path("targets.txt").write_text("images\na.fits\n")
    assert cli.main(["batch", "targets.txt", "-o", "out"]) == 2
    assert one_complaint(capsys.readouterr()) == (
        "the table of targets is ECSV, CSV or FITS; give it a name ending in .ecsv, .csv or .fits, "
        "not targets.txt"
    )


def test_names_that_leave_the_folder_are_rows_that_fail():
    write_targets("../up,a.fits,k1.fits,,1", ".hidden,a.fits,k1.fits,,1", GOOD[0])
    assert batch("--quiet") == 1
    assert list(summary()) == ["row1", "row2", "one"]
    assert "its name '../up' cannot be that of a file" in summary()["row1"]["message"]


@pytest.mark.exhaustive
def test_batch_picture_is_drawn_and_not_overwritten(capsys):
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    name = r"$\two{$"  # which is no formula
    write_targets(GOOD[0], GOOD[1].replace("two", name), "lost,gone.fits,k1.fits,,2")
    assert batch("--plot", "page.png") == 1
    assert "drew page.png" in capsys.readouterr().out
    assert imread("page.png").std() > 0.1
    assert batch("--plot", "page.png") == 1
    assert "page.png exists" in capsys.readouterr().err


@pytest.mark.exhaustive
def test_an_interrupt_ends_it_and_the_next_call_goes_on():
    write_targets(GOOD[0], 'long,cube.fits,psfs.fits,"7,5",1000000', GOOD[1])
    words = [sys.executable, "-m", "lnocl", "batch", "targets.csv", "-o", "out"]
    # Whoever runs the tests in the background may ignore it.
    heeded = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(words, stderr=subprocess.PIPE, text=True, preexec_fn=heeded) as process:
        while not os.path.exists("out/long.json"):
            time.sleep(0.01)
        time.sleep(0.5)  # it listens from the first iteration on
        process.send_signal(signal.SIGINT)
        assert process.stderr.read().splitlines()[-1] == (
            "lnocl: error: interrupted: the same command goes on with the targets that are left"
        )
    assert process.returncode == 130
    assert json.loads(Path("out/long.json").read_text())["status"] == "started"
    assert [each["status"] for each in summary().values()] == ["done", "started", "waiting"]
    os.remove("out/long.fits")  # of the run that was interrupted
    write_targets(GOOD[0], 'long,cube.fits,psfs.fits,"7,5",2', GOOD[1])
    assert batch("--quiet") == 0
    assert [each["n_iter"] for each in summary().values()] == [3, 2, 2]


@pytest.mark.parametrize("error", [ValueError("odd"), RecursionError("deep"), KeyError("k")])
def test_an_error_that_nobody_thought_of_is_a_row(error, monkeypatch):
    solve = deconvolve.solve

    def fail(arguments, *more):
        if "a.fits" in arguments.images:
            raise error
        return solve(arguments, *more)

    monkeypatch.setattr(deconvolve, "solve", fail)
    write_targets("odd,a.fits,k1.fits,,1", "good,b.fits,k1.fits,,1")
    assert batch("--quiet") == 1
    found = summary()
    assert found["good"]["status"] == "done"
    assert found["odd"]["message"].startswith(f"{type(error).__name__}: ")
    assert "Traceback" in Path("out/odd.log").read_text()


def test_a_row_that_is_mended_is_done():
    write_targets("t,a.fits,gone.fits,,1")
    assert batch("--quiet") == 1
    write_targets("t,a.fits,k1.fits,,1")
    assert batch("--quiet") == 0


def test_files_of_others_and_inputs_stay(capsys):
    write_targets("one,a.fits,k1.fits,,1")
    os.mkdir("out")
    os.rename("targets.csv", "out/summary.ecsv")
    table = Table.read("out/summary.ecsv", format="ascii.csv")
    table.write("out/summary.ecsv", overwrite=True)
    given = Path("out/summary.ecsv").read_bytes()
    assert cli.main(["batch", "out/summary.ecsv", "-o", "out"]) == 2
    assert "out/summary.ecsv is one of the inputs" in one_complaint(capsys.readouterr())
    assert Path("out/summary.ecsv").read_bytes() == given
    os.remove("out/summary.ecsv")
    Path("out/one.log").write_text("mine")
    write_targets("one,a.fits,k1.fits,,1")
    assert batch("--quiet") == 1
    assert Path("out/one.log").read_text() == "mine"
    image = Path("b.fits").read_bytes()
    write_targets("b,a.fits,k1.fits,,1", "q,b.fits,k1.fits,,1")
    assert cli.main(["batch", "targets.csv", "-o", ".", "--overwrite", "--quiet"]) == 1
    assert Path("b.fits").read_bytes() == image
    assert json.loads(Path("q.json").read_text())["status"] == "done"


def test_summary_gives_the_status_of_each_row_of_the_current_table():
    write_targets("../up,a.fits,k1.fits,,1", "b,a.fits,k1.fits,,1", "c,a.fits,k1.fits,,1")
    assert batch("--quiet", "--array", "1/2") == 1
    assert batch("--quiet", "--array", "2/2") == 0
    assert [each["status"] for each in summary().values()] == ["failed", "done", "done"]
    os.remove("out/c.fits")
    write_targets("b,a.fits,k1.fits,,2", "c,a.fits,k1.fits,,1", "d,a.fits,k1.fits,,1")
    assert batch("--quiet", "--array", "3/3") == 0
    assert [each["status"] for each in summary().values()] == ["failed", "waiting", "done"]


def test_outputs_are_refused_when_files_resolve_from_another_folder(tmp_path, monkeypatch):
    write_targets("t,a.fits,k1.fits,,1")
    assert batch("--quiet") == 0
    for name in ("b.fits", "k1.fits", "targets.csv"):
        os.makedirs("other", exist_ok=True)
        os.link(name, f"other/{name.replace('b.', 'a.')}")
    monkeypatch.chdir("other")
    assert cli.main(["batch", "targets.csv", "-o", "../out", "--quiet"]) == 1


def test_columns_with_units_are_refused(capsys):
    table = Table({"images": ["a.fits"], "psf": ["k1.fits"], "exposure": [30.0]})
    table["exposure"].unit = "min"
    table.write("t.ecsv")
    assert cli.main(["batch", "t.ecsv", "-o", "out"]) == 2
    assert "column 'exposure' of t.ecsv has a unit, min; give its" in capsys.readouterr().err


def test_arrays_of_positions_are_pairs():
    Table({"images": ["a.fits"], "star": [[(1.0, 2.5), (3.0, 4.0)]]}).write("t.fits")
    assert read_targets("t.fits")[0].words == ("a.fits", "--star", "1,2.5", "--star", "3,4")


def test_without_dask_it_works_but_in_parallel(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    write_targets(*GOOD)
    assert batch("--parallel", "2") == 1
    assert one_complaint(capsys.readouterr()) == (
        "--parallel needs Dask; install it with: pip install distributed"
    )
    assert batch("--quiet") == 0
