"""The files of the images of one observation, and what lies beside the images in them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from lnocl.core.scene.arrays import Array
from lnocl.core.scene.transforms import enlarged
from lnocl.errors import InputError
from lnocl.io.calibration import EACH, Calibration
from lnocl.io.fitsread import read_extension, read_keyword, read_stack
from lnocl.io.maps import Maps
from lnocl.io.noise import NoiseMap, read_noise_map


class ImageFiles:
    """The images of an observation, their headers and extensions.

    Parameters
    ----------
    paths : sequence of str
        Their files, as for `fitsread.read_stack`.
    calibration : Calibration
        Their calibration.

    Attributes
    ----------
    stack : Stack
        The images.
    maps : Maps
        Reads maps that fit them.
    """

    def __init__(self, paths: Sequence[str], calibration: Calibration) -> None:
        self.paths, self.calibration = paths, calibration
        of_one_sky = EACH not in calibration.components
        self.stack = read_stack(paths, calibration.align is not None, of_one_sky)
        self.maps = Maps(self.stack.data.shape, self.stack.shapes)
        self.maps.sha256["images"] = self.stack.sha256

    def bunit(self, j: int) -> str:
        """Return the unit of image j, as its header has it; "" without one."""
        return str(read_keyword(*self.stack.file_of(j), "BUNIT") or "")

    @cached_property
    def noise(self) -> NoiseMap | None:
        """The noise map that was given."""
        given = self.calibration
        if given.noise and any(given.read_noise):
            raise InputError("give `read_noise`, or give `noise`, which includes it, not both")
        return read_noise_map(given.noise, self.maps, lambda: self.extensions("ERR", "noise"))

    def extensions(self, name: str, instead: str) -> Array:
        """Return the extensions of this name beside the images, shape (p, ny, nx)."""
        images, shapes = self.stack.data, self.stack.shapes
        found = []
        for path, shape in zip(self.paths, shapes, strict=False):
            values = read_extension(path, name)
            if values is None:
                raise InputError(
                    f"{path} has no extension {name}; give `{instead}` as a file, or leave it out"
                )
            # A file holds one image, or a cube of all images.
            of_cube = images.shape if len(self.paths) == 1 else shape
            if values.shape not in (shape, of_cube):
                raise InputError(
                    f"the extension {name} of {path} has the shape {values.shape}, its image "
                    f"{of_cube}; give `{instead}` as a file"
                )
            found.append(enlarged(values, images.shape[1:]))
        return np.broadcast_to(np.array(found).reshape(-1, *images.shape[1:]), images.shape)
