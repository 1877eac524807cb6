"""The iterations, and the fit of star fluxes and positions."""
