"""Skies finer than the images: both engines against an explicit matrix, and what must hold.

The matrix is filled by a loop over the PSF's pixels and over the pixels of the sky that a pixel of
an image sees; stars are columns of it, in the middle of pixels of the sky.
"""

import numpy as np
import pytest
from scenes import FEWER_ENGINES, paper, same, worst

import lnocl

N = 16
MU = 1e-3
# About three times what was measured after 30 iterations, extended source and star fluxes.
TOLERANCES = {"double": (1.5e-14, 4e-15), "single": (4e-6, 6e-7)}


class Made:
    """Two images of a sky that is q times as fine, with a star, a mask and a background map."""

    def __init__(self, q):
        rng = np.random.default_rng(q)
        self.q, n = q, q * N
        y, x = np.indices((n, n))
        self.sky = 60.0 / q**2 * np.exp(-0.5 * ((y - 0.4 * n - 0.1 * x) / (0.1 * n)) ** 2)
        k = 2 * q + 3
        v, u = np.indices((k, k)) - k // 2
        cores = [np.exp(-0.5 * (((u + s * v) / q) ** 2 + (v / (0.8 * q)) ** 2)) for s in (0.4, -1)]
        self.psfs = np.array(cores)
        self.star = 6 * q + q // 2, 9 * q + q - 1  # on the sky
        self.stars = [tuple((at - (q - 1) / 2) / q for at in self.star)]
        self.background = 3.0 + 0.2 * np.indices((N, N))[1]
        self.mask = rng.random((2, N, N)) < 0.05
        self.matrix = self._make_matrix()
        light = self.matrix @ np.append(self.sky.ravel(), 2000.0)
        means = light.reshape(2, N, N) + self.background
        self.images = rng.poisson(means).astype(float)
        self.start = rng.uniform(0.5, 1.5, (n, n)) * self.sky.mean()

    def _make_matrix(self):
        q, n = self.q, self.q * N
        matrix = np.zeros((2, N, N, n, n))
        y, x = np.indices((n, n))
        psfs = self.psfs / self.psfs.sum(axis=(1, 2), keepdims=True)
        for (j, ky, kx), value in np.ndenumerate(psfs):
            to = [(at + k - size // 2) % n // q
                  for at, k, size in zip((y, x), (ky, kx), psfs.shape[1:], strict=True)]  # fmt: skip
            np.add.at(matrix[j], (*to, y, x), value)
        matrix = matrix.reshape(2 * N * N, n * n)
        return np.hstack([matrix, matrix[:, [self.star[1] * n + self.star[0]]]])

    def observation(self, **changes):
        given = {
            "images": self.images,
            "psfs": self.psfs,
            "background": self.background,
            "mask": self.mask,
            "oversample": self.q,
        }
        return lnocl.Observation(**(given | changes))

    def deconvolve(self, observation=None, **changes):
        start = {"initial_extended": self.start, "initial_star_fluxes": [1500.0]}
        given = {"stars": self.stars, "mu": MU, **start}
        return paper(observation or self.observation(), **(given | changes))


MADE = {q: Made(q) for q in (2, 4)}

# The PSFs are cut off, so that what is moved between pixels rings a little.
pytestmark = pytest.mark.filterwarnings("ignore:psf . is sharper than its pixels")


def split_gradient(made, n_iter):
    """Return extended source and star flux of the paper's iteration on the matrix."""
    weights, images = (~made.mask).ravel().astype(float), made.images.ravel()
    background = np.concatenate([made.background.ravel()] * 2)
    x, total = np.append(made.start.ravel(), 1500.0), made.matrix.T @ weights
    observed = total >= 0.01 * total[:-1].max()
    x *= observed
    mu = np.append(np.full(made.start.size, MU), 0.0)
    for _ in range(n_iter):
        ratio = weights * images / (made.matrix @ x + background)
        x = np.where(observed, x * (made.matrix.T @ ratio) / (total + mu * x), 0.0)
    return x[:-1].reshape(made.start.shape), x[-1:]


@pytest.mark.parametrize("q", [2, pytest.param(4, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_iterations_are_those_of_the_matrix(engine, q):
    made = MADE[q]
    result = made.deconvolve(n_iter=30, **engine)
    extended, fluxes = split_gradient(made, 30)
    assert result.extended.shape == (q * N, q * N)
    errors = worst(result.extended, extended), worst(result.star_fluxes, fluxes)
    assert np.all(errors <= np.array(TOLERANCES[engine["precision"]])), errors


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_steps_lower_the_objective_to_one_minimum(engine):
    """Both methods end where the gradient in every pixel of the sky is 0 or holds it at 0."""
    made = MADE[2]
    result = made.deconvolve(n_iter=300, solver="sgp", **engine)
    assert (np.diff(result.history["objective"]) <= 1e-5).all()
    x = np.append(result.extended.ravel(), result.star_fluxes)
    background = np.concatenate([made.background.ravel()] * 2)
    weights = (~made.mask).ravel()
    ratio = np.where(weights, made.images.ravel() / (made.matrix @ x + background) - 1.0, 0.0)
    gradient = np.append(MU * result.extended, 0.0) - made.matrix.T @ ratio
    assert abs(gradient @ x) / x.sum() < 2e-4
    assert gradient.min() > -0.02


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_power_of_two_scales_bit_for_bit(engine):
    made = MADE[2]
    for solver in ("sgm", "sgp"):
        result = made.deconvolve(n_iter=20, solver=solver, **engine)
        scaled = made.deconvolve(
            made.observation(images=4.0 * made.images, background=4.0 * made.background),
            n_iter=20,
            solver=solver,
            mu=MU / 4.0,
            initial_extended=4.0 * made.start,
            initial_star_fluxes=[6000.0],
            **engine,
        )
        np.testing.assert_array_equal(scaled.extended, 4.0 * result.extended)
        np.testing.assert_array_equal(scaled.star_fluxes, 4.0 * result.star_fluxes)


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_a_run_resumes_bit_for_bit(engine, tmp_path):
    made, path = MADE[2], tmp_path / "run.fits"
    given = {"n_iter": 12, "solver": "sgp", "refine_positions": True, **engine}
    whole = made.deconvolve(**given)
    made.deconvolve(**given, checkpoint=path, callback=lambda iteration, _: iteration == 5)
    same(made.deconvolve(**given, resume=path), whole)
    other = made.observation(effective_psfs=True)
    with pytest.raises(lnocl.InputError, match="effective_psfs"):
        made.deconvolve(other, **given, resume=path)


def test_held_out_counts_choose_and_errors_are_there():
    made = MADE[2]
    given = {"engine": "numpy", "n_iter": 60, "pad": 0}
    result = lnocl.deconvolve(made.observation(), made.stars, **given)
    assert result.stop_reason == "held-out"
    assert result.extended.shape == made.sky.shape
    assert result.star_fluxes[0] == pytest.approx(2000.0, abs=4 * result.star_flux_errors[0])
    assert 0.8 < result.fit().rms < 1.2
    light = made.matrix @ np.append(result.extended.ravel(), result.star_fluxes)
    expected = np.where(made.mask, 0.0, light.reshape(2, N, N) + made.background)
    models = np.where(made.mask, 0.0, result.models())
    np.testing.assert_allclose(models, expected, rtol=1e-11)
