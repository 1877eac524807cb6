"""PSFs made from the frame of a star."""

from lnocl.psf.make import StarPsf, make_psf, make_psfs

__all__ = ["StarPsf", "make_psf", "make_psfs"]
