"""The engine that a run iterates on, as a protocol: its verbs and its state."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.steps import Steps

if TYPE_CHECKING:
    from lnocl.core.scene.scene import Scene
    from lnocl.core.solvers.scaling import Scaling

# Arrays by name; `objectives` grows along its first axis.
State = dict[str, NDArray[Any]]


class Engine(Protocol):
    """The verbs of a run; estimates are on the grid, scaled as in `lnocl.core.scene.scene`.

    A run is queued: ticks follow each other until it has ended, or has the objectives that it was
    to record, which the device decides. What is left of the queue then does nothing.

    Attributes
    ----------
    name : str
        The device, its platform and driver.
    scene : Scene
        What is modelled.
    scaling : Scaling or None
        The scaling of steps, for the scaled gradient projection method; None is for the
        split-gradient method.
    """

    name: str
    scene: Scene
    scaling: Scaling | None

    def start(self, extended: Array, star_fluxes: Array, recorded: int = 0) -> None:
        """Begin from this estimate, with so many objectives on the record; add its own, and rest.

        Pixels that were not observed are set to 0.
        """

    def take_images(self) -> None:
        """Take the images that the scene has now, all else being as it was."""

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""

    def set_scaling(self, scaling: Scaling) -> None:
        """Replace the scaling of steps."""

    def go_on(self, target: int, tolerance: float) -> None:
        """Let ticks go on until so many objectives are recorded, or have settled.

        They have where they change by less than this share of themselves an iteration.
        """

    def tick(self) -> None:
        """Iterate once, unless it rests: make a step, or shorten the last, which was refused."""

    def finish(self) -> None:
        """Tick until it rests; those that share its ticks do too."""

    def look(self) -> Steps:
        """Return what was decided; this waits for all ticks."""

    def objectives(self, first: int = 0) -> Array:
        """Return the objectives recorded, from one on; this waits for all ticks."""

    def data_term(self) -> float:
        """Return the data term J_0 of the last tick's estimate."""

    def extended(self) -> NDArray[np.floating]:
        """Return the extended source, in the precision of the engine."""

    def star_fluxes(self) -> Array:
        """Return the star fluxes."""

    def state(self) -> State:
        """Return the arrays that `restore` needs, where no tick is under way."""

    def restore(self, state: State) -> None:
        """Continue from this state."""


def has_weights(scene: Scene) -> bool:
    """Return whether pixels of the extended source differ in ``sum_j A_j^T w_j``."""
    return scene.weights is not None or scene.mixing is not None
