"""Stars whose flux differs from epoch to epoch, the rest of the sky being common.

The scenes are turned too, so that their program is that of tests/turned_scenes.py.
"""

import numpy as np
import pytest
import turned_scenes as scenes_turned
from scenes import FEWER_ENGINES, paper, same, worst
from turned_scenes import FLUXES, GRID, NX, NY, STARS, gaussian, observation

import lnocl
from lnocl.scene.scene import Scene

EPOCHS = ["b", "a", "b"]  # of images 0 and 2, and of image 1, which comes first
START = {
    "initial_extended": np.full((NY, NX), 8.0),
    "initial_star_fluxes": np.repeat(FLUXES, 2) / 2,
}
pytestmark = pytest.mark.filterwarnings(
    "ignore:psf . is sharper than its pixels", "ignore:the star at .* lies on bad pixels"
)


def split_gradient(n_iter):
    """Return extended source and star fluxes of the paper's iteration on the matrix."""
    maps, given = scenes_turned.transforms(), observation()
    stars = scenes_turned.star_columns(maps).reshape(3, NY * NX, 2)
    columns = np.zeros((3, NY * NX, 4))
    for j, epoch in enumerate((1, 0, 1)):
        columns[j, :, [epoch, 2 + epoch]] = stars[j].T
    matrix = np.hstack([scenes_turned.matrix(maps), columns.reshape(-1, 4)])
    weights, images = (~given.mask).ravel().astype(float), given.images.ravel()
    background = np.tile(scenes_turned.background().ravel(), 3)
    total = matrix.T @ weights
    is_observed = total[:-4] >= 0.01 * total[:-4].max()
    x = np.append(np.where(is_observed, 8.0, 0.0), START["initial_star_fluxes"])
    total[:-4][~is_observed] = np.inf
    for _ in range(n_iter):
        x *= matrix.T @ (weights * images / (matrix @ x + background)) / total
    return x[:-4].reshape(GRID)[:NY, :NX], x[-4:]


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_iterations_are_those_of_the_matrix(engine):
    result = paper(observation(epochs=EPOCHS), STARS, n_iter=30, **START, **engine)
    extended, fluxes = split_gradient(30)
    assert worst(result.extended, extended) <= 3e-3
    assert worst(result.star_fluxes, fluxes) <= 4e-4
    np.testing.assert_array_equal(result.star_positions, np.repeat(STARS, 2, axis=0))


@pytest.mark.parametrize(
    ("precision", "allowed"),
    [("single", 2e-4), pytest.param("double", 3e-13, marks=pytest.mark.exhaustive)],
)
def test_engines_agree(precision, allowed):
    given = {"solver": "sgp", "n_iter": 30, **START}
    found, expected = (
        paper(observation(epochs=EPOCHS), STARS, **given, **engine)
        for engine in ({"precision": precision}, {"engine": "numpy"})
    )
    assert worst(found.extended, expected.extended) <= allowed
    assert worst(found.star_fluxes, expected.star_fluxes) <= allowed


def test_one_epoch_is_none():
    one, none = (
        paper(given, STARS, n_iter=8, engine="numpy")
        for given in (observation(epochs=[7, 7, 7]), observation())
    )
    same(one, none)
    assert "epoch" not in one.to_table().colnames


def test_a_star_is_in_the_images_of_its_epoch_alone():
    scene = Scene(observation(epochs=EPOCHS), STARS)
    np.testing.assert_array_equal(scene.shown, [[False, True, False], [True, False, True]] * 2)
    plain = Scene(observation(), STARS)
    for j in range(3):
        for s in range(4):
            expected = plain.star_image(j, s // 2) if scene.shown[s, j] else 0.0
            np.testing.assert_array_equal(scene.star_image(j, s), expected)
    total = scene.star_weights[::2] + scene.star_weights[1::2]
    np.testing.assert_allclose(total, plain.star_weights, rtol=1e-14)


def test_exposures_of_epochs_weigh_their_stars():
    """Else the split-gradient method would overstep in epochs of long exposures."""
    y, x = np.indices((32, 32))
    psf = gaussian(*(np.indices((9, 9)) - 4), 2.0 * np.eye(2))
    light, exposure = 900.0 * gaussian(x - 12, y - 11, 2.0 * np.eye(2)), np.array([1.0, 9.0])
    images = exposure[:, None, None] * (light + 1.0)
    given = lnocl.Observation(images, psf, exposure=exposure, epochs=[0, 1])
    scene = Scene(given, [(12, 11)])
    np.testing.assert_allclose(scene.star_weights, [0.2, 1.8], rtol=1e-14)
    result = paper(given, [(12, 11)], n_iter=60, engine="numpy")
    assert worst(result.star_fluxes, 900.0) <= 0.02


def test_held_out_counts_of_epochs_resume(tmp_path):
    options = {"n_iter": 12, "engine": "numpy", "checkpoint": str(tmp_path / "run.fits")}
    given = observation(epochs=EPOCHS)
    lnocl.deconvolve(given, STARS, callback=lambda iteration, _: iteration == 4, **options)
    found = lnocl.deconvolve(given, STARS, resume=options["checkpoint"], **options)
    whole = lnocl.deconvolve(given, STARS, **{**options, "checkpoint": None})
    same(found, whole)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_fluxes_of_nights_and_their_errors():
    """A star of six nights beside a second one on a common host: pulls of 8 seeds."""
    rng, pulls = np.random.default_rng(9), []
    y, x = np.indices((40, 40))
    v, u = np.indices((17, 17)) - 8
    psfs = np.array([gaussian(u, v, np.diag([2.0 + 0.2 * j, 2.4])) for j in range(6)])
    stars = np.array([(16.3, 18.7), (26.1, 22.4)])
    host = 2e3 * gaussian(x - 20, y - 20, np.diag([30.0, 20.0]))
    for _ in range(8):
        fluxes = rng.uniform(5e3, 2e4, (2, 6))
        means = np.full((6, 40, 40), 20.0)
        for j, mean in enumerate(means):
            covariance = np.diag([2.0 + 0.2 * j, 2.4])
            mean += host
            for (at_x, at_y), flux in zip(stars, fluxes[:, j], strict=True):
                mean += flux * gaussian(x - at_x, y - at_y, covariance)
        counts = rng.poisson(means).astype(float)
        given = lnocl.Observation(counts, psfs, background=20.0, epochs=range(6))
        result = lnocl.deconvolve(given, stars, engine="numpy")
        assert worst(result.star_fluxes, fluxes.ravel()) <= 0.05
        pulls.append((result.star_fluxes - fluxes.ravel()) / result.star_flux_errors)
    # Errors of one run are of a common host, and so not independent.
    assert abs(np.mean(pulls)) <= 0.7
    assert 0.6 <= np.sqrt(np.mean(np.square(pulls))) <= 1.4
    table = result.to_table()
    assert table["epoch"].tolist() == [0, 1, 2, 3, 4, 5] * 2
    assert table["x"].value.tolist() == np.repeat(stars[:, 0], 6).tolist()


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_replicas_name_star_and_epoch():
    given = observation(epochs=EPOCHS)
    result = paper(given, STARS, n_iter=3, engine="numpy")
    names = result.bootstrap(10, seed=0).to_table()["name"].tolist()
    assert names == [f"star {s} epoch {e} flux" for s in (1, 2) for e in (0, 1)]


def test_what_is_refused():
    with pytest.raises(lnocl.LnoclError, match=r"epochs`? has shape"):
        observation(epochs=[1, 2])
    same_places = lnocl.Observation(np.ones((2, 16, 16)), np.ones((3, 3)), epochs=[0, 1])
    with pytest.raises(lnocl.LnoclError, match="tiles are of images of one epoch"):
        lnocl.deconvolve_tiles(same_places, [(8, 8)], stop=None, n_iter=1, engine="numpy")
    with pytest.raises(lnocl.LnoclError, match="moves stars of one epoch alone"):
        paper(observation(epochs=EPOCHS), STARS, n_iter=1, refine_positions=True)
