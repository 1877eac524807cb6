"""Several skies with known mixing: what is read, the operators, and the parts of filters."""

import numpy as np
import pytest
from scenes import make_psfs

import lnocl
from lnocl.core.scene.components import Mixing
from lnocl.core.scene.estimate import Estimate
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.scene import Scene
from lnocl.errors import InputError
from lnocl.process import ignored_warnings

SHAPE = 16, 32
LINE = {"line": [1, 0, 1, 0], "continuum": [1, 1, 0.8, 0.5]}


def observe(components=LINE, seed=0, **known):
    rng = np.random.default_rng(seed)
    n = len(next(iter(components.values())))
    images = rng.poisson(50.0, (n, *SHAPE))
    given = {"background": 3.0, "psf_error": 0.0, "exposure": np.linspace(1.0, 2.0, n), **known}
    return lnocl.Observation(images, make_psfs(n, (7, 9)), components=components, **given)


def rotated(n):
    turns = [np.eye(2), [[0.8, -0.6], [0.6, 0.8]]] * n
    return np.concatenate([turns[:n], np.full((n, 2, 1), 0.4)], axis=2)


KINDS = {
    "plain": {},
    "mask": {"mask": np.indices((4, *SHAPE)).sum(axis=0) % 11 == 0},
    "shifted": {"offsets": [[0.5, -1.0], [0.0, 0.0], [1.25, 0.5], [-2.0, 0.0]]},
    "turned": {"transforms": rotated(4)},
    "finer": {"oversample": 2},
    "dimmed": {"transmission": np.linspace(0.2, 1.0, 512).reshape(SHAPE)},
    "exposures": {"exposure": np.linspace(1.0, 2.0, 4 * 512).reshape(4, *SHAPE)},
    "epochs": {"epochs": [1, 1, 2, 2]},
    "halos": {"halos": np.linspace(0.0, 1.0, 512).reshape(SHAPE)},
}


@pytest.fixture(params=KINDS)
def scene(request):
    with ignored_warnings():  # PSFs of tests are sharp
        return Scene(observe(**KINDS[request.param]), [(9.3, 6.0), (20.0, 8.5)], pad=2)


def skies(scene, seed=1):
    return np.random.default_rng(seed).random(scene.sky_grid)


def test_filters_are_numbered_as_images_have_them_first():
    mixing = Mixing.of(np.array([[0.0, 1.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.5]]))
    assert mixing.filters.tolist() == [0, 1, 0, 2]
    assert mixing.rows.tolist() == [[0.0, 1.0], [1.0, 1.0], [0.0, 0.5]]


def test_components_undo_what_filters_show():
    mixing = Mixing.of(observe().components)
    skies = np.random.default_rng(0).random((2, 3, 4))
    np.testing.assert_allclose(mixing.components(mixing.seen(skies)), skies, atol=1e-14)


def test_stars_have_a_flux_in_each_filter_of_each_epoch():
    names = "1 line + 1 continuum", "continuum"
    observation = observe({"line": [1, 0, 1, 0], "continuum": [1, 1, 1, 1]})
    assert observation.epoch_labels == ("line + continuum", "continuum")
    assert observation.epochs.tolist() == [0, 1, 0, 1]
    both = observe({"line": [1, 0, 1, 0], "continuum": [1, 1, 1, 1]}, epochs=["b", "a", "a", "a"])
    assert both.epoch_labels == ("line + continuum, a", "line + continuum, b", "continuum, a")
    assert both.epochs.tolist() == [1, 2, 0, 2]
    assert observe({"line": [1, 0, 2, 0], "continuum": [1, 1, 1, 1]}).epoch_labels == (
        names[0],
        names[1],
        "2 line + 1 continuum",
    )


@pytest.mark.parametrize(
    ("components", "told"),
    [
        ({"line": [1, 1], "continuum": [1, 1]}, "do not tell line and continuum apart"),
        ({"line": [1, 0], "continuum": [0, 0]}, "no image shows the component 'continuum'"),
        ({"line": [1, 0], "continuum": [1, 0]}, "shows no component"),
        ({"line": [1, -1], "continuum": [1, 1]}, "must be 0, or from 1e-06"),
        ({"line": [1, 0, 1], "continuum": [1, 1, 1]}, "a number for each of the 2 images"),
        ({"": [1, 0], "continuum": [1, 1]}, "a name that is empty, or there twice"),
        ({1: [1, 0], "1": [1, 1]}, "a name that is empty, or there twice"),
        ({"line": [1, 1]}, "components has 1 name"),
    ],
)
def test_weights_that_cannot_be_used_are_refused(components, told):
    with pytest.raises(InputError, match=told):
        lnocl.Observation(np.ones((2, *SHAPE)), np.ones((3, 3)), components=components)


def test_errors_of_weights_are_by_name():
    observation = observe(component_errors={"continuum": 0.1})
    assert observation.component_errors.tolist() == [[0.0, 0.1]] * 4
    with pytest.raises(InputError, match="'lines', which is no component"):
        observe(component_errors={"lines": 0.1})


def test_the_model_is_the_sum_of_what_images_have_of_each_sky(scene):
    model, given = Model(scene), skies(scene)
    found = model.forward(given)
    for j, camera in enumerate(model.cameras):
        parts = [w * camera.forward(sky) for w, sky in zip(scene.mixes[j], given, strict=True)]
        np.testing.assert_allclose(found[j], sum(parts), rtol=0, atol=1e-12)


def test_the_adjoint_is_that_of_the_model(scene):
    model, given = Model(scene), skies(scene)
    images = np.random.default_rng(2).random(model.shape)
    left = np.vdot(model.forward(given), images)
    assert np.vdot(given, model.adjoint(images)) == pytest.approx(left, rel=1e-12)


def test_what_a_filter_shows_is_one_sky(scene):
    estimate = Estimate(scene, skies(scene), np.arange(1.0, scene.n_fluxes + 1))
    models = list(estimate.models())
    seen = []
    for part in estimate.parts:
        assert part.estimate.scene.mixing is None
        for j, model in zip(part.images, part.estimate.models(), strict=True):
            np.testing.assert_allclose(model, models[j], rtol=0, atol=1e-11)
            seen.append(j)
    assert sorted(seen) == [0, 1, 2, 3]
    fluxes = np.concatenate([part.fluxes for part in estimate.parts])
    assert sorted(fluxes) == list(range(scene.n_fluxes))


def test_a_change_of_what_filters_show_is_that_of_components(scene):
    estimate = Estimate(scene, skies(scene), np.ones(scene.n_fluxes))

    def brighter(part):
        return Estimate(part.scene, part.sky * 1.5, part.star_fluxes * 2.0)

    changed = estimate.changed(brighter)
    np.testing.assert_allclose(changed.sky, 1.5 * estimate.sky, rtol=1e-12)
    assert (changed.star_fluxes == 2.0).all()


def test_the_order_of_images_does_not_matter():
    observation = observe()
    order = [2, 0, 3, 1]
    other = lnocl.Observation(
        observation.images[order],
        observation.psfs[order],
        background=3.0,
        psf_error=0.0,
        exposure=observation.exposure[order],
        components={name: np.array(w)[order] for name, w in LINE.items()},
    )
    models = [Model(Scene(each)).forward(skies(Scene(each))) for each in (observation, other)]
    np.testing.assert_allclose(models[0][order], models[1], rtol=0, atol=1e-12)


def test_levels_of_a_flat_start_are_those_of_components():
    line, continuum = 20.0, 7.0
    weights = np.array(list(LINE.values())).T
    images = np.broadcast_to((weights @ (line, continuum))[:, None, None], (4, *SHAPE)) + 3.0
    given = {"background": 3.0, "psf_error": 0.0, "components": LINE}
    scene = Scene(lnocl.Observation(images, make_psfs(4, (7, 9)), **given))
    levels = scene.rough_fit.level.ravel() * scene.unit
    np.testing.assert_allclose(levels, (line, continuum), rtol=1e-12)


def test_images_of_a_filter_are_as_they_are_alone():
    given = {"mask": KINDS["mask"]["mask"], "epochs": [1, 1, 2, 2], "star_places": [(9.0, 6.0)]}
    own = np.random.default_rng(3).random((1, 4, 5, 5)) / 50.0
    observation = observe({"line": [1, 0, 1, 0], "continuum": [1, 1, 1, 1]}, star_psfs=own, **given)
    part = observation.of_images([0, 2])
    assert part.component_names == ()
    assert part.epoch_labels == observation.epoch_labels[:2]
    for name in ("images", "mask", "exposure", "psfs", "offsets", "background"):
        np.testing.assert_array_equal(getattr(part, name), getattr(observation, name)[[0, 2]])
    np.testing.assert_array_equal(part.star_psfs, observation.star_psfs[:, [0, 2]])
    wider = part.replace(psfs=np.roll(part.psfs, 1, axis=1), psf_error=0.1)
    joined = observation.joined([([0, 2], wider), ([1, 3], observation.of_images([1, 3]))])
    np.testing.assert_array_equal(joined.psfs[[0, 2]], wider.psfs)
    np.testing.assert_array_equal(joined.psfs[[1, 3]], observation.psfs[[1, 3]])
    assert joined.psf_error == 0.1
    assert joined.component_names == ("line", "continuum")


def test_components_are_told_where_enough_filters_see():
    """Two of three tell line and continuum apart, one alone does not."""
    mixing = Mixing.of(np.array([[1.0, 1.0], [0.0, 1.0], [0.7, 1.0]]), ["line", "continuum"])
    seen = np.array(list(np.ndindex(2, 2, 2)), bool).T.reshape(3, 2, 4)
    told = mixing.told_by(seen)
    np.testing.assert_array_equal(told, seen.sum(axis=0) >= 2)
    assert mixing.told_by(np.ones((3, 2, 4), bool)).all()
    alike = Mixing.of(np.array([[1.0, 1.0], [0.0, 1.0], [0.0, 0.5]]), ["line", "continuum"])
    assert not alike.told_by(np.array([[[False]], [[True]], [[True]]])).any()
