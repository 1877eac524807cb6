"""What is decided in an iteration, of numbers that are given; and runs that are queued."""

import itertools
import math

import numpy as np
import pytest
import scipy.optimize
from hypothesis import given
from hypothesis import strategies as st
from scenes import FEWER_ENGINES, Recipe

from lnocl.core.reference import follow_stars
from lnocl.core.reference.decide import bounded_step, collect_sums, next_step
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.steps import NOT_FINITE, PAUSED, SETTLED, STUCK, Steps
from lnocl.errors import NotFiniteError
from lnocl.process import ignored_warnings

NO_STARS = np.zeros(0)


def record(steps, objectives, objective):
    """Judge an objective, without stars and penalties."""
    collect_sums(steps, objectives, objective, 0.0, 0.0, NO_STARS, NO_STARS, 0.0)


def follow(steps, before, change, star, coupling, slope=-1.0, information=1.0):
    """Return fluxes and change after a step; stars have the same gradients, couplings, F."""
    n = len(before)
    return follow_stars(
        steps,
        np.array(before),
        change,
        np.full(n, -star),
        np.full((1, n), coupling),
        np.ones((n, 1)),
        np.eye(n) / information,
        np.zeros(n),
        np.zeros(n),
        slope,
        (1.0, 1.0),
    )


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
        pytest.param([(9, 9), (math.nan, 1)], [1, 10], id="no number"),
    ],
)
def test_alpha_is_the_smaller_of_two_steps_of_barzilai_and_borwein(changes, alphas):
    steps, found = Steps(), []
    for each in changes:
        follow_stars(
            steps,
            *[NO_STARS] * 3,
            np.zeros((1, 0)),
            np.ones((0, 1)),
            np.eye(0),
            *[NO_STARS] * 2,
            -1.0,
            next_step(steps, *each),
        )
        found.append(steps.alpha)
    assert found == alphas


@pytest.mark.parametrize(("rise", "is_taken"), [(0.9, True), (1.1, False)])
def test_a_rise_below_rounding_is_taken(rise, is_taken):
    steps, objectives = Steps(share=1.0, slope=-1e-3, rounding=1e-3, recorded=1.0), [1000.0]
    record(steps, objectives, 1000.0 + rise)
    assert (len(objectives) == 2) == bool(steps.fresh) == is_taken


@pytest.mark.parametrize(
    ("stars", "change", "slope"),
    [
        pytest.param(None, [], -1.0, id="none"),
        pytest.param((2.0, 0.5), [-2.5], -6.0, id="follows"),
        pytest.param((1.0, -1.5), [0.5], -0.5, id="follows, barely downhill"),
        pytest.param((2.0, -4.0), [-2.0], -5.0, id="would lead uphill"),
        pytest.param((1.0, -2.0), [-1.0], -2.0, id="would lead nowhere"),
    ],
)
def test_a_step_is_shortened_until_the_objective_falls_enough(stars, change, slope):
    """By 1e-4 of the slope of the whole step, that of the stars included, times the share."""
    enough, too_little = 1.001e-4 * slope, 0.999e-4 * slope
    steps, objectives, moved = Steps(recorded=1.0), [0.0], None
    before, shares = ([100.0], stars) if stars else ([], (0.0, 0.0)), []
    for objective in (math.inf, 0.4 * too_little, 0.16 * enough):
        after, moved = follow(steps, before[0], moved, *before[1])
        shares.append(steps.share)
        record(steps, objectives, objective)
    assert shares == pytest.approx([1.0, 0.4, 0.16])
    assert objectives == [0.0, 0.16 * enough]
    assert steps.slope == pytest.approx(slope)
    np.testing.assert_allclose(after, 100.0 + 0.16 * np.array(change))


@pytest.mark.parametrize(
    ("objective", "slope", "reason"),
    [(1.0, -1.0, STUCK), (math.nan, -1.0, NOT_FINITE), (1.0, math.nan, NOT_FINITE)],
)
def test_it_ends_where_no_step_lets_the_objective_fall(objective, slope, reason):
    steps, objectives = Steps(share=1.0, slope=slope, recorded=1.0), [0.0]
    for k in range(12):
        assert (steps.going, steps.reason) == (1.0, PAUSED)
        assert steps.share == pytest.approx(0.4**k)
        record(steps, objectives, objective)
    assert (steps.going, steps.reason, objectives) == (0.0, reason, [0.0])


def test_a_start_that_is_not_finite_ends_it():
    steps = Steps()
    record(steps, [], math.inf)
    assert (steps.going, steps.reason) == (0.0, NOT_FINITE)


@pytest.mark.parametrize("last", [0.0, 1.0])
def test_it_has_settled_by_the_mean_change_over_ten_iterations(last):
    steps, objectives = Steps(tolerance=1e-3), []
    for k in itertools.count():
        record(steps, objectives, last + 20e-3 * max(10 - k, 0))
        if not steps.going:
            break
    # The change is 20e-3 (20 - k) / 10 of 1, or of 0, where it has to be none.
    assert (steps.reason, len(objectives) - 1) == (SETTLED, 20 if last else 11)


def test_target_pauses_the_run_and_queued_steps_have_no_effect():
    steps, objectives = Steps(share=1.0, slope=-1.0, target=3.0, recorded=1.0), [5.0]
    for objective in (4.0, 3.0, 2.0):
        record(steps, objectives, objective)
    assert (objectives, steps.reason, steps.going) == ([5.0, 4.0, 3.0], PAUSED, 0.0)
    assert not steps.fresh


SCENES = st.integers(1, 6).flatmap(
    lambda n: st.tuples(
        st.integers(0, 2**32 - 1), st.just(n), st.floats(0.0, 0.97), st.floats(-1.0, 3.0)
    )
)


@given(SCENES)
def test_bounded_steps_are_those_of_least_squares_within_bounds(scene):
    """As SciPy has them, and never uphill."""
    seed, n, likeness, far = scene
    rng = np.random.default_rng(seed)
    scales = 10.0 ** rng.uniform(-1.0, 1.0, n)
    information = likeness ** abs(np.subtract.outer(range(n), range(n))) * np.outer(scales, scales)
    fluxes_before = 10.0 ** rng.uniform(-1.0, 1.0, n)
    force = 10.0**far * information @ (fluxes_before * rng.uniform(-1.0, 1.0, n))
    # Least squares of the change less its bounds, in units of their roots.
    root, least_change = np.linalg.cholesky(information).T, -0.9 * fluxes_before
    target = -np.linalg.solve(root.T, force) - root @ least_change
    expected = least_change + scipy.optimize.nnls(root, target)[0]
    found = bounded_step(np.linalg.inv(information), force, fluxes_before)
    assert (found >= -0.9 * fluxes_before * (1 + 1e-12)).all()

    def value(change):
        return float(force @ change + 0.5 * change @ information @ change)

    least = value(expected)
    # Measured: 1.6e-6 over 20,000 of them, 1.1e-3 over as many of the most extreme.
    assert value(found) - least <= 5e-3 * abs(least)


def test_a_star_that_another_pushes_above_its_bound_is_let_back():
    """Stars without light are held at 0 where they are; a run was taken to have converged there."""
    inverse = np.array([[43.6, -36.4, 0.07], [-36.4, 43.6, -0.09], [0.07, -0.09, 13.3]])
    force, before = np.array([0.0124, -4e-5, 9.35e-3]), np.array([1.7e-15, 0.0415, 1.7e-15])
    found = bounded_step(inverse, force, before)
    assert found[1] == pytest.approx(-force[1] / np.linalg.inv(inverse)[1, 1], rel=1e-5)
    assert (found[[0, 2]] == -0.9 * before[[0, 2]]).all()


@pytest.mark.parametrize("engine", FEWER_ENGINES)
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_a_run_is_bit_for_bit_the_same_however_it_is_looked_at(engine, solver):
    made = Recipe((16, 32), 3, 2, masked=0.05, background="each").make()
    how = {"precision": "double", "engine": "opencl", **engine}
    setup = Setup(
        made.observation(), made.stars, 0, solver, how["precision"], how["engine"], None, True
    )
    with ignored_warnings():  # of PSFs that ring
        start = make_start(setup, Penalty(smoothing=1e-3))
    found = []
    looks = {1: range(1, 31), 5: [3, 6, 11, 12, 17, 22, 24, 29, 30], 64: [3, 6, 12, 24, 30]}
    for stride, expected in looks.items():
        run = Run(start, 30)
        run.stride = stride
        assert list(run) == list(expected)
        found.append([run.extended(), run.star_fluxes(), run.objectives(), run.star_positions()])
    for other in found[1:]:
        for one, another in zip(found[0], other, strict=True):
            np.testing.assert_array_equal(one, another)


@pytest.mark.parametrize("engine", FEWER_ENGINES)
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_an_end_in_the_middle_of_a_queue_is_where_it_would_be(engine, solver):
    """The objective settles after some iterations of sixty-four that are queued."""
    made = Recipe((16, 32), 3, 2, masked=0.05, background="each").make()
    how = {"precision": "double", "engine": "opencl", **engine}
    setup = Setup(made.observation(), made.stars, 0, solver, how["precision"], how["engine"], None)
    start = make_start(setup, Penalty(smoothing=1e-3))
    ended, whole = Run(start, 200, tolerance=1e-4), Run(start, 200)
    assert ended.complete() == "change"
    whole.complete()
    changes = whole.objectives()
    means = abs(changes[:-10] - changes[10:]) / 10 / abs(changes[10:])
    assert ended.done == 11 + int(np.argmax(means[1:] < 1e-4))
    np.testing.assert_array_equal(ended.objectives(), changes[: ended.done + 1])
    until = Run(start, ended.done)
    until.complete()
    np.testing.assert_array_equal(ended.extended(), until.extended())
    np.testing.assert_array_equal(ended.star_fluxes(), until.star_fluxes())


def test_non_finite_image_pixel_stops_the_run_with_an_error():
    made = Recipe((16, 32), 3, 2, background="each").make()
    setup = Setup(made.observation(), made.stars, 0, "sgp", "double", "numpy", None)
    run = Run(make_start(setup, Penalty()), 9)
    run.engine._images[0, 3, 3] = math.nan
    with pytest.raises(NotFiniteError):
        run.complete()
