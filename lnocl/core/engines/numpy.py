"""The iteration's verbs in plain NumPy: the engine ``"numpy"``."""

from __future__ import annotations

from typing import Any

import numpy as np

from lnocl.core.reference.convolve import convolve_columns, correlate_columns, otf_columns
from lnocl.core.reference.ratio import ratio_rows
from lnocl.core.reference.rows import ComplexArray, rfft_rows
from lnocl.core.reference.scale import scale_rows
from lnocl.core.reference.smooth import smooth
from lnocl.core.reference.step import gradient_rows, step_rows
from lnocl.core.reference.sums import collect_sums
from lnocl.core.reference.transmit import gather_rows, transmit_rows
from lnocl.core.reference.turn import irfft_sheared, ratio_sheared, unshear_columns
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.engine import State
from lnocl.core.solvers.scaling import Scaling


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
    rounding = 0.0

    def __init__(self, scene: Scene, scaling: Scaling | None = None) -> None:
        self.scene, self.scaling = scene, scaling
        if scaling is not None:
            self.set_scaling(scaling)
        self.take_images()
        background = scene.background()
        self._background = background if background.ndim == 3 else background[:, None, None]
        self._otfs = np.array([otf_columns(rfft_rows(scene.psf(j))) for j in range(scene.n_images)])
        self._phases = None
        if rotations := scene.rotations:
            self._phases = np.array([each.row_phases() for each in rotations])
            self._column_shifts = np.array([each.column_shifts for each in rotations])
            self._image_shifts = np.array([each.image_shifts for each in rotations])
        self.move_stars()
        self._inverse_weight = self._invert_weight()
        self._slope = self._curvature = np.zeros(scene.grid)

    def take_images(self) -> None:
        """Take the images that the scene has now, all else being as it was; forget the record."""
        self._images = np.array(list(self.scene.images()))
        self._objectives: list[float] = []
        self._n_fetched = 0

    def set_scaling(self, scaling: Scaling) -> None:
        """Measure steps with this from now on."""
        self.scaling, self._shift = scaling, scaling.shift
        cutouts = [cutout.on_grid(self.scene.grid) for cutout in scaling.cross_information]
        self._cross_information = np.array(cutouts).reshape(len(cutouts), *self.scene.grid)

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""
        scene = self.scene
        self._star_images = np.array(
            [[scene.star_image(j, s) for j in range(scene.n_images)] for s in range(scene.n_fluxes)]
        ).reshape(scene.n_fluxes, *self._images.shape)

    def _invert_weight(self) -> Array | float:
        if self.scene.weights is None:
            return 1.0 / self.scene.n_images
        model = Model(self.scene)
        total = model.adjoint(model.weights)
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
        skies = self._row_spectrum
        if (transmission := self.scene.transmission) is not None:
            skies = transmit_rows(self._extended, transmission)
        step = self.scene.oversample if self._phases is None else 1
        row_spectra = convolve_columns(skies, self._otfs, step, self._phases)
        observed = (
            self._images,
            self.scene.weights,
            self._background,
            self._star_images,
            self._star_fluxes,
        )
        if self._phases is None:
            self._ratio_row_spectra, self._data_term, self._star_sums = ratio_rows(
                row_spectra, *observed
            )
        else:
            self._ratio_turned(row_spectra, observed)
        smoothness = 0.0
        if self.scene.is_smoothed:
            weights = self.scene.smoothing_map
            self._slope, self._curvature, smoothness = smooth(
                self._extended,
                self.scene.smoothing if weights is None else weights,
                self.scene.edge,
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

    def _ratio_turned(self, row_spectra: ComplexArray, observed: tuple[Any, ...]) -> None:
        """Make the ratios of images that are turned, in the steps of their pixels."""
        rotations = enumerate(self.scene.rotations)
        sampled = {j: rotation.samplings for j, rotation in rotations if rotation.samplings}
        for j, (rows, _) in sampled.items():
            row_spectra[j] = rows.forward(row_spectra[j], 0)
        pixels = irfft_sheared(row_spectra)
        for j, (_, columns) in sampled.items():
            pixels[j] = columns.forward(pixels[j], 1)
        sheared, self._data_term, self._star_sums = ratio_sheared(
            pixels, self._column_shifts, self._image_shifts, *observed
        )
        back = unshear_columns(sheared, self._column_shifts)
        for j, (_, columns) in sampled.items():
            back[j] = columns.adjoint(back[j], 1)
        self._ratio_row_spectra = rfft_rows(back)
        for j, (rows, _) in sampled.items():
            self._ratio_row_spectra[j] = rows.adjoint(self._ratio_row_spectra[j], 0)

    def correct(self) -> None:
        """Back-project the ratios to the correction."""
        spectra, otfs, phases = self._ratio_row_spectra, self._otfs, self._phases
        if (transmission := self.scene.transmission) is None:
            self._row_spectrum = correlate_columns(spectra, otfs, phases)
            return
        alone = [slice(j, j + 1) for j in range(len(otfs))]
        back = [
            correlate_columns(spectra[j], otfs[j], None if phases is None else phases[j])
            for j in alone
        ]
        self._row_spectrum = gather_rows(np.array(back), transmission)

    def scale(self) -> None:
        """Scale the estimate by its correction."""
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
        self._gradient, change_step, change_change = gradient_rows(
            self._row_spectrum,
            self._extended,
            self._previous,
            self._gradient,
            self._shift,
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
        """Step from the base; return ``<gradient, d>`` and ``<c_s, d>``; see `step_rows`."""
        self._extended, self._row_spectrum, self._squares, slope, coupling = step_rows(
            self._previous,
            self._gradient,
            self._shift,
            self._inverse_weight,
            self._cross_information,
            self.scene.mu,
            alpha,
            share,
            self._base_curvature,
        )
        return slope, coupling

    def set_star_fluxes(self, star_fluxes: Array) -> None:
        """Make these the star fluxes."""
        self._star_fluxes = star_fluxes.copy()

    def objective(self) -> float:
        """Return the objective recorded last."""
        return self._objectives[-1]

    def forget_objective(self) -> None:
        """Take the objective recorded last off the record."""
        self._objectives.pop()
        self._n_fetched = min(self._n_fetched, len(self._objectives))

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

    def fetched_objectives(self) -> list[float]:
        """Return the objectives recorded since the last call, scaled."""
        fetched, self._n_fetched = self._objectives[self._n_fetched :], len(self._objectives)
        return fetched

    def state(self) -> State:
        """Return the arrays from which `restore` continues between iterations."""
        return {
            "extended": self._extended,
            "star_fluxes": self._star_fluxes,
            "square_sums": np.array([self._squares]),
            "objectives": self.objectives(),
            "previous": self._previous,
            "gradient": self._gradient,
        }

    def restore(self, state: State) -> None:
        """Continue from this state."""
        self._extended, self._previous = state["extended"], state["previous"]
        self._gradient = state["gradient"]
        self._star_fluxes = state["star_fluxes"]
        self._row_spectrum = rfft_rows(self._extended)
        self._squares = float(state["square_sums"][0])
        self._objectives = state["objectives"].tolist()
        self._n_fetched = len(self._objectives)
