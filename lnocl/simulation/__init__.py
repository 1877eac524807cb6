"""Simulated telescopes, targets and images."""
