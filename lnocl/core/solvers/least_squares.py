r"""Joint least squares for a few parameters and for large Gaussian random fields.

The residual of image j, ``g_j - m_j``, is modelled as ``J_j eta + B_j x``. The vector eta is the
change of a few parameters, and J_j holds the derivatives of the model. The vector x is the change
of the fields, whose values are independent and standard normal a priori, and B_j their linear
effect. P_j are the inverse variances of the pixels, Pi those of the prior of the parameters. From
the current values eta_0 and x_0 the changes minimise

.. math::
    \sum_j \| P_j^{1/2} (g_j - m_j - J_j \eta - B_j x) \|^2
    + \|x_0 + x\|^2 + (\eta_0 + \eta)^T \Pi (\eta_0 + \eta)

Eliminating eta leaves a linear system for x, which conjugate gradients solve. Its matrix is the
Schur complement of the block of eta. The covariance of eta and x is the inverse of half the second
derivative of this sum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.smooth_field import SmoothField

# A variance may be too small by this share of it, and a change off by so many standard errors.
MISSING, NEGLIGIBLE = 1e-4, 1e-4
# Derivatives of which a smaller share is not 0 are held as a sparse array.
SPARSE = 0.25
# Added to the diagonal of the information, which is scaled to 1 before; less than the second is no
# information.
ROUNDING, LEAST = 1e-12, 1e-290


class LinearImage(NamedTuple):
    """An image and its model, linear near the current estimate.

    Attributes
    ----------
    slopes : ndarray or csr_array of float64, shape (n, Ny * Nx)
        Derivatives of the model with respect to the n parameters that it depends on.
    unknowns : ndarray of int, shape (n,)
        Indices of these among all parameters, without repeats.
    left : ndarray of float64, shape (Ny, Nx)
        The residuals ``g_j - m_j``.
    precision : ndarray of float64, shape (Ny, Nx)
        One over the Poisson variance of each pixel.
    """

    slopes: Array
    unknowns: NDArray[np.int_]
    left: Array
    precision: Array

    def beside(self, slopes: list[Array], unknowns: NDArray[np.int_]) -> LinearImage:
        """Return the image with more unknowns, and the derivatives with respect to these."""
        if not slopes:
            return self
        each = np.append(self.slopes, np.reshape(slopes, (len(slopes), -1)), axis=0)
        return self._replace(slopes=each, unknowns=np.append(self.unknowns, unknowns))


class Field(Protocol):
    """A random field of independent standard normal values, and its linear effect on the images.

    Attributes
    ----------
    at : ndarray of float64
        The current value of x, where the models are linear.
    """

    at: Array

    def forward(self, x: Array) -> Iterable[Array]:
        """Return the changes of the images, shape (p, Ny, Nx)."""

    def adjoint(self, images: Array) -> Array:
        """Return the transpose of `forward` applied to images, in the shape of x."""


class SourceError:
    """The error of the extended source as a random field, ``a C^(1/2) x``.

    C is the correlation matrix of the error; its effect on image j is ``A_j (a C^(1/2) x)``.

    Parameters
    ----------
    forward : callable
        Returns the images ``A_j f``, shape (p, Ny, Nx), of a sky f, shape (Ny, Nx).
    adjoint : callable
        Returns ``sum_j A_j^T y_j``, shape (Ny, Nx), of p images y.
    amplitude : ndarray of float64, shape (Ny, Nx)
        The standard deviation a of the error, in the unit of the sky. What it is held in is the
        precision of `forward` and `adjoint` too.
    width : float
        Pixels over which it is correlated (`lnocl.core.scene.smooth_field.SmoothField`).
    unit : float, optional
        Of the images that `adjoint` is given, lest single precision cannot hold them.

    Attributes
    ----------
    images_of : callable
        The parameter `forward`.
    at : ndarray of float64, shape (Ny, Nx)
        The current value of x, which is 0.
    """

    def __init__(
        self,
        forward: Callable[[Array], Array],
        adjoint: Callable[[Iterable[Array]], Array],
        amplitude: Array,
        width: float,
        unit: float = 1.0,
    ) -> None:
        self.images_of, self._adjoint = forward, adjoint
        self._amplitude, self._unit = amplitude, np.float64(unit)
        self._smooth = SmoothField(amplitude.shape, width, amplitude.dtype)
        self.at = np.zeros(amplitude.shape)

    def forward(self, x: Array) -> Array:
        """Return the changes of the images, shape (p, Ny, Nx)."""
        return self.images_of(self.of(x))

    def of(self, x: Array) -> Array:
        """Return the change of the extended source, ``a C^(1/2) x``, shape (Ny, Nx)."""
        return np.asarray(self._amplitude * self._smooth.apply(x))

    def adjoint(self, images: Array) -> Array:
        """Return the transpose of `forward` applied to images, shape (Ny, Nx)."""
        scaled = np.asarray(images / self._unit, self._amplitude.dtype)
        return self._unit * self._smooth.apply(self._amplitude * self._adjoint(scaled))


class LeastSquares:
    """The joint least squares of a few parameters and of random fields.

    Parameters
    ----------
    images : list of LinearImage
        The images, of one shape.
    fields : list of Field
        The fields; one at least, but for `moments` and `invert`.
    prior : ndarray of float64, shape (k,) or (k, k)
        One over the variance of the prior of each parameter, whose mean is 0; 0 for no prior. Or
        the inverse of their covariance.
    n_steps : int
        Steps of conjugate gradients, at most.
    finished : float
        They end where the norm of the residual is this share of the first.

    Attributes
    ----------
    information : ndarray of float64, shape (k, k)
        The Fisher information of the parameters with the fields held, and that of the prior.
    """

    def __init__(
        self,
        images: list[LinearImage],
        fields: Sequence[Field],
        prior: Array,
        n_steps: int,
        finished: float,
    ) -> None:
        self._images = [each._replace(slopes=_sparse(each.slopes)) for each in images]
        self._left = np.array([each.left for each in images])
        self._precision = np.array([each.precision for each in images])
        self._fields = fields
        self._prior = prior = np.diag(prior) if prior.ndim == 1 else prior
        self._n_steps, self._finished = n_steps, finished
        self._ends = np.cumsum([field.at.size for field in fields])[:-1]
        self.information = information = prior.copy()
        for each in self._images:
            block = _product(each.slopes * each.precision.reshape(1, -1), each.slopes.T)
            information[np.ix_(each.unknowns, each.unknowns)] += block
        units = 1.0 / np.sqrt(np.maximum(np.diag(information), LEAST))
        scaled = information * units * units[:, None]
        # Stars that nothing tells apart leave it singular.
        inverse = np.linalg.inv(scaled + ROUNDING * np.eye(len(prior)))
        self._inverse = (inverse + inverse.T) / 2.0 * units * units[:, None]

    def solve(self, at: Array | None = None) -> tuple[Array, list[Array]]:
        """Return the changes of the parameters and of the fields that minimise the sum.

        Parameters
        ----------
        at : ndarray of float64, shape (k,), optional
            The current values of the parameters, which the prior draws towards 0; by default 0.

        Returns
        -------
        change : ndarray of float64, shape (k,)
            To add to `at`.
        fields : list of ndarray of float64
            To add to `at` of each field.
        """
        at = np.zeros(len(self._prior)) if at is None else at
        change, x = self._solve(self._prior @ at)
        return change, self._each(x)

    def variances(self, unknowns: Sequence[int] | NDArray[np.int_]) -> Array:
        """Return the variances of some parameters, with the others and the fields marginalised."""
        return self.covariance(unknowns).diagonal().copy()

    def covariance(self, unknowns: Sequence[int] | NDArray[np.int_]) -> Array:
        """Return the covariance of some parameters, with the others and the fields marginalised.

        Variances are too small by less than `MISSING` of them, or where `finished` or `n_steps`
        ends conjugate gradients. Parameters have ``F^-1_ij + <w_i, S^-1 w_j>``, F the information,
        w_i what parameter i does to the fields and S `_curvature`. The w_i of one star in many
        epochs are much alike. So x with ``S x = w_i`` is found for one of them, and its part taken
        from all: with ``<x, S x> = 1``, ``w_i -= <x, w_i> S x`` leaves ``<x, w_i> <x, w_j>``
        less of ``<w_i, S^-1 w_j>``. No direction has less than 1 in S, so that ``|w_i|^2`` bounds
        the rest.
        """
        if not len(unknowns):
            return np.zeros((0, 0))
        columns = [self.invert(unit) for unit in np.eye(len(self._prior))[unknowns]]
        found = np.array([column[unknowns] for column in columns])
        rests = np.array([self._adjoint(self._changes(column)) for column in columns])
        least = self._finished**2 * _sum("ik,ik->i", rests, rests)
        for _ in columns:
            squares = _sum("ik,ik->i", rests, rests)
            enough = np.maximum(least, MISSING * np.diag(found))
            worst = int(np.argmax(squares / enough))
            if squares[worst] <= enough[worst]:
                break
            x, left = self._descend(rests[worst], float(enough[worst]))
            image = rests[worst] - left
            shares, square = _sum("ik,k->i", rests, x), float(_sum("i,i", x, image))
            rests -= shares[:, None] * (image / square)
            found += np.outer(shares, shares) / square
        return found

    def row(self, unknown: int) -> Array:
        """Return the change of one parameter by each residual, shape (p, Ny, Nx)."""
        direct = self.invert(np.eye(len(self._prior))[unknown])
        seen = self._changes(direct)
        wanted = self._adjoint(seen)
        x = self._find_fields(wanted)
        of_fields = self._forward(x)
        seen += self._changes(self.invert(self.moments(of_fields))) - of_fields
        return np.asarray(self._precision * seen)

    def _solve(self, pull: Array) -> tuple[Array, Array]:
        """Return the changes of the parameters, shape (k,), and of the fields, one after the other.

        `pull` is half the gradient of the prior of the parameters, shape (k,).
        """
        direct = self.invert(self.moments(self._left) - pull)
        at = np.concatenate([field.at.ravel() for field in self._fields])
        x = self._find_fields(self._adjoint(self._left - self._changes(direct)) - at)
        return self.invert(self.moments(self._left - self._forward(x)) - pull), x

    def _find_fields(self, wanted: Array) -> Array:
        """Return x with ``S x = wanted``.

        What is left in that bounds by how many standard errors parameters and fields are off.
        """
        least = self._finished**2 * float(_sum("i,i", wanted, wanted))
        return self._descend(wanted, max(least, NEGLIGIBLE**2))[0]

    def _descend(self, wanted: Array, least: float) -> tuple[Array, Array]:
        """Return x with ``S x = wanted`` by conjugate gradients from 0, and what is left of it.

        `_curvature` applies S. They end where the square of what is left is at most `least`.
        """
        x, rest, along = np.zeros_like(wanted), wanted, wanted
        square = float(_sum("i,i", rest, rest))
        for _ in range(self._n_steps):
            if square <= least:
                break
            image = self._curvature(along)
            share = square / float(_sum("i,i", along, image))
            x, rest = x + share * along, rest - share * image
            before, square = square, float(_sum("i,i", rest, rest))
            along = rest + square / before * along
        return x, rest

    def _curvature(self, x: Array) -> Array:
        """Return ``S x``, S half the second derivative in the fields, the parameters eliminated.

        S is the Schur complement of the block of the parameters.
        """
        images = self._forward(x)
        images -= self._changes(self.invert(self.moments(images)))
        return x + self._adjoint(images)

    def _each(self, x: Array) -> list[Array]:
        """Return the fields in their shapes, from all their values one after the other."""
        parts = zip(np.split(x, self._ends), self._fields, strict=True)
        return [part.reshape(field.at.shape) for part, field in parts]

    def _forward(self, x: Array) -> Array:
        """Return the changes of the images by the fields, shape (p, Ny, Nx)."""
        changes = zip(self._fields, self._each(x), strict=True)
        return np.sum([[*field.forward(part)] for field, part in changes], axis=0)

    def _adjoint(self, images: Array) -> Array:
        """Return ``sum_j B_j^T P_j y_j`` of images y, the fields one after the other."""
        weighted = self._precision * images
        return np.concatenate([field.adjoint(weighted).ravel() for field in self._fields])

    def moments(self, images: Array) -> Array:
        """Return ``sum_j J_j^T P_j y_j`` of images y, shape (k,)."""
        moments = np.zeros(len(self._prior))
        for each, image in zip(self._images, self._precision * images, strict=True):
            moments[each.unknowns] += _product(each.slopes, image.ravel())
        return moments

    def _changes(self, change: Array) -> Array:
        """Return the changes of the models, shape (p, Ny, Nx), where the unknowns change."""
        images = np.zeros_like(self._left)
        for image, each in zip(images, self._images, strict=True):
            if (own := change[each.unknowns]).any():
                image[:] = _product(each.slopes.T, own).reshape(image.shape)
        return images

    def invert(self, moments: Array) -> Array:
        """Return the inverse of `information` applied to a vector (k,), or columns (k, n)."""
        return _product(self._inverse, moments)


def _sparse(slopes: Array) -> Array | csr_array:
    """Return derivatives, most of which are 0 where stars light little of a window."""
    return csr_array(slopes) if np.count_nonzero(slopes) < SPARSE * slopes.size else slopes


def _product(matrix: Array | csr_array, other: Array | csr_array) -> Array:
    """Return a product without BLAS."""
    if isinstance(matrix, np.ndarray):
        return _sum("ik,k...->i...", matrix, other)
    product = matrix @ other
    return np.asarray(product if isinstance(product, np.ndarray) else product.toarray())


def _sum(products: str, a: Array, b: Array) -> Array:
    """Return an Einstein sum without BLAS, whose rounding depends on the number of threads."""
    return np.asarray(np.einsum(products, a, b))
