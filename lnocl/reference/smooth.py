"""The edge-preserving term: the twin of kernels/smooth.cl."""

from __future__ import annotations

import numpy as np

from lnocl.scene.observation import Array


def smooth(extended: Array, smoothing: float, edge: float) -> tuple[Array, Array, float]:
    """Return slope, curvature and value of the edge-preserving term.

    ``smoothing * sum psi(f - f')`` over the pairs of neighbouring pixels, also across the borders
    of the grid, ``psi(t) = sqrt(t^2 + edge^2) - edge``. The slope is its gradient. The curvature is
    the sum of ``smoothing * psi'(f - f') / (f - f')`` over the four neighbours of a pixel.
    """
    slope, curvature, value = np.zeros_like(extended), np.zeros_like(extended), 0.0
    for axis in (-1, -2):
        step = extended - np.roll(extended, -1, axis)
        root = np.sqrt(step**2 + edge**2)
        slope += step / root - np.roll(step / root, 1, axis)
        curvature += 1.0 / root + np.roll(1.0 / root, 1, axis)
        value += float((step**2 / (root + edge)).sum())
    return smoothing * slope, smoothing * curvature, smoothing * value
