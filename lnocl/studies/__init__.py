"""The demo, the benchmark of speed against accuracy, and pictures of files."""
