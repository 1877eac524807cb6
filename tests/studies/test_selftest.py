"""The self-test passes where the kernels are right, and names what is not."""

import math

import numpy as np
import pytest

from lnocl import __version__
from lnocl.commands import cli
from lnocl.core.opencl import device, program
from lnocl.core.runs.start import Setup
from lnocl.errors import DeviceError
from lnocl.studies import selftest
from lnocl.studies.selftest import Row

CHOSEN = device.choose().device
NAME = device.describe(CHOSEN)
ADVICE = "do not trust its results; try another driver or --engine numpy"

# In the source of the kernels, once each: what is there, and a fault to put in its place.
FAULTS = {
    "correlate_columns": ("edge[0], -edge[1], OPPOSITE", "edge[0], edge[1], OPPOSITE"),
    "convolve_columns": (
        "edge[2 * place], edge[2 * place + 1], OPPOSITE",
        "edge[2 * place], -edge[2 * place + 1], OPPOSITE",
    ),
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
    "a[q].re /= 1 + (mu + curved.re) * f.re * weight.re;": (
        "a[q].re = coarse(a[q].re / (1 + (mu + curved.re) * f.re * weight.re), 2.5);"
    ),
    "a[q].im /= 1 + (mu + curved.im) * f.im * weight.im;": (
        "a[q].im = coarse(a[q].im / (1 + (mu + curved.im) * f.im * weight.im), 2.5);"
    ),
    "beta / sqrt(t * t + delta * delta);": (
        "coarse(beta / coarse(sqrt(t * t + delta * delta), 3), 2.5);"
    ),
    "t * t / (sqrt(t * t + delta * delta) + delta);": (
        "coarse(t * t / (coarse(sqrt(t * t + delta * delta), 3) + delta), 2.5);"
    ),
    "scaled / (1 + (mu + curvature) * scaled);": (
        "coarse(scaled / (1 + (mu + curvature) * scaled), 2.5);"
    ),
    "(star.sum + star.lost) / star_weights[s];": (
        "(star.sum + star.lost) / star_weights[s] * (1 + 2.5f * 0x1p-23f);"
    ),
}
# Of an error, either way.
SIGN = "(as_ivec(x) & 4) != 0 ? (vec)1 : (vec)-1"


@pytest.fixture
def plant(monkeypatch):
    """Put a fault into the source of the kernels, of one case in single precision."""
    genuine = program.source
    one = {"one image": selftest.cases()["one image"]}
    monkeypatch.setattr(selftest, "has_double", lambda _: False)
    monkeypatch.setattr(selftest, "cases", lambda: one)

    def plant(name):
        old, new = FAULTS[name]
        assert genuine().count(old) == 1
        monkeypatch.setattr(program, "source", lambda: genuine().replace(old, new))

    return plant


def outcome(capsys, *arguments):
    """Return exit status, stdout and stderr, both in lines."""
    status = cli.main(["selftest", *arguments])
    out, err = capsys.readouterr()
    return status, out.splitlines(), err.splitlines()


def is_right(capsys, precisions):
    status, out, err = outcome(capsys, "--device", device.spec_of(CHOSEN))
    assert (status, err) == (0, []), out
    first, *rows, last = out
    assert first.startswith(f"lnocl {__version__} on {NAME}, {CHOSEN.version}")
    assert [row.partition(":")[0] for row in rows] == [
        f"{case} ({solver}, {precision})"
        for case in selftest.cases()
        for solver in ("sgm", "sgp")
        for precision in precisions
    ]
    assert all(row.endswith(" allowed, right") for row in rows)
    assert last == f"all {len(rows)} reconstructions are right on {NAME}"


@pytest.mark.exhaustive
def test_a_device_as_coarse_as_may_be_is_right(capsys, monkeypatch):
    text, before = program.source(), "/* Shares n blocks among"
    for exact, coarse in COARSE.items():
        assert text.count(exact) == 1, exact
        text = text.replace(exact, coarse)
    inline = (
        "INLINE vec coarse(const vec x, const real ulps)\n"
        f"{{ const vec sign = {SIGN}; return x * (1 + sign * ulps * 0x1p-23f); }}\n"
    )
    assert text.count(before) == 1
    monkeypatch.setattr(program, "source", lambda: text.replace(before, inline + before))
    monkeypatch.setattr(selftest, "has_double", lambda _: False)
    is_right(capsys, ["single"])


@pytest.mark.exhaustive
@pytest.mark.skipif(not device.has_double(CHOSEN), reason="no double precision here")
def test_a_good_device_is_right(capsys):
    is_right(capsys, ["single", "double"])


def test_the_scenes_have_every_option_of_the_kernels(monkeypatch):
    given = []

    class Built(Exception):
        pass

    def build(*arguments, **options):
        given.append(options)
        raise Built

    monkeypatch.setattr("lnocl.core.engines.opencl.Program", build)
    for case in selftest.cases().values():
        with pytest.raises(Built):
            selftest._reconstruct(case, "sgm", 1, "single", "opencl", None)
    for name in {name for name in given[0] if name.startswith("has_")}:
        assert {options[name] for options in given} == {True, False}, name
    assert {options["oversample"] for options in given} == {1, 2}
    scenes = {
        name: Setup(each.observation, each.stars, 0, "sgm", "single", "numpy", None).scene(
            each.penalty
        )
        for name, each in selftest.cases().items()
    }
    assert [name for name, each in scenes.items() if each.transmission is not None] == [
        "transmission"
    ]
    assert {each.scale for each in scenes["turned images"].rotations} == {1.0, 1.7}
    assert {each.n_stars for each in scenes.values()} == {0, 1, 2}


@pytest.mark.parametrize("k", range(3))
def test_deviation_of_a_reconstruction_is_the_largest_of_its_arrays(monkeypatch, k):
    def reconstruct(case, solver, n_iter, precision, engine, device):
        found = [np.full(3, 2.0) for _ in range(3)]
        found[k][1] += 2e-3 * (engine == "opencl")
        return found

    monkeypatch.setattr(selftest, "_reconstruct", reconstruct)
    assert all(row.measured == pytest.approx(1e-3) for row in selftest.run())


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    "name", ["correlate_columns", pytest.param("convolve_columns", marks=pytest.mark.exhaustive)]
)
def test_cases_with_a_wrong_kernel_are_named(capsys, plant, name):
    plant(name)
    status, out, err = outcome(capsys)
    assert status == 1
    wrong = "one image (sgm, single), one image (sgp, single)"
    assert err == [f"lnocl: error: WRONG on {NAME}: {wrong}: {ADVICE}"]
    assert [line.split()[-1] for line in out[1:]] == ["WRONG", "WRONG"]


@pytest.mark.exhaustive
def test_a_kernel_that_does_not_start_is_named(capsys, plant):
    plant("step_rows")
    status, (_, of_sgm, of_sgp), err = outcome(capsys)
    assert status == 1
    assert err == [f"lnocl: error: WRONG on {NAME}: one image (sgp, single): {ADVICE}"]
    assert of_sgm.endswith("right")
    assert "INVALID_WORK_GROUP_SIZE" in of_sgp


@pytest.mark.exhaustive
def test_kernels_that_do_not_build_are_named(capsys, plant):
    plant("not built")
    status, (_, *lines), _ = outcome(capsys)
    assert status == 1
    for line in lines:
        assert f"the kernels do not build on {NAME}: " in line
        assert "step.cl" in line
        assert "planted" in line
        assert line.endswith("WRONG")
        assert len(line) < 600


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


def row(precision="single", measured=0.0, **others):
    return Row("one image", "sgm", precision, measured, 1e-6, **others)


@pytest.mark.parametrize("measured", [1.01e-6, math.inf, math.nan])
def test_too_much_and_no_number_are_wrong(measured):
    assert not row(measured=measured).is_right
    assert row(measured=1e-6).is_right


def test_a_line_has_the_deviation_in_units_of_the_rounding():
    found = selftest.line(row(measured=9e-7))
    assert found == "one image (sgm, single): 7.5 of 8.4 allowed, right"


def test_the_verdict_names_each_that_is_wrong():
    rows = [row(measured=2.0), row("double", math.nan, fault="no"), row("double")]
    with pytest.raises(DeviceError) as raised:
        selftest.verdict(rows, NAME)
    wrong = "one image (sgm, single), one image (sgm, double)"
    assert str(raised.value) == f"WRONG on {NAME}: {wrong}: {ADVICE}"


def test_relative_deviation_from_zero_is_infinite_and_from_nan_is_nan():
    assert selftest.relative([], []) == 0.0
    assert selftest.relative([0.0], [0.0]) == 0.0
    assert selftest.relative([1e-9], [0.0]) == math.inf
    assert selftest.relative([1.0, 2.5], [-4.0, 2.0]) == 1.25
    assert math.isnan(selftest.relative([1.0, np.nan], [1.0, 2.0]))
