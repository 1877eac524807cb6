"""``lnocl study``: grids of simulated observations, and what is measured of them."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import lnocl
from lnocl.commands import cli
from lnocl.errors import InputError
from lnocl.studies import experiment, study
from lnocl.studies.study import Case, make_cases

pytestmark = pytest.mark.usefixtures("few_screens", "reference")
SMALL = {"size": [64], "n_images": [2], "stop": ["none"], "smoothing": ["0"], "n_iter": [12]}


@pytest.fixture
def reference(monkeypatch):
    """Reconstruct by the reference; forget what was simulated."""

    def deconvolve(*arguments, device=None, **options):
        return lnocl.deconvolve(*arguments, engine="numpy", **options)

    monkeypatch.setattr(study, "deconvolve", deconvolve)
    study._simulate.cache_clear()


def measured(**axes):
    *_, table = study.run(make_cases(SMALL | axes))
    return table


def test_a_case_is_made_for_each_combination():
    cases = make_cases({"contrast": [1.0, 10.0], "mu": [0.0, 1e-8], "seed": [0, 1, 1]})
    assert len(cases) == len(set(cases)) == 8
    observed = [case.observed for case in cases]
    for each in set(observed):  # those of one observation together
        places = [k for k, other in enumerate(observed) if other == each]
        assert places == list(range(places[0], places[0] + 2))
    assert make_cases({}) == [Case()]


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"contrasts": [1.0]}, "contrasts is not known; give size, contrast"),
        ({"contrast": []}, "contrast has no value"),
        ({"contrast": [0.0]}, "contrast must be finite and more than zero"),
        ({"psf_error": [-0.1]}, "psf_error must be finite and not negative"),
        ({"position_error": [np.nan]}, "position_error must be finite and not negative"),
        ({"n_images": [0]}, "n_images must be a whole number, 1 or more; 0"),
        ({"method": ["clean"]}, "method 'clean' is not known; give mc-rl, rl"),
        ({"n_images": [2.5]}, "n_images must be a whole number"),
        ({"strehl": [1.5]}, r"strehl must be in \(0, 1\]"),
        ({"solver": ["best"]}, "solver 'best' is not known"),
        ({"stop": ["soon"]}, "stop 'soon' is not known"),
        ({"n_iter": [0]}, "n_iter must be a whole number"),
        ({"position_error": [40.0]}, "position_error must be 32 pixels at most"),
    ],
)
def test_values_out_of_range_are_refused(axes, message):
    with pytest.raises(InputError, match=message):
        make_cases(axes)


def test_the_observation_is_that_of_the_case():
    case = Case(size=64, contrast=30.0, extended_magnitude=12.0, n_images=3, exposure=10.0)
    simulation = study._simulate(*case.observed)
    assert simulation.star_fluxes[0] / simulation.extended.sum() == pytest.approx(30.0, rel=1e-9)
    angles = simulation.experiment.angles.to_value("deg")
    np.testing.assert_allclose(angles, [0.0, 60.0, 120.0])
    paper = study._simulate(*Case(size=64).observed)
    brighter = 10.0**0.4 / 3.0
    assert simulation.extended.sum() / paper.extended.sum() == pytest.approx(brighter, rel=1e-9)


@pytest.mark.parametrize("error", [0.01, 0.1])
def test_psfs_have_the_error_that_is_asked_for(error):
    case = Case(size=64, n_images=2, psf_error=error)
    simulation = study._simulate(*case.observed)
    wrong = study._wrong_psfs(simulation, case)
    for psf, other in zip(simulation.psfs, wrong, strict=True):
        assert np.linalg.norm(other - psf) / np.linalg.norm(psf) == pytest.approx(error, rel=1e-9)
        assert other.sum() == pytest.approx(1.0, rel=1e-12)
        assert (other >= 0).all()
        assert other[32, 32] < psf[32, 32]
    with pytest.raises(InputError, match="psf_error is at most 0"):
        study._wrong_psfs(simulation, Case(size=64, n_images=2, psf_error=3.0))


@pytest.mark.parametrize(("method", "name"), [("mc-rl", "MC-RL"), ("rl", "RLM")])
def test_errors_are_those_of_the_experiment(method, name):
    """The paper's experiment measures them too, by code of its own."""
    row = measured(method=[method], solver=["sgm"], mu=[1e-8])[0]
    simulation = study._simulate(*Case(size=64, n_images=2).observed)
    observation = experiment.observe(simulation)
    solve = partial(experiment.reconstruct, simulation, observation, name, 1e-8, 12, 12)
    found = solve(engine="numpy").curve[-1]
    assert row["rho"] == pytest.approx(found["rho"], rel=1e-6)
    assert row["rho_star"] == pytest.approx(found["rho_star"], rel=1e-6)
    true = simulation.star_fluxes[0] / simulation.zero_magnitude_flux
    assert row["magnitude_error"] == pytest.approx(
        found["magnitude"] + 2.5 * np.log10(true), abs=1e-6
    )
    assert row["iterations"] == 12


def test_a_star_that_is_off_is_put_right_where_that_is_asked_for():
    table = measured(position_error=[0.0, 0.4], refine=[False, True], n_iter=[60])
    errors = {(row["position_error"], row["refine"]): row["rho_star"] for row in table}
    assert errors[0.4, False] > 10.0 * errors[0.0, False]
    assert errors[0.4, True] == pytest.approx(errors[0.0, True], rel=0.02)


def test_rows_that_are_there_are_not_done_again(monkeypatch):
    first = measured(contrast=[1.0, 3.0])
    done = []
    measure = study._Measuring._measure
    monkeypatch.setattr(
        study._Measuring, "_measure", lambda self, case: done.append(case) or measure(self, case)
    )
    *_, table = study.run(make_cases(SMALL | {"contrast": [1.0, 3.0, 9.0]}), earlier=first)
    assert [case.contrast for case in done] == [9.0]
    assert table["contrast"].tolist() == [1.0, 3.0, 9.0]
    assert table["rho"].tolist()[:2] == first["rho"].tolist()


def test_numbers_and_none_are_taken_as_deconvolve_takes_them():
    case = Case(stop=None, smoothing=0.02)
    assert case == Case(stop="none", smoothing="0.020")
    assert make_cases({"smoothing": [0.02, "0.02"], "stop": [None, "none", 1e-3, "0.001"]}) == [
        Case(stop="none", smoothing="0.02"),
        Case(stop="0.001", smoothing="0.02"),
    ]


WORDS = ["study", "-o", "t.ecsv", "--size", "64", "--n-images", "2", "--stop", "none",
         "--smoothing", "0", "--n-iter", "4"]  # fmt: skip


def test_the_command_writes_a_table_and_goes_on_with_it(tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    monkeypatch.chdir(tmp_path)
    assert cli.main([*WORDS, "--contrast", "1", "10", "--seed", "0", "1"]) == 0
    assert capsys.readouterr().out == "4 cases done, 4 in t.ecsv\n"
    more = ["--contrast", "1", "10", "100", "--refine", "no", "yes", "--seed", "0", "1"]
    assert cli.main([*WORDS, *more, "--plot", "t.png"]) == 0
    assert capsys.readouterr().out == "8 cases done, 12 in t.ecsv\ndrew t.png\n"
    table = Table.read("t.ecsv")
    assert len({tuple(row[list(study.AXES)]) for row in table}) == 12
    assert (table["rho"] > 0).all()
    assert imread("t.png").std() > 0.1
    assert cli.main([*WORDS, "--overwrite"]) == 0
    assert len(Table.read("t.ecsv")) == 1


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["-o", "t.csv"], "the table is ECSV; give it a name ending in .ecsv, not t.csv"),
        (["-o", "other.ecsv"], "other.ecsv is not a table of lnocl study: give another name"),
        (["-o", "text.ecsv"], "text.ecsv cannot be read as a table"),
        (["--contrast", "0"], "--contrast must be finite and more than zero"),
        (["--contrast", "much"], "argument --contrast: invalid float value: 'much'"),
        (["--refine", "maybe"], "argument --refine: invalid choice: 'maybe'"),
        (["--size", "63"], "must be even"),
    ],
)
def test_the_command_refuses(more, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Table({"a": [1]}).write("other.ecsv")
    Path("text.ecsv").write_text("no table")
    assert cli.main([*WORDS, *more]) in (1, 2)
    assert message in capsys.readouterr().err
