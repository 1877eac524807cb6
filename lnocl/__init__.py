"""Multi-component Richardson-Lucy deconvolution of astronomical images on OpenCL."""

from importlib.metadata import version

from lnocl.deconvolution import deconvolve
from lnocl.errors import DeviceError, FileError, InputError, LnoclError, LnoclWarning
from lnocl.result import Result
from lnocl.scene.observation import Observation

__all__ = [
    "DeviceError",
    "FileError",
    "InputError",
    "LnoclError",
    "LnoclWarning",
    "Observation",
    "Result",
    "deconvolve",
]
__version__ = version("lnocl")
