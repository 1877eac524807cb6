"""Halos: light of known shape whose amount in each image is fitted."""

import pickle
from functools import partial

import halo_scenes
import numpy as np
import pytest
import turned_scenes
from halo_scenes import AMOUNTS, FLUX, LEVELS, STAR, N, P, observation
from scenes import NUMPY_FIRST, Recipe, paper, same, worst

import lnocl
from lnocl.core.scene.scene import Scene

SOLVERS = "sgm", "sgp"
pytestmark = pytest.mark.filterwarnings(
    "ignore:the noise of image",
    "ignore:the PSFs do not fit",
    "ignore:psf . is undersampled",
    "ignore:the images are shifted",
)


def haloed_map():
    """Return a run of maps of exposures, offsets and bad pixels, whose program others build too."""
    shape = (12, 32)
    made = Recipe(shape, 3, 2, mu=1e-3, masked=0.05, read_noise=1.0, exposure="map", fractions=True)
    made = made.make()
    y, x = np.indices(shape)
    halos = np.array([1.0 + np.cos(x / 4.0 + j) * np.sin(y / 3.0) for j in range(3)])
    given = made.observation(images=made.images + 60.0 * halos * made.exposure, halos=halos)
    return partial(made.deconvolve, given)


def haloed_turns():
    """Return a run of images that are turned, likewise."""
    y, x = np.indices(turned_scenes.SHAPE)
    halo = 1.0 / (1.0 + np.hypot(x - 20, y - 7))
    counts = turned_scenes.observation().images + 90.0 * halo
    given = turned_scenes.observation(images=counts, halos=halo)
    return partial(paper, given, turned_scenes.STARS)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("run", [haloed_map, haloed_turns])
@pytest.mark.parametrize(
    ("precision", "allowed"),
    [("single", 2e-4), pytest.param("double", 2e-13, marks=pytest.mark.exhaustive)],
)
def test_engines_agree(run, precision, allowed, solver):
    found, expected = (
        run()(solver=solver, n_iter=20, **engine)
        for engine in ({"precision": precision}, {"engine": "numpy"})
    )
    assert (expected.halo_fluxes > 0).all()
    assert worst(found.extended, expected.extended) <= allowed
    assert worst(found.star_fluxes, expected.star_fluxes) <= allowed
    assert worst(found.halo_fluxes, expected.halo_fluxes) <= allowed


def test_iterations_of_the_split_gradient_are_those_of_the_formula():
    """``a_kj <- a_kj <H_kj, g_j / m_j>`` beside a star and a sky."""
    given = observation()
    start = {"initial_extended": np.full((N, N), 3.0), "initial_star_fluxes": [2500.0]}
    fluxes, models = [], []

    def look(_, estimate):
        fluxes.append(estimate._run.star_fluxes())

    paper(given, [STAR], n_iter=2, callback=look, engine="numpy", **start)
    model = paper(given, [STAR], n_iter=1, engine="numpy", **start).models()
    models = [(given.halos[0, j] * given.images[j] / model[j]).sum() for j in range(P)]
    np.testing.assert_allclose(fluxes[1][1:], fluxes[0][1:] * models, rtol=1e-10)


@pytest.mark.parametrize("engine", NUMPY_FIRST)
@pytest.mark.parametrize("solver", SOLVERS)
def test_counts_of_the_shape_are_all_in_the_halo(solver, engine):
    halos = halo_scenes.speckles()
    counts = 1e5 * halos / halos.sum(axis=(1, 2), keepdims=True)
    given = lnocl.Observation(counts, halo_scenes.psfs(), halos=7.0 * halos)
    result = lnocl.deconvolve(given, solver=solver, stop=None, n_iter=30, **engine)
    np.testing.assert_allclose(result.halo_fluxes, 1e5, rtol=2e-3)
    assert result.extended.sum() <= 200.0


@pytest.mark.exhaustive
def test_amounts_are_unbiased_with_errors_of_the_right_size():
    pulls, star_pulls = [], []
    for seed in range(6):
        result = lnocl.deconvolve(observation(seed), [STAR], engine="numpy")
        pulls.append((result.halo_fluxes - AMOUNTS) / result.halo_flux_errors)
        star_pulls.append((result.star_fluxes - FLUX) / result.star_flux_errors)
        assert worst(result.halo_fluxes, AMOUNTS) <= 0.015
    assert abs(np.mean(pulls)) <= 0.8
    assert 0.5 <= np.sqrt(np.mean(np.square(pulls))) <= 1.6
    assert abs(np.mean(star_pulls)) <= 1.2


@pytest.mark.exhaustive
def test_a_flat_halo_is_a_level_of_the_background():
    pulls = []
    for seed in range(4):
        light = halo_scenes.means(np.ones((P, N, N)), LEVELS, 0.0)
        given = observation(seed, light, background=0.0, halos=np.ones((N, N)))
        result = lnocl.deconvolve(given, [STAR], engine="numpy")
        pulls.append((result.halo_fluxes - LEVELS) / result.halo_flux_errors)
        assert (result.halo_flux_errors < 0.015 * LEVELS).all()
        flux, error = result.extended_flux
        assert abs(flux - halo_scenes.BLOB) <= 4 * error
    assert abs(np.mean(pulls)) <= 1.0
    assert np.sqrt(np.mean(np.square(pulls))) <= 1.7


@pytest.mark.exhaustive
def test_without_halos_nothing_changes():
    light = halo_scenes.means(halo_scenes.speckles(), AMOUNTS)
    given = observation(light=light, halos=np.ones((0, P, N, N)))
    none = lnocl.Observation(given.images, halo_scenes.psfs(), background=20.0)
    results = [lnocl.deconvolve(each, [STAR], engine="numpy") for each in (given, none)]
    same(*results)
    assert results[0].halo_fluxes.shape == results[0].halo_flux_errors.shape == (0, P)


@pytest.mark.exhaustive
def test_order_and_scale():
    given = observation()
    first = lnocl.deconvolve(given, [STAR], stop=None, n_iter=12, engine="numpy")
    order = [2, 0, 1]
    other = lnocl.Observation(
        given.images[order], given.psfs[order], background=20.0, halos=3.0 * given.halos[:, order]
    )
    found = lnocl.deconvolve(other, [STAR], stop=None, n_iter=12, engine="numpy")
    np.testing.assert_allclose(found.halo_fluxes, first.halo_fluxes[:, order], rtol=1e-6)
    assert worst(found.extended, first.extended) <= 1e-5
    scaled = given.replace(images=4.0 * given.images, background=4.0 * given.background)
    options = {"solver": "sgp", "n_iter": 12, "engine": "numpy"}
    found, first = (paper(each, [STAR], **options) for each in (scaled, given))
    np.testing.assert_array_equal(found.halo_fluxes, 4.0 * first.halo_fluxes)
    np.testing.assert_array_equal(found.extended, 4.0 * first.extended)


def test_exposures_leave_amounts_as_they_are():
    """They are electrons of an image, whether exposures are numbers or maps."""
    given, exposure = observation(), np.array([2.0, 2.0, 2.0])
    options = {"solver": "sgp", "n_iter": 12, "engine": "numpy"}
    plain = paper(given, [STAR], **options)
    shared = {"background": 20.0, "halos": given.halos}
    numbers = lnocl.Observation(given.images, given.psfs, exposure=exposure, **shared)
    maps = np.broadcast_to(exposure[:, None, None], given.images.shape)
    for each in (numbers, lnocl.Observation(given.images, given.psfs, exposure=maps, **shared)):
        found = paper(each, [STAR], **options)
        np.testing.assert_allclose(found.halo_fluxes, plain.halo_fluxes, rtol=1e-8)
        np.testing.assert_allclose(found.star_fluxes, plain.star_fluxes / 2.0, rtol=1e-8)
        np.testing.assert_allclose(found.models(), plain.models(), rtol=1e-8)


@pytest.mark.exhaustive
def test_unequal_exposures_and_a_map_agree():
    given, exposure = observation(), np.array([1.0, 2.0, 0.5])
    images = halo_scenes.means(given.halos[0], AMOUNTS, 20.0) - 20.0
    light = given.halos[0] * AMOUNTS[0, :, None, None]
    images = (images - light) * exposure[:, None, None] + light + 20.0
    maps = np.broadcast_to(exposure[:, None, None], images.shape)
    found = [
        lnocl.deconvolve(
            lnocl.Observation(images, given.psfs, exposure=each, background=20, halos=given.halos),
            [STAR],
            stop=None,
            n_iter=40,
            engine="numpy",
        )
        for each in (exposure, maps)
    ]
    for each in found:
        assert worst(each.halo_fluxes, AMOUNTS) <= 5e-3
        assert worst(each.star_fluxes, FLUX) <= 0.05


@pytest.mark.exhaustive
def test_two_halos_and_a_quarter_turn():
    """Images that are turned by index carry their halos; padding leaves them where they are."""
    flat, halos = np.ones((P, N, N)), halo_scenes.speckles()
    expected = halo_scenes.means(halos, AMOUNTS, 0.0) + (LEVELS[0] / N**2)[:, None, None]
    given = {"psfs": halo_scenes.psfs(), "halos": np.array([halos, flat])}
    upright = lnocl.Observation(expected, **given)
    turned = np.rot90(expected[1]).copy(), np.rot90(halos[1]).copy()
    images, shapes = expected.copy(), np.array([halos, flat])
    images[1], shapes[0, 1] = turned
    psfs = given["psfs"].copy()
    psfs[1] = np.rot90(psfs[1])
    maps = np.tile(np.eye(2, 3), (P, 1, 1))
    maps[1] = [(0.0, 1.0, 0.0), (-1.0, 0.0, N - 1.0)]
    rolled = lnocl.Observation(images, psfs, halos=shapes, transforms=maps)
    results = [
        lnocl.deconvolve(each, [STAR], stop=None, n_iter=30, pad=9, engine="numpy")
        for each in (upright, rolled)
    ]
    for each in results:
        assert worst(each.halo_fluxes, np.concatenate([AMOUNTS, LEVELS])) <= 0.03
    np.testing.assert_allclose(results[0].halo_fluxes, results[1].halo_fluxes, rtol=1e-4)


@pytest.mark.exhaustive
def test_epochs_and_masks():
    bad = np.random.default_rng(3).random((P, N, N)) < 0.05
    given = observation(mask=bad, epochs=[0, 1, 0])
    scene = Scene(given, [STAR])
    assert (scene.n_stars, scene.n_halos, scene.n_fluxes) == (2, 3, 5)
    np.testing.assert_array_equal(scene.shown[2:], np.eye(3, dtype=bool))
    np.testing.assert_allclose(scene.star_weights[2:], 1.0, rtol=1e-12)
    result = lnocl.deconvolve(given, [STAR], stop=None, n_iter=15, engine="numpy")
    good = [(given.halos[0, j] > 0).sum() for j in range(P)]
    assert good == [(~each).sum() for each in bad]
    whole = halo_scenes.speckles()
    shares = (whole * ~bad).sum(axis=(1, 2)) / whole.sum(axis=(1, 2))
    assert worst(result.halo_fluxes, AMOUNTS * shares) <= 0.02
    assert len(result.star_fluxes) == len(result.to_table()) == 2


@pytest.mark.exhaustive
def test_positions_are_refined_beside_halos_that_stay():
    places = [(STAR[0] + 0.4, STAR[1] - 0.3)]
    options = {"stop": None, "n_iter": 15, "engine": "numpy"}
    result = lnocl.deconvolve(observation(), places, refine_positions=True, **options)
    assert abs(result.star_positions - STAR).max() <= 0.1
    assert worst(result.halo_fluxes, AMOUNTS) <= 0.02
    assert result.star_position_errors.shape == (1, 2)


def test_an_observation_carries_halos():
    given = observation()
    copied = pickle.loads(pickle.dumps(given))
    np.testing.assert_array_equal(copied.halos, given.halos)
    np.testing.assert_allclose(given.halos.sum(axis=(2, 3)), 1.0, rtol=1e-14)
    part = given.window(range(4, 30), range(10, 40))
    np.testing.assert_array_equal(part.halos, given.halos[:, :, 4:30, 10:40])
    assert given.replace(halos=None).halos.shape == (0, P, N, N)
    assert given.nbytes - given.replace(halos=None).nbytes == given.halos.nbytes
    with pytest.raises(ValueError, match="read-only"):
        given.halos[...] = 0.0
    for shape in ((N, N), (P, N, N), (1, P, N, N), (1, 1, N, N)):
        assert observation(halos=np.ones(shape)).halos.shape == (1, P, N, N)


@pytest.mark.exhaustive
def test_replicas_scatter_as_the_errors_say():
    result = lnocl.deconvolve(observation(), [STAR], stop=None, n_iter=10, engine="numpy")
    found = result.bootstrap(10, seed=0)
    names = found.to_table()["name"].tolist()
    assert names == ["star 1 flux", *(f"halo 1 image {j}" for j in (1, 2, 3))]
    errors = np.append(result.star_flux_errors, result.halo_flux_errors)
    np.testing.assert_allclose(found.values[1:], result.halo_fluxes[0], rtol=1e-12)
    assert (found.standard_errors >= 0.9 * errors).all()
    assert (found.standard_errors <= 3.0 * errors).all()


BAD = {
    "has shape (3, 5)": np.ones((3, 5)),
    "has shape (2, 48, 48)": np.ones((2, N, N)),
    "has shape (1, 2, 48, 48)": np.ones((1, 2, N, N)),
    "halo 1 has -1 at (4, 2) in image 0": (2, 4, -1.0),
    "halo 1 has nan at (4, 2) in image 0": (2, 4, np.nan),
    "is 0 on all good pixels of image 0": np.zeros((N, N)),
    "give real numbers": np.full((N, N), "a"),
}


@pytest.mark.parametrize("message", BAD)
def test_invalid_halos_are_refused_in_one_line(message):
    halo = BAD[message]
    if isinstance(halo, tuple):
        y, x, value = halo
        halo = np.ones((N, N))
        halo[y, x] = value
    with pytest.raises(lnocl.InputError) as caught:
        observation(halos=halo)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tiles_and_fully_masked_images_are_refused_with_halos():
    given = observation()
    with pytest.raises(lnocl.InputError, match="a tile cannot tell the halos"):
        lnocl.deconvolve_tiles(given, [STAR], engine="numpy")
    with pytest.raises(lnocl.InputError, match="is 0 on all good pixels"):
        given.replace(mask=np.arange(P)[:, None, None] == np.zeros((P, N, N)))


def test_values_that_are_bad_where_pixels_are_do_no_harm():
    halo, bad = np.ones((N, N)), np.zeros((N, N), bool)
    halo[3, 5:8], bad[3, 5:8] = (np.nan, np.inf, -7.0), True
    assert observation(halos=halo, mask=bad).halos.max() == pytest.approx(1 / (N**2 - 3))
    masked = np.ma.array(halo, mask=bad)
    assert observation(halos=masked, mask=bad).halos[0, 0, 3, 6] == 0.0
    with pytest.raises(lnocl.InputError, match="masked value"):
        observation(halos=np.ma.array(np.ones((N, N)), mask=bad))


@pytest.mark.exhaustive
@pytest.mark.parametrize("stop", [None, "held-out"])
def test_a_run_resumes_bit_for_bit(tmp_path, stop):
    given, path = observation(), str(tmp_path / "run.fits")
    options = {"stop": stop, "n_iter": 30, "engine": "numpy", "checkpoint": path}
    whole = lnocl.deconvolve(given, [STAR], **{**options, "checkpoint": None})

    def stop_at(iteration, _):
        return iteration == 4

    lnocl.deconvolve(given, [STAR], callback=stop_at, **options)
    found = lnocl.deconvolve(given, [STAR], resume=path, **options)
    same(found, whole)
    np.testing.assert_array_equal(found.halo_fluxes, whole.halo_fluxes)
    other = given.replace(halos=given.halos[:, ::-1].copy())
    with pytest.raises(lnocl.InputError, match="halos differs"):
        lnocl.deconvolve(other, [STAR], resume=path, **options)


@pytest.mark.exhaustive
def test_amounts_beside_a_finer_sky():
    """Pixels of the sky share the noise of an image's, of which light is told from nothing."""
    v, u = np.indices((39, 39)) - 19
    psfs = np.exp(-(u**2 + v**2) / (8.0 * halo_scenes.WIDTHS[:, None, None] ** 2))
    given = observation().images, psfs
    finer = lnocl.Observation(*given, background=20.0, halos=halo_scenes.speckles(), oversample=2)
    result = lnocl.deconvolve(finer, [STAR], engine="numpy")
    assert (abs(result.halo_fluxes - AMOUNTS) <= 3.0 * result.halo_flux_errors).all()
    flux, error = result.extended_flux
    assert abs(flux - halo_scenes.BLOB) <= 4 * error


@pytest.mark.parametrize("n", [1, 2])
def test_halos_of_images_of_several_shapes_have_their_shapes(n):
    shapes = [(12, 14), (9, 11)]
    rng = np.random.default_rng(2)
    halos = [[rng.uniform(1, 2, shape) for shape in shapes] for _ in range(n)]
    images = [np.full(shape, 9.0) for shape in shapes]
    known = {"psfs": np.ones((3, 3)), "transforms": [np.eye(2, 3)] * 2}
    found = lnocl.Observation(images, halos=halos if n > 1 else halos[0], **known).halos
    for halo, given in zip(found, halos, strict=True):
        np.testing.assert_allclose(halo[1, :9, :11], given[1] / given[1].sum())
        assert halo[1].sum() == pytest.approx(1.0)
    with pytest.raises(lnocl.InputError, match=r"halo 1 has shape .*; give each map"):
        lnocl.Observation(images, halos=[halos[0][0], halos[0][1][:5]], **known)
