"""Members of a batch on a device: each is bit for bit as it is alone."""

from __future__ import annotations

import numpy as np
import pytest
from kinds import STARS, observe

from lnocl.core.runs.run import Run, make_runs
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.process import ignored_warnings

# So many iterations, of which one member makes some while the others rest.
LAST, BEFORE = 12, 5
# Kinds of scenes, by the kernels that they launch: solver and precision.
KINDS = {
    "masked": ("sgp", "single"),
    "exposure map": ("sgm", "single"),
    "finer sky": ("sgp", "single"),
    "halos + epochs": ("sgm", "single"),
    "transmission": ("sgm", "single"),
    "several shapes": ("sgm", "double"),
    "turned + transmission": ("sgp", "single"),
    "scaled + epochs": ("sgm", "single"),
}


def starts_of(kind):
    """Return starts that differ in their images: with much light, a third of it, and much."""
    solver, precision = KINDS[kind]
    observation = observe(kind)[0].replace(psf_error=0.0)
    with ignored_warnings():  # of stars masked at their peaks
        setup = Setup(observation, STARS, 0, solver, precision, "opencl", None)
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
        pytest.param(kind, marks=[] if kind == "masked" else [pytest.mark.exhaustive])
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


def test_a_start_leaves_members_alone_that_go_on():
    starts = starts_of("masked")
    alone = Run(starts[0], LAST)
    alone.complete()
    runs = make_runs(starts, LAST)
    runs[0].set_off()
    runs[1].repeat(starts[1], starts[2].scene.observation)
    Together(runs).advance(LAST)
    same(found_by(runs[0]), found_by(alone))
    same(found_by(runs[1]), found_by(runs[2]))


def test_ticks_are_shared():
    """Members that are told to go on are all iterated by the ticks of one."""
    runs = make_runs(starts_of("masked"), LAST)
    for run in runs:
        run.goal = BEFORE
        run.set_off()
    runs[2].engine.finish()
    assert [run.engine.look().done for run in runs] == 3 * [BEFORE]
