"""The memory that a scene takes on a device, buffer by buffer, and on the host."""

from __future__ import annotations

import math

import numpy as np

from lnocl.core.engines.engine import has_weights
from lnocl.core.opencl.layout import Layout
from lnocl.core.opencl.memory import held_bytes
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.windows import StarWindows
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.steps import Steps
from lnocl.core.solvers.scaling import Scaling

N_STEPS = len(Steps().numbers())
# Buffers of a number a star.
OF_STARS = "star_fluxes", "star_weights", "star_corrections", "prior_fluxes", "prior_precision"
# Bytes that PoCL takes for kernels: those that it compiles, and those that it finds stored.
COMPILER = 160 * 2**20, 40 * 2**20
# Estimates of both halves of the counts that are held (`lnocl.core.runs.halves`).
SNAPSHOTS = 22


def buffer_sizes(
    scene: Scene, program: Program, layout: Layout, stars: StarWindows, n_iter: int
) -> dict[str, int]:
    """Return the bytes of each buffer, by the name that the kernels have for it."""
    p, n, item = scene.n_images, scene.n_fluxes, program.dtype.itemsize
    k = scene.observation.n_skies
    pixels, image, pair = layout.pixels_bytes, layout.images.pixels_bytes, 2 * item
    skies, block_sums = k * pixels, k * program.row_blocks * pair
    point = layout.block_bytes // program.grid[1]
    return {
        "images": p * image,
        "otfs": p * pixels,
        "otf_edges": p * program.grid[0] * pair,
        "spectra": (p + k - 1) * layout.spectra_bytes,
        "mixes": p * k * item,
        "extended": skies,
        "inverse_weight": skies if has_weights(scene) else point,
        "background": p * (image if has_background_map(scene) else point),
        "exposure": p * image if scene.has_exposure_map else point,
        "star_images": max(p * stars.bytes, item),
        "star_corners": max(n * p, 1) * 8,
        "star_near": stars.near.nbytes,
        **dict.fromkeys(OF_STARS, max(n, 1) * item),
        "star_totals": max(n, 1) * pair,
        "star_sums": max(p * stars.n_blocks_of_all, 1) * pair,
        "ratio_sums": program.image_row_blocks * p * pair,
        "data_term": pair,
        "square_sums": block_sums,
        "slope": skies if scene.is_smoothed else item,
        "curvature": skies if scene.is_smoothed else item,
        "smoothing_map": skies if scene.smoothing_map is not None else item,
        "smooth_sums": block_sums,
        "smoothing": k * item,
        "edge": k * item,
        "objectives": (n_iter + 1) * pair,
        "steps": N_STEPS * item,
        "row_phases": item,
        "transmission": p * pixels if scene.transmission is not None else item,
        "transmitted": pixels if scene.transmission is not None else item,
    }


def scaling_sizes(
    scene: Scene, program: Program, layout: Layout, cross: StarWindows
) -> dict[str, int]:
    """Return those of the buffers that scaled steps need besides."""
    item, k = program.dtype.itemsize, scene.observation.n_skies
    skies, block_sums = k * layout.pixels_bytes, k * program.row_blocks * 2 * item
    return {
        "previous": skies,
        "gradient": skies,
        "shift": skies,
        "change_sums": 2 * block_sums,
        "flux_mixes": max(scene.n_fluxes, 1) * k * item,
        "star_inverse": max(scene.n_fluxes, 1) ** 2 * item,
        "star_steps": max(scene.n_fluxes, 1) * 4 * item,
        "step_sums": block_sums,
        **cross_sizes(scene, program, cross),
    }


def cross_sizes(scene: Scene, program: Program, cross: StarWindows) -> dict[str, int]:
    """Return those of the buffers that depend on where the stars are."""
    item, k = program.dtype.itemsize, scene.observation.n_skies
    return {
        "cross_information": max(cross.bytes, item),
        "cross_corners": max(scene.n_fluxes, 1) * 8,
        "cross_near": cross.near.nbytes,
        "coupling_sums": max(k * cross.n_blocks_of_all, 1) * 2 * item,
    }


def has_background_map(scene: Scene) -> bool:
    """Return whether a scene has a background for each pixel."""
    return scene.has_exposure_map or scene.observation.background.ndim == 3


def host_bytes(
    scene: Scene, scaling: Scaling | None, of_device: int, program: Program, halves: bool
) -> int:
    """Return about how many bytes the process takes on the host, besides the device's.

    It holds most of them by now: libraries, the observation and the stars. To come are the
    compiler and the answer, and at the end, when the device holds nothing more, the models
    and residuals of an image; with a scaling, the factor of the information; with halves of
    the counts, these and their snapshots.

    Parameters
    ----------
    scene : Scene
        The scene.
    scaling : Scaling or None
        That of its steps.
    of_device : int
        Bytes that the process holds for a device, which is its CPU.
    program : Program
        That of the scene.
    halves : bool
        Whether halves of the counts are run.
    """
    held, most = held_bytes()
    pixels = math.prod(scene.sky_grid)
    frame = pixels * np.dtype(np.float64).itemsize
    to_come = COMPILER[program.is_stored] + max(2 * frame, 6 * frame - of_device)
    if scene.rotations and scaling is None:  # else the host has made its model before
        to_come += (scene.n_images + 2) * frame
    if scaling is not None:
        to_come += 2 * scaling.star_information.band.nbytes
    found = max(held + to_come, most - of_device)
    if halves:
        found += 2 * (scene.observation.images.nbytes + SNAPSHOTS * pixels * program.dtype.itemsize)
    return found
