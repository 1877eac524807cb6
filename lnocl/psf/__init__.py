"""PSFs made from frames of stars, PSFs of several frames summed up, and checks of a PSF."""

from lnocl.psf.make import StarPsf, make_psf, make_psfs
from lnocl.psf.modes import PsfModes, find_modes
from lnocl.psf.report import PsfReport, examine

__all__ = ["PsfModes", "PsfReport", "StarPsf", "examine", "find_modes", "make_psf", "make_psfs"]
