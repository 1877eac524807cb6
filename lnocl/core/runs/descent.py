"""An objective that rises: how it is noticed, and what in the PSFs explains it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.cores import off_centre
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.errors import DivergedError, counted, refuse_not_finite

# With PSFs that are nowhere negative the split-gradient method lowers the objective, but for
# rounding and for a Tikhonov term that outweighs the data, with which every other objective is
# higher than the last. So several in turn must be too high. In 1400 valid runs of the tests the
# least of ten rose by 8e-8 at most; in single precision by 2e-3 beside a pixel 1e6 times as bright
# as the sky. Noisy PSFs made it rise by 0.2 and more.
MAX_RISE = 0.1
N_ABOVE = 10
# The objective of a perfect fit, or of one pixel 1e7 times as bright as the sky, is rounding alone.
# This is a share of the sum of the images.
MIN_OBJECTIVE = 1e-5

# Of a PSF: pixels between peak and centre that are worth naming, the share of its sum in a constant
# level under it, and the standard errors by which such a level is told from noise.
MAX_OFF_CENTRE = 1.0
MAX_LEVEL_SHARE = 0.05
MIN_LEVEL_SIGNIFICANCE = 4.0


class Descent:
    """The objectives of a run, which must not stay above the least of them.

    Parameters
    ----------
    scene : Scene
        The scene of the run.
    """

    def __init__(self, scene: Scene) -> None:
        self._observation = scene.observation
        self._floor = MIN_OBJECTIVE * scene.n_images * math.prod(scene.grid)
        self._least = math.inf
        self._n_above = 0

    def check(self, objectives: Sequence[float]) -> None:
        """Refuse the next objectives, scaled, where they are not finite or stay above the least.

        Raises
        ------
        NotFiniteError
            One is infinite or not a number.
        DivergedError
            `N_ABOVE` in turn are above the least so far by more than `MAX_RISE` of it.
        """
        refuse_not_finite(*objectives)
        for objective in objectives:
            allowed = self._least + MAX_RISE * max(self._least, self._floor)
            self._n_above = self._n_above + 1 if objective > allowed else 0
            self._least = min(self._least, objective)
            if self._n_above == N_ABOVE:
                raise DivergedError(f"the objective rises: {explain_rise(self._observation)}")


def explain_rise(observation: Observation) -> str:
    """Return the faults of PSFs that may make an objective rise, with their remedies."""
    psfs = observation.psfs
    findings = [*_negative_pixels(psfs), *_off_centre(psfs), *_level(psfs)]
    if not findings:
        return (
            "nothing in the psfs explains it; take precision double, and if it rises there too, "
            "see what lnocl selftest says"
        )
    return f"{'; '.join(findings)}; mend the psfs, or take solver sgp, which never lets it rise"


def _negative_pixels(psfs: Array) -> list[str]:
    shares = -np.minimum(psfs, 0.0).sum(axis=(1, 2))
    j = int(np.argmax(shares))
    if shares[j] == 0:
        return []
    n_negative = int((psfs[j] < 0).sum())
    pixels, are = counted(n_negative, "pixel"), "is" if n_negative == 1 else "are"
    return [f"{pixels} of `psfs[{j}]` {are} negative, {100 * shares[j]:.3g} % of its sum"]


def _off_centre(psfs: Array) -> list[str]:
    """Say where a PSF's core is not at its centre."""
    for j, psf in enumerate(psfs):
        dx, dy = off_centre(psf)
        if math.hypot(dx, dy) > MAX_OFF_CENTRE:
            return [f"the core of `psfs[{j}]` lies ({dx:z.1f}, {dy:z.1f}) pixels off its centre"]
    return []


def _level(psfs: Array) -> list[str]:
    """Say where a PSF lies on a constant level, by the pixels of its border."""
    is_border = np.ones(psfs.shape[1:], bool)
    is_border[1:-1, 1:-1] = False
    for j, psf in enumerate(psfs):
        border = psf[is_border]
        level = float(np.median(border))
        noise = 1.25 * border.std() / math.sqrt(border.size)
        share = level * psf.size  # of a unit sum
        if abs(share) > MAX_LEVEL_SHARE and abs(level) > MIN_LEVEL_SIGNIFICANCE * noise:
            return [f"`psfs[{j}]` lies on a background that makes {100 * share:.3g} % of its sum"]
    return []
