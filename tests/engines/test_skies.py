"""Several skies, known shares of which each image shows: twins by sums, kernels by twins."""

import numpy as np
import pytest
import turned_scenes
from scenes import Recipe, worst

from lnocl.core import reference
from lnocl.core.engines.numpy import ReferenceEngine
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.scaling import prepare

pytestmark = pytest.mark.filterwarnings(
    "ignore:psf . is undersampled", "ignore:the star at .* lies on bad pixels"
)

TWO = {"line": [1.0, 0.4, 0.0], "continuum": [1.0, 1.0, 1.0]}
THREE = {"a": [1.0, 0.3, 0.0], "b": [1.0, 1.0, 0.0], "c": [0.0, 0.2, 0.5]}
SMOOTH = Penalty(1e-3, smoothing=1e-2, shares=(1.0, 0.5), spectral=5e-3)
# The grid of tests/kernel_cases.py whose program is built anyway.
STARS = Recipe((48, 80), 3, 2, masked=0.05, background="map")


def shares(n, ny, nx):
    """Return transmissions of n images."""
    return np.random.default_rng(3).uniform(0.3, 1.0, (n, ny, nx))


def scene_of(recipe=STARS, components=TWO, penalty=SMOOTH, **changes):
    """Return a scene of several skies."""
    made = recipe.make()
    return Scene(made.observation(components=components, **changes), made.stars, penalty)


def turned(transmission=None, **changes):
    """Return a scene of two skies whose images are turned."""
    if transmission:
        changes["transmission"] = shares(3, turned_scenes.NY, turned_scenes.NX)
    given = turned_scenes.observation(components=TWO, **changes)
    return Scene(given, turned_scenes.STARS, Penalty(smoothing=1e-2))


def start(scene, solver):
    """Return a start that is nowhere flat, other in each sky, and the scaling of steps."""
    extended, fluxes = scene.start(None, None)
    extended = extended * np.random.default_rng(1).uniform(0.5, 1.5, scene.sky_grid)
    if solver == "sgm":
        return extended, fluxes, None
    fluxes, scaling = prepare(scene, Model(scene), extended, fluxes)
    return extended, fluxes, scaling


def engines(scene, solver, precision="double", n_iter=12):
    """Return both engines, the twins' last, that have begun."""
    extended, fluxes, scaling = start(scene, solver)
    made = (
        OpenCLEngine(scene, precision, None, n_iter, None, scaling),
        ReferenceEngine(scene, scaling),
    )
    for each in made:
        each.start(extended, fluxes)
    return made


def go_on(engine, n_iter):
    engine.go_on(n_iter + 1, 0.0)
    engine.finish()


def assert_same(found, expected, allowed, of_objectives):
    """Assert that estimates agree: by three times what was measured on PoCL."""
    assert found.extended().shape == found.scene.sky_grid
    assert worst(found.extended(), expected.extended()) <= allowed
    assert worst(found.star_fluxes(), expected.star_fluxes()) <= allowed
    np.testing.assert_allclose(found.objectives(), expected.objectives(), rtol=of_objectives)


CASES = {
    "sgp": (scene_of, "sgp"),
    "sgm": (scene_of, "sgm"),
    "three skies": (lambda: scene_of(components=THREE, penalty=Penalty()), "sgp"),
    "no mask, no stars": (lambda: scene_of(Recipe((48, 80), 3), penalty=Penalty()), "sgp"),
    "transmission, sgp": (lambda: scene_of(transmission=shares(3, 48, 80)), "sgp"),
    "transmission, sgm": (lambda: scene_of(transmission=shares(3, 48, 80)), "sgm"),
    "sky twice as fine": (lambda: scene_of(STARS, oversample=2), "sgp"),
    "exposure map": (lambda: scene_of(Recipe((48, 80), 3, 1, exposure="map")), "sgp"),
    "turned, sgp": (turned, "sgp"),
    "turned, sgm": (turned, "sgm"),
    "turned, larger pixels": (lambda: turned(transforms=turned_scenes.scaled()), "sgp"),
    "turned, transmission": (lambda: turned(transmission=True), "sgp"),
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("case", CASES)
def test_kernels_iterate_as_their_twins(case):
    make, solver = CASES[case]
    found, expected = engines(make(), solver)
    for each in (found, expected):
        go_on(each, 12)
    assert_same(found, expected, 3.5e-13, 5e-14)


@pytest.mark.parametrize("solver", ["sgp", "sgm"])
def test_single_precision(solver):
    found, expected = engines(scene_of(), solver, "single")
    for each in (found, expected):
        go_on(each, 6)
    assert_same(found, expected, 8e-7, 2e-6)


@pytest.mark.parametrize("engine", [0, 1], ids=["opencl", "numpy"])
def test_a_run_goes_on_from_its_state_bit_for_bit(engine):
    whole, part, other = (engines(scene_of(), "sgp", "single")[engine] for _ in range(3))
    go_on(whole, 12)
    go_on(part, 5)
    other.restore(part.state())
    go_on(other, 12)
    np.testing.assert_array_equal(other.extended(), whole.extended())
    np.testing.assert_array_equal(other.star_fluxes(), whole.star_fluxes())
    np.testing.assert_array_equal(other.objectives(), whole.objectives())


def test_members_of_a_batch_are_as_alone():
    scene = scene_of()
    extended, fluxes, scaling = start(scene, "sgp")
    first = OpenCLEngine(scene, "single", None, 6, None, scaling, n_members=2, n_in_all=2)
    both = first, first.member(1, scene)
    for each, bright in zip(both, (1.0, 1.5), strict=True):
        each.start(bright * extended, fluxes)
    for each in both:
        each.go_on(7, 0.0)
    first.finish()
    for each, bright in zip(both, (1.0, 1.5), strict=True):
        alone = OpenCLEngine(scene, "single", None, 6, None, scaling)
        alone.start(bright * extended, fluxes)
        go_on(alone, 6)
        np.testing.assert_array_equal(each.extended(), alone.extended())
        np.testing.assert_array_equal(each.star_fluxes(), alone.star_fluxes())


rng = np.random.default_rng(5)
NY, NX = 12, 16
MIXES = np.array([[1.0, 0.0, 0.7], [0.3, 1.0, 0.0]])
SKIES = rng.uniform(size=(3, NY, NX))
PSFS = rng.uniform(size=(2, NY, NX))
OTFS = reference.otf_columns(reference.rfft_rows(PSFS))


def forward(skies):
    """Return what images see of skies, by the twins; they leave a factor 2 of each rfft_rows."""
    rows = reference.convolve_columns(reference.rfft_rows(skies), OTFS, mixes=MIXES)
    return reference.irfft_rows(rows)


def adjoint(images):
    """Return its adjoint."""
    rows = reference.correlate_columns(reference.rfft_rows(images), OTFS, mixes=MIXES)
    return reference.irfft_rows(rows)


def test_twins_mix_as_an_explicit_sum():
    expected = np.zeros((2, NY, NX))
    for j, psf in enumerate(PSFS):
        for w, sky in zip(MIXES[j], SKIES, strict=True):
            for (y, x), value in np.ndenumerate(psf):
                expected[j] += w * value * np.roll(sky, (y, x), (0, 1))
    assert worst(forward(SKIES), expected) <= 1e-14


def test_the_adjoint_of_the_mixed_map_is_its_transpose():
    images = rng.uniform(-1.0, 1.0, (2, NY, NX))
    found, expected = np.vdot(SKIES, adjoint(images)), np.vdot(forward(SKIES), images)
    assert found == pytest.approx(expected, rel=1e-12)


def test_transmitted_skies_have_their_adjoint():
    """<t_j sum_k w_jk f_k, x_j> = <f_k, sum_j w_jk t_j x_j>, the transforms' factors apart."""
    shown, images = rng.uniform(size=(2, NY, NX)), rng.uniform(-1.0, 1.0, (2, NY, NX))
    seen = reference.irfft_rows(reference.transmit_rows(SKIES, shown, MIXES)) / (2 * NX)
    given = reference.rfft_rows(images) / (2 * NX)
    back = reference.irfft_rows(reference.gather_rows(given, shown, MIXES))
    for j, each in enumerate(seen):
        np.testing.assert_allclose(each, shown[j] * np.tensordot(MIXES[j], SKIES, 1), rtol=1e-12)
    assert np.vdot(SKIES, back) == pytest.approx(np.vdot(seen, images), rel=1e-12)


def test_the_slope_between_skies_is_that_of_its_value():
    edge = np.array([0.2, 0.3, 0.5]).reshape(3, 1, 1)
    smoothing = np.array([0.0, 0.4, 0.1]).reshape(3, 1, 1)
    slope, curvature, value = reference.smooth(SKIES, smoothing, edge, 0.6)
    change = rng.uniform(-1e-6, 1e-6, SKIES.shape)
    above, below = (
        reference.smooth(SKIES + sign * change, smoothing, edge, 0.6)[2] for sign in (1, -1)
    )
    assert np.vdot(slope, change) == pytest.approx((above - below) / 2, rel=1e-6)
    # And what two skies have between them, by hand.
    alone = sum(
        reference.smooth(sky, w, d)[2]
        for sky, w, d in zip(SKIES, smoothing.flat, edge.flat, strict=True)
    )
    steps, between = SKIES[:-1] - SKIES[1:], np.array([0.25, 0.4]).reshape(2, 1, 1)
    across = 0.6 * (np.sqrt(steps**2 + between**2) - between).sum()
    assert value == pytest.approx(alone + across, rel=1e-12)
    assert (curvature > 0).all()
