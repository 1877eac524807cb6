"""Scenes that the tests share: asymmetric, off-centre PSFs and Poisson data."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.special import erf

import lnocl

# The paper's iteration, whatever the defaults.
PAPER = {"solver": "sgm", "stop": None, "smoothing": 0.0, "pad": 0}
paper = partial(lnocl.deconvolve, **PAPER)

# Every engine at every precision; the reference always computes in double.
ENGINES = [
    pytest.param({"engine": "numpy", "precision": "double"}, id="numpy"),
    pytest.param({"engine": "opencl", "precision": "double"}, id="opencl-double"),
    pytest.param({"engine": "opencl", "precision": "single"}, id="opencl-single"),
]


def _later(word):
    return [
        pytest.param(*e.values, id=e.id, marks=[pytest.mark.exhaustive] if word in e.id else [])
        for e in ENGINES
    ]


# The same where a program is built for each scene, which takes seconds: CI tests double later; and
# where scenes are such as no other test builds a program for, or the device is not the point.
FEWER_ENGINES = _later("double")
NUMPY_FIRST = _later("opencl")


def named(cases, *fast):
    """Return parameters with names, of which CI alone tests all but some."""
    return [
        pytest.param(case, id=name, marks=[] if name in fast else [pytest.mark.exhaustive])
        for name, case in cases.items()
    ]


def make_psfs(n_images, shape):
    """Return PSFs that have no symmetry and no two of which are equal, centroids off centre."""
    y, x = np.indices(shape)
    y, x = y - shape[0] // 2, x - shape[1] // 2
    psfs = []
    for j in range(n_images):
        cos, sin = np.cos(0.4 + 1.1 * j), np.sin(0.4 + 1.1 * j)
        u, v = cos * x + sin * y - 0.4, cos * y - sin * x + 0.25
        core = np.exp(-0.5 * ((u / 1.9) ** 2 + (v / 0.9) ** 2))
        ghost = np.exp(-0.5 * ((x - 2 * cos) ** 2 + (y + 2 * sin) ** 2))
        psfs.append(core + 0.3 * ghost)
    return np.array(psfs)


def make_smooth_psfs(n_images, shape):
    """Return PSFs that pixels hold to rounding, so that they can be moved by fractions of one."""
    y, x = np.indices(shape)
    y, x = y - shape[0] // 2, x - shape[1] // 2
    widths = (2.6, 3.2), (3.1, 2.7), (2.9, 2.6)
    cores = [np.exp(-0.5 * (((x - 0.6) / w) ** 2 + ((y + 0.4) / h) ** 2)) for w, h in widths]
    return np.array([core + 0.3 * np.roll(core, (2, -3), (0, 1)) for core in cores[:n_images]])


def blur(sky, psf):
    """Return the sky through a PSF, periodic, as a plain sum over the PSF's pixels."""
    blurred = np.zeros(sky.shape)
    cy, cx = psf.shape[0] // 2, psf.shape[1] // 2
    for (y, x), value in np.ndenumerate(psf / psf.sum()):
        blurred += value * np.roll(sky, (y - cy, x - cx), axis=(0, 1))
    return blurred


@dataclass(frozen=True)
class Recipe:
    """What a scene is made of; `make` turns it into the arguments of an observation and a run."""

    shape: tuple[int, int]
    n_images: int = 1
    n_stars: int = 0
    mu: float = 0.0
    smoothing: float = 0.0
    pad: int = 0
    psf_shape: tuple[int, int] = (7, 8)
    background: str = "scalar"  # or "zero", "each", "map"
    read_noise: Any = 0.0
    masked: float = 0.0  # share of the pixels, different in each image
    n_iter: int = 1000
    exposure: str = "none"  # or "each", "map" with zeros in places
    fractions: bool = False  # whether images have offsets, and stars lie, between pixels
    smooth: bool = False  # whether the PSFs hold nothing that pixels cannot

    def make(self):
        return Made(self)


class Made:
    """A recipe's arrays: the input of `lnocl.Observation` and of `lnocl.deconvolve`."""

    def __init__(self, recipe):
        self.recipe = recipe
        ny, nx = recipe.shape
        p = recipe.n_images
        rng = np.random.default_rng([ny, nx, p, recipe.n_stars])
        y, x = np.indices(recipe.shape)
        ridge = y - 0.45 * ny - 0.15 * ny * np.sin(5.0 * x / nx)
        self.sky = sky = (
            90.0 * np.exp(-0.5 * (ridge / (0.08 * ny + 0.5)) ** 2) * (1.2 + np.cos(9.0 * x / nx))
        )
        self.sky = sky
        # Far from the ridge the sky is dark: without a background, pixels there are empty.
        self.psfs = (make_smooth_psfs if recipe.smooth else make_psfs)(p, recipe.psf_shape)
        self.stars = [(int(nx * u), int(ny * v)) for u, v in [(0.3, 0.55), (0.75, 0.2), (0, 0.99)]]
        self.stars = self.stars[: recipe.n_stars]
        fluxes = np.array([3e3, 9e2, 4e3])[: recipe.n_stars]
        object_ = sky.copy()
        for (sx, sy), flux in zip(self.stars, fluxes, strict=True):
            object_[sy, sx] += flux
        each = np.linspace(6.0, 11.0, p)
        self.background = {
            "zero": 0.0,
            "scalar": 8.0,
            "each": each,
            "map": each[:, None, None] * (1.0 + 0.3 * np.cos(6.0 * (x + 0.5) / nx + y / ny)),
        }[recipe.background]
        level = np.asarray(self.background)
        level = level[:, None, None] if level.ndim == 1 else level
        means = np.array([blur(object_, psf) for psf in self.psfs])
        self.offsets = None
        if recipe.fractions:
            self.stars = [(sx + 0.3, sy - 0.4) for sx, sy in self.stars]
            self.offsets = np.array([(0.0, 0.0), (1.4, -0.7), (-2.5, 0.25)])[:p]
            means = np.array([moved(m, *by) for m, by in zip(means, self.offsets, strict=True)])
        self.exposure = self._make_exposure()
        if self.exposure is not None:
            means *= self.exposure if self.exposure.ndim == 3 else self.exposure[:, None, None]
        means += level
        self.images = rng.poisson(np.maximum(means, 0.0)).astype(float)
        sigma = np.broadcast_to(recipe.read_noise, (p,))[:, None, None]
        self.images += sigma * rng.standard_normal(self.images.shape)
        self.images = np.maximum(self.images, -(sigma**2))  # still positive once that is added
        self.mask = rng.random(self.images.shape) < recipe.masked if recipe.masked else None
        # A start away from the answer, never flat.
        self.initial_extended = sky.mean() * rng.uniform(0.5, 1.5, recipe.shape)
        self.initial_star_fluxes = fluxes * np.array([0.6, 1.5, 0.9])[: recipe.n_stars]

    def _make_exposure(self):
        (ny, nx), p = self.recipe.shape, self.recipe.n_images
        if self.recipe.exposure == "none":
            return None
        each = np.linspace(0.7, 2.1, p)
        if self.recipe.exposure == "each":
            return each
        x = np.arange(nx) + 0.5
        exposure = each[:, None, None] * (1.0 + 0.4 * np.cos(4.0 * x / nx)) * np.ones((ny, 1))
        dead = np.random.default_rng(7).random(exposure.shape) < 0.05
        dead[0, :, nx // 2] = True
        return np.where(dead, 0.0, exposure)

    @property
    def mean_exposure(self):
        """That of good pixels, at which penalties have the extended source in electrons."""
        if self.exposure is None or self.exposure.ndim == 1:
            return 1.0 if self.exposure is None else self.exposure.mean()
        is_good = self.exposure > 0 if self.mask is None else (self.exposure > 0) & ~self.mask
        return self.exposure[is_good].mean()

    def observation(self, **changes):
        given = {
            "images": self.images,
            "psfs": self.psfs,
            "background": self.background,
            "read_noise": self.recipe.read_noise,
            "mask": self.mask,
            "exposure": self.exposure,
            "offsets": self.offsets,
            "psf_centre": "given",
        }
        return lnocl.Observation(**(given | changes))

    def deconvolve(self, observation=None, **changes):
        given = {
            "stars": self.stars,
            "mu": self.recipe.mu,
            "smoothing": self.recipe.smoothing,
            "pad": self.recipe.pad,
            "initial_extended": self.initial_extended,
            "initial_star_fluxes": self.initial_star_fluxes,
        }
        return paper(observation or self.observation(), **(given | changes))


def worst(values, expected):
    """Return the largest difference, as a share of the largest expected value."""
    if np.size(expected) == 0:
        return 0.0
    return float(np.abs(values - expected).max() / np.abs(expected).max())


def same(result, other):
    """Assert that two results agree bit for bit."""
    np.testing.assert_array_equal(result.extended, other.extended)
    np.testing.assert_array_equal(result.star_fluxes, other.star_fluxes)
    np.testing.assert_array_equal(result.history, other.history)


def interpolation(n, shift):
    """Return the matrix that moves n periodic samples, by the trigonometric interpolant.

    Its columns are Dirichlet's kernel, summed in closed form; no FFT is used.
    """
    distance = np.subtract.outer(np.arange(n), np.arange(n)) - shift
    u = np.pi * (distance - n * np.round(distance / n))
    with np.errstate(invalid="ignore"):
        kernel = np.sin(u) / (n * (np.sin(u / n) if n % 2 else np.tan(u / n)))
    return np.where(u == 0, 1.0, kernel)


def gaussian_interpolation(n, shift, variance):
    """Return the matrix that moves n periodic samples, taken for a sum of Gaussians.

    One of this variance, integrated over pixels, is on each sample; no frequency is used.
    """
    distance = np.subtract.outer(np.arange(n), np.arange(n))[:, :, None]
    distance = distance + n * np.arange(-30 // n - 1, 30 // n + 2)

    def light(at):
        edges = (at + 0.5) / np.sqrt(2 * variance), (at - 0.5) / np.sqrt(2 * variance)
        return (erf(edges[0]) - erf(edges[1])).sum(axis=2) / 2

    shift = (shift + n / 2) % n - n / 2
    return np.linalg.solve(light(distance).T, light(distance - shift).T).T


def gaussian_variance(profile):
    """Return that of the Gaussian which alternates from pixel to pixel as a profile does.

    Over pixels of unit light it has ``sum_k (-1)^k integral_k``, 4 / pi of what a continuous one
    has at the frequency 1 / 2; so a pixel alone, the sharpest that there is, has not 0.
    """
    seen = abs((profile * np.cos(np.pi * np.arange(profile.size))).sum() / profile.sum())
    return -2 / np.pi**2 * np.log(max(min(seen, 1.0), 1e-16) * np.pi / 4)


def placed(psf, x, y):
    """Return a PSF that lies on a periodic grid of even sides moved as `lnocl` places it."""
    rows, columns = (
        gaussian_interpolation(n, to, gaussian_variance(psf.sum(axis=1 - axis)))
        for axis, (n, to) in enumerate(zip(psf.shape, (y, x), strict=True))
    )
    return rows @ psf @ columns.T


def moved(arrays, x, y):
    """Return periodic arrays moved by any distance."""
    ny, nx = arrays.shape[-2:]
    return interpolation(ny, y) @ arrays @ interpolation(nx, x).T
