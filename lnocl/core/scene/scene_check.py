"""Warnings of a scene whose model is not what its images are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lnocl.core.scene.detector import Movable, on_sky
from lnocl.core.scene.grid import psf_shape
from lnocl.errors import warn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lnocl.core.scene.scene import Scene

# A PSF that rings by more than this share of its peak, moved by half a pixel, is warned of.
# Gaussians do not ring where they are centred on a pixel; sharp ones do where they are not.
MAX_RINGING = 0.01
# Five times the PSF's side wide, a tile of a field that grows by half varied by 0.1
# (docs/validation/tiles.md).
MAX_VARIATION = 0.2


def warn_of_scene(scene: Scene, psfs: Sequence[Movable], may_move: bool) -> None:
    """Warn of PSFs that are too large, vary or ring, and of offsets that go round the edges.

    Parameters
    ----------
    scene : Scene
        The scene.
    psfs : sequence of MovablePsf or DetectorPsf
        That of each image.
    may_move : bool
        Whether stars are moved later on.
    """
    _warn_of_large_psf(scene)
    _warn_of_varying_psfs(scene)
    _warn_of_wrapped_offsets(scene)
    _warn_of_ringing(scene, psfs, may_move)


def _warn_of_large_psf(scene: Scene) -> None:
    shape, grid = psf_shape(scene.observation), scene.grid
    if any(k > n for k, n in zip(shape, grid, strict=True)):
        warn(
            f"the psf {shape} is larger than the grid {grid}: its wings wrap round; crop it, or "
            "give `pad` to enlarge the grid"
        )


def _warn_of_varying_psfs(scene: Scene) -> None:
    observation = scene.observation
    for j, field in enumerate(observation.psf_fields):
        variation = field.variation(observation.psfs[j], observation.shape)
        if variation > MAX_VARIATION:
            warn(
                f"`psfs[{j}]` varies over the image by {variation:.0%}, and what is not a star "
                "is reconstructed with that of the middle: take tiles, by "
                "lnocl.deconvolve_tiles, or a smaller tile"
            )


def _warn_of_wrapped_offsets(scene: Scene) -> None:
    if scene.observation.is_turned:  # the grid holds all that is turned
        return
    offsets = np.ceil(abs(scene.observation.offsets).max(axis=0)).astype(int)[::-1]
    if (offsets > np.subtract(scene.image_grid, scene.observation.shape)).any():
        warn(
            f"the images are shifted by up to {offsets.max()} pixels, and what leaves one edge "
            f"comes in at the opposite one: give `pad` {offsets.max()} or more"
        )


def _warn_of_ringing(scene: Scene, psfs: Sequence[Movable], may_move: bool) -> None:
    """Warn of PSFs that are moved between pixels and are sharper than pixels can hold."""
    observation, q = scene.observation, scene.oversample
    for j, offset in enumerate(observation.offsets):
        places = observation.places(j, scene.stars)
        moved = np.concatenate([[q * offset], on_sky(places, q)])
        if observation.effective_psfs:
            moved -= (q - 1) / 2.0
        if not (may_move or scene.rotations) and (moved == np.round(moved)).all():
            continue
        psf, moved_psf = observation.psfs[j], psfs[j].fine.at(0.5, 0.5).values
        dark = min(psf.min(), 0.0) - moved_psf.min() / scene.gains[j]
        if dark > MAX_RINGING * psf.max():
            warn(
                f"`psfs[{j}]` is undersampled: shifted by half a pixel it rings by "
                f"{dark / psf.max():.1%} of its peak"
            )
