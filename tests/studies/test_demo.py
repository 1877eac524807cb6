"""Simulate, demo and plot from the command line, on the smallest scene."""

import json
import os
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

import lnocl
from lnocl.commands import cli, messages
from lnocl.io import fitswrite, saved_results
from lnocl.metrics import restoration_error, star_rows
from lnocl.simulation import Experiment, Star, load_target, simulate
from lnocl.studies import demo, figures

pytestmark = pytest.mark.usefixtures("few_screens")

SMALL = ("--size", "64")


def one_complaint(captured):
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("lnocl: error: ")
    return captured.err.removeprefix("lnocl: error: ")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Run the demo once; return its folder and what it said."""
    with pytest.MonkeyPatch.context() as patch, open(os.devnull, "w") as nowhere:
        home = tmp_path_factory.mktemp("demo")
        patch.chdir(home)
        patch.setattr(demo, "N_ITER", 100)
        patch.setattr(sys, "stderr", nowhere)
        said = []
        patch.setattr(messages, "say", said.extend)
        assert cli.main(["demo", *SMALL, "-o", "here"]) == 0
    return home / "here", said


class TestDemo:
    def test_it_writes_files_and_a_picture(self, run):
        files, _ = run
        numbers = range(1, 5)
        images = {f"{kind}_{j}.fits" for kind in ("image", "psf") for j in numbers}
        others = {"truth.fits", "record.json", "rlm.fits", "mc-rl.fits"}
        assert {path.name for path in files.glob("*[ns]")} == images | others
        pytest.importorskip("matplotlib")
        assert 10_000 < (files / "demo.png").stat().st_size < 400_000

    def test_its_table_has_the_errors_of_its_files(self, run):
        files, said = run
        truth = fits.getdata(files / "truth.fits")
        rows = [line.split() for line in said if line.startswith(("RLM ", "MC-RL "))]
        assert [row[0] for row in rows] == ["RLM", "MC-RL"]
        near = star_rows((32, 16), truth.shape)
        for row, name, star in zip(rows, ("rlm", "mc-rl"), ((32, 16), None), strict=True):
            found = fits.getdata(files / f"{name}.fits")
            errors = [restoration_error(found, truth, part, star) for part in (None, near)]
            assert row[1:3] == [f"{error:.2%}" for error in errors]
        fluxes = [fits.getdata(files / f"{name}.fits", "STARS")["flux"][0]
                  for name in ("mc-rl", "truth")]  # fmt: skip
        assert rows[1][3] == f"{fluxes[0] / fluxes[1] - 1:+.2%}"
        assert float(rows[0][2].rstrip("%")) > float(rows[1][2].rstrip("%"))

    @pytest.mark.exhaustive
    def test_the_command_in_a_result_repeats_it(self, run, folder, monkeypatch):
        files, _ = run
        header = fits.getheader(files / "mc-rl.fits")
        script = "\n".join(header["HISTORY"]).replace("\\\n", " ")
        home, words = (shlex.split(line) for line in script.splitlines())
        assert Path(home[1]) == files.parent
        monkeypatch.chdir(files.parent)
        assert cli.main([*words[1:-1], str(folder / "again.fits"), "--quiet"]) == 0
        again = saved_results.read_result(str(folder / "again.fits"))
        first = saved_results.read_result(str(files / "mc-rl.fits"))
        np.testing.assert_array_equal(again.extended, first.extended)
        np.testing.assert_array_equal(again.star_fluxes, first.star_fluxes)
        np.testing.assert_array_equal(
            again.tables["HISTORY"]["objective"], first.tables["HISTORY"]["objective"]
        )

    @pytest.mark.exhaustive
    def test_missing_matplotlib_is_reported_once_and_results_are_written(self, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        monkeypatch.setattr(demo, "N_ITER", 20)
        assert cli.main(["demo", *SMALL]) == 0
        told = [
            line
            for line in capsys.readouterr().out.splitlines()
            if "pip install matplotlib" in line
        ]
        assert len(told) == 1
        assert fits.getdata("lnocl_demo/mc-rl.fits").shape == (64, 64)

    @pytest.mark.parametrize(
        ("arguments", "status", "message"),
        [
            (["--size", "65"], 2, "sides must be whole, even"),
            (["--device", "no such"], 2, "fits no OpenCL device"),
            (["-o", "full"], 1, "the output folder full is not empty"),
        ],
    )
    def test_refusals(self, arguments, status, message, capsys):
        Path("full").mkdir()
        Path("full/kept.txt").write_text("kept")
        assert cli.main(["demo", *arguments]) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == ["full"]


BAD_SIMULATE = [
    (["text.fits"], 1, "text.fits is not a FITS file"),
    (["dark.fits", *SMALL], 2, "which has its own; leave it out"),
    (["hh34", "--angle", "0", "nan"], 2, "--angle must be finite"),
    (["hh34", "--exposure-time", "30"], 2, "--exposure-time must be a quantity in min"),
    (["hh34", "--star", "3,4"], 2, "argument --star: '3,4' is not X,Y,MAG"),
    (["hh34", "-o", "full"], 1, "the output folder full is not empty; give another"),
    (["hh34", "-o", "text.fits"], 1, "the output folder text.fits cannot be used"),
]


EXTREMES = [
    (["--star", "32,16,-40"], "all light together and the read noise would leave"),
    (["--exposure-time", "1e300min"], "would leave"),
]


class TestSimulate:
    @pytest.mark.parametrize(("arguments", "message"), EXTREMES)
    def test_extreme_numbers_are_refused_and_leave_no_folder(self, arguments, message, capsys):
        assert cli.main(["simulate", "hh34", *SMALL, *arguments, "-o", "deep/out"]) == 2
        assert message in one_complaint(capsys.readouterr())
        assert os.listdir() == []

    def test_a_folder_that_cannot_be_made_is_refused_before_the_work(self, capsys, monkeypatch):
        monkeypatch.setattr(
            "lnocl.simulation.simulate", lambda *arguments: pytest.fail("work was begun")
        )
        Path("text").write_text("kept")
        assert cli.main(["simulate", "hh34", *SMALL, "-o", "text/out"]) == 1
        assert "text/out cannot be used" in one_complaint(capsys.readouterr())

    @pytest.mark.exhaustive
    def test_the_files_hold_the_simulation(self, capsys):
        options = ("--exposure-time", "10 min", "--extended-magnitude", "12", "--seed", "3")
        arguments = ["hh34", *SMALL, "--angle", "0", "-60", "--star", "20,30,11.5"]
        assert cli.main(["simulate", *arguments, *options, "-o", "out"]) == 0
        expected = simulate(
            load_target("hh34", 64, [Star(20, 30, 11.5 * u.mag)]),
            Experiment(
                angles=(0, -60) * u.deg,
                exposure_time="10 min",
                extended_magnitude=12 * u.mag,
                seed=3,
            ),
        )
        for j in (1, 2):
            with fits.open(f"out/image_{j}.fits", checksum=True) as hdus:
                np.testing.assert_array_equal(hdus[0].data, expected.images[j - 1])
            np.testing.assert_array_equal(fits.getdata(f"out/psf_{j}.fits"), expected.psfs[j - 1])
        truth = saved_results.read_result("out/truth.fits")
        np.testing.assert_array_equal(truth.extended, expected.extended)
        assert truth.stars == [(20.0, 30.0)]
        np.testing.assert_array_equal(truth.star_fluxes, expected.star_fluxes)
        assert set(truth.tables) == {"STARS"}
        record = json.loads(Path("out/record.json").read_text())
        assert (record["lnocl"], record["scene"]) == (lnocl.__version__, "hh34")
        # The record is enough to repeat the experiment.
        again = Experiment(
            **{
                name: u.Quantity(**value) if isinstance(value, dict) else value
                for name, value in record["experiment"].items()
            }
        )
        assert str(again) == str(expected.experiment)
        assert len(os.listdir("out")) == 6
        told = capsys.readouterr().out.splitlines()[-1]
        background = repr(float(expected.background[0]))
        assert told == (
            "lnocl deconvolve out/image_1.fits out/image_2.fits --psf out/psf_1.fits "
            f"out/psf_2.fits --background {background} --read-noise 10.0 --star 20,30 "
            "--psf-error 0 --pad 0 -o out/result.fits"
        )
        assert cli.main([*shlex.split(told)[1:], "--n-iter", "2", "--engine", "numpy"]) == 0
        assert fits.getdata("out/result.fits").shape == (64, 64)

    def test_the_same_seed_gives_the_same_bytes(self):
        for name in ("one", "two"):
            assert cli.main(["simulate", "hh34", *SMALL, "-o", name, "--angle", "30"]) == 0
        assert cli.main(["simulate", "hh34", *SMALL, "--seed", "1", "-o", "3", "--angle=30"]) == 0
        for name in ("image_1.fits", "psf_1.fits", "record.json"):
            one, two, other = (Path(folder, name).read_bytes() for folder in ("one", "two", "3"))
            assert one == two
            assert one != other

    def test_the_defaults_of_the_help_are_those_of_the_experiment(self, monkeypatch):
        stated = ["--angle", "0", "45", "90", "135", "--exposure-time", "30 min"]
        stated += ["--extended-magnitude", "13", "--seed", "0"]
        asked = []

        def refuse(target, experiment):
            asked.append(experiment)
            raise lnocl.InputError("enough")

        monkeypatch.setattr("lnocl.simulation.simulate", refuse)
        assert cli.main(["simulate", "hh34", *SMALL, "-o", "out", *stated]) == 2
        assert str(asked[0]) == str(Experiment())

    def test_overwrite_replaces(self):
        command = ["simulate", "hh34", *SMALL, "-o", "out", "--angle", "0"]
        assert cli.main(command) == 0
        before = Path("out/image_1.fits").read_bytes()
        assert cli.main([*command, "--seed", "2", "--overwrite"]) == 0
        assert Path("out/image_1.fits").read_bytes() != before

    def test_a_file_is_a_scene(self):
        image = np.zeros((48, 40))
        image[20:30, 18:22] = 1.0
        fits.writeto("mine.fits", image, fits.Header({"STARX": 20, "STARY": 24}))
        assert cli.main(["simulate", "mine.fits", "-o", "out", "--angle", "0"]) == 0
        assert saved_results.read_result("out/truth.fits").stars == [(20.0, 24.0)]

    @pytest.mark.parametrize(("arguments", "status", "message"), BAD_SIMULATE)
    def test_refusals(self, arguments, status, message, capsys, monkeypatch):
        monkeypatch.setattr(
            "lnocl.simulation.simulate", lambda *arguments: pytest.fail("work was begun")
        )
        fits.writeto("dark.fits", np.zeros((64, 64)))
        Path("text.fits").write_text("no FITS")
        Path("full").mkdir()
        Path("full/kept.txt").write_text("kept")
        before = sorted(os.listdir())
        size = SMALL if arguments[0] == "hh34" and "--size" not in arguments else ()
        assert cli.main(["simulate", "-o", "out", *arguments, *size]) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == before


@pytest.mark.usefixtures("quick_figures")
class TestPlot:
    @pytest.fixture(autouse=True)
    def _matplotlib(self):
        pytest.importorskip("matplotlib")

    def test_of_one_result_its_picture_is_drawn(self, capsys):
        image = np.ones((32, 32))
        history = np.array([(0, 3.5), (1, 2.5)], [("iteration", int), ("objective", float)])
        fitswrite.write_result("a.fits", image, [], [], {"HISTORY": history})
        assert cli.main(["plot", "a.fits", "-o", "out"]) == 0
        assert capsys.readouterr().out.splitlines() == [
            "drew out/result.png",
            "a.fits has no models and residuals to show: repeat its run with --residuals, "
            "or draw them in the run, with --plot",
        ]
        assert os.listdir("out") == ["result.png"]

    @pytest.mark.exhaustive
    def test_several_results_of_several_stars_are_compared(self, capsys):
        cubes = {name: np.ones((1, 32, 32)) for name in ("MODELS", "RESIDUALS", "ELECTRONS")}
        for name in "ab":
            fitswrite.write_result(
                f"{name}.fits", np.ones((32, 32)), [(3, 4), (9, 9)], [2.0, 1.0], cubes
            )
        assert cli.main(["plot", "a.fits", "b.fits", "-o", "out"]) == 0
        drawn = ["drew out/result_1.png", "drew out/result_2.png", "drew out/objects.png"]
        assert capsys.readouterr().out.splitlines() == drawn

    def test_names_tell_results_apart(self):
        paths = ["a.fits", "in/b.fits", "to/b.fits", "rlm.fits"]
        assert figures._names(paths) == ["a", "in/b.fits", "to/b.fits", "rlm"]

    @pytest.mark.parametrize(
        ("arguments", "status", "message"),
        [
            (["no.fits"], 1, "no.fits cannot be opened"),
            (["image.fits"], 1, "image.fits is not a result or truth written by lnocl"),
            (["a.fits", "b.fits"], 2, "b.fits has the shape (8, 8) and a.fits (9, 8)"),
            (["nan.fits"], 2, "nan.fits holds values that are not finite"),
            (
                ["a.fits", "-o", "full"],
                1,
                "full/result.png exists; give another name, or --overwrite",
            ),
        ],
    )
    def test_refusals(self, arguments, status, message, capsys):
        arrays = {"a": np.ones((9, 8)), "b": np.ones((8, 8))}
        for name, array in {**arrays, "nan": np.full((8, 8), np.nan)}.items():
            fitswrite.write_result(f"{name}.fits", array, [], [])
        fits.writeto("image.fits", np.ones((8, 8)))
        Path("full").mkdir()
        Path("full/result.png").write_text("kept")
        before = sorted(os.listdir())
        assert cli.main(["plot", "-o", "out", *arguments]) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == before
        assert Path("full/result.png").read_text() == "kept"

    def test_without_matplotlib(self, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        assert cli.main(["plot", "a.fits", "-o", "out"]) == 1
        assert "pip install matplotlib" in one_complaint(capsys.readouterr())
        assert not Path("out").exists()
