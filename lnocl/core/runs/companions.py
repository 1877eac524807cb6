"""Points beside stars that are held while PSFs are fitted."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from lnocl.core.runs.guarded_runs import GuardedRuns
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.psf_field import mapped
from lnocl.core.scene.psf_wings import are_noisy, without_noise
from lnocl.core.solvers.companions import companions
from lnocl.errors import DivergedError, NotFiniteError, counted, note
from lnocl.process import ignored_notes, ignored_warnings


def beside_stars(runs: GuardedRuns) -> Array:
    """Return the places of points that a run of a window round the stars shows, shape (n, 2).

    They are those of `lnocl.core.solvers.companions`, (x, y), pixels of the images. The noise of
    wings, which may look like one, is taken from the PSFs.
    """
    places, observation = np.zeros((0, 2)), runs.whole.observation
    psfs = observation.psfs_over_images
    if are_noisy(observation.psfs):
        psfs = mapped(psfs, lambda _, stack: without_noise(stack, observation.oversample))
    with suppress(DivergedError, NotFiniteError), ignored_warnings(), ignored_notes():
        _, found = companions(runs.steady(psfs, runs.stars))
        offset = runs.all_stars[runs.held][0] - runs.stars[0]
        places = np.reshape([each.place + offset for each in found], (-1, 2))
    if len(places):
        named = " ".join(f"({x:.4g}, {y:.4g})" for x, y in places)
        number = counted(len(places), "point")
        note(f"{number} beside stars held while PSFs are fitted, {named}: name what is a star")
    return places
