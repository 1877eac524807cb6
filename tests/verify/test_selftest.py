"""The self-test passes where the kernels are right, and names those that are not."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from kernel_scenes import SCENES

from lnocl import __version__
from lnocl.commands import cli
from lnocl.errors import DeviceError
from lnocl.opencl import device, program
from lnocl.verify import comparison, harness, selftest
from lnocl.verify.selftest import Row

CHOSEN = device.choose().device
NAME = device.describe(CHOSEN)
NO_DOUBLE = "the device has no double precision, so none was tried"
ADVICE = "do not trust its results; try another driver or --engine numpy"
SCENE = "exposure map, mu"
TRIED = comparison.kernels_of(harness.SCENES[SCENE])

# In the source of the kernels, once each: what is there, and a fault to put in its place.
FAULTS = {
    "correlate_columns": ("edge[0], -edge[1], opposite", "edge[0], edge[1], opposite"),
    "convolve_columns": (
        "edge[2 * point], edge[2 * point + 1], opposite",
        "edge[2 * point], -edge[2 * point + 1], opposite",
    ),
    "elsewhere": ("z = held;", "z = held; STORE(columns + SPECTRA_SIZE, 0, LOAD(z, 0));"),
    "step_rows": (
        "KERNEL void step_rows",
        "#undef GROUP\n#define GROUP 2\nKERNEL void step_rows",
    ),
    "not built": ("KERNEL void step_rows", "#error planted\nKERNEL void step_rows"),
}


# Divisions and roots, and the same as far off as OpenCL allows in single precision (full profile,
# section 7.4): 2.5 and 3 units in the last place.
COARSE = {
    "g / modelled;": "coarse(g / modelled, 2.5);",
    "a[q].re /= 1 + penalty_weight(mu, curved.re) * f.re * weight.re;": (
        "a[q].re = coarse(a[q].re / (1 + penalty_weight(mu, curved.re) * f.re * weight.re), 2.5);"
    ),
    "a[q].im /= 1 + penalty_weight(mu, curved.im) * f.im * weight.im;": (
        "a[q].im = coarse(a[q].im / (1 + penalty_weight(mu, curved.im) * f.im * weight.im), 2.5);"
    ),
    "beta / sqrt(t * t + delta * delta);": (
        "coarse(beta / coarse(sqrt(t * t + delta * delta), 3), 2.5);"
    ),
    "t * t / (sqrt(t * t + delta * delta) + delta);": (
        "coarse(t * t / (coarse(sqrt(t * t + delta * delta), 3) + delta), 2.5);"
    ),
    "scaled / (1 + penalty_weight(mu, curvature) * scaled);": (
        "coarse(scaled / (1 + penalty_weight(mu, curvature) * scaled), 2.5);"
    ),
    "(star.sum + star.lost) / star_weights[s];": (
        "(star.sum + star.lost) / star_weights[s] * (1 + 2.5f * 0x1p-23f);"
    ),
}
SIGNS = {"one way": "1", "either way": "(as_ivec(x) & 4) != 0 ? (vec)1 : (vec)-1"}


@pytest.fixture
def plant(monkeypatch):
    """Put faults into the source of the kernels, of one small case in single precision."""
    genuine = program.source
    monkeypatch.setattr(selftest, "has_double", lambda _: False)
    monkeypatch.setattr(selftest, "CASES", (((16, 32), SCENE),))

    def plant(*names, runs=()):
        def source():
            text = genuine()
            for old, new in (FAULTS[name] for name in names):
                assert genuine().count(old) == 1
                text = text.replace(old, new)
            return text

        monkeypatch.setattr(program, "source", source)
        monkeypatch.setattr(selftest, "RUNS", {name: selftest.RUNS[name] for name in runs})

    return plant


def outcome(capsys, *arguments):
    """Return exit status, stdout and stderr, both in lines."""
    status = cli.main(["selftest", *arguments])
    out, err = capsys.readouterr()
    return status, out.splitlines(), err.splitlines()


def verdicts(table):
    """Return right or WRONG by name."""
    rows = (line.split() for line in table)
    return {words[0]: words[-1] for words in rows if words[-1] in ("right", "WRONG")}


def is_right(capsys, n_runs):
    status, out, err = outcome(capsys, "--device", device.spec_of(CHOSEN))
    assert (status, err) == (0, [])
    first, header, *table, unit, last = (line for line in out if line != NO_DOUBLE)
    assert first.startswith(f"lnocl {__version__} on {NAME}, {CHOSEN.version}")
    assert header.split() == ["kernel", "or", "solver", "worst", "in", "deviation", "allowed"]
    assert unit.startswith("deviation: largest difference")
    assert verdicts(table) == dict.fromkeys([*comparison.KERNELS, "sgm", "sgp"], "right")
    assert (
        last
        == f"all {len(comparison.KERNELS)} kernels and {n_runs} deconvolutions are right on {NAME}"
    )


@pytest.mark.exhaustive
def test_a_device_without_double_precision_is_right(capsys, monkeypatch):
    monkeypatch.setattr(selftest, "CASES", (*selftest.CASES[:2], selftest.CASES[-1]))
    monkeypatch.setattr(selftest, "has_double", lambda _: False)
    is_right(capsys, n_runs=2)


@pytest.mark.exhaustive
@pytest.mark.parametrize("signs", SIGNS)
def test_a_device_as_coarse_as_may_be_is_right(capsys, monkeypatch, signs):
    text, before = program.source(), "/* Shares n blocks among"
    for exact, coarse in COARSE.items():
        assert text.count(exact) == 1, exact
        text = text.replace(exact, coarse)
    inline = (
        "INLINE vec coarse(const vec x, const real ulps)\n"
        f"{{ const vec sign = {SIGNS[signs]}; return x * (1 + sign * ulps * 0x1p-23f); }}\n"
    )
    assert text.count(before) == 1
    monkeypatch.setattr(program, "source", lambda: text.replace(before, inline + before))
    monkeypatch.setattr(selftest, "has_double", lambda _: False)
    is_right(capsys, n_runs=2)


@pytest.mark.exhaustive
@pytest.mark.skipif(not device.has_double(CHOSEN), reason="no double precision here")
def test_a_good_device_is_right(capsys):
    is_right(capsys, n_runs=4)


def test_the_cases_have_every_option():
    told = {option for _, scene in selftest.CASES for option in harness.SCENES[scene]}
    assert told == {option for scene in SCENES.values() for option in scene}
    assert {harness.SCENES[scene].get("has_weights", False) for _, scene in selftest.CASES} == {
        True,
        False,
    }


def test_what_is_deconvolved_has_built_its_kernels_before():
    observation, stars = selftest._observe()
    ((grid, scene),) = (case for case in selftest.CASES if case[1] == harness.THREE_IMAGES)
    assert harness.SCENES[scene]["n_images"] == len(observation.images)
    assert harness.SCENES[scene]["n_stars"] == len(stars)
    assert observation.images.shape[1:] == grid == (selftest.SIZE, selftest.SIZE)
    assert observation.background.shape == observation.images.shape
    assert 0.01 < observation.mask.mean() < 0.03


@pytest.mark.parametrize("field", ["extended", "star_fluxes", "history"])
def test_a_deconvolution_strays_by_the_worst_of_what_it_returns(field):
    def result(**changed):
        fields = dict.fromkeys(("extended", "star_fluxes", "history"), np.full(3, 2.0)) | changed
        fields["history"] = fields["history"].view([("objective", float)])
        return SimpleNamespace(**fields)

    found = result(**{field: np.array([2.0, 2.001, 2.0])})
    assert selftest._strays(lambda: found, result()) == pytest.approx(5e-4)


def test_wrong_kernels_are_named(capsys, plant):
    """By what they compute, by where they write, and as they do not start."""
    plant("convolve_columns", "elsewhere", "step_rows")
    status, out, err = outcome(capsys)
    assert status == 1
    wrong = "convolve_columns", "correlate_columns", "step_rows"
    named = ", ".join(f"{name} (single)" for name in wrong)
    assert err == [f"lnocl: error: WRONG on {NAME}: {named}: {ADVICE}"]
    assert {name for name, verdict in verdicts(out).items() if verdict == "right"} == {*TRIED} - {
        *wrong
    }
    assert sum(" failed " in line for line in out) == 2
    assert NO_DOUBLE in out
    of_correlate, of_step = out[-2:]
    assert of_correlate == "correlate_columns (single, 16 x 32): others than array 0 are written"
    assert of_step.startswith("step_rows (single, 16 x 32): ")
    assert "INVALID_WORK_GROUP_SIZE" in of_step


@pytest.mark.exhaustive
def test_a_wrong_kernel_spoils_deconvolutions(monkeypatch, plant):
    plant("correlate_columns", runs=("sgm",))
    monkeypatch.setattr(selftest, "CASES", ())
    (found,) = selftest.run(CHOSEN)
    assert (found.what, found.precision, found.right, found.fault) == ("sgm", "single", False, "")


@pytest.mark.exhaustive
def test_kernels_that_do_not_build_are_named(capsys, plant):
    plant("not built", runs=("sgp",))
    status, out, err = outcome(capsys)
    assert status == 1
    assert err == [f"lnocl: error: WRONG on {NAME}: build (single), sgp (single): {ADVICE}"]
    assert verdicts(out) == {"build": "WRONG", "sgp": "WRONG"}
    of_build, of_sgp = out[-2:]
    start = f"the kernels do not build on {NAME}: "
    assert of_build.startswith(f"build (single, 16 x 32): {start}")
    assert of_sgp.startswith(f"sgp (single, 64 x 64): {start}")
    assert "step.cl" in of_build
    assert "planted" in of_build
    assert len(of_build) < 600


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--device", "no such"], "--device 'no such' fits no OpenCL device"),
        (["all"], "unrecognized arguments: all"),
    ],
)
def test_wrong_use(capsys, arguments, message):
    status, out, (err,) = outcome(capsys, *arguments)
    assert (status, out) == (2, [])
    assert err.startswith(f"lnocl: error: {message}")


def row(what="fft_columns", precision="single", measured=0.0, **others):
    return Row(what, precision, (8, 16), measured, 1e-6, **others)


@pytest.mark.parametrize("measured", [1.01e-6, math.inf, math.nan])
def test_too_much_and_no_number_are_wrong(measured):
    assert not row(measured=measured).right
    assert row(measured=1e-6).right


def test_the_table_has_the_worst_row_of_each(capsys):
    rows = [row(measured=m) for m in (1e-7, math.nan, 0.5)]
    rows += [row("sgm", "double", 8e-7), row("sgm", "single", 9e-7)]
    _, first, second, *_ = selftest.table(rows)
    assert first.split() == ["fft_columns", "single,", "8", "x", "16", "nan", "8.4", "WRONG"]
    assert second.split() == ["sgm", "single,", "8", "x", "16", "7.5", "8.4", "right"]


def test_the_verdict_names_each_once_with_its_precisions():
    rows = [
        row(precision=precision, measured=measured)
        for precision in ("single", "double")
        for measured in (1.0, 2.0)
    ]
    with pytest.raises(DeviceError) as raised:
        selftest.verdict([*rows, row("sgm"), row("build", fault="no")], CHOSEN)
    assert str(raised.value) == f"WRONG on {NAME}: fft_columns (single, double): {ADVICE}"


def test_what_is_not_there_is_no_small_deviation():
    assert comparison.relative([], []) == 0.0
    assert comparison.relative([0.0], [0.0]) == 0.0
    assert comparison.relative([1e-9], [0.0]) == math.inf
    assert comparison.relative([1.0, 2.5], [-4.0, 2.0]) == 1.25
    assert math.isnan(comparison.relative([1.0, np.nan], [1.0, 2.0]))
