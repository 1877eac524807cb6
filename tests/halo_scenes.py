"""A small scene of images that each have a halo of known shape: a star and a blob beside it."""

import numpy as np
from turned_scenes import gaussian

import lnocl

N, P = 48, 3
STAR, FLUX, BLOB = (33.3, 15.8), 3000.0, 15000.0
AMOUNTS = np.array([[2.0e5, 2.5e5, 1.8e5]])
WIDTHS = 1.5 + 0.1 * np.arange(P)
Y, X = np.indices((N, N))
# Of the light beside the halos in the flat scene, electrons per pixel.
LEVELS = np.array([[20.0, 15.0, 25.0]]) * N**2


def psfs():
    """Return the PSFs of the images."""
    v, u = np.indices((19, 19)) - 9
    return np.array([gaussian(u, v, width**2 * np.eye(2)) for width in WIDTHS])


def speckles():
    """Return a shape for each image: rings that are broken into speckles."""
    radius = np.hypot(X - 24, Y - 24)
    wave = [1.0 + 0.5 * np.sin(X / 3.0 + j) * np.cos(Y / 4.0) for j in range(P)]
    return np.array(wave) / (1.0 + (radius / 6.0) ** 2)


def sky_in(j):
    """Return what image j has of star and blob, electrons."""
    star = FLUX * gaussian(X - STAR[0], Y - STAR[1], WIDTHS[j] ** 2 * np.eye(2))
    return star + BLOB * gaussian(X - 17, Y - 30, (9.0 + WIDTHS[j] ** 2) * np.eye(2))


def means(halos, amounts, background=20.0):
    """Return the expected counts, shape (p, ny, nx), of halos (p, ny, nx) of these amounts."""
    light = halos / halos.sum(axis=(1, 2), keepdims=True) * np.reshape(amounts, (P, 1, 1))
    return light + background + np.array([sky_in(j) for j in range(P)])


def observation(seed=1, light=None, **changes):
    """Return the scene's observation, or one with other arguments, or of other means."""
    expected = means(speckles(), AMOUNTS) if light is None else light
    given = {
        "images": np.random.default_rng(seed).poisson(expected).astype(float),
        "psfs": psfs(),
        "background": 20.0,
        "halos": speckles(),
    }
    return lnocl.Observation(**(given | changes))
