"""OpenCL devices, programs, layouts, launches and transforms."""
