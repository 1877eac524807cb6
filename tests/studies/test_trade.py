"""The bench: its numbers, its front and advice, and what it leaves when refused or stopped."""

import functools
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from hypothesis import given
from hypothesis import strategies as st
from scenes import Recipe, paper

import lnocl
from lnocl import metrics
from lnocl.commands import cli
from lnocl.plotting.curves import draw_costs
from lnocl.simulation import hh34, simulate
from lnocl.studies import bench, demo, experiment, trade

pytestmark = pytest.mark.usefixtures("few_screens")

MADE = Recipe((32, 32), n_images=2, n_stars=1, mu=1e-4, smooth=True, psf_shape=(9, 9)).make()
N_ITER = 8
ROWS = 16


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fits.writeto("images.fits", MADE.images)
    fits.writeto("psfs.fits", MADE.psfs)
    return tmp_path


FILES = ("images.fits", "--psf", "psfs.fits", "--background", "8", "--mu", "1e-4")
STAR = ("--star", "9,17")


def run(*arguments):
    return cli.main(["bench", "--n-iter", str(N_ITER), *arguments])


def by_numpy(*arguments, device, **keywords):
    return paper(*arguments, engine="numpy", **keywords)


@pytest.fixture(
    scope="module", params=["numpy", pytest.param("opencl", marks=pytest.mark.exhaustive)]
)
def engine(request):
    """Return the name of the engine that a comparison is made with."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "numpy":
            patch.setattr(trade, "deconvolve", by_numpy)
        yield request.param


@pytest.fixture(scope="module")
def tables(engine):
    """Return the tables that a comparison yields, one after each run."""
    return list(trade.compare(MADE.observation(), MADE.stars, 1e-4, N_ITER))


@pytest.fixture
def numpy_only(monkeypatch):
    """Compute with the reference engine, for which nothing is compiled."""
    monkeypatch.setattr(trade, "deconvolve", by_numpy)


def direct(row, engine, n_iter=None):
    return paper(
        MADE.observation(),
        MADE.stars,
        mu=1e-4,
        n_iter=n_iter or int(row["iterations"]),
        precision=str(row["precision"]),
        pad=int(row["pad"]),
        engine=engine,
    )


class TestNumbers:
    def test_a_row_for_each_setting(self, tables):
        assert [len(table) for table in tables] == [4, 8, 12, 16]
        last = tables[-1]
        settings = [("double", 0), ("single", 0), ("double", 4), ("single", 4)]
        assert list(zip(last["precision"], last["pad"], last["iterations"], strict=True)) == [
            (precision, pad, n) for precision, pad in settings for n in (1, 2, 4, 8)
        ]
        assert not {"rho", "rho_star", "mag_error"} & set(last.colnames)

    @pytest.mark.parametrize("i", range(ROWS))
    def test_deviations_are_those_of_direct_runs(self, tables, engine, i):
        row = tables[-1][i]
        found, reference = (direct(each, engine) for each in (row, tables[0][3]))
        f, f0 = found.extended, reference.extended
        near = slice(17 - 12, 17 + 12)
        flux, flux0 = f.sum(axis=1), f0.sum(axis=1)
        counts = flux0 >= 0.05 * flux0.max()
        threshold = 0.1 * f0.max()
        width, width0 = (metrics.width_profile(each, threshold) for each in (f, f0))
        expected = {
            "deviation": np.sqrt(((f - f0) ** 2).sum() / (f0**2).sum()),
            "near_star": np.sqrt(((f - f0)[near] ** 2).sum() / (f0[near] ** 2).sum()),
            "star_flux": abs(found.star_fluxes[0] / reference.star_fluxes[0] - 1),
            "flux": np.abs(flux / flux0 - 1)[counts].max(),
            "width": np.abs(width / np.where(width0, width0, np.nan) - 1)[width0 > 0].max(),
        }
        got = {name: row[name] for name in expected}
        assert got == pytest.approx(expected, rel=1e-6, abs=1e-12)
        # The reference knows no single precision.
        assert (row["deviation"] == 0) == (i == 3 or (i == 7 and engine == "numpy"))

    def test_the_goal_is_the_objective_of_the_reference(self, tables, engine):
        table = tables[-1]
        goal = direct(table[3], engine).history["objective"][-1] * (1 + 1e-3)
        for i in range(0, ROWS, 4):
            objective = direct(table[i], engine, N_ITER).history["objective"]
            reached = np.flatnonzero(objective <= goal)
            expected = reached[0] * table["ms"][i] / 1e3 if reached.size else np.nan
            np.testing.assert_allclose(table["to_goal"][i : i + 4], expected)
        assert np.isfinite(table["to_goal"][3])

    def test_times_are_positive_and_go_with_the_iterations(self, tables):
        table = tables[-1]
        assert (table["ms"] > 0).all()
        np.testing.assert_allclose(table["seconds"], table["ms"] * table["iterations"] / 1e3)

    @pytest.mark.usefixtures("numpy_only")
    @pytest.mark.parametrize("stars", [[], [(9, 3)]], ids=["none", "at the edge"])
    def test_without_rows_around_a_star_all_rows_count(self, stars):
        *_, table = trade.compare(MADE.observation(), stars, n_iter=N_ITER)
        assert np.isnan(table["near_star"]).all()
        assert np.isnan(table["star_flux"]).all() == (not stars)
        assert np.isfinite(table["flux"]).all()
        assert trade.deviation_column(table) == "deviation"
        shown = [float(f"{deviation:.1e}") for deviation in table["deviation"]]
        expected = trade.pareto_front(table["seconds"], shown)
        np.testing.assert_array_equal(table["front"], expected)

    @pytest.mark.usefixtures("numpy_only")
    def test_a_psf_of_one_pixel_asks_for_no_padding(self):
        *_, table = trade.compare(MADE.observation(psfs=np.ones((1, 1))), n_iter=N_ITER)
        assert set(table["pad"]) == {0}

    @pytest.mark.usefixtures("numpy_only")
    def test_a_warning_comes_once(self):
        narrow = np.ones((1, 65))
        with pytest.warns(lnocl.LnoclWarning, match="larger than the grid") as caught:
            list(trade.compare(MADE.observation(psfs=narrow), n_iter=N_ITER))
        assert len(caught) == 1

    @pytest.mark.usefixtures("numpy_only")
    def test_images_without_light_are_refused(self):
        dark = lnocl.Observation(np.zeros((8, 8)), np.ones((3, 3)))
        with pytest.raises(lnocl.InputError, match="hold no light"):
            list(trade.compare(dark, n_iter=N_ITER))


class Clock:
    """A device whose first iteration takes 100 s, later ones 2, a fetch 5 and telling 7."""

    def __init__(self):
        self.now = 0.0
        self.pending = 0.0

    @property
    def star_fluxes(self):
        return np.ones(1)

    @functools.cached_property
    def extended(self):
        self.now += self.pending + 5.0
        self.pending = 0.0
        return np.ones((2, 2))

    def tell(self):
        self.now += 7.0


@pytest.mark.parametrize("checkpoints", [[1, 2, 4, 8], [2, 4, 8], [8]])
def test_the_clock_holds_the_iterations_after_the_first_and_nothing_else(checkpoints, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(trade.time, "perf_counter", lambda: clock.now)
    timer = trade.IterationTimer(checkpoints, clock.tell)
    for iteration in range(1, 9):
        clock.pending += 100.0 if iteration == 1 else 2.0
        timer(iteration, clock)
        clock.__dict__.pop("extended", None)  # lnocl makes a new estimate for each call
    assert timer.seconds_each == 2.0
    assert list(timer.estimates) == checkpoints


COSTS = st.one_of(st.integers(0, 4).map(float), st.just(float("nan")))


@given(st.lists(st.tuples(COSTS, COSTS), min_size=1, max_size=12))
def test_front_is_what_brute_force_finds(settings):
    def beaten(s, d):
        return any(
            other != (s, d) and other[0] <= s and other[1] <= d
            for other in settings
            if not np.isnan(other).any()
        )

    expected = [not np.isnan([s, d]).any() and not beaten(s, d) for s, d in settings]
    seconds, deviations = zip(*settings, strict=True)
    assert trade.pareto_front(seconds, deviations).tolist() == expected


class TestAdvice:
    @pytest.mark.parametrize("accuracy", [1e-15, 1e-4, 0.1, 0.3, 1.0, 10.0])
    def test_it_is_the_fastest_row_within_the_accuracy(self, tables, accuracy):
        table = tables[-1]
        rows = [row for row in table if row["near_star"] <= accuracy]
        best = min(rows, key=lambda row: row["seconds"])
        assert best["front"]
        padding = f"{best['pad']} pixels of padding" if best["pad"] else "no padding"
        assert trade.advice(table, accuracy) == (
            f"for an accuracy of {accuracy:g}: {best['precision']} precision, {padding}, "
            f"{best['iterations']} iterations: {best['seconds']:.2g} s, "
            f"deviation {best['near_star']:.1e}"
        )

    def test_where_there_is_none_it_says_so(self, tables):
        assert trade.advice(tables[0][:3], 1e-9) == (
            "for an accuracy of 1e-09: no setting is so close to the reference"
        )


@pytest.mark.usefixtures("engine")
class TestCommand:
    def test_files(self, tables, capsys):
        assert run(*FILES, *STAR, "-o", "out", "--accuracy", "0.01") == 0
        captured = capsys.readouterr()
        assert captured.err == ""
        table = Table.read("out.ecsv")
        for name in ("deviation", "near_star", "star_flux", "flux", "width"):
            np.testing.assert_allclose(table[name], tables[-1][name], rtol=1e-6, atol=1e-12)
        lines = captured.out.splitlines()
        assert len([line for line in lines if line.startswith(("double ", "single "))]) == ROWS
        assert lines[-1] == trade.advice(table, 0.01)
        assert table.meta["device"] in lines[0]
        assert (table.meta["version"], table.meta["accuracy"]) == (lnocl.__version__, 0.01)
        inputs = table.meta["inputs"]
        assert (set(inputs["images"]), set(inputs["psfs"])) == ({"images.fits"}, {"psfs.fits"})
        assert (table.meta["stars"], table.meta["mu"]) == ([[9.0, 17.0]], 1e-4)
        assert Path("out.png").exists() == ("drew out.png" in lines)

    @pytest.mark.usefixtures("numpy_only")
    def test_the_demo_has_a_truth(self, capsys):
        assert run("--size", "64", "-o", "out") == 0
        table = Table.read("out.ecsv")
        simulation = simulate(hh34(64))
        result = paper(
            experiment.observe(simulation),
            simulation.stars,
            mu=demo.MU,
            n_iter=N_ITER,
            engine="numpy",
        )
        truth, reference = simulation.extended, table[3]
        rows = metrics.star_rows(simulation.stars[0], truth.shape)
        ratio = result.star_fluxes[0] / simulation.star_fluxes[0]
        expected = {
            "rho": metrics.restoration_error(result.extended, truth),
            "rho_star": metrics.restoration_error(result.extended, truth, rows),
            "mag_error": -2.5 * np.log10(ratio),
        }
        got = {name: reference[name] for name in expected}
        assert got == pytest.approx(expected, rel=1e-9)
        assert set(table["pad"]) == {0, 32}
        assert table.meta["inputs"] == {"scene": "hh34", "size": 64, "seed": 0}

    def test_without_output_nothing_is_written(self, capsys):
        before = sorted(os.listdir())
        assert run(*FILES, *STAR) == 0
        assert capsys.readouterr().out.splitlines()[-1].startswith("for an accuracy of 0.001: ")
        assert sorted(os.listdir()) == before

    def test_without_matplotlib_the_table_is_written(self, capsys, monkeypatch):
        monkeypatch.setitem(sys.modules, "matplotlib", None)
        assert run(*FILES, *STAR, "-o", "out") == 0
        assert "no picture: pictures need matplotlib" in capsys.readouterr().out
        assert (Path("out.ecsv").exists(), Path("out.png").exists()) == (True, False)

    def test_what_is_interrupted_keeps_its_complete_runs(self, tables, capsys, monkeypatch):
        calls, deconvolve = [], trade.deconvolve

        def stop(*arguments, **keywords):
            calls.append(keywords["n_iter"])
            if calls.count(N_ITER) == 3:
                raise KeyboardInterrupt
            return deconvolve(*arguments, **keywords)

        monkeypatch.setattr(trade, "deconvolve", stop)
        assert run(*FILES, *STAR, "-o", "out") == 130
        captured = capsys.readouterr()
        assert captured.err == "lnocl: error: interrupted\n"
        assert captured.out.splitlines()[-1].startswith("for an accuracy of 0.001: ")
        kept = Table.read("out.ecsv")
        np.testing.assert_allclose(kept["deviation"], tables[1]["deviation"], atol=1e-12)

    def test_what_is_interrupted_before_a_run_is_done_leaves_nothing(self, capsys, monkeypatch):
        def stop(*arguments, **keywords):
            raise KeyboardInterrupt

        monkeypatch.setattr(trade, "deconvolve", stop)
        assert run(*FILES, *STAR, "-o", "out") == 130
        assert capsys.readouterr() == ("", "lnocl: error: interrupted\n")
        assert not Path("out.ecsv").exists()

    @pytest.mark.parametrize("ending", ["ecsv", "png"])
    def test_existing_files_are_refused_before_the_work(self, ending, capsys, monkeypatch):
        monkeypatch.setattr(bench.FitsFiles, "load", lambda source: pytest.fail("work was begun"))
        Path(f"out.{ending}").write_text("kept")
        assert run(*FILES, "-o", "out") == 1
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith(f"lnocl: error: the output out.{ending} exists")
        assert captured.err.count("\n") == 1
        assert Path(f"out.{ending}").read_text() == "kept"

    def test_overwrite_replaces(self):
        Path("out.ecsv").write_text("old")
        assert run(*FILES, *STAR, "-o", "out", "--overwrite") == 0
        assert len(Table.read("out.ecsv")) == ROWS

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--psf", "psfs.fits"], "--psf goes with images, and none are given"),
            (STAR, "--star goes with images"),
            (["--background", "8"], "--background goes with images"),
            (["--read-noise", "8"], "--read-noise goes with images"),
            (["images.fits"], "images need their PSFs: give --psf"),
            ([*FILES, "--size", "64"], "--size is of the demo's scene"),
            ([*FILES, "--n-iter", "7"], "--n-iter must be a whole number, 8 or more; 7"),
            ([*FILES, "--accuracy", "0"], "accuracy must be positive and finite; 0"),
            ([*FILES, "--accuracy", "nan"], "accuracy must be positive and finite; nan"),
            ([*FILES, "--star", "32,3"], "the star at (32, 3) lies outside"),
            ([*FILES, "--mu", "-1"], "mu must be"),
            ([*FILES, "--device", "no such"], "fits no OpenCL device"),
            (["--size", "65"], "each side must be even"),
            (["-o", "there/"], "names no file"),
        ],
    )
    def test_wrong_use_is_one_line(self, arguments, message, capsys):
        before = sorted(os.listdir())
        assert run(*arguments) == 2
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith("lnocl: error: ")
        assert captured.err.count("\n") == 1
        assert message in captured.err
        assert sorted(os.listdir()) == before


def test_the_front_has_no_masked_settings():
    seconds = np.ma.array([1.0, 2.0, 3.0], mask=[False, True, True])
    with pytest.raises(lnocl.InputError, match="seconds has 2 masked values; fill them or leave"):
        trade.pareto_front(seconds, [1.0, 2.0, 3.0])


def test_the_figure_joins_the_front_and_marks_the_reference():
    pytest.importorskip("matplotlib")
    settings = {
        "double": {
            "seconds": np.array([1.0, 4.0]),
            "deviation": np.array([0.1, 0.0]),
            "front": np.array([False, True]),
        },
        "single": {
            "seconds": np.array([2.0, 0.5]),
            "deviation": np.array([1e-6, 0.1]),
            "front": np.array([True, True]),
        },
    }
    (axis,) = draw_costs(settings, "all rows").axes
    lines = {line.get_label(): line for line in axis.lines}
    np.testing.assert_array_equal(lines["front"].get_data(), [[0.5, 2.0], [0.1, 1e-6]])
    np.testing.assert_array_equal(lines["double"].get_data(), [[1.0], [0.1]])
    np.testing.assert_array_equal(lines["single"].get_data(), [[2.0, 0.5], [1e-6, 0.1]])
    assert lines["reference (deviation 0)"].get_xdata()[0] == 4.0
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
