"""The weights of a penalty, in the units of a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.penalty import MAX_WEIGHT, Penalty
from lnocl.core.scene.star_prior import StarPrior
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import InputError

if TYPE_CHECKING:
    from lnocl.core.scene.scene import Scene

# delta of the edge-preserving term, in means of a flat extended source: docs/validation/sgp.md.
EDGE = 3.0


# The attributes mu, smoothing, smoothing_map, edge, star_prior and spectral_smoothing of a scene.
Scaled = tuple[float, Any, Array | None, Any, StarPrior | None, float]


def scaled(penalty: Penalty, scene: Scene) -> Scaled:
    """Return the weights of a penalty in the units of a scene.

    Raises
    ------
    InputError
        One is too large for float32.
    """
    longer = 1.0 if penalty.exposure is None else penalty.exposure / scene.mean_exposure
    smoothing: Any = _scaled("smoothing", penalty.smoothing, longer, scene)
    between = penalty.spectral * penalty.smoothing if scene.mixing is not None else 0.0
    spectral = _scaled("spectral_smoothing", between, longer, scene)
    if scene.mixing is not None:
        smoothing = smoothing * np.reshape(
            penalty.shares or [1.0] * scene.observation.n_skies, (-1, 1, 1)
        )
    smoothing_map, edge = None, 0.0 * smoothing
    if penalty.near_stars is not None:
        smoothing_map = smoothing + longer * enlarged(penalty.near_stars, scene.grid)
    if np.any(smoothing) or smoothing_map is not None or spectral:
        edge = EDGE * scene.rough_fit.level
        if penalty.edges:
            edge = np.reshape(penalty.edges, np.shape(edge)) / scene.unit
    mu = _scaled("mu", penalty.mu, scene.scale * longer**2, scene)
    star_prior = penalty.stars and penalty.stars.scaled(scene.unit, scene.scale)
    return mu, smoothing, smoothing_map, edge, star_prior, spectral


def _scaled(name: str, weight: float, factor: float, scene: Scene) -> float:
    """Return a weight of the penalty, scaled."""
    if weight * factor > MAX_WEIGHT:
        raise InputError(
            f"`{name}` {weight:g} is too large for images of about {scene.scale:g} electrons "
            f"per pixel; the most that means anything there is {MAX_WEIGHT / factor:g}"
        )
    return float(weight) * factor if weight else 0.0  # the factor may be infinite
