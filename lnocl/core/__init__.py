"""From arrays to arrays: the model of a scene, its engines and solvers, and runs of these."""
