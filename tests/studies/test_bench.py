"""The bench: its numbers and advice, and what it leaves when refused or stopped."""

import functools
import os

import numpy as np
import pytest
from astropy.io import fits
from scenes import Recipe, paper

import lnocl
from lnocl import metrics
from lnocl.commands import cli
from lnocl.simulation import hh34, simulate
from lnocl.studies import bench

pytestmark = pytest.mark.usefixtures("few_screens")

MADE = Recipe((32, 32), n_images=2, n_stars=1, smooth=True, psf_shape=(9, 9)).make()
CASE = bench.Case(MADE.observation(), MADE.stars)
N_ITER = 8
ROWS = 16


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fits.writeto("images.fits", MADE.images)
    fits.writeto("psfs.fits", MADE.psfs)
    return tmp_path


FILES = ("images.fits", "--psf", "psfs.fits", "--background", "8")
STAR = ("--star", "9,17")


def run(*arguments):
    return cli.main(["bench", "--n-iter", str(N_ITER), *arguments])


def by_numpy(*arguments, device, progress=False, **keywords):
    return paper(*arguments, engine="numpy", **keywords)


@pytest.fixture(
    scope="module", params=["numpy", pytest.param("opencl", marks=pytest.mark.exhaustive)]
)
def engine(request):
    """Return the name of the engine that a comparison is made with."""
    with pytest.MonkeyPatch.context() as patch:
        if request.param == "numpy":
            patch.setattr(bench, "deconvolve", by_numpy)
        yield request.param


@pytest.fixture(scope="module")
def table(engine):
    return list(bench.compare(CASE, N_ITER))


@pytest.fixture
def numpy_only(monkeypatch):
    """Compute with the reference engine, for which nothing is compiled."""
    monkeypatch.setattr(bench, "deconvolve", by_numpy)


def direct(row, engine):
    settings = {name: row[name] for name in ("precision", "pad")} | {"n_iter": row["iterations"]}
    return paper(CASE.observation, CASE.stars, engine=engine, **settings).extended


class TestNumbers:
    def test_a_row_for_each_setting(self, table):
        settings = [("double", 0), ("single", 0), ("double", 4), ("single", 4)]
        assert [(row["precision"], row["pad"], row["iterations"]) for row in table] == [
            (precision, pad, n) for precision, pad in settings for n in (1, 2, 4, 8)
        ]
        assert set(table[0]) == set(bench.COLUMNS) - {"error"}

    @pytest.mark.parametrize("i", range(ROWS))
    def test_deviations_are_those_of_direct_runs(self, table, engine, i):
        f, f0 = (direct(each, engine) for each in (table[i], table[3]))
        near = slice(17 - 12, 17 + 12)
        expected = np.sqrt(((f - f0)[near] ** 2).sum() / (f0[near] ** 2).sum())
        assert table[i]["deviation"] == pytest.approx(expected, rel=1e-6, abs=1e-12)
        # The reference knows no single precision.
        assert (table[i]["deviation"] == 0) == (i == 3 or (i == 7 and engine == "numpy"))

    def test_times_are_positive_and_go_with_the_iterations(self, table):
        for row in table:
            assert row["ms"] > 0
            assert row["seconds"] == pytest.approx(row["ms"] * row["iterations"] / 1e3)

    @pytest.mark.parametrize("stars", [[], [(9, 3)]], ids=["none", "at the edge"])
    def test_without_rows_around_a_star_all_rows_count(self, stars):
        assert bench.Case(CASE.observation, stars, []).rows == slice(None)

    @pytest.mark.usefixtures("numpy_only")
    def test_a_psf_of_one_pixel_asks_for_no_padding(self):
        case = bench.Case(MADE.observation(psfs=np.ones((1, 1))), [])
        assert {row["pad"] for row in bench.compare(case, N_ITER)} == {0}

    @pytest.mark.usefixtures("numpy_only")
    def test_a_warning_comes_once(self):
        case = bench.Case(MADE.observation(psfs=np.ones((1, 65))), [])
        with pytest.warns(lnocl.LnoclWarning, match="larger than the grid") as caught:
            list(bench.compare(case, N_ITER))
        assert len(caught) == 1

    @pytest.mark.usefixtures("numpy_only")
    def test_images_without_light_are_refused(self):
        dark = bench.Case(lnocl.Observation(np.zeros((8, 8)), np.ones((3, 3))), [])
        with pytest.raises(lnocl.InputError, match="hold no light"):
            list(bench.compare(dark, N_ITER))


class Clock:
    """A device whose first iteration takes 100 s, later ones 2 and a fetch 5."""

    def __init__(self):
        self.now = 0.0
        self.pending = 0.0

    @functools.cached_property
    def extended(self):
        self.now += self.pending + 5.0
        self.pending = 0.0
        return np.ones((2, 2))


@pytest.mark.parametrize("iterations", [[1, 2, 4, 8], [2, 4, 8], [8]])
def test_the_clock_holds_the_iterations_after_the_first_and_fetches(iterations, monkeypatch):
    clock = Clock()
    monkeypatch.setattr(bench.time, "perf_counter", lambda: clock.now)
    timer = bench.IterationTimer(iterations)
    for iteration in range(1, 9):
        clock.pending += 100.0 if iteration == 1 else 2.0
        timer(iteration, clock)
        clock.__dict__.pop("extended", None)  # lnocl makes a new estimate for each call
    assert timer.seconds == 7 * 2.0 + 5.0 * len({*iterations} - {1})
    assert list(timer.estimates) == iterations


class TestAdvice:
    @pytest.mark.parametrize("accuracy", [1e-15, 1e-4, 0.1, 0.3, 1.0, 10.0])
    def test_it_is_the_fastest_row_within_the_accuracy(self, table, accuracy):
        rows = [row for row in table if row["deviation"] <= accuracy]
        best = min(rows, key=lambda row: row["seconds"])
        padding = f"{best['pad']} pixels of padding" if best["pad"] else "no padding"
        assert bench.advice(table, accuracy) == (
            f"for an accuracy of {accuracy:g}: {best['precision']} precision, {padding}, "
            f"{best['iterations']} iterations: {best['seconds']:.2g} s, "
            f"deviation {best['deviation']:.1e}"
        )

    def test_unreachable_accuracy_gives_no_advice(self, table):
        assert bench.advice(table[:3], 1e-9) == (
            "for an accuracy of 1e-09: no setting is so close to the reference"
        )


@pytest.mark.usefixtures("engine")
class TestCommand:
    def test_rows_are_those_of_the_comparison(self, table, capsys):
        assert run(*FILES, *STAR, "--accuracy", "0.01") == 0
        captured = capsys.readouterr()
        assert captured.err == ""
        lines = captured.out.splitlines()
        rows = [line.split() for line in lines if line.startswith(("double ", "single "))]
        found = [float(row[5]) for row in rows]
        expected = [row["deviation"] for row in table]
        np.testing.assert_allclose(found, expected, rtol=0.06, atol=1e-12)
        assert lines[-1].startswith("for an accuracy of 0.01: ")

    @pytest.mark.exhaustive
    @pytest.mark.usefixtures("numpy_only")
    def test_the_demo_has_a_truth(self, capsys):
        assert run("--size", "64") == 0
        made = simulate(hh34(64))
        observation = lnocl.Observation(
            made.images, made.psfs, background=made.background, read_noise=made.read_noise
        )
        result = paper(observation, made.stars, n_iter=N_ITER, engine="numpy")
        rows = metrics.star_rows(made.stars[0], made.extended.shape)
        expected = metrics.restoration_error(result.extended, made.extended, rows)
        lines = capsys.readouterr().out.splitlines()
        rows = [line.split() for line in lines if line.startswith(("double ", "single "))]
        assert rows[3][-1] == f"{expected:.2%}"
        assert {row[1] for row in rows} == {"0", "32"}

    def test_interrupted_bench_prints_its_complete_runs(self, capsys, monkeypatch):
        calls, deconvolve = [], bench.deconvolve

        def stop(*arguments, **keywords):
            calls.append(keywords["n_iter"])
            if calls.count(N_ITER) == 3:
                raise KeyboardInterrupt
            return deconvolve(*arguments, **keywords)

        monkeypatch.setattr(bench, "deconvolve", stop)
        assert run(*FILES, *STAR) == 130
        captured = capsys.readouterr()
        assert captured.err == "lnocl: error: interrupted\n"
        rows = [line.split()[0] for line in captured.out.splitlines()[2:]]
        assert rows == 4 * ["double"] + 4 * ["single"]

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["--psf", "psfs.fits"], "--psf does nothing without images: give that too, or"),
            (STAR, "--star does nothing without images"),
            (["--background", "8"], "--background does nothing without images"),
            (["--read-noise", "8"], "--read-noise does nothing without images"),
            (["images.fits"], "images need their PSFs: give --psf"),
            ([*FILES, "--size", "64"], "--size is of the demo's scene"),
            ([*FILES, "--n-iter", "7"], "--n-iter must be a whole number, 8 or more; 7"),
            ([*FILES, "--accuracy", "0"], "accuracy must be positive and finite; 0"),
            ([*FILES, "--accuracy", "nan"], "accuracy must be positive and finite; nan"),
            ([*FILES, "--device", "no such"], "fits no OpenCL device"),
            (["--size", "65"], "sides must be whole, even"),
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
