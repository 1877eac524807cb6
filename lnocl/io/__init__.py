"""FITS files, headers, maps, sky coordinates and atomic output."""
