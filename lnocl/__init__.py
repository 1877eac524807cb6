"""Multi-component Richardson-Lucy deconvolution of astronomical images on OpenCL.

Describe the images with `Observation`, reconstruct the sky with `deconvolve`, and read its
`Result`; errors are `LnoclError`, warnings `LnoclWarning`:

    observation = lnocl.Observation(images, psfs, background=559.0, read_noise=10.0)
    result = lnocl.deconvolve(observation, stars=[(512, 256)])

The command ``lnocl --help`` does the same for FITS files, and more.
"""

from lnocl import loading

loading.begin()  # before what takes its time
# ruff: noqa: E402
from importlib.metadata import version

from lnocl.core.runs.plan import Plan, plan
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.psf_field import PsfField
from lnocl.core.scene.transforms import rotations
from lnocl.deconvolution import deconvolve
from lnocl.errors import DeviceError as DeviceError
from lnocl.errors import FileError as FileError
from lnocl.errors import InputError as InputError
from lnocl.errors import LnoclError, LnoclWarning
from lnocl.result import Result
from lnocl.tiles import deconvolve_tiles

__all__ = [
    "LnoclError",
    "LnoclWarning",
    "Observation",
    "Plan",
    "PsfField",
    "Result",
    "deconvolve",
    "deconvolve_tiles",
    "plan",
    "rotations",
]
__version__ = version("lnocl")
