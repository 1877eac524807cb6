"""The NumPy twin of every kernel, in float64."""
