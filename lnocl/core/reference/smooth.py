"""The edge-preserving term: the twin of kernels/smooth.cl."""

from __future__ import annotations

import numpy as np

from lnocl.core.scene.arrays import Array


def smooth(
    extended: Array, smoothing: float | Array, edge: float | Array, spectral: float = 0.0
) -> tuple[Array, Array, float]:
    """Return slope, curvature and value of the edge-preserving term.

    ``sum (beta + beta') / 2 psi(f - f')`` over the pairs of neighbouring pixels, also across the
    borders of the grid, ``psi(t) = sqrt(t^2 + edge^2) - edge``. The weight beta is `smoothing`, a
    number or a map. The slope is the term's gradient. The curvature is the sum of
    ``(beta + beta') / 2 psi'(f - f') / (f - f')`` over the four neighbours of a pixel. With several
    skies, `edge` of shape (K, 1, 1), the same pixels of neighbours among them are pairs too, of
    weight `spectral`; their edge is the mean of both skies'.
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
    if spectral:
        step, between = extended[:-1] - extended[1:], np.asarray(edge)
        between = (between[:-1] + between[1:]) / 2.0
        root = np.sqrt(step**2 + between**2)
        share = spectral / root
        slope[:-1] += share * step
        slope[1:] -= share * step
        curvature[:-1] += share
        curvature[1:] += share
        value += float((spectral * step**2 / (root + between)).sum())
    return slope, curvature, value
