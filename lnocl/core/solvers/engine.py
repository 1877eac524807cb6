"""The engine that a solver iterates on, as a protocol: its verbs and its state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array

if TYPE_CHECKING:
    from lnocl.core.scene.scene import Scene
    from lnocl.core.solvers.scaling import Scaling

# Arrays by name; `objectives` grows along its first axis.
State = dict[str, NDArray[Any]]


class Engine(Protocol):
    """The verbs of an iteration; estimates are on the grid, scaled as in `lnocl.core.scene.scene`.

    Both solvers call `ratio` and `correct`; the split-gradient method `scale`, the scaled gradient
    projection method the verbs from `gradient` to `forget_objective`. A run calls the others.

    Attributes
    ----------
    name : str
        The device, its platform and driver.
    scene : Scene
        What is modelled.
    rounding : float
        A rise of the objective, as a share of it, that may be rounding: in single precision, where
        a step promises less than that long before the estimate is at the minimum.
    scaling : Scaling or None
        The scaling of steps, for the scaled gradient projection method.
    """

    name: str
    scene: Scene
    rounding: float
    scaling: Scaling | None

    def start(self, extended: Array, star_fluxes: Array) -> None:
        """Begin from this estimate; pixels that were not observed are set to 0."""

    def take_images(self) -> None:
        """Take the images that the scene has now, all else being as it was; forget the record."""

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""

    def set_scaling(self, scaling: Scaling) -> None:
        """Replace the scaling of steps."""

    def ratio(self) -> None:
        """Make the ratios of the estimate; record its objective."""

    def correct(self) -> None:
        """Back-project the ratios to the correction."""

    def scale(self) -> None:
        """Scale the estimate by its correction."""

    def gradient(self) -> tuple[float, float]:
        """Take the estimate as the base of the next step and the correction for its gradient.

        Return ``<D y, s>`` and ``<D y, D y>``, with s and y the changes of estimate and gradient
        since the last base, and D the scaling.
        """

    def star_gradient(self) -> Array:
        """Return the gradient of the objective in the star fluxes."""

    def step(self, alpha: float, share: float) -> tuple[float, Array]:
        """Make the estimate the base plus a share of d, its projected step of length alpha.

        Return ``<gradient, d>`` and, for each star, ``<cross_information, d>``.
        """

    def set_star_fluxes(self, star_fluxes: Array) -> None:
        """Replace the star fluxes."""

    def objective(self) -> float:
        """Return the objective recorded last."""

    def forget_objective(self) -> None:
        """Take the objective recorded last off the record."""

    def objectives(self) -> Array:
        """Return the objectives recorded so far; this waits for the device."""

    def fetched_objectives(self) -> list[float]:
        """Return the objectives of `ratio` that have arrived since the last call, in order.

        This does not wait for the device, so that the latest may be missing.
        """

    def data_term(self) -> float:
        """Return the data term J_0 of the objective recorded last."""

    def extended(self) -> Array:
        """Return the extended source."""

    def star_fluxes(self) -> Array:
        """Return the star fluxes."""

    def state(self) -> State:
        """Return the arrays that `restore` needs, as they are between iterations."""

    def restore(self, state: State) -> None:
        """Continue from this state."""
