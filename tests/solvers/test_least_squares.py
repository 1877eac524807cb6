"""Least squares of stars and fields: what their rounding depends on, and variances."""

import os
import subprocess
import sys

import numpy as np
import pytest

from lnocl.core.solvers import least_squares
from lnocl.core.solvers.least_squares import LeastSquares, LinearImage

SCRIPT = """
import hashlib
import numpy as np
from lnocl.core.solvers.least_squares import LeastSquares, LinearImage

class Field:
    at = np.zeros((256, 256))
    def forward(self, x):
        return x[None]
    def adjoint(self, images):
        return images[0]

rng = np.random.default_rng(0)
slopes, left = rng.standard_normal((12, 256 * 256)), rng.standard_normal((256, 256))
image = LinearImage(slopes, np.arange(12), left, rng.random((256, 256)))
fit = LeastSquares([image], [Field()], np.zeros(12), 20, 1e-9)
change, fields = fit.solve(np.zeros(12))
for values in fit.information, change, *fields:
    print(hashlib.sha256(np.ascontiguousarray(values)).hexdigest())
"""


@pytest.mark.exhaustive
def test_threads_of_blas_change_no_bit():
    found = {
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "OPENBLAS_NUM_THREADS": str(n), "OMP_NUM_THREADS": str(n)},
            capture_output=True,
            check=True,
            text=True,
        ).stdout
        for n in (1, 2)
    }
    assert len(found) == 1
    assert len(found.pop().splitlines()) == 3


SIDE = 12


class Blurred:
    """A field that each image sees blurred by a PSF of its own, without symmetry."""

    def __init__(self, n_images):
        self.at = np.zeros((SIDE, SIDE))
        y, x = np.indices((SIDE, SIDE))
        psfs = [np.exp(-(x**2) / (2 + j % 3) - (y - 0.4 * x) ** 2 / 3) for j in range(n_images)]
        self._otfs = 9.0 * np.fft.rfft2(psfs)

    def forward(self, x):
        return np.fft.irfft2(self._otfs * np.fft.rfft2(x), (SIDE, SIDE))

    def adjoint(self, images):
        spectra = np.conj(self._otfs) * np.fft.rfft2(np.array(images))
        return np.fft.irfft2(spectra.sum(axis=0), (SIDE, SIDE))


def nights(n_epochs, noise=0.5):
    """Return the least squares of two stars in each of some epochs, of an image each.

    PSFs come again after 15 epochs; the noise of pixels does not, where it differs.
    """
    rng, (y, x) = np.random.default_rng(8), np.indices((SIDE, SIDE))
    images = []
    for j in range(n_epochs):
        widths = 2.0 + 0.1 * (j % 5), 1.5
        stars = np.array(
            [
                np.exp(-((x - at_x) ** 2) / widths[0] - (y - at_y) ** 2 / widths[1]).ravel()
                for at_x, at_y in ((4.2, 5.1), (7.3, 5.9))
            ]
        )
        precision = rng.uniform(1.0 - noise, 1.0 + noise, (SIDE, SIDE))
        unknowns = np.array([j, n_epochs + j])
        images.append(LinearImage(stars, unknowns, rng.standard_normal((SIDE, SIDE)), precision))
    return images, Blurred(n_epochs), 2 * n_epochs


def dense_covariance(images, field, k):
    """Return the variances of all parameters by the inverse of the whole information."""
    slopes = np.zeros((k, len(images), SIDE**2))
    for j, each in enumerate(images):
        slopes[each.unknowns, j] = each.slopes
    of_field = np.array([field.forward(unit.reshape(SIDE, SIDE)) for unit in np.eye(SIDE**2)])
    columns = np.concatenate([slopes, of_field.reshape(SIDE**2, len(images), -1)])
    weights = np.array([each.precision.ravel() for each in images])
    information = np.einsum("ajn,jn,bjn->ab", columns, weights, columns)
    information[k:, k:] += np.eye(SIDE**2)
    return np.linalg.inv(information)[:k, :k]


def test_variances_match_the_dense_inverse_within_the_stated_tolerance():
    images, field, k = nights(6)
    whole = dense_covariance(images, field, k)
    expected, fit = np.diag(whole), LeastSquares(images, [field], np.zeros(k), 2000, 1e-12)
    found = fit.variances(range(k))
    scales = np.sqrt(np.outer(expected, expected))
    correlations = np.abs(fit.covariance(range(k)) - whole) / scales
    assert correlations.max() < least_squares.MISSING
    lack = 1.0 - found / expected
    assert lack.min() > -1e-9
    assert 0.0 < lack.max() < least_squares.MISSING
    alone = LeastSquares(images, [field], np.zeros(k), 2000, 1e-12).variances([k - 1])
    assert not len(LeastSquares(images, [field], np.zeros(k), 2000, 1e-12).variances([]))
    assert alone[0] == pytest.approx(expected[-1], rel=least_squares.MISSING)


def test_stars_that_light_little_of_a_window_are_held_without_its_dark_pixels(monkeypatch):
    images, field, k = nights(4)
    images = [
        each._replace(slopes=np.where(each.slopes > 0.5, each.slopes, 0.0)) for each in images
    ]
    fits = []
    for share in (0.0, 0.25):
        monkeypatch.setattr(least_squares, "SPARSE", share)
        fits.append(LeastSquares(images, [field], np.full(k, 0.1), 2000, 1e-12))
    assert [isinstance(fit._images[0].slopes, np.ndarray) for fit in fits] == [True, False]
    np.testing.assert_allclose(fits[1].information, fits[0].information, rtol=1e-14, atol=1e-14)
    rng = np.random.default_rng(1)
    of_field, seen, change = (rng.standard_normal(shape) for shape in (SIDE**2, (4, SIDE, SIDE), k))
    for name, given in (("_curvature", of_field), ("moments", seen), ("_changes", change)):
        whole, sparse = (getattr(fit, name)(given) for fit in fits)
        np.testing.assert_allclose(sparse, whole, rtol=1e-12, atol=1e-12)


def test_epochs_share_the_solutions_of_their_variances(monkeypatch):
    """With a solution for each, products of the matrix would grow as the number of epochs."""
    products, curvature = [], LeastSquares._curvature
    monkeypatch.setattr(
        LeastSquares, "_curvature", lambda fit, x: products.append(1) or curvature(fit, x)
    )

    def count(n_epochs, unknowns):
        images, field, k = nights(n_epochs, noise=0.0)
        fit = LeastSquares(images, [field], np.zeros(k), 2000, 1e-12)
        products.clear()
        fit.variances(unknowns)
        return len(products)

    few, many = (count(n, range(n)) for n in (15, 60))
    assert many < 1.5 * few
    assert many < 0.1 * 60 * count(60, [0])
