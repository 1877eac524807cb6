"""Sources that are detected: points that are fitted beside stars, and a table of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.scene.estimate import Estimate
from lnocl.core.solvers.companions import FARTHEST, Companion, companions
from lnocl.core.solvers.halos import halo_errors
from lnocl.detection.point_test import point_flux
from lnocl.detection.score import Null
from lnocl.detection.score_map import ScoreMap
from lnocl.detection.score_noise import MANY

if TYPE_CHECKING:
    from astropy.table import QTable

# A point is told from the extended source where it is so many errors above what that may be, and
# there is light round a place where the score there is so many times its noise.
CLEAR = 3.0
# Error of a place between pixels, pixels of the sky.
INTERPOLATED = 0.02
# So many of the highest maxima near stars are tried as points.
MOST_LIKELY = 4
POINT_SOURCE, EXTENDED = "point", "extended"


def points_beside_stars(
    estimate: Estimate, null: Null, found: ScoreMap, least: float
) -> tuple[Estimate, list[Companion]]:
    """Return companions above a threshold, and the estimate that has them as stars.

    A companion scatters the ring that it lies in, and hides so from a map, or has a maximum of it
    beside its place. So points are tried where a place near a star has more than counts scatter,
    and at maxima where errors of PSFs may matter.

    Parameters
    ----------
    estimate : Estimate
        Of the run.
    null : Null
        Its model without sources.
    found : ScoreMap
        The map of points beside that.
    least : float
        The threshold.
    """
    scene, score, q = estimate.scene, found.score, estimate.scene.oversample
    if found.width or not scene.n_stars:
        return estimate, []
    is_near = score.is_tested & (null.rings < FARTHEST)
    places, _, gaussian = found.maxima(least)
    x, y = np.round(places).astype(int).T
    rows, columns = score.values.shape
    at = y % rows, x % columns
    may_err = found.noise.degrees[at] < MANY
    if not may_err.any() and not (score.values[is_near] > CLEAR).any():
        return estimate, []
    pixels, fluxes = (places - (q - 1) / 2.0) / q, found.peak_fluxes(*at)
    likely = [
        Companion(pixels[i], float(fluxes[i]), np.zeros(3), float(gaussian[i]))
        for i in np.flatnonzero(may_err)[:MOST_LIKELY]
    ]
    return companions(estimate, likely, halo_errors(estimate).raised, least)


def detections(
    estimate: Estimate, moves: bool, found: ScoreMap, least: float, beside: Sequence[Companion]
) -> QTable:
    """Return the table of `lnocl.significance.Significance`.

    Parameters
    ----------
    estimate : Estimate
        Of the run.
    moves : bool
        Whether positions of stars were fitted.
    found : ScoreMap
        The map of sources, which has the points beside stars as stars.
    least : float
        The threshold.
    beside : sequence of Companion
        These points.
    """
    from astropy.table import QTable
    from astropy.units import electron, pix
    from scipy.spatial import KDTree

    places, values, gaussian = found.maxima(least)
    scene, q = estimate.scene, estimate.scene.oversample
    x, y = np.round(places).astype(int).T
    rows, columns = found.values.shape
    at = y % rows, x % columns
    errors, fluxes = found.errors[at], found.peak_fluxes(*at)
    kinds = np.full(len(places), POINT_SOURCE, dtype="U8")
    pixels = (places - (q - 1) / 2.0) / q
    raised = halo_errors(estimate).raised
    # Beside its own light the flux of a bright source is steep, and not to be interpolated.
    is_steep = fluxes - found.fluxes[at] > errors
    for i, place in enumerate(places):
        if found.width:
            kinds[i] = EXTENDED
        elif is_steep[i] or found.light_round(place, values[i]) > CLEAR:
            fluxes[i], errors[i] = point_flux(estimate, pixels[i], fluxes[i], moves, raised)
            kinds[i] = POINT_SOURCE if fluxes[i] > CLEAR * errors[i] else EXTENDED
    # Of a maximum between pixels the place errs by its noise, and by how it is interpolated.
    curvature = np.moveaxis(found.score.curvature[:, :, *at], -1, 0)
    spread = np.sqrt(np.diagonal(np.linalg.inv(curvature), axis1=1, axis2=2))[:, ::-1]
    ratio = np.maximum(found.fluxes[at] / found.errors[at], 1.0)
    moved = np.hypot(spread / ratio[:, None], INTERPOLATED) / q
    points = [(*p.place, *p.errors[1:], p.flux, p.errors[0], p.significance) for p in beside]
    rows = [*zip(*pixels.T, *moved.T, fluxes, errors, gaussian, strict=True), *points]
    names = "x", "y", "x_error", "y_error", "flux", "flux_error", "significance"
    units = [*[pix] * 4, electron, electron, None]
    table = QTable(np.reshape(rows, (-1, len(names))), names=names, units=units)
    pixels = np.stack([table["x"].value, table["y"].value], axis=1)
    distance, nearest = KDTree(scene.places).query(pixels)
    table["star"] = np.where(np.isfinite(distance), nearest + 1, 0)
    table["distance"] = distance * pix
    table["kind"] = np.append(kinds, [POINT_SOURCE] * len(beside))
    return table[np.argsort(-table["significance"], kind="stable")]
