"""Simulate, demo and plot from the command line, on the smallest scene."""

import json
import os
import runpy
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
from lnocl.plotting.figure import save_figure
from lnocl.simulation import Experiment, Star, Target, hh34, load_target, simulate
from lnocl.simulation.photometry import MAG_PER_ARCSEC2
from lnocl.studies import demo, experiment, figures, files

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


def save_one(figure, path, overwrite):
    """Render the first picture alone: each takes a second."""
    if Path(path).stem == "demo":
        save_figure(figure, path, overwrite)
    else:
        Path(path).touch()


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
        patch.setattr(figures, "save_figure", save_one)
        assert cli.main(["demo", *SMALL, "-o", "here"]) == 0
    return home / "here", said


class TestDemo:
    def test_it_writes_files_and_pictures(self, run):
        files, _ = run
        numbers = range(1, 5)
        assert {path.name for path in files.iterdir()} >= {
            *(f"{kind}_{j}.fits" for kind in ("image", "psf") for j in numbers),
            *("truth.fits", "record.json", "rlm.fits", "mc-rl.fits"),
        }
        pytest.importorskip("matplotlib")
        pictures = {path.stem: path.stat().st_size for path in files.glob("*.png")}
        names = {"demo", "objects", "errors", "magnitude", "flux", "width", "result_1", "result_2"}
        assert set(pictures) == names
        assert max(pictures.values()) < 400_000

    def test_its_table_has_the_numbers_of_its_files(self, run):
        files, said = run
        rows = [line.split() for line in said if line.startswith(("RLM ", "MC-RL "))]
        assert [row[0] for row in rows] == ["RLM", "MC-RL"]
        for row, name in zip(rows, ("rlm", "mc-rl"), strict=True):
            curve = saved_results.read_result(str(files / f"{name}.fits")).tables["CURVE"]
            assert f"{curve['rho'].min():.2%}" in row
            assert f"{curve['rho_star'].min():.2%}" in row
        assert float(rows[0][3].rstrip("%")) > float(rows[1][4].rstrip("%"))

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
    def test_the_same_numbers_each_time(self, run, capsys, monkeypatch):
        files, said = run
        monkeypatch.setattr(demo, "N_ITER", 100)
        monkeypatch.setattr(demo, "_pictures", lambda *arguments: iter(()))
        assert cli.main(["demo", *SMALL, "-o", "here"]) == 0
        numbers = [line for line in said if not line.startswith("drew ")]
        assert capsys.readouterr().out.splitlines() == numbers
        for name in ("rlm.fits", "mc-rl.fits"):
            np.testing.assert_array_equal(
                fits.getdata(Path("here", name)), fits.getdata(files / name)
            )

    def test_without_matplotlib_it_says_what_to_install(self, capsys, monkeypatch):
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
            (["--size", "65"], 2, "each side must be even"),
            (["--size", "32"], 2, "each side must be even and 64 or more"),
            (["--seed", "-1"], 2, "seed must be a whole number"),
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


BAD_SIMULATE = {
    "scene": (["hh35"], 2, "scene 'hh35' is neither a built-in one (hh34) nor a file"),
    "odd": (["hh34", "--size", "129"], 2, "the image is 129 x 129 pixels; each side must be"),
    "small": (["hh34", "--size", "32"], 2, "each side must be even and 64 or more"),
    "no flux": (["dark.fits"], 2, "the extended source has no flux"),
    "no FITS": (["text.fits"], 1, "text.fits is not a FITS file"),
    "size of a file": (["dark.fits", *SMALL], 2, "which has its own; leave it out"),
    "strehl 0": (["hh34", "--strehl", "0"], 2, "strehl must be in (0, 1]; 0.0 was given"),
    "strehl 2": (["hh34", "--strehl", "2"], 2, "strehl must be in (0, 1]"),
    "strehl nan": (["hh34", "--strehl", "nan"], 2, "strehl must be in (0, 1]"),
    "angle": (["hh34", "--angle", "0", "nan"], 2, "angles must be finite"),
    "angle inf": (["hh34", "--angle", "-inf"], 2, "angles must be finite"),
    "throughput": (["hh34", "--throughput", "1.5"], 2, "throughput must be in (0, 1]"),
    "time": (["hh34", "--exposure-time", "30"], 2, "--exposure-time must be a quantity in min"),
    "no time": (["hh34", "--exposure-time", "0 s"], 2, "--exposure-time must be positive"),
    "sky": (["hh34", "--sky", "nan"], 2, "--sky must be finite"),
    "noise": (["hh34", "--read-noise", "-1"], 2, "--read-noise must be one number, 0 or more"),
    "seed": (["hh34", "--seed", "-2"], 2, "seed must be a whole number, 0 or more"),
    "star": (["hh34", "--star", "3,4"], 2, "argument --star: '3,4' is not X,Y,MAG"),
    "outside": (["hh34", *SMALL, "--star", "64,4,13"], 2, "lies outside the image"),
    "between": (["hh34", *SMALL, "--star", "6.5,4,13"], 2, "lies between pixels"),
    "magnitude": (["hh34", *SMALL, "--star", "6,4,nan"], 2, "the magnitude of a star must"),
    "folder": (["hh34", "-o", "full"], 1, "the output folder full is not empty; give another"),
    "file": (["hh34", "-o", "text.fits"], 1, "the output folder text.fits cannot be used"),
}


EXTREMES = {
    "star": (["--star", "32,16,-40"], "the star at (32, 16) would leave"),
    "time": (["--exposure-time", "1e300min"], "would leave"),
    "sky": (["--sky", "-1000"], "too bright"),
}


class TestSimulate:
    @pytest.mark.parametrize(("arguments", "message"), EXTREMES.values(), ids=EXTREMES)
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

    def test_the_record_is_whole_or_not_there(self, capsys, monkeypatch):
        simulation = simulate(hh34(64), Experiment(angles=0 * u.deg))
        Path("out").mkdir()
        Path("out/record.json").write_text("kept")
        with pytest.raises(lnocl.FileError, match=r"record.json exists"):
            files.write_simulation("out", "hh34", simulation)
        assert Path("out/record.json").read_text() == "kept"

        def fail(*names):
            if str(names[1]).endswith("record.json"):
                raise OSError(28, "No space left on device")
            return replace(*names)

        replace = os.replace
        monkeypatch.setattr(os, "replace", fail)
        with pytest.raises(lnocl.FileError, match=r"record.json cannot be written: No space"):
            files.write_simulation("out", "hh34", simulation, overwrite=True)
        assert Path("out/record.json").read_text() == "kept"
        assert not list(Path("out").glob(".lnocl*"))

    def test_the_files_hold_the_simulation(self, capsys):
        options = ("--exposure-time", "10 min", "--strehl", "0.5", "--throughput", "0.2")
        more = ("--extended-magnitude", "12", "--sky", "14", "--read-noise", "5", "--seed", "3")
        arguments = ["hh34", *SMALL, "--angle", "0", "-60", "--star", "20,30,11.5"]
        assert cli.main(["simulate", *arguments, *options, *more, "-o", "out"]) == 0
        expected = simulate(
            load_target("hh34", 64, [Star(20, 30, 11.5 * u.mag)]),
            Experiment(
                angles=(0, -60) * u.deg,
                exposure_time="10 min",
                strehl=0.5,
                throughput=0.2,
                extended_magnitude=12 * u.mag,
                sky_brightness=14 * MAG_PER_ARCSEC2,
                read_noise=5 * u.electron,
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
        assert record == {"lnocl": lnocl.__version__, "scene": "hh34", **expected.record()}
        assert len(os.listdir("out")) == 6
        told = capsys.readouterr().out.splitlines()[-1]
        background = repr(float(expected.background[0]))
        assert told == (
            "lnocl deconvolve out/image_1.fits out/image_2.fits --psf out/psf_1.fits "
            f"out/psf_2.fits --background {background} --read-noise 5.0 --star 20,30 --pad 0 "
            "-o out/result.fits"
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
        stated += ["--strehl", "0.7", "--throughput", "0.3", "--extended-magnitude", "13"]
        stated += ["--sky", "13.5", "--read-noise", "10", "--seed", "0"]
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

    @pytest.mark.parametrize(
        ("arguments", "status", "message"), BAD_SIMULATE.values(), ids=BAD_SIMULATE
    )
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

    def test_everything_the_data_allow(self, run, capsys):
        files, _ = run
        results = [str(files / f"{name}.fits") for name in ("rlm", "mc-rl")]
        truth = str(files / "truth.fits")
        assert cli.main(["plot", *results, "--truth", truth, "-o", "out"]) == 0
        names = ["result_1", "result_2", "errors", "magnitude", "objects", "flux", "width"]
        assert capsys.readouterr().out.splitlines() == [f"drew out/{name}.png" for name in names]
        assert sorted(os.listdir("out")) == sorted(f"{name}.png" for name in names)

    def test_of_one_result_its_picture_is_drawn(self, capsys):
        image = np.ones((32, 32))
        history = np.array([(0, 3.5), (1, 2.5)], [("iteration", int), ("objective", float)])
        fitswrite.write_result("a.fits", image, [], [], history)
        assert cli.main(["plot", "a.fits", "-o", "out"]) == 0
        assert capsys.readouterr().out.splitlines() == [
            "drew out/result.png",
            "a.fits has no models and residuals to show: repeat its run with --models --residuals, "
            "or draw them in the run, with --plot",
        ]
        assert os.listdir("out") == ["result.png"]

    def test_several_results_of_several_stars_are_compared(self, capsys):
        cubes = {"MODELS": (np.ones((1, 32, 32)), ""), "RESIDUALS": (np.ones((1, 32, 32)), "")}
        for name in "ab":
            fitswrite.write_result(
                f"{name}.fits", np.ones((32, 32)), [(3, 4), (9, 9)], [2.0, 1.0], cubes=cubes
            )
        fitswrite.write_result("truth.fits", np.ones((32, 32)), [(3, 4), (9, 9)], [2.0, 1.0])
        assert cli.main(["plot", "a.fits", "b.fits", "-o", "out"]) == 0
        drawn = ["drew out/result_1.png", "drew out/result_2.png", "drew out/objects.png"]
        assert capsys.readouterr().out.splitlines() == drawn
        assert cli.main(["plot", "a.fits", "b.fits", "--truth", "truth.fits", "-o", "more"]) == 0
        assert capsys.readouterr().out.splitlines()[2:] == [
            "drew more/objects.png",
            "flux and width skipped: they are profiles beside one star",
        ]

    def test_names_tell_results_apart(self):
        for name, method in (
            ("a", "RLM"),
            ("b", "MC-RL"),
            ("c", "MC-RL"),
            ("d", "MC-RL"),
            ("e", ""),
        ):
            cards = [("MU", 1e-8 if name == "d" else 0.0, "")]
            cards += [("METHOD", method, "")] if method else []
            fitswrite.write_result(f"{name}.fits", np.ones((8, 8)), [], [], cards=cards)
        paths = [f"{name}.fits" for name in "abcde"]
        saved = [saved_results.read_result(path) for path in paths]
        assert figures._names(paths, saved) == [
            "RLM",
            "MC-RL (b.fits)",
            "MC-RL (c.fits)",
            "MC-RL mu=1e-08",
            "e",
        ]

    @pytest.mark.parametrize(
        ("arguments", "status", "message"),
        [
            (["no.fits"], 1, "no.fits cannot be opened"),
            (["a.fits", "--truth", "no.fits"], 1, "no.fits cannot be opened"),
            (["image.fits"], 1, "image.fits is not a result or truth written by lnocl"),
            (["a.fits", "b.fits"], 2, "b.fits has the shape (8, 8) and a.fits (9, 8)"),
            (["b.fits", "--truth", "a.fits"], 2, "b.fits has the shape (8, 8) and a.fits (9, 8)"),
            (["nan.fits"], 2, "nan.fits holds values that are not finite"),
            (
                ["a.fits", "--truth", "dark.fits"],
                2,
                "dark.fits holds no flux; give another --truth",
            ),
            (
                ["a.fits", "-o", "full"],
                1,
                "full/flux.png exists; give another name, or --overwrite",
            ),
        ],
    )
    def test_refusals(self, arguments, status, message, capsys):
        arrays = {"a": np.ones((9, 8)), "b": np.ones((8, 8)), "dark": np.zeros((9, 8))}
        for name, array in {**arrays, "nan": np.full((8, 8), np.nan)}.items():
            fitswrite.write_result(f"{name}.fits", array, [], [])
        fits.writeto("image.fits", np.ones((8, 8)))
        Path("full").mkdir()
        Path("full/flux.png").write_text("kept")
        before = sorted(os.listdir())
        assert cli.main(["plot", "-o", "out", *arguments]) == status
        assert message in one_complaint(capsys.readouterr())
        assert sorted(os.listdir()) == before
        assert Path("full/flux.png").read_text() == "kept"

    def test_without_matplotlib(self, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        assert cli.main(["plot", "a.fits", "-o", "out"]) == 1
        assert "pip install matplotlib" in one_complaint(capsys.readouterr())
        assert not Path("out").exists()


@pytest.fixture(scope="module")
def simulation():
    return simulate(hh34(64), Experiment(angles=[0, 90] * u.deg))


class TestExperiment:
    @pytest.mark.parametrize(("every", "looks"), [(10, [3]), (2, [2, 3]), (1, [1, 2, 3])])
    def test_the_last_iteration_is_always_looked_at(self, simulation, every, looks):
        found = experiment.reconstruct(
            simulation, experiment.observe(simulation), "MC-RL", 0.0, 3, every, engine="numpy"
        )
        assert found.curve["iteration"].tolist() == looks
        assert found.best("rho_star")[0] in looks
        assert found.extended.shape == (64, 64)

    @pytest.mark.parametrize("n", [0, 2])
    def test_exactly_one_star(self, n):
        stars = [Star(10 + j, 20) for j in range(n)]
        several = simulate(
            Target(np.ones((64, 64)), stars),
            Experiment(angles=0 * u.deg),
        )
        with pytest.raises(lnocl.InputError, match=f"has {n} stars"):
            experiment.reconstruct(several, experiment.observe(several), "RLM", 0.0, 1)

    def test_every_is_positive(self, simulation):
        with pytest.raises(lnocl.InputError, match="every must be"):
            experiment.Tracker(simulation, "RLM", 0, 5)

    @pytest.mark.filterwarnings("error")
    def test_profile_errors_are_of_40_rows_or_nan(self):
        """20 rows before the star and 19 after it; NaN where all the light is beyond."""
        image = np.zeros((96, 64))
        image[70, 20] = 1.0
        star = Star(20, 50)
        how = Experiment(angles=0 * u.deg)
        for row, expected in ((70, np.nan), (69, 0.0), (30, 0.0), (29, np.nan)):
            moved = np.roll(image, row - 70, axis=0)
            made = simulate(Target(moved, [star]), how)
            curve = np.zeros(1, experiment.CURVE_DTYPE)
            found = experiment.Reconstruction("MC-RL", 0.0, curve, made.extended, 1.0)
            errors = experiment.profile_errors(made, found)
            np.testing.assert_array_equal(list(errors.values()), expected)


@pytest.fixture(scope="module")
def main():
    path = Path(__file__).parents[2] / "benchmarks" / "hh34_table.py"
    return runpy.run_path(str(path))["main"]


class TestTable:
    QUICK = ("--quick", "--mu", "3e-8", "-o", "t")

    def test_rows_are_kept_and_bound_to_their_experiment(self, main, capsys):
        assert main(self.QUICK) == 0
        names = ["mc-rl_3e-08.fits", "rlm_0.fits", "table.ecsv", "truth.fits"]
        assert sorted(os.listdir("t")) == names
        header = fits.getheader("t/mc-rl_3e-08.fits")
        assert {"NITER", "CREATOR", "SOLVER", "PIXSCALE", "MINUTES"} <= set(header)
        assert (header["SCENE"], header["SIZEX"], header["SEED"]) == ("hh34", 64, 0)
        truth = fits.getheader("t/truth.fits")
        assert truth["PIXSCALE"] == 5.0
        heading = capsys.readouterr().out
        assert all(name in heading for name in ("rho'", "rho' at", "rho''", "rho'' at"))
        before = {name: Path("t", name).read_bytes() for name in names}
        assert main(self.QUICK) == 0
        assert {name: Path("t", name).read_bytes() for name in names} == before
        capsys.readouterr()
        for option, keyword in (("--every", "EVERY"), ("--patience", "PATIENCE")):
            assert main([*self.QUICK, option, "7"]) == 2
            complaint = capsys.readouterr().err
            assert f"its {keyword} is" in complaint
            assert complaint.count("\n") == 1
        assert {name: Path("t", name).read_bytes() for name in names} == before

    def test_another_truth_is_refused_and_kept(self, main, capsys):
        Path("t").mkdir()
        fitswrite.write_result("t/truth.fits", np.ones((64, 64)), [(32, 16)], [1.0])
        before = Path("t/truth.fits").read_bytes()
        assert main(self.QUICK) == 2
        complaint = capsys.readouterr().err
        assert complaint == (
            "hh34_table: error: t/truth.fits is the truth of another experiment; give another "
            "folder\n"
        )
        assert Path("t/truth.fits").read_bytes() == before

    def test_wrong_use_is_one_line(self, main, capsys):
        assert main(["--size", "65", "-o", "t"]) == 2
        assert capsys.readouterr().err.startswith("hh34_table: error: the image is 65 x 65")
        assert os.listdir() == []

    def test_quick_takes_a_file(self, main):
        image = np.zeros((64, 64))
        image[20:60, 30:34] = 1.0
        fits.writeto("jet.fits", image, fits.Header({"STARX": 32, "STARY": 24}))
        assert main([*self.QUICK, "--scene", "jet.fits"]) == 0
        assert fits.getheader("t/rlm_0.fits")["SCENE"] == "jet.fits"
