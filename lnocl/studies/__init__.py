"""The paper's experiment, the demo, and benchmarks of speed against accuracy."""
