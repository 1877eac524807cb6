"""Sums over the pixels that stars light, against arrays of stars x pixels; and the work done."""

import tracemalloc

import numpy as np
import pytest
from astropy import units as u
from scenes import make_psfs, make_smooth_psfs, paper, worst

import lnocl
from lnocl.runs.run import Run
from lnocl.runs.start import Setup, make_start
from lnocl.scene import shifting
from lnocl.scene.penalty import Penalty
from lnocl.scene.scene import Scene
from lnocl.scene.shifting import Stamp
from lnocl.scene.stars import StarImages, check_positions, overlap

# One is alone, two are neighbours, one wraps round two edges; or all of the grid is lit.
FIELDS = {
    "apart and over the edges": ((64, 128), [(100.0, 40.0), (20.3, 30.2), (23.0, 28.0), (0.4, 63)]),
    "one, over the edges": ((64, 64), [(63.0, 1.0)]),
    "PSFs as large as the grid": ((8, 16), [(3.25, 4.0), (11.0, 7.5)]),
}
every_field = pytest.mark.parametrize("name", FIELDS)


def scene_of(name):
    shape, stars = FIELDS[name]
    psfs = make_smooth_psfs(2, (7, 8))
    observation = lnocl.Observation(np.ones((2, *shape)), psfs, offsets=[(0, 0), (1.3, -2.0)])
    return Scene(observation, stars, pad=0)


pytestmark = pytest.mark.filterwarnings(
    "ignore:the images are shifted by up to", "ignore:psf . is sharper than its pixels"
)


@every_field
@pytest.mark.parametrize("j", [0, 1])
def test_sums_are_those_over_all_pixels(name, j):
    scene = scene_of(name)
    field, rng = scene.star_field, np.random.default_rng(0)
    dense = np.array([scene.star_image(j, s).ravel() for s in range(scene.n_stars)])
    lit, x = field.lit(j), rng.normal(size=scene.grid)
    fluxes, weights = rng.random(scene.n_stars), rng.random(scene.grid)
    images = field.images(j, lit)
    assert not dense[:, ~lit.ravel()].any()
    assert worst(images.light(fluxes), (fluxes @ dense)[lit.ravel()]) <= 5e-16
    assert worst(field.light(j, fluxes).ravel(), fluxes @ dense) <= 5e-16
    assert worst(images.products(x[lit]), [dense @ x.ravel()]) <= 2e-15
    expected = (dense * weights.ravel()) @ dense.T
    assert worst(images.information(weights[lit]), expected) <= 1e-15


def test_sums_over_images_of_several_pieces_and_derivatives():
    size, k, rng = 50, 3, np.random.default_rng(1)
    dense, pieces = np.zeros((k, 4, size)), []
    for s in range(4):
        pieces.append([])
        for n in (7, 12):
            pixels, values = rng.permutation(size)[:n], rng.normal(size=(k, n))
            pieces[s].append((pixels, values))
            dense[:, s, pixels] += values
    images = StarImages(size, pieces, np.ones((4, 4), bool))
    x, columns = rng.random(size), dense.reshape(-1, size)
    assert worst(images.light(x[:4]), x[:4] @ dense[0]) <= 1e-15
    assert worst(images.products(x).ravel(), columns @ x) <= 1e-15
    assert worst(images.information(x), (columns * x) @ columns.T) <= 1e-15


def test_stamps_overlap_where_they_share_pixels():
    grid, rng = (12, 16), np.random.default_rng(2)
    stamps = [
        Stamp(np.ones(rng.integers(1, 7, 2)), *rng.integers(-20, 20, 2).tolist()) for _ in range(30)
    ]
    dense = np.array([stamp.on_grid(grid).ravel() for stamp in stamps])
    np.testing.assert_array_equal(overlap(stamps, grid), dense @ dense.T > 0)
    assert 0.1 < overlap(stamps, grid).mean() < 0.9


def test_each_psf_is_transformed_once_and_each_star_placed_once(monkeypatch):
    """Before, every sum over a star's pixels placed it anew."""
    made, placed = [], []

    class Counted(shifting._Spectrum):
        def __init__(self, *given):
            made.append(given)
            super().__init__(*given)

        def moved(self, *given):
            placed.append(given)
            return super().moved(*given)

    monkeypatch.setattr(shifting, "_Spectrum", Counted)
    observation = lnocl.Observation(np.full((2, 32, 32), 9.0), make_psfs(2, (32, 32)))
    stars = [(4.3, 5.2), (20.1, 9.0), (6.0, 30.7)]
    paper(observation, stars, solver="sgp", smoothing=1e-3, n_iter=2, engine="numpy")
    assert len(made) == 2
    assert len(placed) == 2 * 3 + 2  # and each PSF once to see whether it rings


class NoEngine:
    scaling = None

    def start(self, *_):
        pass


@pytest.mark.exhaustive
@pytest.mark.parametrize("refines", [False, True])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_memory_does_not_grow_as_stars_times_pixels(refines, solver, monkeypatch):
    """That of all before the first iteration but the engine. Measured 0.13 to 0.62, once 2 to 4."""
    monkeypatch.setattr("lnocl.runs.run._make_engine", lambda *_: NoEngine())
    rng, size, n = np.random.default_rng(3), 256, 100
    stars = rng.uniform(20, size - 20, (n, 2))
    observation = lnocl.Observation(rng.poisson(20.0, (size, size)), make_smooth_psfs(1, (15, 15)))
    setup = Setup(stars, 0, solver, "double", "numpy", None, refine_positions=refines)
    tracemalloc.start()
    try:
        Run(make_start(setup, observation, Penalty(smoothing=1e-3)), 3)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 0.75 * 8 * n * size**2


APART = lnocl.Observation(np.ones((32, 32)), make_psfs(1, (3, 3)))


@pytest.mark.parametrize(
    ("stars", "numbers"),
    [
        ([(5, 7), (5, 7)], "1 and 2"),
        ([(5, 7), (9, 3), (5.0004, 6.9996)], "1 and 3"),
        ([(9, 3), (5, 20), (5, 7), (5, 9), (5, 7.0009)], "3 and 5"),
    ],
)
def test_two_stars_at_one_position_are_refused(stars, numbers):
    with pytest.raises(lnocl.InputError) as caught:
        check_positions(stars, APART)
    assert str(caught.value) == (
        f"stars {numbers} are at one position, (5, 7), where their fluxes cannot be told apart; "
        "leave one of them out"
    )


def test_stars_a_little_apart_are_not_refused():
    stars = [(5, 7), (5.002, 7), (5, 7.002), (4.998, 6.998), (20, 7)]
    np.testing.assert_array_equal(check_positions(stars, APART), stars)


@pytest.mark.parametrize("kind", ["array", "list", "pairs"])
def test_stars_may_be_in_pixels_and_in_no_other_unit(kind):
    def give(unit):
        stars = np.array([(5.5, 7.0), (9.0, 3.0)])
        if kind == "pairs":
            return [(x * unit, y * unit) for x, y in stars]
        return stars * unit if kind == "array" else [star * unit for star in stars]

    for unit in (u.pix, u.dimensionless_unscaled):
        np.testing.assert_array_equal(check_positions(give(unit), APART), [(5.5, 7), (9, 3)])
    for unit in (u.arcsec, u.deg, u.km):
        with pytest.raises(lnocl.InputError, match=f"^stars must be in pixels, not in {unit}; "):
            check_positions(give(unit), APART)
