"""The door: what an observation makes of its input, what it refuses and what it announces."""

import inspect
import pickle
import warnings
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData, StdDevUncertainty
from scenes import paper

import lnocl
from lnocl.core.scene.fields import FIELDS
from lnocl.core.scene.geometry import MOVES
from lnocl.errors import InputError

PSF = np.array([[0.0, 1.0, 0.0], [1.0, 4.0, 2.0]])
IMAGES = np.arange(1.0, 49.0).reshape(3, 4, 4)


def observe(**changes):
    return lnocl.Observation(**({"images": IMAGES, "psfs": PSF} | changes))


# --- What it holds


def test_one_image_becomes_a_stack():
    observation = observe(images=IMAGES[0], background=2)
    assert observation.n_images == 1
    assert observation.shape == (4, 4)
    np.testing.assert_array_equal(observation.images, IMAGES[:1])
    np.testing.assert_array_equal(observation.psfs, PSF[None] / 8)
    np.testing.assert_array_equal(observation.background, [2.0])
    np.testing.assert_array_equal(observation.mask, np.zeros((1, 4, 4), bool))


@pytest.mark.parametrize("scale", [5e-324, 1e-300, 3.0, 1e300])
def test_each_psf_is_normalised_by_its_own_sum(scale):
    found = observe(psfs=[scale * PSF, PSF[::-1], 4 * PSF], psf_centre="given").psfs
    np.testing.assert_array_equal(found, [scale * PSF / (8 * scale), PSF[::-1] / 8, PSF / 8])


@pytest.mark.parametrize("psfs", [PSF, PSF[None]])
def test_one_psf_serves_all_images(psfs):
    np.testing.assert_array_equal(observe(psfs=psfs).psfs, [PSF / 8] * 3)


@pytest.mark.parametrize(
    ("background", "held"),
    [
        (2, [2.0, 2.0, 2.0]),
        ([2], [2.0, 2.0, 2.0]),
        ((1, 2, 3), [1.0, 2.0, 3.0]),
        (np.float32(0.0), [0.0, 0.0, 0.0]),
        (2 * IMAGES, 2 * IMAGES),
    ],
)
def test_background(background, held):
    np.testing.assert_array_equal(observe(background=background).background, held)


def each_pixel(values):
    """Return what is one for all images, or one for each, as a map."""
    values = np.asarray(values, float)
    return np.broadcast_to(values[:, None, None] if values.ndim == 1 else values, IMAGES.shape)


@pytest.mark.parametrize("background", [5.0, [5.0, 6.0, 7.0], 0.5 * IMAGES])
@pytest.mark.parametrize("read_noise", [3.0, [0.0, 1.0, 4.0], IMAGES / 7, IMAGES[1] / 7])
def test_read_noise_squared_is_added_to_images_and_background(read_noise, background):
    mask, variance = IMAGES % 5 == 0, each_pixel(read_noise) ** 2
    if np.ndim(read_noise) > 1:  # what is masked may hold anything
        read_noise = np.where(mask, np.nan, read_noise)
    observation = observe(read_noise=read_noise, background=background, mask=mask)
    np.testing.assert_array_equal(observation.images, np.where(mask, 0.0, IMAGES + variance))
    expected = each_pixel(background) + variance
    np.testing.assert_array_equal(each_pixel(observation.background)[~mask], expected[~mask])


def arrays_of(observation):
    held = {name: getattr(observation, name) for name in (*FIELDS, "offsets", "turns")}
    return {name: each for name, each in held.items() if isinstance(each, np.ndarray)}


@pytest.mark.parametrize("name", ["background", "read_noise", "exposure"])
def test_one_map_serves_all_images(name):
    for mask in (None, IMAGES % 5 == 0):
        one = arrays_of(observe(**{name: IMAGES[1]}, mask=mask))
        each = arrays_of(observe(**{name: np.array([IMAGES[1]] * 3)}, mask=mask))
        for attribute, values in each.items():
            np.testing.assert_array_equal(one[attribute], values)
        assert one["background" if name == "read_noise" else name].shape == IMAGES.shape


@pytest.mark.parametrize(
    ("exposure", "held"),
    [
        (None, [1.0, 1.0, 1.0]),
        (2, [2.0, 2.0, 2.0]),
        ([0.5], [0.5, 0.5, 0.5]),
        ((1, 2, 1e-9), [1.0, 2.0, 1e-9]),
        (IMAGES[0], [IMAGES[0]] * 3),
    ],
)
def test_exposure(exposure, held):
    observation = observe(exposure=exposure)
    np.testing.assert_array_equal(observation.exposure, held)
    assert observation.exposure.dtype == np.float64
    assert not observation.mask.any()
    np.testing.assert_array_equal(observation.images, IMAGES)


@pytest.mark.parametrize("exposure", [np.where(IMAGES % 7, 2.0, 0.0), IMAGES[0] - 1.0])
def test_exposure_of_zero_masks(exposure):
    mask = IMAGES == 30
    observation = observe(exposure=np.where(mask, np.nan, exposure), mask=mask)
    expected = mask | (np.broadcast_to(exposure, IMAGES.shape) == 0)
    np.testing.assert_array_equal(observation.mask, expected)
    np.testing.assert_array_equal(observation.images, np.where(expected, 0.0, IMAGES))
    np.testing.assert_array_equal(
        observation.exposure[~mask], np.broadcast_to(exposure, IMAGES.shape)[~mask]
    )


def test_offsets():
    np.testing.assert_array_equal(observe().offsets, np.zeros((3, 2)))
    offsets = [(0, 0), (3.9, -3.5), (-1, 2)]
    np.testing.assert_array_equal(observe(offsets=offsets).offsets, offsets)
    wide = lnocl.Observation(np.ones((2, 5)), PSF, offsets=[(4.5, -1.5)])
    np.testing.assert_array_equal(wide.offsets, [(4.5, -1.5)])
    for offset, given in [((4.5, 2), "2"), ((4.5, -3), "-3"), ((7, 1), "7")]:
        with pytest.raises(lnocl.InputError, match=f"the images' 5 by 2 pixels; {given} was given"):
            lnocl.Observation(np.ones((2, 5)), PSF, offsets=[offset])


MASK = IMAGES[0] % 3 == 0


@pytest.mark.parametrize(
    ("images", "mask", "held"),
    [
        (IMAGES, np.array([MASK, ~MASK, MASK]), [MASK, ~MASK, MASK]),
        (IMAGES, MASK, [MASK] * 3),
        (IMAGES[0], MASK, [MASK]),
        (np.ma.array(IMAGES, mask=[MASK, ~MASK, MASK]), None, [MASK, ~MASK, MASK]),
        (np.ma.array(IMAGES[0], mask=MASK), None, [MASK]),
        ([np.ma.array(IMAGES[0], mask=MASK), IMAGES[1]], None, [MASK, MASK & False]),
        (np.ma.array(IMAGES), None, [MASK & False] * 3),
        (np.ma.array(IMAGES, mask=[MASK] * 3), IMAGES[0] > 9, [MASK | (IMAGES[0] > 9)] * 3),
    ],
)
def test_masks(images, mask, held):
    observation = observe(images=images, mask=mask)
    np.testing.assert_array_equal(observation.mask, held)
    data = np.reshape(np.ma.getdata(images), observation.images.shape)
    np.testing.assert_array_equal(observation.images, np.where(held, 0.0, data))


@pytest.mark.filterwarnings(
    "ignore:psf . is undersampled", "ignore:the images are shifted by up to"
)
def test_input_is_copied_and_never_modified():
    given = {
        "images": np.where(IMAGES == 7, np.nan, IMAGES - 3.0),
        "psfs": np.array([PSF, PSF - 0.1, PSF]),
        "background": np.ones_like(IMAGES),
        "read_noise": np.array([0.0, 0.5, 1.0]),
        "mask": IMAGES > 40,
        "exposure": np.where(IMAGES == 9, 0.0, 2.0),
        "offsets": np.array([(0.0, 0.0), (1.0, 0.5), (0.0, -1.0)]),
    }
    before = {name: array.copy() for name, array in given.items()}
    with pytest.warns(lnocl.LnoclWarning):
        observation = lnocl.Observation(**given)
    start = {"initial_extended": np.ones((4, 4)), "initial_star_fluxes": np.array([2.0])}
    held = {name: array.copy() for name, array in arrays_of(observation).items()}
    paper(observation, stars=[(1, 2)], n_iter=3, engine="numpy", **start)
    for name, array in before.items():
        np.testing.assert_array_equal(given[name], array)
        assert not any(
            np.shares_memory(given[name], own) for own in arrays_of(observation).values()
        )
    for name, array in held.items():
        np.testing.assert_array_equal(getattr(observation, name), array)
    np.testing.assert_array_equal(start["initial_extended"], np.ones((4, 4)))
    np.testing.assert_array_equal(start["initial_star_fluxes"], [2.0])


def masked(values, n_masked):
    """Return values of which the last few are masked."""
    mask = np.arange(np.size(values)) >= np.size(values) - n_masked
    return np.ma.array(values, mask=mask.reshape(np.shape(values)))


GIVEN = {
    "psfs": np.array([PSF] * 3),
    "background": IMAGES,
    "read_noise": [1.0, 2.0, 3.0],
    "mask": IMAGES > 40,
    "exposure": IMAGES,
    "offsets": np.eye(3, 2),
}


@pytest.mark.parametrize("name", GIVEN)
def test_masked_arrays_with_nothing_masked_are_plain_arrays(name):
    expected = arrays_of(observe(**{name: GIVEN[name]}))
    for given in (np.ma.array(GIVEN[name]), masked(GIVEN[name], 0)):
        for attribute, values in arrays_of(observe(**{name: given})).items():
            np.testing.assert_array_equal(values, expected[attribute])
            assert type(values) is type(expected[attribute])


# --- What it refuses


def assert_refused(message, **changes):
    with pytest.raises(lnocl.InputError) as caught:
        observe(**changes)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2


@pytest.mark.parametrize("name", ["images", *GIVEN])
def test_arrays_other_than_real_numbers_are_refused(name):
    for given in (np.array([["1"]]), np.array([[1j]]), np.array([[None]])):
        holds = "is of type" if name == "mask" else "holds"
        assert_refused(f"{name} {holds} {given.dtype}", **{name: given})
    assert_refused(f"{name} cannot be read as an array", **{name: [[1.0, 2.0], [3.0]]})


REMEDIES = {
    "psfs": "repair them first, as lnocl.psf.make_psf does",
    "mask": "fill them or leave them out",
    "offsets": "fill them or leave them out",
}


@pytest.mark.parametrize("name", GIVEN)
def test_masked_values_are_refused(name):
    remedy = REMEDIES.get(name, "fill them and add their mask to mask")
    assert_refused(f"{name} has 2 masked values; {remedy}", **{name: masked(GIVEN[name], 2)})


@pytest.mark.parametrize("name", ["background", "read_noise", "exposure"])
@pytest.mark.parametrize("value", [-0.5, np.nan, np.inf])
def test_values_that_no_image_has_are_refused(name, value):
    least = "more than zero" if name == "exposure" else "not negative"
    for given in (value, [1.0, value, 3.0]):
        assert_refused(f"{name} must be finite and {least}; {value:g}", **{name: given})
    given = np.where(IMAGES == 7, value, 1.0)
    assert_refused(f"{name} must be finite and not negative; {value:g}", **{name: given})


@pytest.mark.parametrize("name", ["background", "read_noise", "exposure"])
def test_numbers_and_maps_of_other_shapes_are_refused(name):
    for given in ([1, 2], IMAGES[:, 1:], IMAGES[1:]):
        assert_refused(f"{name} has shape {np.shape(given)}", **{name: given})


REFUSED = [
    ({"images": IMAGES[0, 0]}, "images has 1 dimension;"),
    ({"images": IMAGES[None]}, "images has 4 dimensions"),
    ({"images": IMAGES[:0]}, "images is empty: its shape is (0, 4, 4)"),
    ({"images": IMAGES[:, :, :0]}, "images is empty"),
    (
        {"images": np.ones((64, 48, 3))},
        "images has shape (64, 48, 3), but its axes are (p, ny, nx): of colours give one, "
        "images[:, :, 0]; if they are of one sky, np.moveaxis(images, -1, 0)",
    ),
    (
        {"psfs": np.ones((8, 9, 4))},
        "psfs has shape (8, 9, 4), but its axes are (p, ny, nx): of colours give one, psfs[:, ",
    ),
    ({"psfs": [PSF, PSF]}, "2 psfs for 3 images"),
    ({"psfs": [PSF] * 4}, "4 psfs for 3 images"),
    ({"images": IMAGES[0], "psfs": [PSF] * 2}, "2 psfs for 1 image"),
    ({"psfs": PSF[0]}, "psfs has 1 dimension;"),
    ({"psfs": PSF[None, None]}, "psfs has 4 dimensions"),
    ({"psfs": PSF[:0]}, "psfs is empty"),
    ({"psfs": [PSF, PSF, 0 * PSF]}, "psf 2 has the sum 0;"),
    ({"psfs": [PSF, -PSF, PSF]}, "psf 1 has the sum -8;"),
    ({"psfs": [PSF, 0 * PSF, -PSF]}, "psf 1 has the sum 0;"),
    ({"psfs": [PSF, PSF, PSF * np.nan]}, "is not finite in "),
    ({"psfs": np.where(PSF == 4, np.inf, PSF)}, "is not finite in 1 pixel, the first at (1, 1): "),
    (
        {"psfs": [PSF, np.full((2, 3), 1e308), PSF]},
        "psf 1 has the sum inf; it must be positive, finite and more than",
    ),
    ({"psfs": [[1e308] * 4 + [-1e308] * 4]}, "it must be positive, finite and more than"),
    (
        {"psfs": [[1e300, -1e300, 1.0]]},
        "psf 0 has the sum 1; it must be positive, finite and more than the rounding of its values",
    ),
    ({"mask": np.zeros((4, 5), bool)}, "mask has shape (4, 5)"),
    ({"mask": np.zeros((2, 4, 4), bool)}, "mask has shape (2, 4, 4)"),
    ({"read_noise": 1e200}, "the square of read_noise must be finite"),
    (
        {"read_noise": 2e15},
        "the images, with exposure and the square of read_noise, must be at most 1e+30 electrons "
        "per pixel: divide the counts and read_noise by a constant",
    ),
    (
        {"background": 1e30, "read_noise": 9e14},
        "the background, with exposure and the square of read_noise, must be at most 1e+30 ele",
    ),
    (
        {"images": np.where(IMAGES == 7, 1.7e308, 1.0), "read_noise": 1e154},
        "the images, with exposure and the square of read_noise, must be at most 1e+30 ele",
    ),
    (
        {"read_noise": np.ma.masked},
        "read_noise has 1 masked value; fill it and add its mask to mask",
    ),
    ({"exposure": 0}, "exposure must be finite and more than zero; 0 was"),
    ({"exposure": 0 * IMAGES}, "all pixels are masked"),
    ({"exposure": (IMAGES < 20) * 1.0, "mask": IMAGES < 20}, "all pixels are masked"),
    (
        {"offsets": [(0, 0), (1, 1)]},
        "offsets has shape (2, 2); give (dx, dy) for each of the 3 images",
    ),
    ({"offsets": np.zeros((3, 3))}, "offsets has shape (3, 3)"),
    ({"offsets": (1, 2)}, "offsets has shape (2,)"),
    (
        {"offsets": [(0, 0), (0, -4), (0, 0)]},
        "offsets must be finite, and less than the images' 4 by 4 pixels; -4 was given",
    ),
    ({"offsets": np.full((3, 2), np.nan)}, "4 by 4 pixels; nan was given"),
    (
        {"pupils": np.ones((2, 2))},
        "pupils has shape (2, 2); give (2, 3), the shape of the PSFs, or one such map for each",
    ),
    ({"pupils": -np.ones((2, 3))}, "pupils hold values that are negative or not"),
    ({"pupils": np.zeros((2, 3))}, "pupils hold a map that is all 0"),
    (
        {"psf_scatter": np.full((2, 3), np.nan)},
        "psf_scatter hold values that are negative or not finite; repair them first",
    ),
    ({"psf_scatter": np.ones((2, 2, 3))}, "psf_scatter has shape"),
    ({"mask": np.ones((4, 4), bool)}, "all pixels are masked"),
    ({"images": np.ma.masked_all((3, 4, 4))}, "all pixels are masked"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_refused(changes, message):
    assert_refused(message, **changes)


def test_all_but_images_and_psfs_go_by_name():
    with pytest.raises(TypeError, match="3 positional arguments but 4 were given"):
        lnocl.Observation(IMAGES, PSF, 5.0)


def test_nothing_but_non_finite_pixels_is_refused():
    with (
        pytest.warns(lnocl.LnoclWarning, match="^48 image pixels are not finite"),
        pytest.raises(lnocl.InputError, match="all pixels are masked"),
    ):
        observe(images=IMAGES * np.nan)


def test_an_image_may_be_masked_as_a_whole():
    assert observe(mask=IMAGES > 32).mask[2].all()


# --- What it announces


def announced(**changes):
    """Return the observation, what was announced, and the files at which it points."""
    given = {"images": IMAGES, "psfs": PSF} | changes
    names = {"Observation": lnocl.Observation, "given": given}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        # Compiled, so that the line which calls is the only one in its file.
        exec(compile("observation = Observation(**given)", "caller.py", "exec"), names)
    for warning in caught:
        assert warning.category is lnocl.LnoclWarning
        assert "\n" not in str(warning.message)
    return names["observation"], [str(w.message) for w in caught], {w.filename for w in caught}


@pytest.mark.parametrize("shape", [(7, 64, 3), (64, 7, 3), (64, 64, 5), (3, 64, 64)])
def test_narrow_images_are_images(shape):
    observation = lnocl.Observation(np.ones(shape), np.ones((1, 1)))
    assert observation.images.shape == shape


def test_non_finite_pixels_are_masked_and_counted():
    images = IMAGES.copy()
    images[0, 0, :3] = np.nan, np.inf, -np.inf
    images[1, 1, 1] = np.nan
    images[2, 2, 2] = np.nan  # known to be bad
    mask = np.zeros(IMAGES.shape, bool)
    mask[2, 2, 2:] = True
    observation, messages, files = announced(images=images, mask=mask)
    assert messages == ["4 image pixels are not finite and were masked"]
    assert files == {"caller.py"}
    np.testing.assert_array_equal(observation.mask, ~np.isfinite(images) | mask)
    assert (observation.images[observation.mask] == 0).all()


@pytest.mark.parametrize(("read_noise", "count"), [(0, 5), (1, 4), ([1, 2, 1], 1)])
def test_negative_counts_are_set_to_zero_and_counted(read_noise, count):
    images = IMAGES.copy()
    images[0, 0, 0] = -1.0
    images[1, 0] = -2.0, -2.5, -3.0, -5.0
    images[2, 3, 3] = -1e9  # known to be bad
    observation, messages, files = announced(
        images=images, read_noise=read_noise, mask=IMAGES == 48
    )
    assert len(messages) == 1
    verbs = "pixel is negative and was" if count == 1 else "pixels are negative and were"
    assert messages[0].startswith(f"{count} image {verbs} set to 0")
    assert files == {"caller.py"}
    variance = np.broadcast_to(np.square(read_noise), (3,))[:, None, None]
    expected = np.where(IMAGES == 48, 0.0, np.maximum(images + variance, 0.0))
    np.testing.assert_array_equal(observation.images, expected)


def test_counts_raised_above_zero_by_read_noise_give_no_warning():
    observation, messages, _ = announced(images=np.full((4, 4), -1.0), read_noise=1.5)
    assert messages == []
    np.testing.assert_array_equal(observation.images, np.full((1, 4, 4), 1.25))


def test_maps_may_be_masked_where_the_images_are():
    bad = np.zeros(IMAGES.shape, bool)
    bad[:, 0, 1] = bad[1, 1, 1] = True
    images = np.ma.array(IMAGES, mask=bad)
    maps = np.ma.array(np.where(bad, np.nan, 2.0), mask=bad)
    one_for_all = np.ma.array(np.where(bad[0], np.nan, 2.0), mask=bad[0])
    for name in ("background", "exposure", "read_noise"):
        for given in (maps, one_for_all):
            found = lnocl.Observation(images, PSF, **{name: given})
            plain = lnocl.Observation(images, PSF, **{name: np.full(given.shape, 2.0)})
            for made in ("images", "background", "exposure", "mask"):
                np.testing.assert_array_equal(getattr(found, made), getattr(plain, made))
        with (
            pytest.warns(lnocl.LnoclWarning, match="3 image pixels are not finite"),
            pytest.raises(lnocl.InputError, match=f"{name} has 1 masked value; fill it"),
        ):
            lnocl.Observation(np.where(bad[0], np.nan, IMAGES), PSF, **{name: maps})


def test_without_more_there_is_no_background_and_an_exposure_of_one():
    observation = lnocl.Observation(IMAGES, PSF)
    assert observation.background.tolist() == [0.0] * 3
    assert observation.exposure.tolist() == [1.0] * 3


def test_single_pixels_are_announced_in_the_singular():
    images = np.where(IMAGES == 7, np.nan, np.where(IMAGES == 9, -1.0, IMAGES))
    _, messages, _ = announced(images=images, psfs=np.where(PSF == 2, -0.8, PSF))
    assert messages[0] == "1 image pixel is not finite and was masked"
    assert messages[1].startswith("1 psf pixel is negative and was kept: 15 % of the light")
    assert messages[2].startswith("1 image pixel is negative and was set to 0; if the sky was ")


def test_few_negative_psf_pixels_are_noted_but_not_warned_of(caplog):
    psf = np.where(PSF == 2, -0.1, PSF)
    with caplog.at_level("INFO", "lnocl"):
        assert announced(psfs=psf)[1] == []
    share = 0.1 / psf.sum()
    assert f"kept: {100 * share:.2g} % of the light of a PSF at most" in caplog.text


def test_negative_psf_pixels_are_preserved_and_counted():
    psfs = np.array([PSF, PSF, PSF])
    psfs[1:, 0, 0] = -0.8
    observation, messages, files = announced(psfs=psfs)
    assert messages == [
        "2 psf pixels are negative and were kept: 11 % of the light of a PSF at most"
    ]
    assert files == {"caller.py"}
    np.testing.assert_allclose(observation.psfs[1:], psfs[1:] / 7.2, rtol=3e-16)
    np.testing.assert_array_equal(observation.psfs[0], PSF / 8)


@pytest.mark.parametrize("maps", [False, True])
def test_the_arrays_of_an_observation_are_read_only(maps):
    shape = (2, 4, 5)
    given = {"background": 1.0, "read_noise": 2.0, "exposure": 3.0}
    given = {name: np.full(shape, value) if maps else value for name, value in given.items()}
    observation = lnocl.Observation(np.ones(shape), np.ones((1, 1)), **given)
    names = arrays_of(observation)
    assert set(names) == {*FIELDS, "offsets", "turns"} - {
        "oversample",
        "effective_psfs",
        "psf_error",
    }
    for name in names:
        with pytest.raises(ValueError, match="read-only"):
            getattr(observation, name)[...] = 0
    for name, array in given.items():
        assert not maps or array.flags.writeable, name


def test_ideal_psfs_are_those_of_the_pupils():
    pupil = np.zeros((2, 3))
    pupil[1, 1] = 1.0
    observation = observe(pupils=pupil)
    assert observation.pupils.shape == observation.psfs.shape
    np.testing.assert_allclose(observation.ideal_psfs, 1.0 / 6.0)  # of one point
    given = observe(pupils=pupil, ideal_psfs=PSF)
    np.testing.assert_array_equal(given.ideal_psfs[0], PSF / PSF.sum())


def test_one_scatter_serves_all_images():
    scatter = observe(psf_scatter=0.1 * PSF).psf_scatter
    np.testing.assert_array_equal(scatter, [0.1 * PSF] * len(IMAGES))
    assert observe(psf_scatter=0.0 * PSF).psf_scatter.shape == (0, *PSF.shape)


def a_made_psf(side=3, share=0.1):
    psf = np.ones((side, side)) / side**2
    return SimpleNamespace(psf=psf, scatter=share * psf)


def test_psfs_that_were_made_bring_their_scatter():
    images, made = IMAGES[:2], a_made_psf()
    for psfs in (made, [made, made]):
        found = lnocl.Observation(images, psfs, psf_error=0.03)
        np.testing.assert_array_equal(found.psf_scatter, [made.scatter] * 2)
        np.testing.assert_array_equal(found.psfs, [made.psf] * 2)
    told = lnocl.Observation(images, made, psf_error=0.03, psf_scatter=np.full((3, 3), 0.5))
    np.testing.assert_array_equal(told.psf_scatter, np.full((2, 3, 3), 0.5))


def test_exact_psfs_have_no_scatter():
    assert not len(lnocl.Observation(IMAGES, a_made_psf(), psf_error=0.0).psf_scatter)


def test_psfs_of_several_shapes_with_and_without_scatter_may_be_mixed():
    made, other = a_made_psf(5), np.ones((3, 3))
    found = lnocl.Observation(np.ones((2, 8, 8)), [other, made], psf_error=0.03)
    np.testing.assert_array_equal(found.psfs[0], np.pad(other / 9, 1))
    np.testing.assert_array_equal(found.psf_scatter, [np.zeros((5, 5)), made.scatter])


# --- Another observation, checked


def two_images(**known):
    images = np.full((2, 8, 9), 5.0)
    return lnocl.Observation(images, np.ones((3, 3)), background=1.0, read_noise=2.0, **known)


def test_replace_shares_all_else_and_takes_values_as_they_are():
    given = two_images(psf_scatter=np.ones((3, 3)))
    images, psfs = np.full((2, 8, 9), 7.0), np.full((2, 3, 3), 0.2)
    other = given.replace(images=images, psfs=psfs)
    for name in ("images", "psfs"):
        assert np.shares_memory(getattr(other, name), {"images": images, "psfs": psfs}[name])
        assert not getattr(other, name).flags.writeable
    assert images.flags.writeable
    np.testing.assert_array_equal(other.psfs, psfs)
    for name in ("mask", "background", "read_noise", "exposure", "offsets", "psf_scatter"):
        assert getattr(other, name) is getattr(given, name)
    np.testing.assert_array_equal(given.images, 9.0)  # 5 and the square of the read noise


def test_replace_leaves_nothing_in_bad_pixels():
    mask = np.zeros((2, 8, 9), bool)
    mask[1, 2, 3] = True
    given = two_images()
    other = given.replace(mask=mask)
    np.testing.assert_array_equal(other.images, np.where(mask, 0.0, 9.0))
    np.testing.assert_array_equal(given.images, 9.0)


def test_replace_keeps_one_psf_for_all_images_in_one():
    other = two_images().replace(background=np.array([1.0, 2.0]))
    assert other.psfs.strides[0] == 0
    assert pickle.loads(pickle.dumps(other)).psfs.shape == (2, 3, 3)


def test_replacing_psfs_by_another_shape_requires_their_related_arrays():
    given = two_images(psf_scatter=np.ones((3, 3)), pupils=np.ones((3, 3)))
    with pytest.raises(InputError, match=r"^pupils has shape \(2, 3, 3\); give \(5, 5\), the"):
        given.replace(psfs=np.ones((2, 5, 5)))
    other = given.replace(psfs=np.ones((2, 5, 5)), ideal_psfs=None, pupils=None, psf_scatter=None)
    assert other.pupils.shape == other.psf_scatter.shape == (0, 5, 5)
    assert other.psf_modes.shape == (2, 0, 5, 5)


def test_replaced_psfs_are_the_same_all_over():
    field = lnocl.PsfField(np.ones((2, 3, 3)), [(0, 0), (8, 0)])
    given = lnocl.Observation(np.ones((8, 9)), field)
    assert given.replace(background=np.array([2.0])).psf_fields
    assert not given.replace(psfs=given.psfs).psf_fields


MASK_89 = np.indices((8, 9)).sum(axis=0) < 3
MASK_89[7, 7:] = True
HALO_89 = np.exp(-np.hypot(*(np.indices((8, 9)) - 3.4)))
PUPIL = np.pad(np.ones((2, 2)), 1)[:3, :3]
TURNED = lnocl.rotations([0.0, 30.0], (4, 3))
# Wrong values of each parameter that replace takes; images are of 8 rows, and 9 columns.
WRONG = {
    "psf_error": [-0.01, 0.31, np.nan, [0.1, 0.2], "x"],
    "images": [
        np.ones((8, 9), complex),
        [[1.0], [2.0, 3.0]],
        np.ones(9),
        np.ones((0, 8, 9)),
        np.full((2, 8, 9), 1e31),
        np.ma.masked_all((2, 8, 9)),
        np.full((2, 8, 9), 5.0) * u.adu,
    ],
    "mask": [np.ones((2, 8, 9)), np.ones((2, 8, 9), bool), np.ones((8, 8), bool), "all"],
    "psfs": [
        np.full((2, 3, 3), np.nan),
        np.zeros((2, 3, 3)),
        -np.ones((3, 3)),
        np.ones((3, 3, 3)),
        np.ones(3),
        np.ma.masked_all((3, 3)),
        [lnocl.PsfField(np.ones((1, 3, 3)), [(0, 0)])] * 3,
    ],
    "background": [-1.0, [1.0, np.nan], np.ones(3), np.ones((3, 8, 9)), 1e31, 3 * u.adu, None],
    "background_error": [-1.0, [1.0, np.nan], np.ones(3), np.ones((2, 8, 9)), 3 * u.adu],
    "read_noise": [-1.0, np.full(2, np.inf), np.ones((8, 8)), 1e200, 3 * u.s],
    "exposure": [0.0, [1.0, -1.0], np.ones(3), np.zeros((8, 9)), 3 * u.m, "long"],
    "offsets": [np.zeros((3, 2)), [(0, 0), (9, 0)], [(0, 0), (0, np.nan)], np.eye(2) * u.arcsec],
    "transforms": [
        np.ones((1, 2, 3)),
        np.full((2, 2, 3), np.nan),
        [np.eye(2, 3), [(1.0, 0.2, 0.0), (0.0, 1.0, 0.0)]],
        [np.eye(2, 3), 2.0 * np.eye(2, 3)],
        [np.eye(2, 3), 0.5 * np.eye(2, 3)],
    ],
    "components": [
        {"line": [1, 0, 0], "continuum": [1, 1, 1]},
        {"line": [1, 0], "continuum": [1, -1]},
        {"line": [1, 0], "continuum": [1, np.nan]},
        {"line": [1, 0], "continuum": [2, 0]},
        {"line": [1, 1], "continuum": [1, 1]},
        {"line": [1, 0], "continuum": [0, 0]},
        {"line": [1, 0], "continuum": "all"},
        {"line": [1, 0], "": [1, 1]},
        {"line": [1, 0], "continuum": [1, 1], "scattered": [0, 1]},
        {"line": [1, 1]},
        {},
        [[1, 0], [1, 1]],
    ],
    "component_errors": [{"line": 0.1}, [[0.1, 0.1]], 0.1, "all"],
    "epochs": [[0], [0, 1, 2], [None, "a"], [0.0, np.nan], "ab", [[1], [2, 3]]],
    "halos": [np.ones((8, 8)), -np.ones((8, 9)), np.zeros((8, 9)), np.full((8, 9), np.nan)],
    "transmission": [
        np.ones((8, 8)),
        np.ones((3, 8, 9)),
        np.full((8, 9), 1.1),
        np.full((8, 9), -0.1),
        np.full((8, 9), np.nan),
        np.zeros((8, 9)),
        np.ma.masked_all((8, 9)),
        1.0,
    ],
    "oversample": [3, 0, 2.0, None],
    "effective_psfs": [1, None],
    "ideal_psfs": [np.ones((5, 5)), np.zeros((3, 3)), np.full((3, 3), np.inf), np.ones((3, 3, 3))],
    "pupils": [-PUPIL, np.zeros((3, 3)), np.ones((2, 5, 5)), np.ones((3, 3, 3))],
    "psf_modes": [np.ones((2, 4, 5, 5)), np.ones(3), np.full((1, 3, 3), np.nan)],
    "psf_scatter": [-np.ones((2, 3, 3)), np.ones((3, 3, 3))],
    "star_psfs": [np.full((3, 3), 0.1), np.full((1, 2, 3, 3), 0.1), np.ones(3)],
    "star_places": [np.ones(3), [(0.0, np.nan)], [(1.0, 1.0)], np.eye(2) * u.arcsec],
}


def error_of(make, **changes):
    with pytest.raises(InputError) as caught:
        make(**changes)
    assert "\n" not in str(caught.value)
    return str(caught.value)


WRONG_BESIDE_COMPONENTS = [
    {"lines": 0.1},
    {"line": -0.1},
    {"line": [0.1, np.nan]},
    {"line": [0.1, 0.1, 0.1]},
    np.zeros((2, 3)),
    np.full((2, 2), np.inf),
]


@pytest.mark.parametrize("errors", WRONG_BESIDE_COMPONENTS, ids=str)
def test_errors_of_weights_are_refused_alike(errors):
    given = {"images": np.full((2, 8, 9), 5.0), "psfs": np.ones((3, 3))}
    given["components"] = {"line": [1, 0], "continuum": [1, 1]}
    wrong = error_of(lnocl.Observation, **given, component_errors=errors)
    assert error_of(lnocl.Observation(**given).replace, component_errors=errors) == wrong


@pytest.mark.parametrize("name", WRONG)
def test_replace_gives_the_same_errors_as_a_new_observation(name):
    given = {"images": np.full((2, 8, 9), 5.0), "psfs": np.ones((3, 3)), "background": [1.0, 2.0]}
    observation = lnocl.Observation(**given)
    for values in WRONG[name]:
        wrong = error_of(lnocl.Observation, **{**given, name: values})
        assert error_of(observation.replace, **{name: values}) == wrong


def test_replace_takes_every_parameter_but_the_treatment_of_centres():
    names = set(inspect.signature(lnocl.Observation).parameters)
    assert set(WRONG) == names - {"psf_centre"}


def test_every_parameter_is_a_row_of_the_table_of_fields():
    names = set(inspect.signature(lnocl.Observation).parameters)
    assert {*FIELDS, *MOVES} == names - {"psf_centre"}


LINE_AND_CONTINUUM = {"line": [1, 0], "continuum": [1, 1]}
RIGHT = {
    "mask": MASK_89,
    "background": np.where(MASK_89, 0.0, 3.0),
    "exposure": [1.0, 1.5] * u.min,
    "offsets": [(0.0, 0.0), (1.5, -2.0)],
    "transforms": TURNED,
    "components": LINE_AND_CONTINUUM,
    "component_errors": {"continuum": [0.1, 0.0]},
    "epochs": ["second", "first"],
    "halos": HALO_89,
    "oversample": 2,
    "effective_psfs": True,
    "pupils": PUPIL,
    "psf_modes": np.arange(9.0).reshape(1, 3, 3),
    "psf_scatter": np.arange(9.0).reshape(3, 3),
}


def made(make, **given):
    """Return what all attributes hold, or why it is refused."""
    try:
        observation = make(**given)
    except InputError as error:
        return {"refused": str(error)}
    others = ("oversample", "effective_psfs", "sky_shape", "transforms")
    return arrays_of(observation) | {name: getattr(observation, name) for name in others}


@pytest.mark.parametrize("name", RIGHT)
@pytest.mark.parametrize("before", [None, *RIGHT])
def test_replace_equals_a_new_observation(name, before):
    given = {"images": np.full((2, 8, 9), 5.0), "psfs": np.ones((2, 3, 3))}
    if before:
        given[before] = RIGHT[before]
    if before == "component_errors":
        given["components"] = LINE_AND_CONTINUUM
    other = made(lnocl.Observation(**given).replace, **{name: RIGHT[name]})
    if name == "transforms":  # which take the place of offsets
        given.pop("offsets", None)
    if name == "components":  # which bring theirs
        given.pop("epochs", None)
        given.pop("component_errors", None)
    new = made(lnocl.Observation, **{**given, name: RIGHT[name]})
    assert other.keys() == new.keys()
    for attribute, expected in new.items():
        if attribute == "halos" and expected.size:  # of unit sum, before and with another mask
            np.testing.assert_allclose(other[attribute], expected, rtol=2e-16)
        else:
            np.testing.assert_array_equal(other[attribute], expected, err_msg=attribute)


@pytest.mark.parametrize(
    ("known", "changes", "message"),
    [
        ({}, {"image": 1.0}, "image cannot be replaced in an observation; what can is oversample"),
        ({}, {"turns": np.zeros((2, 2, 2))}, "turns cannot be replaced"),
        ({}, {"_is_checked": True}, "_is_checked cannot be replaced"),
        ({}, {"images": np.ones((2, 8, 8))}, "mask has shape (2, 8, 9); the images have (2, 8, 8)"),
        ({"transforms": TURNED}, {"offsets": np.eye(2)}, "transforms are not taken beside offsets"),
        (
            {"mask": MASK_89, "exposure": np.ones((8, 9))},
            {"mask": MASK_89 & False, "images": np.ones((2, 8, 9))},
            "mask frees 16 pixels of which nothing is held; give exposure with it",
        ),
        (
            {"mask": MASK_89},
            {"mask": None},
            "mask frees 16 pixels of which nothing is held",
        ),
        (
            {"mask": MASK_89, "halos": HALO_89},
            {"mask": None, "images": np.ones((2, 8, 9))},
            "mask frees 16 pixels of which nothing is held; give halos with it",
        ),
    ],
)
def test_replace_refuses_unknown_names_and_inconsistent_changes(known, changes, message):
    observation = lnocl.Observation(np.full((2, 8, 9), 5.0), np.ones((3, 3)), **known)
    assert message in error_of(observation.replace, **changes)


NOT_KNOWN = np.where(MASK_89, np.nan, 2.0)
UNKNOWN = {
    "images": {"images": np.broadcast_to(NOT_KNOWN, (2, 8, 9))},
    "exposure": {"exposure": np.where(MASK_89, 0.0, 2.0)},
    "read_noise": {"read_noise": StdDevUncertainty(np.where(MASK_89, 0.0, 2.0))},
}


@pytest.mark.filterwarnings("ignore:.* image pixels are not finite")
@pytest.mark.parametrize("marks", UNKNOWN)
@pytest.mark.parametrize("name", ["background", "exposure", "read_noise", "halos"])
def test_whatever_shows_bad_pixels_shows_them_to_all_others(marks, name):
    """In an observation and in one that is replaced, by whatever comes first."""
    given = {"images": np.full((2, 8, 9), 5.0), "psfs": np.ones((3, 3))}
    changes = {name: np.ma.array(NOT_KNOWN, mask=MASK_89), **UNKNOWN[marks]}
    found = lnocl.Observation(**{**given, **changes})
    np.testing.assert_array_equal(found.mask, [MASK_89] * 2)
    replaced = lnocl.Observation(**given).replace(**changes)
    for attribute in ("mask", "exposure", "read_noise", "halos"):
        expected = getattr(found, attribute)
        np.testing.assert_array_equal(getattr(replaced, attribute), expected, err_msg=attribute)


def test_replaced_counts_per_time_are_multiplied_by_the_exposure():
    given = {"images": np.full((2, 8, 9), 5.0), "psfs": np.ones((3, 3))}
    changes = {
        "images": np.full((2, 8, 9), 7.0) * u.electron / u.s,
        "background": np.array([0.5, 1.0]) * u.electron / u.min,
        "exposure": [60.0, 30.0] * u.s,
    }
    other = lnocl.Observation(**given).replace(**changes)
    expected = lnocl.Observation(**{**given, **changes})
    for name, values in arrays_of(expected).items():
        np.testing.assert_array_equal(getattr(other, name), values, err_msg=name)


def test_replaced_offsets_stay_where_images_are_turned_no_more():
    observation = lnocl.Observation(np.full((2, 8, 9), 5.0), np.ones((3, 3)), transforms=TURNED)
    other = observation.replace(transforms=None, offsets=[(0, 1), (2, 3)])
    np.testing.assert_array_equal(other.offsets, [(0, 1), (2, 3)])
    assert not other.is_mapped


def test_a_replaced_mask_takes_the_light_of_halos_from_bad_pixels():
    observation = lnocl.Observation(np.full((2, 8, 9), 5.0), np.ones((3, 3)), halos=HALO_89)
    other = observation.replace(mask=MASK_89)
    assert not other.halos[..., MASK_89].any()
    np.testing.assert_allclose(other.halos.sum(axis=(2, 3)), 1.0, rtol=1e-15)


# --- Epochs


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ([None, "a"], "epochs holds labels without an order, of NoneType and str; give numbers "),
        ([None, None], "epochs holds labels without an order, of NoneType; give numbers alone"),
        ([60000.5, np.nan], "epochs holds a label that is not a number; give one, or a name"),
        (np.array(["2020-01-01", "NaT"], "M8[D]"), "epochs holds a label that is not a number"),
        (np.ma.array([1, 2], mask=[0, 1]), "epochs has 1 masked value"),
    ],
)
def test_epochs_without_a_label_are_refused(labels, message):
    wrong = error_of(lnocl.Observation, images=IMAGES[:2], psfs=PSF, epochs=labels)
    assert wrong.startswith(message)


# --- Bad pixels and where images lie


def sheared_images():
    """Return images, their bad pixels, and maps of them that are fitted to the good ones."""
    images, bad = np.arange(4000.0).reshape(2, 40, 50) % 9, np.zeros((2, 40, 50), bool)
    bad[1, :, :9], bad[1, 31:] = True, True
    sheared = np.array([np.eye(2, 3), [(1.0, 1e-3, 0.3), (2e-4, 1.0, -0.7)]])
    return images, bad, {"psfs": np.ones((3, 3)), "transforms": sheared}


def test_bad_pixels_are_the_same_however_they_are_marked():
    """The map of an image is fitted to its good pixels, so that these are known before."""
    images, bad, known = sheared_images()
    wanted = lnocl.Observation(images, mask=bad, **known)
    whole = lnocl.Observation(images, **known)
    assert abs(wanted.offsets - whole.offsets).max() > 1e-3  # so that it shows
    errors = np.where(bad, 0.0, 3.0)
    flagged = [CCDData(each, unit="electron", mask=m) for each, m in zip(images, bad, strict=True)]
    unknown = [
        CCDData(each, unit="electron", uncertainty=StdDevUncertainty(error))
        for each, error in zip(images, errors, strict=True)
    ]
    for given in (
        {"images": np.ma.array(images, mask=bad)},
        {"images": [np.ma.array(each, mask=m) for each, m in zip(images, bad, strict=True)]},
        {"images": flagged},
        {"images": unknown},
        {"images": images, "exposure": np.where(bad, 0.0, 1.0)},
        {"images": images, "read_noise": StdDevUncertainty(errors)},
    ):
        found = lnocl.Observation(**given, **known)
        np.testing.assert_array_equal(found.transforms, wanted.transforms)
        np.testing.assert_array_equal(found.mask, wanted.mask)
    with pytest.warns(lnocl.LnoclWarning, match="not finite and were masked"):
        found = lnocl.Observation(np.where(bad, np.nan, images), **known)
    np.testing.assert_array_equal(found.transforms, wanted.transforms)


def test_bad_pixels_that_are_replaced_are_those_of_a_new_observation():
    images, bad, known = sheared_images()
    whole = lnocl.Observation(images, **known)
    wanted = arrays_of(lnocl.Observation(images, mask=bad, **known))
    for changes in ({"mask": bad}, {"images": np.ma.array(images, mask=bad)}):
        found = arrays_of(whole.replace(**changes))
        for name, values in wanted.items():
            np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_bad_pixels_that_are_replaced_upright_are_those_of_a_new_observation():
    images, bad, known = sheared_images()
    quarter = np.array([(0.0, -1.0), (1.0, 0.0)])
    known["transforms"][1] = quarter @ known["transforms"][1] + [(0.0, 0.0, 49.0), (0.0, 0.0, 0.0)]
    wanted = lnocl.Observation(images, mask=bad, **known).upright()
    upright = lnocl.Observation(images, **known).upright()
    assert abs(wanted.offsets - upright.offsets).max() > 1e-3
    found = upright.replace(mask=wanted.mask)
    np.testing.assert_array_equal(found.images, wanted.images)
    np.testing.assert_allclose(found.turns, wanted.turns, atol=1e-15)
    np.testing.assert_allclose(found.offsets, wanted.offsets, atol=1e-13)


def test_a_window_of_turned_images_shows_places_where_the_whole_does():
    maps = lnocl.rotations([0.0, 30.0], (20, 15)) * [[[1.0]], [[0.5]]]
    psfs = np.ones((2, 3, 3))
    whole = lnocl.Observation(np.full((2, 40, 50), 5.0), psfs, transforms=maps)
    part = whole.window(range(4, 30), range(7, 47))
    assert part.shape == part.sky_shape == (26, 40)
    at, corner = np.array([(3.0, 4.0), (20.0, 11.5)]), (7, 4)
    for j in range(2):
        np.testing.assert_allclose(part.places(j, at) + corner, whole.places(j, at + corner))


def test_attributes_cannot_be_set():
    observation = two_images()
    with pytest.raises(AttributeError, match=r"replace\(psfs=\.\.\.\) returns another"):
        observation.psfs = np.ones((2, 3, 3))


def test_replace_refuses_images_with_an_uncertainty_of_any_shape():
    given = lnocl.Observation(np.ones((3, 12, 14)), np.ones((3, 3)))
    for shape in ((12, 14), (12, 12)):
        errors = StdDevUncertainty(np.full(shape, 2.0))
        images = CCDData(np.ones(shape), unit="electron", uncertainty=errors)
        with pytest.raises(InputError, match="with an uncertainty replace none; give read_noise"):
            given.replace(images=images)


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_read_noise_is_added_to_no_array_of_the_caller(dtype):
    images = np.full((2, 12, 14), 5.0, dtype)
    found = lnocl.Observation(images, np.ones((3, 3)), read_noise=3.0)
    assert (images == 5.0).all()
    assert (found.images == 14.0).all()
    assert not np.shares_memory(lnocl.Observation(images, np.ones((3, 3))).images, images)


def test_it_is_printed_as_given():
    obs = lnocl.Observation(
        np.full((2, 8, 10), 90.0), np.ones((3, 5)), background=[84.42, 86.0], read_noise=5.0,
        epochs=[1, 2],
    )  # fmt: skip
    assert str(obs).splitlines() == [
        "lnocl.Observation",
        "images: 2 of 10 x 8 pixels",
        "PSFs: 5 x 3 pixels",
        "background: 84.42 to 86",
        "read noise: 5",
        "bad pixels: 0 %",
        "epochs: 2",
    ]
