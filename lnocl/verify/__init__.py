"""Every kernel against its NumPy twin, on any device."""
