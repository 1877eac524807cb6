"""What may be free in a fit: conditions on images, of plans, of refusals and of advice."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from lnocl.scene.observation import Observation


class Condition(NamedTuple):
    """What must hold of images for a fit, or of a plan for a step.

    Attributes
    ----------
    holds : callable
        Tells of the subject whether it does.
    otherwise : str
        What is said where it does not.
    """

    holds: Callable[[Any], bool]
    otherwise: str


ONE_EPOCH = Condition(lambda images: images.n_epochs == 1, "the images are of several epochs")
ALL_ONE_PSF = Condition(
    lambda images: not len(images.star_psfs), "stars have PSFs of their own, which tell of no other"
)

# What each parameter of `lnocl.deconvolve` needs, in the order in which reasons are given.
NEEDS = {
    "refine_positions": (ONE_EPOCH,),
    "refine_psfs": (ALL_ONE_PSF,),
    "psf_scatter": (ALL_ONE_PSF,),
}


def why_not(name: str, observation: Observation) -> str:
    """Return why a parameter of `NEEDS` cannot be used for images; nothing where it can."""
    return next((each.otherwise for each in NEEDS[name] if not each.holds(observation)), "")


def refusal(name: str, observation: Observation) -> str:
    """Return the message that refuses a parameter for images; nothing where it can be used."""
    why = why_not(name, observation)
    return why and f"`{name}` cannot be used where {why}; leave it out"
