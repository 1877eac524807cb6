"""Light that a star may exchange with a host: against dense matrices, and for whom there is any."""

import numpy as np
import pytest

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers import exchange
from lnocl.core.solvers.exchange import DEVIATIONS, exchanged
from lnocl.core.solvers.near_star import NearStar, Surroundings

N, STAR, FLUX = 48, (23.3, 24.6), 3e4
Y, X = np.indices((N, N), float)
R = np.hypot(X - STAR[0], Y - STAR[1])
SIDE = X - STAR[0]


def light(values):
    return 2e4 * values / values.sum()


# What lies round the star, and whether that is a host, which is brightest under the star.
SKIES = {
    "host": (light(np.exp(-R / 3.0)), True),
    "lopsided host": (light(np.exp(-np.hypot(SIDE - 0.5, 1.6 * (Y - STAR[1])) / 3.0)), True),
    "alone": (np.full((N, N), 0.1), False),
    "ring": (light(np.exp(-((R - 7) ** 2) / 6) * (1 + 0.6 * SIDE / (R + 1))), False),
    "jet": (light(np.exp(-((SIDE - 8) ** 2) / 20 - (Y - STAR[1]) ** 2 / 4)), False),
}


def an_estimate(sky, error=0.03, depths=(1.0,)):
    """Return the true sky and star of images through lopsided PSFs that differ."""
    y, x = np.indices((21, 21)) - 10.0
    psfs = [(1 + (x**2 + 1.3 * y**2 + 0.3 * x * y) / w**2) ** -3.0 for w in (2.4, 3.0)]
    psfs = [psf * (1 + 0.2 * np.tanh(x / 2)) for psf in psfs][: len(depths)]
    known = {"background": 9.0, "psf_centre": "given", "psf_error": error}
    shape = len(depths), N, N
    flat = Scene(lnocl.Observation(np.full(shape, 9.0), psfs, **known, exposure=depths), [STAR])
    means = Model(flat).images(sky / flat.unit, np.array([FLUX]) / flat.unit) * flat.scale
    counts = np.random.default_rng(1).poisson(means)
    scene = Scene(lnocl.Observation(counts, psfs, **known, exposure=depths), [STAR])
    return Estimate(scene, sky, np.array([FLUX]))


def dense(near):
    """Return the variances of the flux with the extended source unknown and known, and its move."""
    columns = [[] for _ in near.images]
    for field in near.fields:
        for k in range(field.at.size):
            unit = np.zeros(field.at.size)
            unit[k] = 1.0
            for image, seen in zip(
                columns, field.forward(unit.reshape(field.at.shape)), strict=True
            ):
                image.append(np.ravel(seen))
    n, sizes = len(near.prior), [field.at.size for field in near.fields]
    total = n + sum(sizes)
    information, moments = np.zeros((total, total)), np.zeros(total)
    information[:n, :n], information[n:, n:] = near.prior, np.eye(sum(sizes))
    for image, of_fields in zip(near.images, columns, strict=True):
        rows = np.zeros((total, image.left.size))
        rows[image.unknowns], rows[n:] = image.slopes, of_fields
        information += (rows * image.precision.ravel()) @ rows.T
        moments += rows @ (image.precision * image.left).ravel()
    of_source = np.zeros(total, bool)
    of_source[n : n + sizes[0]] = True
    of_source[1:3] = True  # the level and the cusp
    known = np.ix_(~of_source, ~of_source)
    return (
        np.linalg.inv(information)[0, 0],
        np.linalg.inv(information[known])[0, 0],
        np.linalg.solve(information, moments)[0],
    )


def test_exchanged_light_matches_the_dense_matrix(monkeypatch):
    monkeypatch.setattr(exchange, "FINISHED", 1e-6)
    monkeypatch.setattr("lnocl.core.solvers.near_star.WINDOW", 4.0)
    estimate = an_estimate(SKIES["lopsided host"][0], depths=(1.0, 0.6))
    near = NearStar(Surroundings(estimate, False), 0, 1e-6)
    unknown, known, moved = dense(near)
    expected = DEVIATIONS * np.sqrt(unknown - known + moved**2) * estimate.scene.unit / FLUX
    assert exchanged(estimate, 0.0) == pytest.approx(expected, rel=1e-3)
    assert expected > 0.05


@pytest.mark.parametrize("name", SKIES)
def test_hosts_and_nothing_else_exchange_much(name):
    sky, is_host = SKIES[name]
    (share,) = exchanged(an_estimate(sky), 0.0)
    assert share > 0.1 if is_host else share < 0.02


def test_exchanged_light_is_zero_for_exact_psfs():
    assert exchanged(an_estimate(SKIES["host"][0], error=0.0), 0.0) == 0


def test_exchanged_light_below_the_minimum_is_not_computed(monkeypatch):
    monkeypatch.setattr(exchange, "NearStar", None)
    assert exchanged(an_estimate(SKIES["alone"][0]), 0.1) == 0
