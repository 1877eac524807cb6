"""What benchmarks measure of the paper's experiment, by hand; its table on the smallest scene."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

import lnocl
from lnocl.simulation import Experiment, Star, Target, hh34, simulate

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"

pytestmark = pytest.mark.usefixtures("few_screens")


@pytest.fixture
def experiment(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import experiment

    return experiment


def test_widths_by_hand_and_masked(experiment):
    image = np.array(
        [
            [0, 2, 0, 0, 2, 0],  # a gap between first and last counts
            [2, 2, 2, 2, 2, 2],
            [0, 0, 2, 0, 0, 0],
            [1, 1, 1, 1, 1, 1],  # not greater than the threshold
            [0, 0, 0, 0, 0, 2],
        ]
    )
    assert experiment.width_profile(image, 1).tolist() == [4, 6, 1, 0, 1]
    masked = experiment.width_profile(image, 1, star=(3, 1))
    assert np.isnan(masked).tolist() == [True, True, True, False, False]
    # A Gaussian of sigma s is above exp(-8) of its peak within 4 s of it.
    x = np.arange(101) - 50
    gaussians = np.exp(-0.5 * (x / np.array([[2.2], [5.3], [9.1]])) ** 2)
    assert experiment.width_profile(gaussians, math.exp(-8)).tolist() == [17, 43, 73]


def test_relative_errors_and_fluxes_by_hand(experiment):
    error = experiment.relative_error([1.0, 2.0, np.nan, 1.0], [0.0, 4.0, 1.0, -4.0])
    np.testing.assert_array_equal(error, [np.nan, -0.5, np.nan, -1.25])
    image = np.arange(25.0).reshape(5, 5)
    # Columns 0 to 2 of rows 2 to 4: 10 11 12, 15 16 17, 20 21 22.
    assert experiment.box_flux(image, (1, 3)) == 144


@pytest.mark.filterwarnings("error")
def test_profile_errors_are_of_40_rows_or_nan(experiment):
    """20 rows before the star and 19 after it; NaN where all the light is beyond."""
    for row, expected in ((70, np.nan), (69, 0.0), (30, 0.0), (29, np.nan)):
        image = np.zeros((96, 64))
        image[row, 20] = 1.0
        curve = np.zeros(1, experiment.CURVE_DTYPE)
        found = experiment.Reconstruction("MC-RL", 0.0, curve, image, 1.0)
        errors = experiment.profile_errors(image, (20, 50), found)
        np.testing.assert_array_equal(list(errors.values()), expected)


@pytest.mark.parametrize(("every", "looks"), [(10, [3]), (2, [2, 3])])
@pytest.mark.parametrize("method", ["RLM", "MC-RL"])
def test_errors_are_those_of_the_estimate_at_each_look(method, every, looks, experiment):
    made = simulate(hh34(64), Experiment(angles=[0, 90] * u.deg))
    found = experiment.reconstruct(made, method, 0.0, 3, every, engine="numpy")
    assert found.curve["iteration"].tolist() == looks
    at, rho = found.best("rho_star")
    stars, masked = ([], (32, 16)) if method == "RLM" else (made.stars, None)
    settings = {**experiment.PAPER, "n_iter": at, "engine": "numpy"}
    direct = lnocl.deconvolve(experiment.observe(made), stars, **settings)
    rows = lnocl.metrics.star_rows((32, 16), (64, 64))
    true = made.extended
    assert rho == lnocl.metrics.restoration_error(direct.extended, true, rows, masked)
    np.testing.assert_array_equal(found.extended, direct.extended)
    flux = direct.extended[15:18, 31:34].sum() if method == "RLM" else direct.star_fluxes[0]
    assert found.star_flux == pytest.approx(flux)


def test_wrong_uses(experiment):
    several = simulate(Target(np.ones((64, 64)), [Star(9, 20)] * 2), Experiment(angles="0 deg"))
    with pytest.raises(lnocl.InputError, match="has 2 stars"):
        experiment.Tracker(several, "RLM", 1, 5)
    with pytest.raises(lnocl.InputError, match="every must be"):
        experiment.Tracker(several, "RLM", 0, 5)


@pytest.mark.system
def test_the_table_is_resumed_and_bound_to_its_experiment(tmp_path):
    pytest.importorskip("matplotlib")

    def run(*more):
        words = [str(BENCHMARKS / "hh34_table.py"), "--quick", "--mu", "3e-8", "-o", "t", *more]
        return subprocess.run(
            [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True
        )

    done = run()
    assert (done.returncode, done.stderr.count("error")) == (0, 0)
    folder = tmp_path / "t"
    results = ["mc-rl_3e-08.fits", "rlm_0.fits", "truth.fits"]
    figures = [f"{name}.png" for name in ("errors", "flux", "magnitude", "objects", "width")]
    assert sorted(os.listdir(folder)) == sorted([*results, *figures, "table.ecsv"])
    table = Table.read(folder / "table.ecsv")
    header = fits.getheader(folder / "mc-rl_3e-08.fits")
    assert (header["SCENE"], header["SIZEX"], header["SEED"]) == ("hh34", 64, 0)
    assert table["rho'' at"][1] == header["NITER"]
    assert table["rho''"][0] > table["rho''"][1]
    before = {name: (folder / name).read_bytes() for name in [*results, "table.ecsv"]}
    assert run().returncode == 0
    refused = run("--every", "7")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "its EVERY is" in refused.stderr
    assert {name: (folder / name).read_bytes() for name in before} == before
