"""The OpenCL sources, carried as package data."""
