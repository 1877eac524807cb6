r"""Least squares of a few unknowns and of fields of many, as one linear problem.

The images differ from their models by ``J eta + B x``, with a few unknowns eta, of derivatives J,
and fields x of N(0, 1), one number a pixel and more. Weighted by one over their variances P,

.. math:: \sum_j \| P_j^{1/2} (g_j - m_j - J_j \eta - B_j x) \|^2 + \|x\|^2 + \eta^T \Pi \eta

is least where eta is eliminated and x found by conjugate gradients. The inverse of its second
derivative is the covariance of both; that of eta is the inverse of the Schur complement of x.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from lnocl.scene.arrays import Array
from lnocl.scene.smooth_field import SmoothField

# Of the information's diagonal.
ROUNDING = 1e-12


class LinearImage(NamedTuple):
    """One image near an estimate.

    Attributes
    ----------
    slopes : ndarray of float64, shape (k, Ny * Nx)
        Derivatives of its model with respect to its k unknowns.
    unknowns : ndarray of int, shape (k,)
        Which they are.
    left : ndarray of float64, shape (Ny, Nx)
        ``g_j - m_j``.
    precision : ndarray of float64, shape (Ny, Nx)
        One over the variance of that, for Poisson counts.
    """

    slopes: Array
    unknowns: NDArray[np.int_]
    left: Array
    precision: Array


class Field(Protocol):
    """A field of many numbers x ~ N(0, 1), and what it changes in the images, linearly.

    Attributes
    ----------
    at : ndarray of float64
        x, where it is.
    """

    at: Array

    def forward(self, x: Array) -> Iterable[Array]:
        """Return the changes of the images, shape (p, Ny, Nx)."""

    def adjoint(self, images: Sequence[Array]) -> Array:
        """Return what `forward` is the transpose of, of the shape of x."""


class SourceError:
    """The error of the extended source, ``A_j (a C^(1/2) x)``.

    Parameters
    ----------
    forward, adjoint : callable
        ``A_j f`` of a sky f, shape (p, Ny, Nx), and ``sum_j A_j^T y_j`` of images y.
    amplitude : ndarray of float64, shape (Ny, Nx)
        a, its standard deviation.
    width : float
        Pixels over which it is correlated (`lnocl.scene.smooth_field.SmoothField`).

    Attributes
    ----------
    images_of : callable
        `forward`, of a sky.
    """

    def __init__(
        self,
        forward: Callable[[Array], Array],
        adjoint: Callable[[Iterable[Array]], Array],
        amplitude: Array,
        width: float,
    ) -> None:
        self.images_of, self._adjoint, self._amplitude = forward, adjoint, amplitude
        self._smooth = SmoothField(amplitude.shape, width)
        self.at = np.zeros(amplitude.shape)

    def forward(self, x: Array) -> Array:
        """Return the changes of the images, shape (p, Ny, Nx)."""
        return self.images_of(self.of(x))

    def of(self, x: Array) -> Array:
        """Return the change of the extended source, ``a C^(1/2) x``, shape (Ny, Nx)."""
        return np.asarray(self._amplitude * self._smooth.apply(x))

    def adjoint(self, images: Sequence[Array]) -> Array:
        """Return what `forward` is the transpose of, shape (Ny, Nx)."""
        return self._smooth.apply(self._amplitude * self._adjoint(images))


class LeastSquares:
    """The least squares of a few unknowns, and of fields.

    Parameters
    ----------
    images : list of LinearImage
        The images.
    fields : list of Field
        The fields; one at least.
    prior : ndarray of float64, shape (k,)
        One over the variance of the prior of each unknown, 0 for none; its mean is 0.
    n_steps : int
        Steps of conjugate gradients, at most.
    finished : float
        The share of the gradient at which they end.

    Attributes
    ----------
    information : ndarray of float64, shape (k, k)
        The Fisher information of the unknowns, the fields held.
    """

    def __init__(
        self,
        images: list[LinearImage],
        fields: Sequence[Field],
        prior: Array,
        n_steps: int,
        finished: float,
    ) -> None:
        self._images, self._fields, self._prior = images, fields, prior
        self._n_steps, self._finished = n_steps, finished
        self._ends = np.cumsum([field.at.size for field in fields])[:-1]
        self.information = information = np.diag(prior)
        for each in images:
            block = _sum("ik,jk->ij", each.slopes * each.precision.ravel(), each.slopes)
            information[np.ix_(each.unknowns, each.unknowns)] += block
        self._units = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
        scaled = information * self._units * self._units[:, None]
        # Stars that nothing tells apart leave it singular.
        self._factor = scipy.linalg.cho_factor(scaled + ROUNDING * np.eye(len(prior)))

    def solve(self, at: Array) -> tuple[Array, list[Array]]:
        """Return the changes of the unknowns, from where they are, and of the fields."""
        change, x = self._solve(self._prior * at)
        return change, self._each(x)

    def variance(self, unknown: int) -> float:
        """Return the variance of an unknown, the others and the fields not being known either."""
        direct = self._invert(np.eye(len(self._prior))[unknown])
        wanted = self._adjoint(self._changes(direct))
        return float(direct[unknown] + _sum("i,i", wanted, self._find_fields(wanted)))

    def _left(self) -> Array:
        return np.array([each.left for each in self._images])

    def _solve(self, pull: Array) -> tuple[Array, Array]:
        """Return the changes of the unknowns, and of the fields, one after the other."""
        left = self._left()
        direct = self._invert(self._moments(left) - pull)
        at = np.concatenate([field.at.ravel() for field in self._fields])
        x = self._find_fields(self._adjoint(left - self._changes(direct)) - at)
        return self._invert(self._moments(left - self._forward(x)) - pull), x

    def _find_fields(self, wanted: Array) -> Array:
        """Return the changes of the fields, by conjugate gradients."""
        x, rest, along = np.zeros_like(wanted), wanted, wanted
        square = first = float(_sum("i,i", rest, rest))
        for _ in range(self._n_steps):
            if square <= self._finished**2 * first:
                break
            image = self._curvature(along)
            share = square / float(_sum("i,i", along, image))
            x, rest = x + share * along, rest - share * image
            before, square = square, float(_sum("i,i", rest, rest))
            along = rest + square / before * along
        return x

    def _curvature(self, x: Array) -> Array:
        """Return the second derivative along x, the unknowns following it."""
        images = self._forward(x)
        images -= self._changes(self._invert(self._moments(images)))
        return x + self._adjoint(images)

    def _each(self, x: Array) -> list[Array]:
        """Return each field, in its shape."""
        parts = zip(np.split(x, self._ends), self._fields, strict=True)
        return [part.reshape(field.at.shape) for part, field in parts]

    def _forward(self, x: Array) -> Array:
        """Return what the fields change in the images, shape (p, Ny, Nx)."""
        images = np.zeros((len(self._images), *self._images[0].left.shape))
        for field, part in zip(self._fields, self._each(x), strict=True):
            for image, change in zip(images, field.forward(part), strict=True):
                image += change
        return images

    def _adjoint(self, images: Array) -> Array:
        """Return what `_forward` is the transpose of, the images weighted."""
        weighted = [each.precision * x for each, x in zip(self._images, images, strict=True)]
        return np.concatenate([field.adjoint(weighted).ravel() for field in self._fields])

    def _moments(self, images: Array) -> Array:
        """Return the products of images with the slopes, weighted."""
        moments = np.zeros(len(self._prior))
        for each, image in zip(self._images, images, strict=True):
            weighted = (each.precision * image).ravel()
            moments[each.unknowns] += _sum("ik,k->i", each.slopes, weighted)
        return moments

    def _changes(self, change: Array) -> Array:
        """Return the changes of the models, shape (p, Ny, Nx), where the unknowns change."""
        return np.array(
            [
                _sum("i,ik->k", change[each.unknowns], each.slopes).reshape(each.left.shape)
                for each in self._images
            ]
        )

    def _invert(self, moments: Array) -> Array:
        return np.asarray(self._units * scipy.linalg.cho_solve(self._factor, self._units * moments))


def _sum(products: str, a: Array, b: Array) -> Array:
    """Return sums of products, whose rounding depends on no number of threads as BLAS's does."""
    return np.asarray(np.einsum(products, a, b))
