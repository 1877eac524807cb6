"""The verbs of an iteration on NumPy and on OpenCL."""
