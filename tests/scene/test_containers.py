"""Astropy's containers are taken as their numbers in electrons, or refused in one line."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.nddata import (
    CCDData,
    InverseVariance,
    NDData,
    StdDevUncertainty,
    UnknownUncertainty,
    VarianceUncertainty,
)
from astropy.utils.masked import Masked

import lnocl
from lnocl.core.scene.fields import FIELDS

PSF = np.array([[0.0, 1.0, 0.0], [1.0, 4.0, 2.0]])
IMAGES = np.arange(1.0, 49.0).reshape(3, 4, 4)
MASK = IMAGES % 5 == 0
TIMES = np.array([10.0, 20.0, 40.0])


def observe(**changes):
    return lnocl.Observation(**({"images": IMAGES, "psfs": PSF} | changes))


def assert_same(observation, other):
    for name in (*FIELDS, "transforms"):
        values = getattr(other, name)
        np.testing.assert_array_equal(getattr(observation, name), values)
        assert type(getattr(observation, name)) is type(values)


# --- Units of counts


@pytest.mark.parametrize(
    ("unit", "electrons"),
    [
        (u.electron, 1.0),
        (u.photon, 1.0),
        (u.count, 1.0),
        (u.electron / u.pix, 1.0),
        (u.ct / u.pixel, 1.0),
        (u.dimensionless_unscaled, 1.0),
        (1024 * u.electron, 1024.0),
        (u.Unit(1 / 1024), 1 / 1024),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["array", "list", "integers"])
def test_counts(unit, electrons, kind):
    images = IMAGES.astype(int) if kind == "integers" else IMAGES
    given = [image * unit for image in images] if kind == "list" else images * unit
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        observation = observe(images=given, background=2 * unit, read_noise=[1, 2, 3] * unit)
    expected = {"images": electrons * IMAGES, "background": 2 * electrons}
    assert_same(observation, observe(**expected, read_noise=np.array([1, 2, 3]) * electrons))


@pytest.mark.parametrize("per", [1 / u.s, 1 / u.pix / u.s, 60 / u.min])
@pytest.mark.parametrize(
    ("exposure", "seconds"),
    [
        (TIMES * u.s, TIMES),
        (TIMES * 1000 * u.ms, TIMES),
        (list(TIMES * u.s), TIMES),
        (TIMES, TIMES),
        (TIMES * u.dimensionless_unscaled, TIMES),
        (8 * u.s, 8.0),
        (IMAGES * u.s, IMAGES),
        (NDData(IMAGES[0] * u.s), IMAGES[0]),
        (NDData(IMAGES), IMAGES),
        ([CCDData(image, unit=u.s) for image in IMAGES], IMAGES),
    ],
)
def test_counts_per_time_are_multiplied_by_the_exposure(exposure, seconds, per):
    each = seconds if np.ndim(seconds) != 1 else seconds[:, None, None]
    images = IMAGES / 8
    observation = observe(images=images * u.electron * per, exposure=exposure)
    assert_same(observation, observe(images=images * each, exposure=seconds))


@pytest.mark.parametrize("seconds", [TIMES, IMAGES / 4, 2.0], ids=["each", "map", "one"])
@pytest.mark.parametrize("rate", [0.5, np.array([0.5, 0.25, 2.0]), IMAGES / 8, IMAGES[2]])
def test_background_may_be_per_time(rate, seconds):
    exposed, each = (
        np.broadcast_to(v[:, None, None] if np.ndim(v) == 1 else v, IMAGES.shape)
        for v in (seconds, rate)
    )
    observation = observe(background=rate * u.ct / u.s, exposure=seconds * u.s)
    held = observation.background
    held = held[:, None, None] if held.ndim == 1 else held
    np.testing.assert_array_equal(np.broadcast_to(held, IMAGES.shape), each * exposed)
    np.testing.assert_array_equal(observation.images, IMAGES)


def test_masked_rates_stay_masked():
    images = np.where(MASK, np.inf, IMAGES) / u.s * u.electron
    exposure = np.where((IMAGES == 7) | (IMAGES == 10), 0.0, 4.0)  # one of them is masked
    observation = observe(images=images, mask=MASK, exposure=exposure * u.s)
    expected = observe(images=4.0 * IMAGES, mask=MASK | (IMAGES == 7), exposure=4.0)
    np.testing.assert_array_equal(observation.images, expected.images)
    np.testing.assert_array_equal(observation.mask, expected.mask)


# --- NDData


@pytest.mark.parametrize(
    "images",
    [
        NDData(IMAGES, mask=MASK),
        NDData(IMAGES, mask=MASK, unit=u.electron),
        NDData(np.ma.array(IMAGES, mask=MASK)),
        CCDData(IMAGES / 1024, mask=MASK, unit=1024 * u.photon),
        [CCDData(i, mask=m, unit="electron") for i, m in zip(IMAGES, MASK, strict=True)],
        tuple(NDData(i, mask=m) for i, m in zip(IMAGES, MASK, strict=True)),
        [np.ma.array(i, mask=m) for i, m in zip(IMAGES, MASK, strict=True)],
        Masked(IMAGES, mask=MASK),
        Masked(IMAGES, mask=MASK) * u.ct,
        [
            *(NDData(i, mask=m) for i, m in zip(IMAGES[:2], MASK[:2], strict=True)),
            np.ma.array(IMAGES[2], mask=MASK[2]),
        ],
    ],
)
def test_nddata_bring_their_mask_and_unit(images):
    assert_same(observe(images=images), observe(mask=MASK))
    more = IMAGES[0] > 9
    assert_same(observe(images=images, mask=more), observe(mask=MASK | more))


def test_nddata_without_a_mask_and_with_one_for_all():
    image = CCDData(IMAGES[0], unit="adu").multiply(2 * u.electron / u.adu)  # the gain
    assert_same(observe(images=image), observe(images=2 * IMAGES[0]))
    images = [NDData(IMAGES[0]), NDData(IMAGES[1], mask=MASK[1]), IMAGES[2].tolist()]
    mask = MASK * np.array([0, 1, 0], bool)[:, None, None]
    assert_same(observe(images=images), observe(mask=mask))
    dead = [NDData(IMAGES[0]), NDData(IMAGES[1], mask=True)]
    np.testing.assert_array_equal(observe(images=dead).mask, [MASK[0] & False, MASK[0] | True])


# --- Uncertainties

# Of all noise: the counts, and a read noise that differs from pixel to pixel.
READ_NOISE = 1.0 + IMAGES % 3
VARIANCE = IMAGES + READ_NOISE**2
BY_CLASS = {
    StdDevUncertainty: np.sqrt,
    VarianceUncertainty: np.array,
    InverseVariance: np.reciprocal,
}


def assert_nearly_same(found, expected):
    for name in ("images", "background", "read_noise", "exposure"):
        values = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(*values, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(found.mask, expected.mask)


@pytest.mark.parametrize(("kind", "of_variance"), BY_CLASS.items())
class TestUncertainties:
    def test_of_images_have_the_noise_of_the_counts(self, kind, of_variance):
        image = CCDData(IMAGES, unit="electron", uncertainty=kind(of_variance(VARIANCE)))
        assert_nearly_same(observe(images=image), observe(read_noise=READ_NOISE))

    def test_follow_the_unit_and_the_exposure(self, kind, of_variance):
        unit = 4 * u.electron / u.s
        per_unit = 4.0 * TIMES[:, None, None]
        images = [
            CCDData(i, unit=unit, uncertainty=kind(of_variance(v)))
            for i, v in zip(IMAGES / per_unit, VARIANCE / per_unit**2, strict=True)
        ]
        found = observe(images=images, exposure=TIMES)
        assert_nearly_same(found, observe(read_noise=READ_NOISE, exposure=TIMES))

    def test_of_another_unit_are_converted(self, kind, of_variance):
        power = {StdDevUncertainty: 1, VarianceUncertainty: 2, InverseVariance: -2}[kind]
        unit = (2 * u.electron) ** power
        noise = kind(of_variance(VARIANCE / 4.0), unit=unit)
        image = NDData(IMAGES, unit="electron", uncertainty=noise)
        assert_nearly_same(observe(images=image), observe(read_noise=READ_NOISE))

    def test_of_read_noise_leave_the_counts_out(self, kind, of_variance):
        noise = kind(of_variance(READ_NOISE**2))
        assert_nearly_same(observe(read_noise=noise), observe(read_noise=READ_NOISE))

    @pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
    def test_mark_bad_pixels(self, kind, of_variance, value):
        bad = IMAGES % 7 == 0
        uncertain = np.where(bad, value, of_variance(VARIANCE))
        image = NDData(IMAGES, uncertainty=kind(uncertain))
        assert_nearly_same(observe(images=image), observe(read_noise=READ_NOISE, mask=bad))
        known = kind(np.where(bad, value, of_variance(READ_NOISE**2)))
        expected = observe(read_noise=READ_NOISE, mask=bad)
        assert_nearly_same(observe(read_noise=known), expected)

    def test_are_never_modified(self, kind, of_variance):
        given = of_variance(VARIANCE)
        image = NDData(IMAGES, uncertainty=kind(given.copy()))
        observe(images=image)
        np.testing.assert_array_equal(image.uncertainty.array, given)


def test_uncertainties_below_the_photon_noise_give_no_read_noise():
    variance = np.where(IMAGES == 9, 0.9 * IMAGES, VARIANCE)
    image = NDData(IMAGES, uncertainty=VarianceUncertainty(variance))
    assert_nearly_same(observe(images=image), observe(read_noise=READ_NOISE * (IMAGES != 9)))


STDDEV = StdDevUncertainty(np.sqrt(VARIANCE))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"images": NDData(IMAGES, uncertainty=StdDevUncertainty(READ_NOISE / 9))},
            "the uncertainty of image 0 is less than the noise of its counts in most pixels",
        ),
        ({"images": NDData(IMAGES, uncertainty=STDDEV), "read_noise": 1.0}, "give read_noise, or"),
        (
            {"images": NDData(IMAGES, uncertainty=UnknownUncertainty(VARIANCE))},
            "images has an uncertainty of the class UnknownUncertainty; make it",
        ),
        (
            {"images": [NDData(IMAGES[0], uncertainty=StdDevUncertainty(IMAGES[0])), IMAGES[1]]},
            "some of images have an uncertainty",
        ),
        (
            {"images": NDData(IMAGES, uncertainty=StdDevUncertainty(-VARIANCE))},
            "the uncertainty of images has negative values",
        ),
        (
            {"images": NDData(IMAGES, uncertainty=StdDevUncertainty(VARIANCE[0]))},
            r"images have an uncertainty of shape \(4, 4\)",
        ),
        (
            {"read_noise": StdDevUncertainty(READ_NOISE, unit="adu")},
            "the uncertainty of read_noise is in adu; give it in counts",
        ),
        (
            {"read_noise": StdDevUncertainty(READ_NOISE, unit="electron / s"), "exposure": TIMES},
            "the uncertainty of read_noise is in electron / s; give it in counts",
        ),
    ],
)
def test_uncertainties_that_are_refused(given, message):
    with pytest.raises(lnocl.InputError, match=f"^{message}"):
        observe(**given)


def test_nddata_are_never_modified():
    image = CCDData(IMAGES[0].copy(), unit="electron", mask=MASK[0].copy())
    observation = observe(images=image, mask=IMAGES[0] < 5)
    np.testing.assert_array_equal(image.data, IMAGES[0])
    np.testing.assert_array_equal(image.mask, MASK[0])
    assert not np.shares_memory(image.data, observation.images)
    assert not np.shares_memory(image.mask, observation.mask)


@pytest.mark.parametrize(
    "psfs",
    [
        PSF * u.m,
        NDData(PSF),
        CCDData(PSF, unit="adu"),
        [CCDData(PSF, unit="adu")] * 3,
        [PSF * u.Jy] * 3,
        [NDData(PSF, mask=PSF == 9)] * 3,
    ],
)
def test_units_of_psfs_do_not_matter(psfs):
    assert_same(observe(psfs=psfs), observe())


@pytest.mark.parametrize("unit", [u.pix, 2 * u.pix])
def test_offsets_may_be_pixels(unit):
    offsets = np.array([(0, 0), (1.5, -0.5), (-1, 1)])
    expected = observe(offsets=offsets * unit.to(u.pix))
    for given in (offsets * unit, [tuple(pair * unit) for pair in offsets]):
        assert_same(observe(offsets=given), expected)
    assert_same(observe(offsets=NDData(offsets)), observe(offsets=offsets))


# --- What is refused


@pytest.mark.parametrize(
    "wrap",
    [
        NDData,
        lambda values, mask: NDData(values, mask=mask, unit=u.dimensionless_unscaled),
        lambda values, mask: CCDData(values, mask=mask, unit=u.dimensionless_unscaled),
        lambda values, mask: NDData(np.ma.array(values, mask=mask)),
        lambda values, mask: [NDData(v, mask=m) for v, m in zip(values, mask, strict=True)],
        lambda values, mask: Masked(values, mask=mask),
        lambda values, mask: Masked(values, mask=mask) * u.dimensionless_unscaled,
    ],
    ids=["NDData", "with a unit", "CCDData", "NDData of numpy.ma", "list", "Masked", "quantity"],
)
@pytest.mark.parametrize("name", ["psfs", "background", "read_noise", "exposure"])
def test_only_images_may_be_masked(name, wrap):
    values = IMAGES / 8
    assert_same(observe(**{name: wrap(values, mask=MASK & False)}), observe(**{name: values}))
    with pytest.raises(lnocl.InputError, match=f"^{name} has 9 masked values; [^\n]*$"):
        observe(**{name: wrap(values, mask=MASK)})


@pytest.mark.parametrize("rate", [1e200, IMAGES[0] * 1e200, IMAGES * 1e200])
@pytest.mark.parametrize("name", ["images", "background"])
def test_counts_of_an_exposure_that_no_number_holds_are_refused(name, rate):
    given = {"images": IMAGES[:1], "exposure": 1e200 * u.s}
    rate = rate[:1] if np.ndim(rate) == 3 else rate
    given[name] = np.broadcast_to(rate, (1, 4, 4)) * u.ct / u.s
    with pytest.raises(lnocl.InputError, match=f"the {name}, with exposure and the square of read"):
        observe(**given)


REFUSED = [
    (
        {"images": IMAGES * u.adu / u.s, "exposure": 1 * u.s},
        "images must be counts per pixel, not adu / s; multiply by the gain",
    ),
    ({"images": IMAGES * u.DN}, "multiply by the gain (electrons per adu)"),
    ({"images": [image * u.adu for image in IMAGES]}, "images must be counts per pixel, not adu"),
    ({"images": IMAGES * u.Jy}, "images must be counts per pixel, not Jy; give electrons"),
    (
        {"images": IMAGES * u.electron / u.s},
        "images in electron / s are counts per time; give exposure in seconds with them",
    ),
    (
        {"background": 2 * u.electron / u.s},
        "background in electron / s are counts per time; give exposure in seconds with them",
    ),
    ({"background": NDData(IMAGES, unit="adu")}, "background must be counts per pixel, not adu"),
    ({"read_noise": 2 * u.adu}, "read_noise must be counts per pixel, not adu"),
    (
        {"read_noise": 2 * u.electron / u.s, "exposure": 2 * u.s},
        "read_noise in electron / s are counts per time; give electrons",
    ),
    ({"exposure": 2 * u.m}, "exposure must be in seconds, not in m"),
    (
        {"exposure": [2 * u.s, 2 * u.m, 1 * u.s]},
        "exposure come in several units (s, m); give them in one",
    ),
    ({"offsets": [(1 * u.arcsec, 1 * u.arcsec)] * 3}, "offsets must be in pixels, not in arcsec"),
    (
        {"images": [CCDData(i, unit=n) for i, n in zip(IMAGES, ("ct", "adu", "ct"), strict=True)]},
        "images come in several units (ct, adu); give them in one",
    ),
    (
        {"images": [CCDData(IMAGES[0], unit="electron"), IMAGES[1]]},
        "images come in several units (electron, None); give them in one",
    ),
    (
        {"images": [CCDData(IMAGES[0], unit="ct"), CCDData(IMAGES[1, 1:], unit="ct")]},
        "images cannot be read as an array: their shapes differ",
    ),
    (
        {"images": NDData(IMAGES, mask=MASK[:, 1:])},
        "images have a mask of shape (3, 3, 4); their data have (3, 4, 4)",
    ),
    (
        {"psfs": [PSF * u.m, PSF * u.s, PSF * u.s]},
        "psfs come in several units (m, s); give them in one",
    ),
    (
        {"images": u.Magnitude(IMAGES * u.ct)},
        "images in mag(ct) are not linear; give them in linear units, as physical does of a Mag",
    ),
    (
        {"exposure": u.Decibel(TIMES * u.s)},
        "exposure in dB(s) are not linear; give them in linear units",
    ),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_refused(changes, message):
    with pytest.raises(lnocl.InputError) as caught:
        observe(**changes)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
