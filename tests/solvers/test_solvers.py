"""The schedule of the iterations, on an engine whose sums are given."""

import math
from itertools import chain, repeat

import numpy as np
import pytest

from lnocl.core.solvers.sgm import sgm
from lnocl.core.solvers.sgp import Steps, sgp
from lnocl.errors import NotFiniteError


class Scripted:
    """An engine that returns what it is given, and notes what it is asked for.

    Its stars have the information 1 each.
    """

    rounding = 0.0

    def __init__(self, changes=(), objectives=(), slope=-1.0, star=None, coupling=0.0):
        self.changes = chain(changes, repeat((1.0, 1.0)))
        self.to_record = chain(objectives, map(float, range(0, -1000, -1)))
        self.slope, self.scaling = slope, self
        self.gradients = np.array([] if star is None else [star])
        self.coupling = np.full(self.gradients.shape, coupling)
        self.fluxes = np.full(self.gradients.shape, 100.0)
        self.recorded, self.steps, self.calls = [], [], []

    def ratio(self):
        self.calls.append("ratio")
        self.recorded.append(next(self.to_record))

    def correct(self):
        self.calls.append("correct")

    def scale(self):
        self.calls.append("scale")

    def gradient(self):
        return next(self.changes)

    def star_gradient(self):
        return self.gradients

    def star_step(self, fluxes, gradient, coupling):
        return -(gradient + coupling)

    def step(self, alpha, share):
        self.steps.append((alpha, share))
        return self.slope, self.coupling

    def set_star_fluxes(self, star_fluxes):
        self.fluxes = star_fluxes

    def star_fluxes(self):
        return self.fluxes

    def objective(self):
        return self.recorded[-1]

    def forget_objective(self):
        self.recorded.pop()

    @property
    def alphas(self):
        return [alpha for alpha, share in self.steps]

    @property
    def shares(self):
        return [share for alpha, share in self.steps]


def test_split_gradient_method_does_three_things_an_iteration():
    engine = Scripted()
    assert list(sgm(engine, 3)) == [1, 2, 3]
    assert engine.calls == ["ratio", "correct", "scale"] * 3


@pytest.mark.parametrize(
    ("changes", "alphas"),
    [
        pytest.param(
            [(9, 9), (6, 2), (1, 2), (4, 1), (5, 1), (2, 1)], [1, 3, 0.5, 0.5, 4, 2], id="smaller"
        ),
        pytest.param(
            [(9, 9), (2, 1), (-1, 1), (0, 1), (1, 0)], [1, 2, 2, 20, 20], id="J bends down"
        ),
        pytest.param([(9, 9), (1, 1e9), (1, 1e9)], [1, 1e-5, 1e-5], id="short"),
        pytest.param([(9, 9), (1e9, 1), (1e9, 1)], [1, 1e5, 1e5], id="long"),
    ],
)
def test_alpha_is_the_smaller_of_two_steps_of_barzilai_and_borwein(changes, alphas):
    engine = Scripted(changes)
    n = len(alphas)
    assert list(sgp(engine, n)) == list(range(1, n + 1))
    assert engine.alphas == alphas
    assert engine.shares == [1.0] * n
    assert engine.recorded == list(range(0, -n - 1, -1))


@pytest.mark.parametrize(("rise", "is_taken"), [(0.9, True), (1.1, False)])
def test_a_rise_below_rounding_is_taken(rise, is_taken):
    engine = Scripted(objectives=[1000.0, 1000.0 + rise], slope=-1e-3)
    engine.rounding = 1e-3
    assert list(sgp(engine, 1)) == [1]
    assert (engine.shares == [1.0]) == is_taken


def test_steps_go_on_from_what_is_remembered():
    changes = [(9, 9), (6, 2), (1, 2), (4, 1), (5, 1), (2, 1)]
    engine, steps = Scripted(changes), Steps()
    for n in (1, 3, 2):
        list(sgp(engine, n, steps))
    assert engine.alphas == [1, 3, 0.5, 0.5, 4, 2]


@pytest.mark.parametrize(
    ("stars", "change", "slope"),
    [
        pytest.param({}, [], -1.0, id="none"),
        pytest.param({"star": 2.0, "coupling": 0.5}, [-2.5], -6.0, id="follows"),
        pytest.param({"star": 1.0, "coupling": -1.5}, [0.5], -0.5, id="follows, barely downhill"),
        pytest.param({"star": 2.0, "coupling": -4.0}, [-2.0], -5.0, id="would lead uphill"),
        pytest.param({"star": 1.0, "coupling": -2.0}, [-1.0], -2.0, id="would lead nowhere"),
    ],
)
def test_a_step_is_shortened_until_the_objective_falls_enough(stars, change, slope):
    """By 1e-4 of the slope of the whole step, that of the stars included, times the share."""
    enough, too_little = 1.001e-4 * slope, 0.999e-4 * slope
    engine = Scripted([], [0.0, math.inf, 0.4 * too_little, 0.16 * enough], **stars)
    assert list(sgp(engine, 1)) == [1]
    assert engine.shares == pytest.approx([1.0, 0.4, 0.16])
    assert engine.recorded == [0.0, 0.16 * enough]
    np.testing.assert_allclose(engine.fluxes, 100.0 + 0.16 * np.array(change))


def test_it_ends_at_the_base_where_no_step_lets_the_objective_fall():
    engine = Scripted([], [0.0, *[1.0] * 100], star=2.0)
    assert list(sgp(engine, 5)) == []
    assert engine.shares == pytest.approx([*(0.4**k for k in range(13)), 0.0])
    assert engine.recorded == [0.0]
    np.testing.assert_array_equal(engine.fluxes, [100.0])


@pytest.mark.parametrize(
    "given",
    [
        {"objectives": [math.nan]},
        {"objectives": [0.0, *[math.inf] * 100]},
        {"objectives": [0.0, *[math.nan] * 100]},
        {"slope": math.nan},
        {"star": math.inf},
        {"star": 1.0, "coupling": math.nan},
    ],
)
def test_what_is_not_finite_is_refused(given):
    with pytest.raises(NotFiniteError):
        list(sgp(Scripted(**given), 3))
