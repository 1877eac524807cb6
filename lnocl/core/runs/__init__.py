"""A solver at work: iterations, stopping rules, held-out counts, checkpoints, progress."""
