"""The demo, the tuning of a device, simulations as files, and pictures of files."""
