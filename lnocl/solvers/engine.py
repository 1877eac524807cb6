"""The verbs that the solvers ask of an engine."""

from __future__ import annotations

from typing import Protocol

from numpy.typing import NDArray

from lnocl.scene.observation import Array


class StarSteps(Protocol):
    """How star fluxes follow the extended source."""

    def star_step(self, fluxes: Array, gradient: Array, coupling: Array) -> Array:
        """Return the change of the star fluxes for their gradient and what a step reaches."""


class Engine(Protocol):
    """The verbs of an iteration; estimates are on the grid and scaled, as in `lnocl.scene.scene`.

    The split-gradient method needs those as far as `scale`; the scaled gradient projection method
    `ratio`, `correct` and those from `gradient` on.
    """

    scaling: StarSteps | None

    def start(self, extended: Array, star_fluxes: Array) -> None:
        """Begin from this estimate."""

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""

    def ratio(self) -> None:
        """Make the ratios of the estimate; record its objective."""

    def correct(self) -> None:
        """Back-project the ratios to the correction."""

    def scale(self) -> None:
        """Scale the estimate by its correction.

        Raises
        ------
        NotFiniteError
            An objective, perhaps that of some iterations ago, is infinite or not a number.
        """

    def gradient(self) -> tuple[float, float]:
        """Take the estimate as the base of the next step and the correction for its gradient.

        Return ``<D y, s>`` and ``<D y, D y>``, with s and y the changes of estimate and gradient
        since the last base, and D the scaling.
        """

    def star_gradient(self) -> Array:
        """Return the gradient of the objective in the star fluxes."""

    def step(self, alpha: float, share: float) -> tuple[float, Array]:
        """Make the estimate the base plus a share of d, its projected step of length alpha.

        Return ``<gradient, d>`` and what d reaches of the stars.
        """

    def set_star_fluxes(self, star_fluxes: Array) -> None:
        """Make these the star fluxes."""

    def objective(self) -> float:
        """Return the objective recorded last."""

    def forget_objective(self) -> None:
        """Take the objective recorded last off the record."""

    def extended(self) -> Array:
        """Return the extended source."""

    def star_fluxes(self) -> Array:
        """Return the star fluxes."""

    def data_term(self) -> float:
        """Return the data term J_0 of the objective recorded last."""

    def objectives(self) -> Array:
        """Return the objectives recorded so far."""

    def state(self) -> dict[str, NDArray]:
        """Return what `restore` needs, as it is between iterations."""

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from this state."""
