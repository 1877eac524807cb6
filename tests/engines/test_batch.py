"""Members of a batch on a device: each is bit for bit as it is alone."""

from __future__ import annotations

import numpy as np
import pytest
from kinds import STARS, observe
from scenes import Recipe

from lnocl.core.engines import opencl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.runs.halves import Halves
from lnocl.core.runs.run import Run, complete_together, make_runs
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.star_prior import StarPrior
from lnocl.errors import DeviceError, InputError
from lnocl.process import ignored_warnings

# So many iterations, of which one member makes some while the others rest.
LAST, BEFORE = 12, 5
# Kinds of scenes, by the kernels that they launch: solver and precision.
KINDS = {
    "small": ("sgp", "single"),
    "masked": ("sgp", "double"),
    "exposure map": ("sgm", "single"),
    "finer sky": ("sgp", "single"),
    "halos + epochs": ("sgm", "single"),
    "transmission": ("sgm", "single"),
    "several shapes": ("sgm", "double"),
    "turned + transmission": ("sgp", "single"),
    "scaled + epochs": ("sgm", "single"),
}


def starts_of(kind, engine="opencl", **options):
    """Return starts that differ in their images: with much light, a third of it, and much."""
    solver, precision = KINDS[kind]
    if kind == "small":  # whose programs other tests build
        made = Recipe((16, 32), 3, 2, masked=0.05, background="each").make()
        stars, observation = made.stars, made.observation()
    else:
        stars, observation = STARS, observe(kind)[0]
    observation = observation.replace(psf_error=0.0)
    with ignored_warnings():  # of stars masked at their peaks
        setup = Setup(observation, stars, 0, solver, precision, engine, None, **options)
        start = make_start(setup, Penalty(0.01, smoothing=0.3))
    shares, rng = (1.0, 0.3, 1.0), np.random.default_rng(8)
    counts = (rng.poisson(np.maximum(share * observation.images, 0.0)) for share in shares)
    return [start.of_half(observation.replace(images=each)) for each in counts]


class Together:
    """Runs that are iterated together, as halves of the counts are."""

    def __init__(self, runs):
        self.runs, self._going = runs, [iter(run) for run in runs]

    def advance(self, goal, *some):
        pairs = [(self.runs[k], self._going[k]) for k in some or range(len(self.runs))]
        for run, _ in pairs:
            run.goal = goal
            run.set_off()
        for run, going in pairs:
            while run.done < goal and next(going, None):
                pass


def found_by(run):
    return [run.extended(), run.star_fluxes(), run.objectives(), run.engine.data_term()]


def same(found, expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=[] if kind == "small" else [pytest.mark.exhaustive])
        for kind in KINDS
    ],
)
def test_a_member_is_bit_for_bit_as_alone(kind):
    starts = starts_of(kind)
    expected = []
    for start in starts:
        alone = Run(start, LAST)
        alone.complete()
        expected.append(found_by(alone))
    assert not np.array_equal(expected[0][0], expected[2][0])
    runs = make_runs(starts, LAST)
    assert len({id(run.engine._memory.buffers) for run in runs}) == 1
    batch = Together(runs)
    batch.advance(BEFORE, 1)  # the others rest
    state = runs[1].state()
    batch.advance(LAST)
    for run, each in zip(runs, expected, strict=True):
        same(found_by(run), each)
    runs[1].restore(state)
    Together(runs).advance(LAST)
    for run, each in zip(runs, expected, strict=True):
        same(found_by(run), each)
    runs[0].repeat(starts[0], starts[2].scene.observation)
    Together(runs).advance(LAST)
    same(found_by(runs[0]), expected[2])
    same(found_by(runs[1]), expected[1])


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_each_member_has_its_prior_of_star_fluxes(solver, monkeypatch):
    monkeypatch.setitem(KINDS, "small", (solver, "single"))
    found = []
    for starts in ([each] for each in starts_of("small")), [starts_of("small")]:
        for some in starts:
            runs = make_runs(some, LAST)
            for run, start in zip(runs, some, strict=True):
                share = 0.9 + 0.01 * (start.scene.observation.images.mean() % 1.0)
                run.scene.star_prior = StarPrior(share * start.star_fluxes, np.full(2, 0.1))
                run.repeat(start, start.scene.observation)
            complete_together(runs)
            found += map(found_by, runs)
    for alone, member in zip(found[:3], found[3:], strict=True):
        same(member, alone)
    assert not np.array_equal(found[0][1], found[2][1])


def test_a_start_leaves_members_alone_that_go_on():
    starts = starts_of("small")
    alone = Run(starts[0], LAST)
    alone.complete()
    runs = make_runs(starts, LAST)
    runs[0].set_off()
    runs[1].repeat(starts[1], starts[2].scene.observation)
    Together(runs).advance(LAST)
    same(found_by(runs[0]), found_by(alone))
    same(found_by(runs[1]), found_by(runs[2]))


def test_a_start_that_is_refused_leaves_its_member_at_rest():
    starts = starts_of("small")
    runs = make_runs(starts, LAST)
    observation, prior = starts[0].scene.observation, StarPrior(np.full(2, 1e300), np.ones(2))
    runs[0].scene.star_prior = prior
    with pytest.raises(InputError, match="cannot be held"):
        runs[0].repeat(starts[0], observation)
    assert not any(run.engine.look().going for run in runs)
    runs[0].scene.star_prior = None
    runs[0].repeat(starts[0], observation)
    complete_together(runs)
    assert [run.done for run in runs] == 3 * [LAST]


def ticks_of(runs, monkeypatch):
    ticks, tick = [], OpenCLEngine.tick
    monkeypatch.setattr(OpenCLEngine, "tick", lambda engine: (ticks.append(1), tick(engine)))
    complete_together(runs)
    return len(ticks)


@pytest.mark.parametrize("stride", [1, 64])
def test_ticks_are_shared(stride, monkeypatch):
    """However often a run is looked at; and what fails then fails behind proven kernels."""
    runs = make_runs(2 * starts_of("small")[:1], LAST)
    for run in runs:
        run.stride = stride
    assert ticks_of(runs, monkeypatch) < 1.5 * LAST
    assert runs[1].engine.is_proven


def test_halves_share_ticks_from_snapshot_to_snapshot(monkeypatch):
    ticks, tick = [], OpenCLEngine.tick
    monkeypatch.setattr(OpenCLEngine, "tick", lambda engine: (ticks.append(1), tick(engine)))
    (start, *_) = starts_of("small")
    alone = Run(start, 40)
    alone.stride = 1
    alone.complete()
    n_alone, halves = len(ticks), Halves([start, start], 40, 40)
    for run in halves._runs:
        run.stride = 1
    assert [*halves][-1] == 40
    assert len(ticks) == 2 * n_alone


def test_runs_that_fit_the_device_alone_do_not_share_ticks(monkeypatch):
    """One buffer for all members may be larger than a device gives at once."""
    starts = starts_of("small")
    expected = make_runs(starts, LAST)
    complete_together(expected)
    refuse = opencl.refuse_if_too_large
    limit = 2 * max(b.size for b in expected[0].engine._memory.buffers.values()) / 3

    def refused(device, sizes, count):
        if max(sizes.values()) > limit:
            raise DeviceError("gives less at once")
        return refuse(device, sizes, count)

    monkeypatch.setattr(opencl, "refuse_if_too_large", refused)
    runs = make_runs(starts, LAST)
    assert len({id(run.engine._memory.buffers) for run in runs}) == 3
    complete_together(runs)
    for run, other in zip(runs, expected, strict=True):
        same(found_by(run), found_by(other))


@pytest.mark.parametrize("engine", ["numpy", "opencl"])
def test_where_stars_move_each_run_has_the_scaling_of_its_start(engine):
    first, other, _ = starts_of("small", engine, refine_positions=True)
    other = other.at(2.0 * other.extended, other.star_fluxes, other.scene.stars)
    runs = make_runs([first, other], LAST)
    assert [run.engine.scaling for run in runs] == [first.scaling, other.scaling]
    assert not np.array_equal(first.scaling.shift, other.scaling.shift)
