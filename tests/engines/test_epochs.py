"""Stars whose flux differs from epoch to epoch, the rest of the sky being common.

The scenes are turned too, so that their program is that of tests/turned_scenes.py.
"""

import numpy as np
import pytest
import turned_scenes as scenes_turned
from scenes import FEWER_ENGINES, paper, same, worst
from turned_scenes import FLUXES, GRID, NX, NY, STARS, gaussian, observation

import lnocl
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.near_star import NearStar, Surroundings
from lnocl.io.saved_results import read_result

EPOCHS = ["b", "a", "b"]  # of images 0 and 2, and of image 1, which comes first
START = {
    "initial_extended": np.full((NY, NX), 8.0),
    "initial_star_fluxes": np.repeat(FLUXES, 2) / 2,
}
pytestmark = pytest.mark.filterwarnings(
    "ignore:psf . is undersampled", "ignore:the star at .* lies on bad pixels"
)


def split_gradient(n_iter, given, is_shown):
    """Return extended source and star fluxes of the paper's iteration on the matrix."""
    maps = scenes_turned.transforms()
    stars = scenes_turned.star_columns(maps).reshape(3, NY * NX, 2)
    columns = np.zeros((3, NY * NX, 4))
    for j, epoch in enumerate((1, 0, 1)):
        columns[j, :, [epoch, 2 + epoch]] = stars[j].T
    columns[..., ~is_shown] = 0.0
    matrix = np.hstack([scenes_turned.matrix(maps), columns.reshape(-1, 4)])
    weights, images = (~given.mask).ravel().astype(float), given.images.ravel()
    background = np.tile(scenes_turned.background().ravel(), 3)
    total = matrix.T @ weights
    is_observed = total[:-4] >= 0.01 * total[:-4].max()
    x = np.append(np.where(is_observed, 8.0, 0.0), START["initial_star_fluxes"])
    total[:-4][~is_observed] = total[-4:][~is_shown] = np.inf
    for _ in range(n_iter):
        x *= matrix.T @ (weights * images / (matrix @ x + background)) / total
    return x[:-4].reshape(GRID)[:NY, :NX], x[-4:]


@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_iterations_are_those_of_the_matrix(engine):
    result = paper(observation(epochs=EPOCHS), STARS, n_iter=30, **START, **engine)
    extended, fluxes = split_gradient(30, observation(), np.ones(4, bool))
    assert worst(result.extended, extended) <= 3e-3
    assert worst(result.star_fluxes, fluxes) <= 4e-4
    np.testing.assert_array_equal(result.star_positions, np.repeat(STARS, 2, axis=0))


NOT_SHOWN = r"the star at \(11\.3, 8\.2\) is on no good pixel of epoch 0: its flux there is NaN$"


def without_first_star(**changes):
    """Return the observation with the first star masked in the one image of epoch "a"."""
    bad = scenes_turned.mask()
    x, y = scenes_turned.transforms()[1] @ np.append(STARS[0], 1.0)
    v, u = np.indices(scenes_turned.SHAPE)
    bad[1] |= np.hypot(u - x, v - y) < 7.5
    return observation(epochs=EPOCHS, mask=bad, **changes)


@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", FEWER_ENGINES)
def test_a_star_that_one_epoch_does_not_show_has_no_flux_there_and_the_others_as_before(engine):
    given, shown = without_first_star(), np.array([False, True, True, True])
    start = START | {"initial_star_fluxes": np.where(shown, START["initial_star_fluxes"], np.nan)}
    with pytest.warns(lnocl.LnoclWarning, match=NOT_SHOWN):
        result = paper(given, STARS, n_iter=30, **start, **engine)
    extended, fluxes = split_gradient(30, given, shown)
    assert worst(result.extended, extended) <= 3e-3
    assert worst(result.star_fluxes[shown], fluxes[shown]) <= 4e-4
    np.testing.assert_array_equal(np.isnan(result.star_fluxes), ~shown)
    np.testing.assert_array_equal(np.isnan(result.star_flux_errors), ~shown)
    np.testing.assert_array_equal(result.star_positions, np.repeat(STARS, 2, axis=0))


def nights(bad=None, **known):
    """Return three nights of two stars on a common host, each night with a PSF of its own."""
    rng, (y, x) = np.random.default_rng(4), np.indices((30, 33))
    spreads = [np.diag([1.5 + 0.3 * j, 2.2]) for j in range(3)]
    psfs = [gaussian(*(np.indices((11, 11)) - 5), spread[::-1, ::-1]) for spread in spreads]
    images = np.full((3, 30, 33), 20.0) + 2e3 * gaussian(x - 15, y - 14, np.diag([30.0, 20.0]))
    for image, spread, fluxes in zip(images, spreads, NIGHTS.T, strict=True):
        for (at_x, at_y), flux in zip(PLACES, fluxes, strict=True):
            image += flux * gaussian(x - at_x, y - at_y, spread)
    given = {"background": 20.0, "epochs": [5, 2, 9], "mask": bad, **known}
    return lnocl.Observation(rng.poisson(images).astype(float), psfs, **given)


PLACES = [(9.3, 11.7), (22.1, 18.4)]
NIGHTS = np.array([(9e3, 7e3, 8e3), (4e3, 5e3, 6e3)])


def bad_first_star():
    """Return bad pixels round the first star in the last image, of epoch 2."""
    bad, (y, x) = np.zeros((3, 30, 33), bool), np.indices((30, 33))
    bad[2] = np.hypot(x - 9.3, y - 11.7) < 8.5
    return bad


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the star at .* is on no good pixel of epoch 2")
def test_flux_without_good_pixels_is_nan_in_all_outputs(tmp_path):
    given, seen, lost = nights(bad_first_star()), [], [False, False, True, False, False, False]
    path = str(tmp_path / "run.fits")
    options = {"n_iter": 12, "engine": "numpy", "checkpoint": path}

    def stop(iteration, estimate):
        seen.append(estimate.star_fluxes)
        return iteration == 4

    lnocl.deconvolve(given, PLACES, callback=stop, **options)
    assert all(np.isnan(fluxes).tolist() == lost for fluxes in seen)
    result = lnocl.deconvolve(given, PLACES, resume=path, **options)
    same(result, lnocl.deconvolve(given, PLACES, **{**options, "checkpoint": None}))
    pulls = (result.star_fluxes - NIGHTS[:, [1, 0, 2]].ravel()) / result.star_flux_errors
    assert abs(pulls[~np.array(lost)]).max() < 3
    for told in (result.star_fluxes, result.star_flux_errors, result.to_table()["flux"].value):
        assert np.isnan(told).tolist() == lost
    assert np.isfinite(result.extended_flux).all()
    again = lnocl.deconvolve(
        given, PLACES, initial_star_fluxes=result.star_fluxes, n_iter=1, stop=None, engine="numpy"
    )
    assert np.isnan(again.star_fluxes).tolist() == lost
    result.write(tmp_path / "found.fits")
    saved = read_result(str(tmp_path / "found.fits"))
    np.testing.assert_array_equal(saved.star_fluxes, result.star_fluxes)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:the star at .* is on no good pixel of epoch 2")
def test_light_curve_products_omit_fluxes_without_good_pixels():
    result = paper(nights(bad_first_star()), PLACES, n_iter=8, engine="numpy")
    table = result.bootstrap(10).to_table()
    of_first = [f"star 1 epoch {e} flux" for e in (0, 1)]
    assert table["name"].tolist() == [*of_first, *(f"star 2 epoch {e} flux" for e in range(3))]
    assert np.isfinite(table["error"]).all()
    curves = result.significance().contrast_curves()
    mean = result.star_fluxes[:2].mean()
    np.testing.assert_allclose((curves["flux50"] / curves["contrast50"])[0].value, mean)
    drawn = [axes for axes in result.plot().axes if axes.get_title().startswith("light curves")]
    words = [text.get_text() for text in drawn[0].get_legend().get_texts()]
    shown = f"{mean:,.0f}".replace(",", " ")
    assert words[0] == f"star 1, mean {shown} electron"


def test_a_star_that_images_of_an_epoch_do_not_reach_has_no_flux_there():
    rng, (y, x) = np.random.default_rng(6), np.indices((40, 40))
    psf = gaussian(*(np.indices((11, 11)) - 5), np.diag([2.0, 1.4]))
    offsets, star = np.array([(0.0, 0.0), (-14.0, 0.0)]), (6.2, 21.7)
    light = [gaussian(x - star[0] - dx, y - star[1], np.diag([1.4, 2.0])) for dx, _ in offsets]
    images = rng.poisson(20.0 + 5e3 * np.array(light)).astype(float)
    given = lnocl.Observation(images, psf, background=20.0, offsets=offsets, epochs=["one", "two"])
    with pytest.warns(lnocl.LnoclWarning, match="is on no good pixel of epoch 1"):
        result = lnocl.deconvolve(given, [star], engine="numpy")
    assert abs(result.star_fluxes[0] - 5e3) < 3 * result.star_flux_errors[0]
    assert np.isnan(result.star_fluxes[1])


@pytest.mark.exhaustive
@pytest.mark.parametrize("moves", [False, True])
def test_a_star_that_is_masked_everywhere_is_left_out_and_rows_stay(moves):
    bad = scenes_turned.mask()
    maps, (v, u) = scenes_turned.transforms(), np.indices(scenes_turned.SHAPE)
    masked = (33.1, 5.2)
    for each, there in zip(bad, maps @ np.append(masked, 1.0), strict=True):
        each |= np.hypot(u - there[0], v - there[1]) < 8.0
    given = observation(mask=bad)
    options = {"n_iter": 20, "refine_positions": moves, "engine": "numpy"}
    expected = paper(given, STARS, **options)
    with pytest.warns(lnocl.LnoclWarning, match=r"\(33\.1, 5\.2\) lies where all images are mask"):
        found = paper(given, [STARS[0], masked, STARS[1]], **options)
    assert np.isnan([found.star_fluxes[1], found.star_flux_errors[1]]).all()
    assert found.star_positions[1].tolist() == [33.1, 5.2]
    assert worst(found.star_fluxes[::2], expected.star_fluxes) <= 1e-12
    assert worst(found.extended, expected.extended) <= 1e-12
    assert worst(found.star_flux_errors[::2], expected.star_flux_errors) <= 1e-6


@pytest.mark.parametrize(
    ("precision", "allowed"),
    [("single", 4e-5), pytest.param("double", 3e-14, marks=pytest.mark.exhaustive)],
)
def test_engines_agree(precision, allowed):
    given = {"solver": "sgp", "n_iter": 15, **START}
    found, expected = (
        paper(observation(epochs=EPOCHS), STARS, **given, **engine)
        for engine in ({"precision": precision}, {"engine": "numpy"})
    )
    assert worst(found.extended, expected.extended) <= allowed
    assert worst(found.star_fluxes, expected.star_fluxes) <= allowed


@pytest.mark.exhaustive
def test_single_epoch_equals_no_epochs():
    one, none = (
        paper(given, STARS, n_iter=8, engine="numpy")
        for given in (observation(epochs=[7, 7, 7]), observation())
    )
    same(one, none)
    assert "epoch" not in one.to_table().colnames


@pytest.mark.exhaustive
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


@pytest.mark.exhaustive
def test_light_expected_under_a_star_is_independent_of_the_number_of_epochs():
    """Else the edge of its core would be filled once for each."""
    found = []
    for scene in (Scene(observation(epochs=EPOCHS), STARS), Scene(observation(), STARS)):
        fluxes = np.repeat(FLUXES, scene.n_stars // 2)
        around = Surroundings(Estimate(scene, scenes_turned.sky(), fluxes), moves=False)
        found.append(NearStar(around, 0, 1e-4).expected)
    np.testing.assert_allclose(*found, rtol=1e-12)


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


@pytest.mark.exhaustive
def test_held_out_counts_of_epochs_resume(tmp_path):
    options = {"n_iter": 12, "engine": "numpy", "checkpoint": str(tmp_path / "run.fits")}
    given = observation(epochs=EPOCHS)
    lnocl.deconvolve(given, STARS, callback=lambda iteration, _: iteration == 4, **options)
    found = lnocl.deconvolve(given, STARS, resume=options["checkpoint"], **options)
    whole = lnocl.deconvolve(given, STARS, **{**options, "checkpoint": None})
    same(found, whole)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_fluxes_of_nights_and_their_errors():
    """A star of six nights beside a second one on a common host: pulls of 8 seeds."""
    rng, pulls, of_changes = np.random.default_rng(9), [], []
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
        off = result.star_fluxes - fluxes.ravel()
        pulls.append(off / result.star_flux_errors)
        changes = off.reshape(2, 6) - off.reshape(2, 6).mean(axis=1, keepdims=True)
        of_changes.append(changes.ravel() / result.star_variation_errors)
        assert (result.star_variation_errors < result.star_flux_errors).all()
    # Errors of one run are of a common host, and so not independent.
    assert abs(np.mean(pulls)) <= 0.7
    assert 0.6 <= np.sqrt(np.mean(np.square(pulls))) <= 1.4
    # Without the host, which epochs share, they are independent but for their mean.
    assert 0.8 <= np.sqrt(np.mean(np.square(of_changes))) <= 1.2
    table = result.to_table()
    assert table["epoch"].tolist() == [0, 1, 2, 3, 4, 5] * 2
    assert table["x"].value.tolist() == np.repeat(stars[:, 0], 6).tolist()


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_replicas_name_star_and_epoch():
    given = observation(epochs=EPOCHS)
    result = paper(given, STARS, n_iter=3, engine="numpy")
    names = result.bootstrap(10, seed=0).to_table()["name"].tolist()
    assert names == [f"star {s} epoch {e} flux" for s in (1, 2) for e in (0, 1)]


@pytest.mark.exhaustive
def test_epochs_of_the_wrong_shape_are_refused():
    with pytest.raises(lnocl.LnoclError, match=r"epochs`? has shape"):
        observation(epochs=[1, 2])


def test_labels_that_are_whole_numbers_have_no_decimals():
    given = observation().replace(epochs=[303.0, 60735.25, 303.0])
    assert given.epoch_labels == ("303", "60735.25")
