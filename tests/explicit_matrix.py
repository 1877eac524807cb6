"""A scene's problem as an explicit matrix, and its minimum by L-BFGS-B.

`Problem` shares nothing with the package: its matrix is filled by a loop over the PSF's pixels, its
stars are columns of it, and nothing is scaled.
"""

import numpy as np
from scipy.optimize import minimize
from scipy.special import kl_div

from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene


class Problem:
    """J of a periodic scene and its gradient; unknowns x, the extended source and then the stars'.

    Electrons throughout.
    """

    def __init__(
        self,
        images,
        psfs,
        background=0.0,
        mask=None,
        stars=(),
        mu=0.0,
        exposure=None,
        smoothing=0.0,
        edge=1.0,
    ):
        p, ny, nx = images.shape
        y, x = np.indices((ny, nx))
        matrix = np.zeros((p, ny, nx, ny, nx))
        for (j, ky, kx), value in np.ndenumerate(psfs / psfs.sum(axis=(1, 2), keepdims=True)):
            to = (y + ky - psfs.shape[1] // 2) % ny, (x + kx - psfs.shape[2] // 2) % nx
            matrix[(j, *to, y, x)] += value
        if exposure is not None:
            matrix *= exposure[:, :, :, None, None]
        matrix = matrix.reshape(images.size, ny * nx)
        self.n_pixels = ny * nx
        self.matrix = np.hstack([matrix, matrix[:, [sy * nx + sx for sx, sy in stars]]])
        level = np.asarray(background, float)
        level = level[:, None, None] if level.ndim == 1 else level
        self.background = np.broadcast_to(level, images.shape).ravel()
        self.images = images.ravel()
        self.weights = np.ones(images.size) if mask is None else (~mask).ravel().astype(float)
        if exposure is not None:
            self.weights *= exposure.ravel() > 0
        self.mu = np.repeat([mu, 0.0], [ny * nx, len(stars)])
        self.smoothing, self.edge = smoothing, edge
        at = y * nx + x
        pairs = [at.ravel(), at.ravel()], [np.roll(at, -1, axis).ravel() for axis in (0, 1)]
        first, second = (np.concatenate(indices) for indices in pairs)
        self.differences = np.zeros((2 * ny * nx, ny * nx + len(stars)))
        np.add.at(self.differences, (np.arange(len(first)), first), 1.0)
        np.add.at(self.differences, (np.arange(len(second)), second), -1.0)

    def model(self, x):
        return self.matrix @ x + self.background

    def objective(self, x):
        data_term = self.weights @ kl_div(self.images, np.maximum(self.model(x), 0.0))
        roughness = np.sum(np.hypot(self.differences @ x, self.edge) - self.edge)
        return data_term + 0.5 * self.mu @ x**2 + self.smoothing * roughness

    def ratio(self, x):
        """Return the images over x; 0 where nothing was counted, whatever is expected there."""
        return np.divide(self.images, x, out=np.zeros(len(x)), where=self.images > 0)

    def gradient(self, x):
        steps = self.differences @ x
        roughness = self.differences.T @ (steps / np.hypot(steps, self.edge))
        data_term = self.matrix.T @ (self.weights * (1 - self.ratio(self.model(x))))
        return data_term + self.mu * x + self.smoothing * roughness

    def errors(self, x):
        """Return the standard errors of each unknown by itself, from the second derivatives.

        That of a star where nothing was counted is infinite.
        """
        curvature = self.weights * self.ratio(self.model(x) ** 2)
        bends = self.edge**2 / np.hypot(self.differences @ x, self.edge) ** 3
        roughness = (self.differences**2).T @ bends
        with np.errstate(divide="ignore"):
            return ((self.matrix**2).T @ curvature + self.mu + self.smoothing * roughness) ** -0.5

    def off_the_minimum(self, x):
        """Return how far the projected gradient moves an unknown at most, in standard errors."""
        errors = self.errors(x)
        return np.max(np.abs(x - np.maximum(x - errors**2 * self.gradient(x), 0.0)) / errors)

    def minimum(self):
        """Return the minimum by L-BFGS-B in units of the standard errors, begun anew twice."""
        x = np.repeat([self.images.mean(), 1e3], [self.n_pixels, len(self.mu) - self.n_pixels])
        for _ in range(3):
            errors = self.errors(x)
            found = minimize(
                lambda z, errors=errors: self.objective(z * errors),
                x / errors,
                jac=lambda z, errors=errors: self.gradient(z * errors) * errors,
                method="L-BFGS-B",
                bounds=[(0.0, None)] * len(x),
                options={"maxiter": 5000, "maxfun": 5000, "ftol": 0.0, "gtol": 1e-10},
            )
            x = found.x * errors
        return x

    def split(self, x):
        return x[: self.n_pixels], x[self.n_pixels :]


def problem_of(made, stars=None):
    stars = made.stars if stars is None else stars
    recipe = made.recipe
    scene = Scene(made.observation(), stars, Penalty(recipe.mu, recipe.smoothing))
    return Problem(
        made.images,
        made.psfs,
        made.background,
        made.mask,
        stars,
        recipe.mu * made.mean_exposure**2,
        made.exposure,
        recipe.smoothing * made.mean_exposure,
        scene.edge * scene.unit or 1.0,
    )


def unknowns(estimate):
    return np.concatenate([estimate.extended.ravel(), estimate.star_fluxes])


def relative_error(values, expected):
    return np.linalg.norm(values - expected) / np.linalg.norm(expected)
