"""What is mended of images before anything is fitted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lnocl.core.runs.start import Setup
from lnocl.core.scene.arrays import Mask
from lnocl.core.scene.penalty import Penalty
from lnocl.errors import counted, note
from lnocl.process import ignored_notes, ignored_warnings

# Places that a line names.
MOST_NAMED = 3


def mask_cores(setup: Setup) -> tuple[Setup, str]:
    """Return a setup with cores of stars masked that images have lost, and that in words.

    `lnocl.core.scene.saturation` says which these are.
    """
    from lnocl.core.scene.saturation import lost_cores

    with ignored_warnings(), ignored_notes():  # the run has them too
        scene = setup.scene(Penalty())
    lost, named = np.zeros(setup.observation.mask.shape, bool), []
    for each in lost_cores(scene):
        lost[each.image, each.rows, each.columns] |= each.lost
        x, y = scene.stars[each.star]
        is_flat = np.isfinite(each.level)
        why = f"flat at {each.level:.6g} electrons" if is_flat else "far below what is beside them"
        pixels = counted(int(each.lost.sum()), "pixel")
        named.append(f"{pixels} of `images[{each.image}]` at ({x:.7g}, {y:.7g}), {why}")
    return _masked(setup, lost, named, "saturated")


def fit_exposures(setup: Setup) -> tuple[Setup, str]:
    """Return a setup with exposures times the zero points that stars tell, and these in words.

    `lnocl.core.scene.zero_points` says which these are.
    """
    from lnocl.core.scene.zero_points import zero_points

    with ignored_warnings(), ignored_notes():
        found = zero_points(setup.scene(Penalty()))
    if found is None:
        return setup, ""
    factors, observation = np.exp(found.values), setup.observation
    each = factors if observation.exposure.ndim == 1 else factors[:, None, None]
    words = "; ".join(
        f"`images[{j}]` {factor:.3f} +- {factor * error:.1g}"
        for j, (factor, error) in enumerate(zip(factors, found.errors, strict=True))
        if factor != 1.0
    )
    words = f"times {words}, by {counted(found.n_stars, 'star')}"
    note(f"exposures fitted: {words} (`mend_images` False leaves them)")
    changed = observation.replace(exposure=observation.exposure * each)
    return replace(setup, observation=changed, in_time=setup.is_rate), words


def _masked(setup: Setup, bad: Mask, named: Sequence[str], what: str) -> tuple[Setup, str]:
    """Return a setup with more pixels masked, and in words which; say so where there are any."""
    if not bad.any():
        return setup, ""
    observation = setup.observation
    words = _first(named)
    note(f"{what} pixels masked: {words} (`mend_images` False leaves them)")
    return replace(setup, observation=observation.replace(mask=observation.mask | bad)), words


def _first(named: Sequence[str]) -> str:
    """Return the first of what is named, and the number of others."""
    more = len(named) - MOST_NAMED
    others = [f"and {counted(more, 'other')}"] if more > 0 else []
    return "; ".join([*named[:MOST_NAMED], *others])
