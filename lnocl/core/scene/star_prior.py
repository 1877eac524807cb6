"""What is known of star fluxes before a run: a Gaussian prior, beside the data term."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lnocl.core.scene.arrays import Array


@dataclass(frozen=True)
class StarPrior:
    """The term ``sum_s (c_s - c0_s)^2 / (2 sigma_s^2)`` of what a solver minimises.

    It has the extended source leave to stars what is theirs: without it pixels near a star may take
    over its light at almost no price.

    Attributes
    ----------
    fluxes : ndarray of float64, shape (n_fluxes,)
        The c0_s.
    precision : ndarray of float64, shape (n_fluxes,)
        The ``1 / sigma_s^2``; 0 where nothing is known, as of halos.
    """

    fluxes: Array
    precision: Array

    @classmethod
    def of(cls, fluxes: Array, errors: Array) -> StarPrior:
        """Return the prior of fluxes with these standard errors; NaN: nothing is known."""
        is_known = np.isfinite(errors) & (errors > 0) & np.isfinite(fluxes)
        precision = np.divide(1.0, errors**2, out=np.zeros_like(errors), where=is_known)
        return cls(np.where(is_known, fluxes, 0.0), precision)

    def scaled(self, unit: float, scale: float) -> StarPrior:
        """Return it in other units: fluxes over `unit`, and the term over `scale`.

        That of half of the counts, which are half as bright and have half of the information, is
        the same, scaled.
        """
        return StarPrior(self.fluxes / unit, self.precision * unit**2 / scale)

    def drawn(self, fluxes: Array, rng: np.random.Generator) -> StarPrior:
        """Return a prior like this one that was told of stars of these fluxes."""
        is_known = self.precision > 0
        errors = np.zeros_like(self.precision)
        errors[is_known] = self.precision[is_known] ** -0.5
        drawn = fluxes + errors * rng.standard_normal(len(fluxes))
        return replace(self, fluxes=np.where(is_known, drawn, 0.0))

    def gradient(self, fluxes: Array) -> Array:
        """Return its gradient in the fluxes."""
        return self.precision * (fluxes - self.fluxes)
