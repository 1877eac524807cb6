"""An observation, its units, and the scene that is modelled on the grid of the transform."""
