"""The plain NumPy twin of every kernel, in float64, and the engine they make together.

Each function here has the name of the kernel whose equation it writes down; it takes and returns
arrays in their natural order, where the kernel keeps its own layout (`lnocl.opencl.fft`). Row
spectra are half spectra along x alone, shape (..., Ny, Nx // 2 + 1).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import xlog1py

from lnocl.errors import refuse_not_finite
from lnocl.scene.observation import Array
from lnocl.scene.scene import LEAST_MODEL, Scene
from lnocl.solvers.scaling import Scaling

ComplexArray = NDArray[np.complex128]


def rfft_rows(pixels: Array) -> ComplexArray:
    """Return twice the half spectrum of each row: ``2 sum_x f(x) exp(-2 pi i k x / Nx)``."""
    return 2.0 * np.fft.rfft(pixels, axis=-1)


def fft_columns(spectra: ComplexArray) -> ComplexArray:
    """Return the spectrum of each column: ``sum_y F(y) exp(-2 pi i k y / Ny)``."""
    return np.fft.fft(spectra, axis=-2)


def ifft_columns(spectra: ComplexArray) -> ComplexArray:
    """Return ``sum_k F(k) exp(+2 pi i k y / Ny)`` of each column, not divided by Ny."""
    return np.fft.ifft(spectra, axis=-2, norm="forward")


def irfft_rows(row_spectra: ComplexArray) -> Array:
    """Return ``sum_k F(k) exp(+2 pi i k x / Nx)`` of each row, not divided by Nx."""
    nx = 2 * (row_spectra.shape[-1] - 1)
    return np.fft.irfft(row_spectra, n=nx, axis=-1, norm="forward")


def otf_columns(row_spectra: ComplexArray) -> ComplexArray:
    """Return the optical transfer function, from the row spectra of a PSF (peak at the origin).

    The spectrum divided by what the transforms leave in: Ny Nx of the two inverse ones, 2 of
    each of the two forward ones.
    """
    ny, nx = row_spectra.shape[-2], 2 * (row_spectra.shape[-1] - 1)
    return fft_columns(row_spectra) / (4.0 * ny * nx)


def convolve_columns(row_spectrum: ComplexArray, otfs: ComplexArray) -> ComplexArray:
    """Return the row spectra of ``A_j f``, shape (p, Ny, Nx // 2 + 1), from that of f."""
    return ifft_columns(otfs * fft_columns(row_spectrum))


def correlate_columns(row_spectra: ComplexArray, otfs: ComplexArray) -> ComplexArray:
    """Return the row spectrum of ``sum_j A_j^T (r_j - w_j)`` from those of the r_j - w_j."""
    return ifft_columns((np.conj(otfs) * fft_columns(row_spectra)).sum(axis=0))


def ratio_rows(
    row_spectra: ComplexArray,
    images: Array,
    weights: NDArray[Any] | None,
    background: Array,
    star_images: Array,
    star_fluxes: Array,
) -> tuple[ComplexArray, float, Array]:
    """Return the row spectra of ``r_j - w_j``, the objective's data term, and the star sums.

    ``m_j = A_j f + sum_s c_s P_js + b_j``, ``r_j = w_j g_j / m_j``, ``sum_j <P_js, r_j - w_j>`` and
    ``J_0 = sum w_j (g_j ln(g_j / m_j) + m_j - g_j)``; La Camera et al. (2012), Eq. 7 and 9.
    Where ``m_j`` is not above `LEAST_MODEL`, ``r_j = 0`` and ``m_j = LEAST_MODEL`` in J_0.
    """
    model = irfft_rows(row_spectra) + background
    model += np.einsum("s,sjyx->jyx", star_fluxes, star_images)
    dark = model <= LEAST_MODEL  # which NaN is not: it reaches the objective
    model = np.where(dark, LEAST_MODEL, model)
    ratio = images / model
    # Its terms of first order cancel, those of scipy.special.kl_div only the terms themselves.
    divergence = model * (xlog1py(ratio, ratio - 1.0) - (ratio - 1.0))
    excess = np.where(dark, 0.0, ratio) - 1.0
    if weights is not None:
        excess, divergence = weights * excess, weights * divergence
    star_sums = np.einsum("sjyx,jyx->s", star_images, excess)
    return rfft_rows(excess), float(divergence.sum()), star_sums


def smooth(extended: Array, beta: float, delta: float) -> tuple[Array, Array, float]:
    """Return slope, curvature and value of the edge-preserving term.

    ``beta sum psi(f - f')`` over the pairs of pixels that share an edge, also round the grid's own
    edges, ``psi(t) = sqrt(t^2 + delta^2) - delta``. slope is its gradient, and curvature the sum of
    ``beta psi'(f - f') / (f - f')`` over the four neighbours of a pixel.
    """
    slope, curvature, value = np.zeros_like(extended), np.zeros_like(extended), 0.0
    for axis in (-1, -2):
        step = extended - np.roll(extended, -1, axis)
        root = np.sqrt(step**2 + delta**2)
        slope += step / root - np.roll(step / root, 1, axis)
        curvature += 1.0 / root + np.roll(1.0 / root, 1, axis)
        value += float((step**2 / (root + delta)).sum())
    return beta * slope, beta * curvature, beta * value


def collect_sums(
    objective: float,
    squares: float,
    smoothness: float,
    star_sums: Array,
    star_weights: Array,
    mu: float,
) -> tuple[float, Array]:
    """Return the objective, ``J_0 + mu / 2 sum f^2 +`` smoothness, and the star corrections.

    A star's correction is ``1 + sum_j <P_js, r_j - w_j> / sum_j <P_js, w_j>``; one that negative
    PSF pixels have made negative counts as 0.
    """
    return objective + 0.5 * mu * squares + smoothness, np.maximum(
        1.0 + star_sums / star_weights, 0.0
    )


def scale_rows(
    row_spectrum: ComplexArray,
    extended: Array,
    inverse_weight: Array | float,
    mu: float,
    star_fluxes: Array,
    star_corrections: Array,
    slope: Array | float = 0.0,
    curvature: Array | float = 0.0,
) -> tuple[Array, ComplexArray, float, Array]:
    """Return the scaled extended source, its row spectrum and sum of squares, and star fluxes.

    ``f <- f (1 + a u) / (1 + (mu + curvature) f a)``, ``u = c + curvature f - slope``, with
    ``c = sum_j A_j^T (r_j - w_j)`` and ``a = 1 / sum_j A_j^T w_j``, 0 where nothing was observed;
    ``c_s`` is multiplied by its correction; La Camera et al. (2012), Eq. 9, as
    ``sum_j A_j^T w_j`` is what ``r_j = w_j`` gives. slope and curvature, of the edge-preserving
    term (`smooth`), split its gradient into curvature f and what is left, neither negative.
    A correction ``1 + a u`` that rounding has made negative counts as 0.
    """
    excess = irfft_rows(row_spectrum) + curvature * extended - slope
    correction = np.maximum(1.0 + inverse_weight * excess, 0.0)
    scaled = extended * correction / (1.0 + (mu + curvature) * extended * inverse_weight)
    squares = float((scaled**2).sum())
    return scaled, rfft_rows(scaled), squares, star_fluxes * star_corrections


def gradient_rows(
    row_spectrum: ComplexArray,
    extended: Array,
    previous: Array,
    gradient: Array,
    shift: Array,
    inverse_weight: Array | float,
    mu: float,
    slope: Array | float = 0.0,
    curvature: Array | float = 0.0,
) -> tuple[Array, float, float]:
    """Return the gradient of J in f, ``<D y, s>`` and ``<D y, D y>``.

    The gradient is ``mu f + slope - c``, ``c = sum_j A_j^T (r_j - w_j)``; y is its change from
    `gradient` and s that of f from `previous`. With z the shift,
    ``D = (f + z) a / (1 + (mu + curvature) (f + z) a)``.
    """
    following = mu * extended + slope - irfft_rows(row_spectrum)
    scaling = _shifted_scaling(extended, shift, inverse_weight, mu + curvature)
    change = scaling * (following - gradient)
    return following, float((change * (extended - previous)).sum()), float((change**2).sum())


def _shifted_scaling(
    extended: Array, shift: Array, inverse_weight: Array | float, penalty_weight: Array | float
) -> Array:
    scaled = (extended + shift) * inverse_weight
    return scaled / (1.0 + penalty_weight * scaled)


def step_rows(
    extended: Array,
    gradient: Array,
    shift: Array,
    inverse_weight: Array | float,
    reach: Array,
    mu: float,
    alpha: float,
    share: float,
    curvature: Array | float = 0.0,
) -> tuple[Array, ComplexArray, float, float, Array]:
    """Return ``f + share d``, its row spectrum and squares, ``<gradient, d>`` and ``<reach_s, d>``.

    ``d = P(f - alpha D gradient) - f`` with P the projection on ``f >= 0`` and D as in
    `gradient_rows`; Bonettini, Zanella & Zanni (2009), Inverse Problems 25, 015002.
    """
    scaling = _shifted_scaling(extended, shift, inverse_weight, mu + curvature)
    direction = np.maximum(extended - alpha * scaling * gradient, 0.0) - extended
    trial = np.maximum(extended + share * direction, 0.0)
    slope = float((gradient * direction).sum())
    reached = (reach * direction).sum(axis=(-2, -1))
    return trial, rfft_rows(trial), float((trial**2).sum()), slope, reached


class ReferenceEngine:
    """The iteration's verbs in plain NumPy, float64: the engine ``"numpy"``.

    Parameters
    ----------
    scene : Scene
        What is modelled.
    scaling : Scaling, optional
        For the scaled gradient projection method.
    """

    name = "numpy"

    def __init__(self, scene: Scene, scaling: Scaling | None = None) -> None:
        self.scene, self.scaling = scene, scaling
        self._images = scene.images()
        background = scene.background()
        self._background = background if background.ndim == 3 else background[:, None, None]
        self._otfs = np.array([otf_columns(rfft_rows(scene.psf(j))) for j in range(scene.n_images)])
        self.move_stars()
        self._inverse_weight = self._invert_weight()
        self._slope = self._curvature = np.zeros(scene.grid)
        self._objectives: list[float] = []

    def set_scaling(self, scaling: Scaling) -> None:
        """Measure steps with this from now on."""
        self.scaling = scaling

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""
        scene = self.scene
        self._star_images = np.array(
            [[scene.star_image(j, s) for j in range(scene.n_images)] for s in range(scene.n_stars)]
        ).reshape(scene.n_stars, *self._images.shape)

    def _invert_weight(self) -> Array | float:
        if self.scene.weights is None:
            return 1.0 / self.scene.n_images
        row_spectra = rfft_rows(self.scene.weights.astype(np.float64))
        total = irfft_rows(correlate_columns(row_spectra, self._otfs))
        observed = self.scene.observed(total)
        return np.divide(1.0, total, out=np.zeros_like(total), where=observed)

    def start(self, extended: Array, star_fluxes: Array) -> None:
        """Begin from this estimate, on the grid and scaled; unobserved pixels are set to 0."""
        self._extended = np.where(np.asarray(self._inverse_weight) > 0, extended, 0.0)
        self._star_fluxes = star_fluxes.copy()
        self._row_spectrum = rfft_rows(self._extended)
        self._squares = float((self._extended**2).sum())
        self._previous = self._extended
        self._gradient = np.zeros_like(self._extended)

    def ratio(self) -> None:
        """Make the ratios of the estimate; record its objective."""
        self._ratio_row_spectra, self._data_term, self._star_sums = ratio_rows(
            convolve_columns(self._row_spectrum, self._otfs),
            self._images,
            self.scene.weights,
            self._background,
            self._star_images,
            self._star_fluxes,
        )
        smoothness = 0.0
        if self.scene.smoothing:
            self._slope, self._curvature, smoothness = smooth(
                self._extended, self.scene.smoothing, self.scene.edge
            )
        objective, self._star_corrections = collect_sums(
            self._data_term,
            self._squares,
            smoothness,
            self._star_sums,
            self.scene.star_weights,
            self.scene.mu,
        )
        self._objectives.append(objective)

    def correct(self) -> None:
        """Back-project the ratios to the correction."""
        self._row_spectrum = correlate_columns(self._ratio_row_spectra, self._otfs)

    def scale(self) -> None:
        """Scale the estimate by its correction."""
        refuse_not_finite(self._objectives[-1])
        self._extended, self._row_spectrum, self._squares, self._star_fluxes = scale_rows(
            self._row_spectrum,
            self._extended,
            self._inverse_weight,
            self.scene.mu,
            self._star_fluxes,
            self._star_corrections,
            self._slope,
            self._curvature,
        )

    def gradient(self) -> tuple[float, float]:
        """Take the estimate for the base of steps; return ``<D y, s>`` and ``<D y, D y>``."""
        assert self.scaling is not None
        self._gradient, change_step, change_change = gradient_rows(
            self._row_spectrum,
            self._extended,
            self._previous,
            self._gradient,
            self.scaling.shift,
            self._inverse_weight,
            self.scene.mu,
            self._slope,
            self._curvature,
        )
        self._previous, self._base_curvature = self._extended, self._curvature
        return change_step, change_change

    def star_gradient(self) -> Array:
        """Return the gradient of the objective in the star fluxes."""
        return -self._star_sums

    def step(self, alpha: float, share: float) -> tuple[float, Array]:
        """Step from the base; return ``<gradient, d>`` and ``<reach_s, d>``."""
        assert self.scaling is not None
        self._extended, self._row_spectrum, self._squares, slope, reached = step_rows(
            self._previous,
            self._gradient,
            self.scaling.shift,
            self._inverse_weight,
            self.scaling.reach,
            self.scene.mu,
            alpha,
            share,
            self._base_curvature,
        )
        return slope, reached

    def set_star_fluxes(self, star_fluxes: Array) -> None:
        """Make these the star fluxes."""
        self._star_fluxes = star_fluxes.copy()

    def objective(self) -> float:
        """Return the objective recorded last."""
        return self._objectives[-1]

    def forget_objective(self) -> None:
        """Take the objective recorded last off the record."""
        self._objectives.pop()

    def extended(self) -> Array:
        """Return the extended source, on the grid and scaled."""
        return self._extended.copy()

    def star_fluxes(self) -> Array:
        """Return the star fluxes, scaled."""
        return self._star_fluxes.copy()

    def data_term(self) -> float:
        """Return the data term of the objective recorded last, scaled."""
        return self._data_term

    def objectives(self) -> Array:
        """Return the objectives recorded so far, scaled."""
        return np.array(self._objectives)

    def state(self) -> dict[str, Array]:
        """Return what `restore` needs, as it is between iterations."""
        return {
            "extended": self._extended,
            "star_fluxes": self._star_fluxes,
            "square_sums": np.array([self._squares]),
            "objectives": self.objectives(),
            "previous": self._previous,
            "gradient": self._gradient,
        }

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from this state."""
        self._extended, self._previous = state["extended"], state["previous"]
        self._gradient = state["gradient"]
        self._star_fluxes = state.get("star_fluxes", np.zeros(0))
        self._row_spectrum = rfft_rows(self._extended)
        self._squares = float(state["square_sums"][0])
        self._objectives = state.get("objectives", np.zeros(0)).tolist()
