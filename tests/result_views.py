"""What the picture of a result shows, made up."""

import dataclasses

import numpy as np

from lnocl.plotting.result import ResultView


def make_view(p=2, n_stars=1, shape=(60, 70), **changes):
    chance = np.random.default_rng(3)
    models = np.full((p, *shape), 50.0)
    residuals = chance.normal(size=models.shape)
    stars = [(10.0 + 5 * s, 20.0) for s in range(n_stars)]
    iterations = np.arange(4.0)
    view = ResultView(
        extended=chance.random(shape),
        stars=stars,
        star_fluxes=np.arange(n_stars, 0.0, -1.0),
        n_iter=3,
        history={"iteration": iterations, "objective": 9.0 - iterations},
        held_out={},
        images=models + np.sqrt(models) * residuals,
        models=models,
        residuals=residuals,
        offsets=np.zeros((p, 2)),
    )
    return dataclasses.replace(view, **changes)
