"""A run from start to end: with the first penalty, or with one that held-out counts choose."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lnocl.checkpoint import Checkpointer
from lnocl.core.runs.halves import Halves
from lnocl.core.runs.held_out import HeldOutCounts
from lnocl.core.runs.options import warn_of_rounding
from lnocl.core.runs.outcome import Outcome
from lnocl.core.runs.preparation import Prepared, quietly
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Start, make_start
from lnocl.core.runs.steady import run_steadily, told_prior
from lnocl.core.runs.stopping import Rule, make_rule
from lnocl.core.scene.noise_check import warn_of_noise
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.star_check import warn_of_stars
from lnocl.errors import DivergedError, NotFiniteError, warn
from lnocl.progress import Progress
from lnocl.result import Callback, Estimate, Iterating


def reconstruct(
    prepared: Prepared,
    callback: Callback | None = None,
    progress: bool = False,
    checkpointer: Checkpointer | None = None,
    own: NDArray[np.intp] | None = None,
    within: tuple[slice, slice] | None = None,
) -> Outcome:
    """Return the outcome with the first penalty, or with those that held-out counts choose.

    Parameters
    ----------
    prepared : Prepared
        The parameters. With its steady penalty a run goes before, whose star fluxes are the prior
        of the others (`lnocl.core.runs.steady`); it is the outcome where held-out counts find no
        end.
    callback, progress
        As for `deconvolve`.
    checkpointer : Checkpointer, optional
        Writes checkpoints, and holds the one to resume from.
    own : ndarray of int, optional
        The stars of which it is warned; by default all.
    within : tuple of slice, optional
        Rows and columns of the sky whose errors held-out counts choose by; by default all.
    """
    setup, penalties, steady = prepared.setup, prepared.penalties, prepared.steady
    n_iter, stop = prepared.n_iter, prepared.stop
    checkpointer = checkpointer or Checkpointer()
    if setup.engine == "opencl" and setup.precision == "single":
        warn_of_rounding(n_iter)
    with quietly():
        with Progress(None, "", bool(progress), "measuring steps"):
            start = make_start(setup, penalties[0])
            if setup.settles_halos:
                from lnocl.core.runs.halos import settle_halos  # which loads scipy

                start = settle_halos(start)
        warn_of_noise(setup.observation)
        warn_of_stars(start.scene, setup.refine_positions, own)
        told = None
        if steady is not None and start.scene.n_stars:
            told = _run_steadily(start, steady, n_iter, progress)
        if told is not None:
            prior = told_prior(told)
            penalties = [replace(penalty, stars=prior) for penalty in penalties]
        if stop == "held-out":
            stride = n_iter if callback is None else 1
            held_out = HeldOutCounts(start, penalties, n_iter, stride, within)
            outcome = _choose(held_out, callback, progress, checkpointer)
            if outcome.stop_reason != "held-out" or not held_out.finds_no_end:
                return outcome
            if steady is not None and told is None:
                told = _run_steadily(start, steady, n_iter, progress)
            held_out.warn_of_no_end(None if told is None else steady)
            return outcome if told is None else replace(told, curve=outcome.curve)
        with Progress(n_iter, "it", bool(progress), "iterations") as bar:
            run = Run(start.penalised(penalties[0]), n_iter)
            del start  # which holds arrays of the grid
            return run.outcome(_complete(run, make_rule(stop), callback, bar, checkpointer))


def _choose(
    held_out: HeldOutCounts, callback: Callback | None, progress: bool, checkpointer: Checkpointer
) -> Outcome:
    """Have held-out counts choose, from their checkpoint where there is one."""
    with Progress(None, "it", bool(progress), "iterations") as bar:
        checkpointer.restore_held_out(held_out)

        def look(iteration: int, halves: Halves) -> bool:
            bar.show(iteration, lambda: f"objective {halves.objective():.6g}")
            return _is_ended(callback, iteration, halves)

        outcome = held_out.choose(look, partial(checkpointer.save_held_out, held_out))
    checkpointer.save_held_out(held_out, outcome.stop_reason)
    return outcome


def _run_steadily(start: Start, penalty: Penalty, n_iter: int, progress: bool) -> Outcome | None:
    """Return that of `lnocl.core.runs.steady.run_steadily`; None where its objective rises."""
    fitting = Progress(n_iter, "it", bool(progress), "fitting the stars")
    with fitting, suppress(DivergedError, NotFiniteError):  # of which the halves tell
        return run_steadily(start, penalty, n_iter, fitting.update)
    return None


def _complete(
    run: Run,
    rule: Rule,
    callback: Callback | None,
    bar: Progress,
    checkpointer: Checkpointer,
) -> str:
    """Take a run from its checkpoint, if any, to its end; return why it ended."""
    stop_reason = checkpointer.restore(run, rule)
    save = partial(checkpointer.save, run, rule)
    if stop_reason:
        save(stop_reason)  # perhaps in another file
        return stop_reason
    try:
        return _iterate(run, rule, callback, bar, save)
    except NotFiniteError:
        checkpointer.return_to_best(run)
        warn(
            f"the objective became infinite or not a number: the result is that of iteration "
            f"{run.done}, where it was least; scale the scene where its values are large beyond "
            "measure, else see what lnocl selftest says of the device"
        )
        return "not finite"
    except DivergedError as error:
        checkpointer.return_to_best(run)
        warn(f"{error.message}; the result is that of iteration {run.done}, where it was least")
        return "diverged"


def _iterate(
    run: Run,
    rule: Rule,
    callback: Callback | None,
    bar: Progress,
    save: Callable[[str], None],
) -> str:
    """Iterate to the end, saving checkpoints; return why it ended."""
    quantity = partial(rule.quantity, run)
    stop_reason, run.tolerance = None, rule.tolerance
    if callback is not None or rule.looks:
        run.stride = 1
    for iteration in run:
        if _is_ended(callback, iteration, run):
            stop_reason = "callback"
        if rule.met(run):
            stop_reason = rule.reason  # it would end here without a callback too
        bar.show(iteration, quantity)
        if stop_reason is not None:
            break
        save("")
    stop_reason = stop_reason or ("n_iter" if run.done == run.n_iter else "converged")
    run.check_descent()
    if stop_reason in ("n_iter", "converged"):
        rule.miss(run)
    save(stop_reason)
    return stop_reason


def _is_ended(callback: Callback | None, iteration: int, run: Iterating) -> bool:
    """Give the callback the estimate of an iteration; return whether it ends the run."""
    if callback is None:
        return False
    estimate = Estimate(run)
    is_ended = bool(callback(iteration, estimate))
    estimate._close()
    return is_ended
