"""PSFs made from frames of stars, and looked at."""

from lnocl.psf.make import StarPsf, make_psf, make_psfs
from lnocl.psf.report import PsfReport, examine

__all__ = ["PsfReport", "StarPsf", "examine", "make_psf", "make_psfs"]
