"""The demo, the benchmark of speed against accuracy, the self-test, and pictures of files."""
