"""Each linear map against its adjoint, and those of a window against those of the grid.

PSFs have no symmetry, and images differ in depth, PSF, place and scale: so a conjugate that is
dropped, an axis that is turned round, or one image taken for another changes a sum.
"""

from functools import cache

import numpy as np
import pytest
import scipy.ndimage
import turned_scenes
from scenes import make_psfs, make_smooth_psfs, worst

import lnocl
from lnocl.core.scene.camera import Camera, Windows, sampled
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.psf_families import spectrum
from lnocl.core.scene.psf_pixels import PsfPixels
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.view import View
from lnocl.core.solvers import near_star
from lnocl.core.solvers.near_star import NearStar, Surroundings
from lnocl.core.solvers.psf_fit import _PixelErrors, _sky

pytestmark = [
    pytest.mark.filterwarnings("ignore:the images are shifted"),
    pytest.mark.filterwarnings("ignore:psf . is undersampled"),
    pytest.mark.filterwarnings("ignore:the star at .* lies on bad pixels"),
]

SHAPE, P = (40, 56), 3
STARS = [(27, 18), (9.3, 30.6)]
RNG = np.random.default_rng(11)
IMAGES = RNG.poisson(np.array([20.0, 60.0, 9.0])[:, None, None] * np.ones(SHAPE)).astype(float)
EXPOSURE = np.array([1.0, 3.0, 0.4])
OFFSETS = np.array([(0.0, 0.0), (1.4, -2.7), (-3.0, 0.3)])
SECONDS = EXPOSURE[:, None, None] * RNG.uniform(0.5, 2.0, SHAPE)
MASK = RNG.random((P, *SHAPE)) < 0.03
SMOOTH = make_smooth_psfs(P, (13, 15))
BROAD = make_smooth_psfs(P, (18, 17))


def turned(maps, transmission=None, psfs=SMOOTH, **changes):
    given = {"psfs": psfs, "psf_centre": "given", "transmission": transmission, **changes}
    return turned_scenes.observation(maps, **given)


def shares(*shape):
    """Return transmissions of three images, one of which hides a disc."""
    y, x = np.indices(shape) / np.reshape(shape, (2, 1, 1))
    hidden = np.clip(8.0 * np.hypot(y - 0.4, x - 0.6) - 0.5, 0.0, 1.0)
    return np.array([0.3 + 0.6 * x * y, hidden, 1.0 - 0.7 * y])


KINDS = {
    "apart": lambda: observe(make_psfs(P, (7, 8))),
    "shared": lambda: observe(make_psfs(1, (7, 8)), offsets=np.round(OFFSETS)),
    "moved": lambda: observe(SMOOTH, offsets=OFFSETS, mask=MASK),
    "mapped": lambda: observe(SMOOTH, offsets=OFFSETS, exposure=SECONDS),
    "halves": lambda: observe(SMOOTH, offsets=np.round(OFFSETS) + 0.5),
    "wide": lambda: observe(make_smooth_psfs(P, (39, 52)), offsets=OFFSETS),
    "finer": lambda: observe(make_smooth_psfs(P, (18, 17)), offsets=OFFSETS, oversample=2),
    "effective": lambda: observe(
        make_smooth_psfs(P, (18, 17)), offsets=OFFSETS, oversample=2, effective_psfs=True
    ),
    "turned": lambda: turned(turned_scenes.transforms()),
    "scaled": lambda: turned(turned_scenes.scaled()),
    "turned, finer": lambda: turned(turned_scenes.transforms(), psfs=BROAD, oversample=2),
    "scaled, effective": lambda: turned(
        turned_scenes.scaled(), psfs=BROAD, oversample=2, effective_psfs=True
    ),
    "dimmed": lambda: observe(SMOOTH, offsets=OFFSETS, mask=MASK, transmission=shares(*SHAPE)),
    "dimmed, finer": lambda: observe(
        make_smooth_psfs(P, (18, 17)), offsets=OFFSETS, oversample=2, transmission=shares(80, 112)
    ),
    "dimmed, scaled": lambda: turned(turned_scenes.scaled(), shares(*turned_scenes.SHAPE)),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


def observe(psfs, **changes):
    given = {"background": [2.0, 5.0, 1.0], "exposure": EXPOSURE, "psf_centre": "given"}
    return lnocl.Observation(IMAGES, psfs, **(given | changes))


@cache
def a_scene(kind):
    observation = KINDS[kind]()
    return Scene(observation, turned_scenes.STARS if observation.is_turned else STARS)


def dot(a, b):
    return float(np.vdot(a, b))


def noise(*shape, seed=3):
    return np.random.default_rng(seed).standard_normal(shape)


def assert_adjoint(forward, adjoint, x, y):
    """Assert that ``<A x, y>`` is ``<x, A^T y>``, but for rounding."""
    images = np.asarray(forward(x))
    scale = np.linalg.norm(images) * np.linalg.norm(y)
    assert dot(images, y) == pytest.approx(dot(x, adjoint(y)), rel=0, abs=1e-13 * scale)


@every_kind
def test_images_of_the_sky(kind):
    model = Model(a_scene(kind))
    x, y = noise(*model.grid), noise(*model.shape, seed=4)
    assert_adjoint(model.forward, model.adjoint, x, y)
    factors = abs(noise(2, P, seed=5))
    for found, shares in zip(model.adjoints(y, factors), factors, strict=True):
        expected = model.adjoint(shares[:, None, None] * y)
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


@every_kind
def test_images_in_single_precision(kind):
    """Measured: 2.6e-7; only shears and transmissions are made in double precision there."""
    model = Model(a_scene(kind))
    single = model.single()
    for found, exact, shape in (
        (single.forward, model.forward, model.grid),
        (single.adjoint, model.adjoint, model.shape),
    ):
        x = noise(*shape).astype(np.float32)
        made = found(x)
        is_plain = not model.scene.rotations and model.scene.transmission is None
        assert made.dtype == np.float32 or not is_plain
        assert worst(made, exact(x.astype(np.float64))) <= 5e-7


@every_kind
def test_flat_and_shared_images(kind):
    """They take shorter ways, which give what the long ones do."""
    model = Model(a_scene(kind))
    x, factors = abs(noise(*model.grid)), abs(noise(2, P, seed=5))
    # What is turned is flat where no edge is near.
    inside = np.s_[:, 7:13, 8:20] if model.scene.rotations else np.s_[:]
    allowed = 1e-3 if model.scene.rotations else 1e-12
    flat = np.broadcast_to(2.0, model.grid)
    expected = model.forward(x + flat) - model.forward(x)
    np.testing.assert_allclose(model.forward(flat)[inside], expected[inside], rtol=allowed)
    of_ones = [np.broadcast_to(each.of_ones(), model.shape[1:]) for each in model.cameras]
    np.testing.assert_allclose(2.0 * np.array(of_ones)[inside], expected[inside], rtol=allowed)
    ny, nx = model.shape[1:]
    # Samples of an effective PSF a pixel apart may sum to another number.
    ones = [] if kind.endswith("effective") else [np.broadcast_to(1.3, (ny, nx))]
    for one in (abs(noise(ny, nx, seed=6)), *ones):
        shared = model.adjoints(np.broadcast_to(one, model.shape), factors)
        apart = model.adjoints([one + np.zeros((ny, nx)) for _ in range(P)], factors)
        np.testing.assert_allclose(shared[inside], apart[inside], rtol=allowed)


@every_kind
def test_cutouts_of_stars(kind):
    scene = a_scene(kind)
    model = Model(scene)
    cutouts = [scene.star_cutout(j, 1) for j in range(P)]
    whole = model.adjoint([each.on_grid(scene.image_grid) for each in cutouts])
    found = model.adjoint_of_cutouts(cutouts).on_grid(model.grid)
    # Where images are turned, what is cut off is a ten thousandth.
    allowed = 1e-4 if scene.rotations else 1e-12
    np.testing.assert_allclose(found, whole, atol=allowed * abs(whole).max())


@every_kind
def test_the_matrix_of_a_camera(kind):
    """Against stars in the middle of pixels of the sky, which no shears turn."""
    scene = a_scene(kind)
    q, (height, width) = scene.oversample, scene.grid
    # What is turned does not go round.
    inner = (6, 6, 16, 34) if scene.rotations else (0, 0, height, width)
    places = [np.linspace(*inner[k::2], 7, endpoint=False) for k in (0, 1)]
    rng = np.random.default_rng(5)
    for j in range(P):
        camera, weights = Camera(scene, j), rng.random(scene.image_grid)
        assert_adjoint(camera.forward, camera.adjoint, noise(*scene.grid), weights - 0.5)
        is_seen = np.ones(weights.shape, bool) if scene.weights is None else scene.weights[j] > 0
        squares = camera.squares(weights * is_seen)
        for v, u in np.stack(places, axis=1).astype(int):
            sky = np.zeros(scene.grid)
            sky[v, u] = 1.0
            star = (np.array([u, v]) - (q - 1) / 2) / q
            (psf,) = scene.star_psfs(star[None])[j]
            expected = psf.at(*scene.observation.places(j, star)).on_grid(scene.image_grid)
            allowed = 1e-2 if scene.rotations else 1e-14  # shears turn no single pixel
            difference = abs(camera.forward(sky) - expected)[is_seen]
            assert difference.max() <= allowed * expected.max()
            left = (1e-2 if scene.rotations else 1e-14) * squares.max()
            assert squares[v, u] == pytest.approx((expected**2 * weights)[is_seen].sum(), abs=left)


WINDOWS = {
    "inside": (range(3, 14), range(6, 23)),
    "round the edges": (range(-4, 5), range(30, 43)),
    "an axis": (range(2, 5), range(-7, 49)),
}


@pytest.mark.parametrize("place", WINDOWS)
@every_kind
def test_a_window_of_a_camera(kind, place):
    """Between all that reaches it, and between a part of that, and the image."""
    scene = a_scene(kind)
    if scene.rotations and place != "inside":
        pytest.skip("the grid of an image that is turned is no period")
    seen, q = WINDOWS[place], scene.oversample
    for j in range(P):
        camera = Camera(scene, j)
        for sky in (None, [range(q * at.start + 2, q * at.stop + 3) for at in seen]):
            window = camera.window(seen, sky)
            ends = zip(window.reached, scene.grid, strict=True)
            there = np.ix_(*(np.array(at) % n for at, n in ends))
            x, laid = abs(noise(*scene.grid))[there], np.zeros(scene.grid)
            assert_adjoint(window.forward, window.adjoint, x, noise(*window.shape, seed=4))
            laid[there] = x
            expected = camera.forward(laid)
            for axis, at in enumerate(seen):
                expected = expected.take(at, axis, mode="wrap")
            # The weights that turn an image have an error of their own.
            allowed = 2e-3 if scene.rotations else 1e-13
            assert abs(window.forward(x) - expected).max() <= allowed * abs(expected).max()


def test_windows_of_one_camera_that_end_alike():
    """Which hold as much of the PSF, up to the same lag, but from another one on."""
    camera, (rows, columns) = Camera(a_scene("apart"), 1), (range(2, 18), range(5, 21))
    sky = np.zeros(camera.grid)
    sky[np.ix_(rows, columns)] = x = abs(noise(16, 16))
    whole = camera.forward(sky)
    for first in (3, 4):
        seen = range(first, 14), range(first + 3, 17)
        found = camera.window(seen, (rows, columns)).forward(x)
        np.testing.assert_allclose(found, whole[np.ix_(*seen)], rtol=1e-12)


@every_kind
@pytest.mark.parametrize("dark", [[], [1], [0, 1, 2]])
def test_windows_of_all_images_at_once(kind, dark):
    """Images of one cut and others, some of them dark."""
    scene, q = a_scene(kind), a_scene(kind).oversample
    places = [(range(3, 20), range(8, 19))] * 2 + [(range(5, 20), range(8, 19))]
    sky = range(2 * q, 22 * q), range(6 * q, 20 * q)
    maps = [Camera(scene, j).window(seen, sky) for j, seen in enumerate(places)]
    windows, x = Windows(maps), abs(noise(20 * q, 14 * q))
    for found, each in zip(windows.forward(x), maps, strict=True):
        np.testing.assert_allclose(found, each.forward(x), rtol=1e-12, atol=1e-12 * found.max())
    images = [noise(*each.shape, seed=j) * (j not in dark) for j, each in enumerate(maps)]
    expected = sum(each.adjoint(y) for each, y in zip(maps, images, strict=True))
    np.testing.assert_allclose(windows.adjoint(images), expected, rtol=0, atol=1e-13 * q**2 * 10)


@every_kind
def test_the_sky_round_a_star(kind, monkeypatch):
    """Its adjoint, and its images against those of the whole sky."""
    monkeypatch.setattr(near_star, "WINDOW", 2.0)
    scene = a_scene(kind)
    sky = np.full(scene.grid, 3.0)
    around = Surroundings(Estimate(scene, sky, np.full(scene.n_fluxes, 900.0)), False)
    near = NearStar(around, 0, 1e-8)
    source, shape = near.source, near.expected.shape
    assert shape != scene.grid
    x, y = abs(noise(*shape)), noise(P, *near.window.shape, seed=4)
    weights = np.array([each.precision > 0 for each in near.images])
    assert_adjoint(source.images_of, source._adjoint, x, y * weights)
    laid = np.zeros(scene.grid)
    laid[near.places(scene)] = x
    images, of_ones = map(Model(scene).forward, (laid, np.ones(scene.grid)))
    levels = [each.slopes[list(each.unknowns).index(near.level)] for each in near.images]
    responses = np.reshape(levels, y.shape)
    for j, found in enumerate(source.images_of(x)):
        there = View.round(scene, j, near.window).window
        expected = images[j][there.of(scene.image_grid)]
        ny, nx = expected.shape
        is_seen = weights[j, :ny, :nx]
        # The weights that turn an image have an error of their own.
        allowed = 1e-3 if scene.rotations else 1e-9
        difference = abs(found[:ny, :nx] - expected)[is_seen].max()
        assert difference <= allowed * expected[is_seen].max()
        flat = of_ones[j][there.of(scene.image_grid)]
        np.testing.assert_allclose(responses[j, :ny, :nx][is_seen], flat[is_seen], rtol=allowed)


@pytest.mark.parametrize("kind", ["apart", "moved", "finer", "turned", "scaled", "turned, finer"])
def test_errors_of_the_pixels_of_psfs(kind):
    scene = a_scene(kind)
    psfs = scene.observation.psfs
    pixels = PsfPixels(psfs, 0.1 * abs(psfs) + 1e-4, scene.oversample)
    sky = abs(noise(*scene.grid, seed=5))
    errors = _PixelErrors(Model(scene), pixels, sky, np.array([40.0, 7.0]), np.zeros(psfs.shape))
    x, y = noise(*psfs.shape), noise(P, *scene.image_grid, seed=4)
    assert_adjoint(lambda x: list(errors.forward(x)), errors.adjoint, x, y)


@pytest.mark.parametrize(
    ("kind", "allowed"),
    [("moved", 3e-3), ("finer", 2e-4), ("dimmed, finer", 2e-4), ("turned", 2e-2)],
)
def test_sky_convolved_with_the_given_psfs_reproduces_the_model(kind, allowed):
    """Through the PSFs as they were given it is the model, but for how these are shifted."""
    scene = a_scene(kind)
    model, fluxes = Model(scene), np.array([400.0, 70.0])
    sky = scipy.ndimage.gaussian_filter(abs(noise(*scene.grid, seed=5)), 2.0, mode="wrap")
    models = Estimate.of_scaled(scene, sky, fluxes).models()
    for j, (image, background) in enumerate(zip(models, model.background, strict=True)):
        otf = spectrum(scene.observation.psfs[j], scene.grid)
        found = np.fft.irfft2(otf * _sky(model, j, sky, fluxes), scene.grid)
        expected = image - background
        difference = abs(sampled(found, scene.oversample) - expected)
        assert difference.max() <= allowed * expected.max()
