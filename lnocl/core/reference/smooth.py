"""The edge-preserving term: the twin of kernels/smooth.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array


def smooth(extended: Array, smoothing: float | Array, edge: float) -> tuple[Array, Array, float]:
    """Return slope, curvature and value of the edge-preserving term.

    ``sum (beta + beta') / 2 psi(f - f')`` over the pairs of neighbouring pixels, also across the
    borders of the grid, ``psi(t) = sqrt(t^2 + edge^2) - edge``. The weight beta is `smoothing`, a
    number or a map. The slope is the term's gradient. The curvature is the sum of
    ``(beta + beta') / 2 psi'(f - f') / (f - f')`` over the four neighbours of a pixel.
    """
    slope, curvature, value = np.zeros_like(extended), np.zeros_like(extended), 0.0
    weight = np.broadcast_to(smoothing, extended.shape)
    for axis in (-1, -2):
        step = extended - np.roll(extended, -1, axis)
        pair = (weight + np.roll(weight, -1, axis)) / 2.0
        root = np.sqrt(step**2 + edge**2)
        share = pair / root
        slope += share * step - np.roll(share * step, 1, axis)
        curvature += share + np.roll(share, 1, axis)
        value += float((pair * step**2 / (root + edge)).sum())
    return slope, curvature, value
