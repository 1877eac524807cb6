"""Sums over the pixels that stars light, against arrays of stars x pixels; and the work done."""

import tracemalloc

import numpy as np
import pytest
from astropy import units as u
from scenes import make_psfs, make_smooth_psfs, paper, worst

import lnocl
from lnocl.core.runs.run import Run
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene import shifting
from lnocl.core.scene import stars as star_images
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.shifting import Cutout
from lnocl.core.scene.stars import Order, StarImages, check_positions, order_of
from lnocl.core.scene.view import View, Window

# One is alone, two are neighbours, one wraps round two edges; or all of the grid is covered.
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
    "ignore:the images are shifted by up to", "ignore:psf . is undersampled"
)


@every_field
@pytest.mark.parametrize("j", [0, 1])
def test_sums_are_those_over_all_pixels(name, j):
    scene = scene_of(name)
    field, rng = scene.star_field, np.random.default_rng(0)
    dense = np.array([scene.star_image(j, s).ravel() for s in range(scene.n_stars)])
    covered, x = field.covered(j), rng.normal(size=scene.grid)
    fluxes, weights = rng.random(scene.n_stars), rng.random(scene.grid)
    images = field.images(j, covered)
    assert not dense[:, ~covered.ravel()].any()
    assert worst(images.light(fluxes), (fluxes @ dense)[covered.ravel()]) <= 5e-16
    assert worst(field.light(j, fluxes).ravel(), fluxes @ dense) <= 5e-16
    assert worst(images.products(x[covered]), [dense @ x.ravel()]) <= 2e-15
    cores = np.array([core.on_grid(scene.grid).ravel() for core in field.cores[j]])
    expected = (cores * weights.ravel()) @ cores.T
    assert worst(images.information(weights[covered]).block(slice(None)), expected) <= 1e-15


@pytest.mark.parametrize("flux", [1e3, 1e7])
@pytest.mark.parametrize("wings", ["Gaussian", "Moffat"])
def test_faint_pixels_hardly_inform(wings, flux):
    y, x = np.indices((81, 81)) - 40
    square = (x**2 + y**2) / 2.25
    psf = 0.5**square if wings == "Gaussian" else (1 + (2**0.4 - 1) * square) ** -2.5
    stars = [(60.3, 50.2), (66.9, 57.4), (9.0, 100.6)]
    scene = Scene(lnocl.Observation(np.full((128, 128), 50.0), psf), stars)
    whole = np.array([scene.star_image(0, s).ravel() for s in range(3)])
    covered = scene.star_field.covered(0)
    assert scene.star_field.cores[0][0].values.size < (900 if wings == "Gaussian" else 113**2)
    weights = 1.0 / (50.0 + (flux * whole.sum(axis=0)).clip(0))
    found = (
        scene.star_field.images(0, covered)
        .information(weights.reshape(covered.shape)[covered])
        .block(slice(None))
    )
    expected = (whole * weights) @ whole.T
    assert worst(found, expected) <= 3e-7  # measured 1.6e-7 at most


@pytest.mark.parametrize("tile", [4, 32])
def test_sums_over_images_of_several_pieces_and_derivatives(tile, monkeypatch):
    """The second piece is of the image alone; pieces wrap round the edges of the grid."""
    monkeypatch.setattr(star_images, "TILE", tile)
    grid, n, rng = (10, 14), 4, np.random.default_rng(1)
    dense, pieces = np.zeros((3, n, *grid)), []
    covered = rng.random(grid) < 0.8
    for s in range(n):
        pieces.append([])
        for k in (3, 1):
            shape = k, *rng.integers(3, 11, 2)
            piece = Cutout(rng.normal(size=shape), *rng.integers(-20, 20, 2).tolist())
            pieces[s].append(piece)
            for values, each in zip(piece.values, dense[:, s], strict=False):
                each += Cutout(values, piece.y, piece.x).on_grid(grid)
    images = StarImages(covered, pieces, Order(np.array([2, 0, 3, 1]), n - 1))
    x, columns = rng.random(np.count_nonzero(covered)), dense[..., covered].reshape(3 * n, -1)
    assert worst(images.light(x[:n]), x[:n] @ columns[:n]) <= 1e-15
    assert worst(images.products(x).ravel(), columns @ x) <= 1e-15
    information = images.information(x)
    assert worst(information.block(slice(None)), (columns * x) @ columns.T) <= 1e-15
    np.testing.assert_array_equal(information.diagonal, np.diag(information.block(slice(None))))


@pytest.mark.parametrize("goes_round", [False, True])
def test_stars_that_share_pixels_are_near_in_their_order(goes_round):
    grid, rng = (400, 96), np.random.default_rng(2)
    margin = 0 if goes_round else 20
    stars = rng.uniform(margin, np.subtract(grid[::-1], margin), (200, 2))
    offsets = np.array([(0.0, 0.0), (2.6, -3.3)])
    images = [
        [Cutout(np.ones((k, 15)), int(y) - k // 2, int(x) - 7) for x, y in stars + offset]
        for k, offset in zip((21, 16), offsets, strict=True)
    ]
    there = [stars + offset for offset in offsets]
    places, width = order_of(stars, zip(there, images, strict=True), grid)
    np.testing.assert_array_equal(np.sort(places), np.arange(200))
    for cutouts in images:
        dense = np.array([cutout.on_grid(grid).ravel() for cutout in cutouts])
        one, other = np.nonzero(dense @ dense.T)
        assert abs(places[one] - places[other]).max() <= width
    assert width < 70  # along the other axis all 200 stars meet


def count_products(n):
    """Return the elements of the information of n stars on a grid that grows with them."""
    ny, rng = 16 * n, np.random.default_rng(3)
    stars = np.column_stack([rng.uniform(12, 52, n), 16 * np.arange(n) + 8.0])
    observation = lnocl.Observation(np.ones((ny, 64)), make_smooth_psfs(1, (7, 8)))
    field = Scene(observation, stars, pad=0).star_field
    covered = field.covered(0)
    return field.images(0, covered).information(np.ones(np.count_nonzero(covered))).band.size


def test_information_is_of_stars_that_overlap_alone():
    """Four times as many stars on four times the sky take four times as much; before, 16 times."""
    assert count_products(128) <= 5 * count_products(32)


def test_light_of_a_window_is_that_of_the_stars_that_reach_it(monkeypatch):
    """Before, every star of the scene was laid into the window of each."""
    rng = np.random.default_rng(4)
    stars = rng.uniform(10, 246, (60, 2))
    observation = lnocl.Observation(rng.poisson(50.0, (256, 256)), make_smooth_psfs(1, (7, 8)))
    scene = Scene(observation, stars, pad=0)
    laid, add_to = [], Cutout.add_to
    monkeypatch.setattr(Cutout, "add_to", lambda *args: laid.append(args) or add_to(*args))
    fluxes = rng.uniform(1.0, 2.0, 60)
    view = View(scene, 0, Window(10, 90, (40, 50)))
    image = view.model(Estimate(scene, np.zeros(scene.grid), fluxes))
    whole = scene.star_field.light(0, fluxes / scene.unit)
    expected = whole[10:50, 90:140]
    np.testing.assert_allclose(image, expected, rtol=1e-12, atol=1e-15)
    assert 0 < len(laid) < 30


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

    def __init__(self, setup, parts, n_iter):
        ((self.scene, _),) = parts

    def start(self, *_):
        pass


@pytest.mark.exhaustive
@pytest.mark.parametrize("refines", [False, True])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_memory_does_not_grow_as_stars_times_pixels(refines, solver, monkeypatch):
    """That of all before the first iteration but the engine. Measured 0.13 to 0.62, once 2 to 4."""
    monkeypatch.setattr("lnocl.core.runs.run._make_engines", lambda *given: [NoEngine(*given)])
    rng, size, n = np.random.default_rng(3), 256, 100
    stars = rng.uniform(20, size - 20, (n, 2))
    observation = lnocl.Observation(rng.poisson(20.0, (size, size)), make_smooth_psfs(1, (15, 15)))
    setup = Setup(observation, stars, 0, solver, "double", "numpy", None, refine_positions=refines)
    tracemalloc.start()
    try:
        Run(make_start(setup, Penalty(smoothing=1e-3)), 3)
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
