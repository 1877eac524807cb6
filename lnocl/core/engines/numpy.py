"""The iteration's verbs in plain NumPy: the engine ``"numpy"``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lnocl.core.engines.engine import State, has_weights
from lnocl.core.reference.convolve import convolve_columns, correlate_columns, otf_columns
from lnocl.core.reference.decide import collect_sums, follow_stars, next_step
from lnocl.core.reference.ratio import ratio_rows
from lnocl.core.reference.rows import ComplexArray, rfft_rows
from lnocl.core.reference.scale import scale_rows
from lnocl.core.reference.smooth import smooth
from lnocl.core.reference.step import gradient_rows, shortened, step_rows
from lnocl.core.reference.transmit import gather_rows, transmit_rows
from lnocl.core.reference.turn import irfft_sheared, ratio_sheared, unshear_columns
from lnocl.core.scene.arrays import Array, together
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.steps import STUCK, Steps
from lnocl.core.solvers.scaling import Scaling, inverse_weight


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
        self._mixes = None if scene.mixing is None else scene.mixes
        if scaling is not None:
            self.set_scaling(scaling)
        self.take_images()
        self._objectives: list[float] = []
        self._background, _ = together(scene.background(), self._images)
        self._otfs = np.array([otf_columns(rfft_rows(scene.psf(j))) for j in range(scene.n_images)])
        self._phases = None
        if rotations := scene.rotations:
            self._phases = np.array([each.row_phases() for each in rotations])
            self._column_shifts = np.array([each.column_shifts for each in rotations])
            self._image_shifts = np.array([each.image_shifts for each in rotations])
        self.move_stars()
        self._inverse_weight = (
            inverse_weight(scene, scaling) if has_weights(scene) else 1.0 / scene.n_images
        )
        self._slope = self._curvature = np.zeros(scene.sky_grid)

    def take_images(self) -> None:
        """Take the images that the scene has now, all else being as it was."""
        self._images = np.array(list(self.scene.images()))

    def set_scaling(self, scaling: Scaling) -> None:
        """Measure steps with this from now on."""
        self.scaling, self._shift = scaling, scaling.shift
        cutouts = [cutout.on_grid(self.scene.grid) for cutout in scaling.cross_information]
        self._cross_information = np.array(cutouts).reshape(len(cutouts), *self.scene.grid)
        self._star_inverse = scaling.star_information.solve(np.eye(len(cutouts)))

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""
        scene = self.scene
        self._star_images = np.array(
            [[scene.star_image(j, s) for j in range(scene.n_images)] for s in range(scene.n_fluxes)]
        ).reshape(scene.n_fluxes, *self._images.shape)

    def start(self, extended: Array, star_fluxes: Array, recorded: int = 0) -> None:
        """Begin from this estimate, with so many objectives on the record; add its own."""
        self._extended = np.where(np.asarray(self._inverse_weight) > 0, extended, 0.0)
        self._star_fluxes = star_fluxes.copy()
        self._previous = self._extended
        self._gradient, self._changes = np.zeros_like(self._extended), [0.0, 0.0]
        self._objectives = self._objectives[:recorded]
        self._judge_estimate(Steps(recorded=recorded))
        self._make_gradient()
        self._steps.going = self._steps.fresh = 0.0

    def _judge_estimate(self, steps: Steps) -> None:
        """Make the ratios of an estimate from elsewhere, and record its objective."""
        self._steps, self._prior = steps, self.scene.prior_of_fluxes()
        self._before, self._change = self._star_fluxes, np.zeros_like(self._star_fluxes)
        self._row_spectrum = rfft_rows(self._extended)
        self._squares = float((self._extended**2).sum())
        self._ratio()

    def go_on(self, target: int, tolerance: float) -> None:
        """Let ticks go on until so many objectives are recorded, or have settled."""
        self._steps = replace(self._steps, going=1.0, fresh=1.0, target=target, tolerance=tolerance)

    def tick(self) -> None:
        """Iterate once: make a step, or one shorter than the last, which was refused."""
        if not self._steps.going:
            return
        if self.scaling is None:
            self._correct()
            self._scale()
        else:
            self._step()
        self._ratio()
        self._make_gradient()

    def finish(self) -> None:
        """Tick until it rests; it shares its ticks with none."""
        while self._steps.going:
            self.tick()

    def look(self) -> Steps:
        """Return what was decided."""
        if self._steps.reason == STUCK:
            self._extended, self._star_fluxes = self._previous, self._before
        return self._steps

    def _ratio(self) -> None:
        """Make the ratios of the estimate; judge its objective."""
        skies = self._row_spectrum
        if (transmission := self.scene.transmission) is not None:
            skies = transmit_rows(self._extended, transmission, self._mixes)
        step = self.scene.oversample if self._phases is None else 1
        mixes = self._mixes if transmission is None else None
        row_spectra = convolve_columns(skies, self._otfs, step, self._phases, mixes)
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
                self.scene.spectral_smoothing,
            )
        self._star_corrections = collect_sums(
            self._steps,
            self._objectives,
            self._data_term,
            self._squares,
            smoothness,
            self._star_sums,
            self.scene.star_weights,
            self.scene.mu,
        )

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

    def _correct(self) -> None:
        """Back-project the ratios to the correction."""
        spectra, otfs, phases = self._ratio_row_spectra, self._otfs, self._phases
        if (transmission := self.scene.transmission) is None:
            self._row_spectrum = correlate_columns(spectra, otfs, phases, self._mixes)
            return
        alone = [slice(j, j + 1) for j in range(len(otfs))]
        back = [
            correlate_columns(spectra[j], otfs[j], None if phases is None else phases[j])
            for j in alone
        ]
        self._row_spectrum = gather_rows(np.array(back), transmission, self._mixes)

    def _scale(self) -> None:
        """Scale the estimate by its correction."""
        self._extended, self._row_spectrum, self._squares, self._star_fluxes = scale_rows(
            self._row_spectrum,
            self._extended,
            self._inverse_weight,
            self.scene.mu,
            self._star_fluxes,
            self._star_corrections,
            self.scene.star_weights,
            *self._prior,
            self._slope,
            self._curvature,
        )

    def _make_gradient(self) -> None:
        """Make the gradient of a new estimate, and how it has changed."""
        if self.scaling is None or not self._steps.fresh:
            return
        self._correct()
        self._gradient, *self._changes = gradient_rows(
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

    def _step(self) -> None:
        """Make a step from the estimate, or shorten it; let the stars follow."""
        steps, slope, coupling = self._steps, 0.0, np.zeros((1, 0))
        length = next_step(steps, *self._changes)
        if steps.shortened:
            trial, self._row_spectrum, self._squares = shortened(self._extended, self._previous)
        else:
            self._before = self._star_fluxes
            trial, self._row_spectrum, self._squares, slope, coupling = step_rows(
                self._extended,
                self._gradient,
                self._shift,
                self._inverse_weight,
                self._cross_information,
                self.scene.mu,
                length[0],
                self._curvature,
            )
            self._previous = self._extended
        self._extended = trial
        self._star_fluxes, self._change = follow_stars(
            steps,
            self._before,
            self._change,
            self._star_sums,
            coupling,
            self.scene.flux_mixes,
            self._star_inverse,
            *self._prior,
            slope,
            length,
        )

    def extended(self) -> Array:
        """Return the extended source, on the grid and scaled."""
        return self._extended.copy()

    def star_fluxes(self) -> Array:
        """Return the star fluxes, scaled."""
        return self._star_fluxes.copy()

    def data_term(self) -> float:
        """Return the data term of the last tick's estimate, scaled."""
        return self._data_term

    def objectives(self, first: int = 0) -> Array:
        """Return the objectives recorded, from one on, scaled."""
        return np.array(self._objectives[first:])

    def state(self) -> State:
        """Return the arrays from which `restore` continues."""
        state = {
            "extended": self._extended,
            "star_fluxes": self._star_fluxes,
            "objectives": self.objectives(),
            "steps": self._steps.numbers(),
        }
        if self.scaling is None:
            return state
        changes = {"previous": self._previous, "gradient": self._gradient}
        return state | changes | {"change_sums": np.array(self._changes)}

    def restore(self, state: State) -> None:
        """Continue from this state."""
        steps = Steps(*state["steps"].tolist())
        self._extended, self._star_fluxes = state["extended"], state["star_fluxes"]
        self._objectives = state["objectives"].tolist()[:-1]
        self._judge_estimate(replace(Steps(), recorded=len(self._objectives)))
        self._steps = steps
        if self.scaling is not None:
            self._previous, self._gradient = state["previous"], state["gradient"]
            self._changes = state["change_sums"].tolist()
