"""What may be free in a fit: the rule of the refusals, and of the advice that leads to them."""

from __future__ import annotations

from lnocl.scene.observation import Observation


def refusal(name: str, observation: Observation) -> str:
    """Return why a parameter of `lnocl.deconvolve` is refused for images; nothing where it is not.

    Parameters
    ----------
    name : {"refine_positions", "refine_psfs"}
        The parameter.
    observation : Observation
        The images.
    """
    if name == "refine_positions":
        if observation.n_epochs > 1:
            return "`refine_positions` moves stars of one epoch alone; leave it out, or `epochs`"
        return ""
    if observation.psf_fields:
        return (
            "`refine_psfs` and `psf_scatter` are for PSFs that are the same all over the images; "
            "leave them out where PSFs vary over the field"
        )
    if observation.is_turned or observation.n_epochs > 1:
        return (
            "`refine_psfs` and `psf_scatter` are for images of one epoch that are not turned "
            "against the sky; leave them out"
        )
    if len(observation.halos):
        return (
            "`refine_psfs` and `psf_scatter` are for images without `halos`; leave one of them out"
        )
    return ""
