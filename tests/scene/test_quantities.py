"""Quantities and angles are taken in the unit that is asked for, or refused in one line."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import Angle
from astropy.nddata import CCDData

import lnocl
from lnocl import metrics
from lnocl.detection import find_stars
from lnocl.psf import examine, find_modes, make_psf, make_psfs
from lnocl.simulation import Target

Y, X = np.indices((17, 17)) - 8
PSF = np.exp(-(X**2 + (Y - 0.4 * X) ** 2) / 6.0)
FRAME = np.random.default_rng(0).poisson(10.0, (40, 44)).astype(float)
FRAME[10:27, 14:31] += np.round(3000 * PSF)
IMAGES = np.stack([FRAME, 2 * FRAME])
HALF = np.degrees(0.5)


def observe(**changes):
    return lnocl.Observation(**({"images": IMAGES, "psfs": PSF} | changes))


@pytest.mark.parametrize(
    ("angles", "degrees"),
    [
        ([0.5] * u.rad, [HALF]),
        ([0.5, 2.0] * u.hourangle, [7.5, 30.0]),
        ([0.5 * u.rad, 90.0 * u.deg], [HALF, 90.0]),
        ([30.0 * u.arcmin], [0.5]),
        (Angle(["0d30m", "1h"]), [0.5, 15.0]),
        ([Angle("0d30m"), Angle("1h")], [0.5, 15.0]),
        ([0.5] * u.dimensionless_unscaled, [0.5]),
        (np.array([30.0]), [30.0]),
    ],
)
def test_rotations_are_by_any_unit_of_angle(angles, degrees):
    for centre in ((3.0, 4.0), (3.0, 4.0) * u.pix, [3.0 * u.pix, 4.0 * u.pix]):
        found = lnocl.rotations(angles, centre)
        np.testing.assert_allclose(found, lnocl.rotations(degrees, (3.0, 4.0)), rtol=1e-13)


def psf_of(**given):
    return make_psf(FRAME * u.adu, size=11, **given).psf


def a_field(positions):
    return lnocl.PsfField([PSF, PSF.T], positions).at(25.0, 3.0)


# What is given with a unit, and the same without.
ALIKE = {
    "offsets": (
        lambda v: observe(offsets=v).offsets,
        [(1.0, 2.0), (0.0, -3.0)] * u.pix,
        [(1, 2), (0, -3)],
    ),
    "exposure": (lambda v: observe(exposure=v).exposure, [3 * u.min, 30 * u.s], [180, 30]),
    "replaced exposure": (
        lambda v: observe().replace(exposure=v).exposure,
        [3, 0.5] * u.min,
        [180.0, 30.0],
    ),
    "replaced offsets": (
        lambda v: observe().replace(offsets=v).offsets,
        [(1, 2), (0, -3)] * u.pix,
        [(1, 2), (0, -3)],
    ),
    "replaced images": (
        lambda v: observe().replace(images=v).images,
        IMAGES / 1000 * u.Unit("1000 ct"),
        IMAGES,
    ),
    "nodes": (a_field, [(0, 0), (100, 0)] * u.pix, [(0, 0), (100, 0)]),
    "place": (
        lambda v: lnocl.PsfField([PSF, PSF.T], [(0, 0), (100, 0)]).at(v, v),
        25 * u.pix,
        25,
    ),
    "rotate": (lambda v: psf_of(rotate=v), 0.5 * u.rad, HALF),
    "rotate several": (
        lambda v: make_psfs(FRAME, v, size=11)[1].psf,
        [0.1, 0.5] * u.rad,
        np.degrees([0.1, 0.5]),
    ),
    "position": (lambda v: psf_of(position=v), (22, 18) * u.pix, (22, 18)),
    "background": (lambda v: psf_of(background=v), 0.012 * u.Unit("1000 adu"), 12.0),
    "saturation": (lambda v: psf_of(saturation=v), 5 * u.Unit("1000 adu"), 5000.0),
    "stars' saturation": (
        lambda v: len(find_stars(CCDData(FRAME, unit="adu"), PSF, saturation=v)),
        5 * u.Unit("1000 adu"),
        5000.0,
    ),
    "threshold": (lambda v: len(find_stars(FRAME, PSF, threshold=v)), 500 * u.percent, 5.0),
    "psf": (lambda v: examine(v).lines(), PSF * u.m, PSF),
    "modes": (
        lambda v: find_modes(v, 1).share,
        np.array([PSF, PSF**1.1, PSF.T]) / u.sr,
        [PSF, PSF**1.1, PSF.T],
    ),
    "truth": (
        lambda v: metrics.restoration_error(FRAME * u.m, v),
        IMAGES[1] * u.km / 1000,
        IMAGES[1],
    ),
    "star": (lambda v: metrics.mask_star(FRAME, v), (3, 4) * u.pix, (3, 4)),
    "magnitude": (lambda v: metrics.magnitude(30 * u.Jy, v), 3000 * u.mJy, 3.0),
    "profile": (metrics.flux_profile, FRAME * u.m, FRAME),
    "extended": (lambda v: Target(v[:, :40]).extended, FRAME * u.m, FRAME),
}


@pytest.mark.parametrize("case", ALIKE)
def test_a_quantity_is_taken_in_its_unit(case):
    taken, given, plain = ALIKE[case]
    found, expected = taken(given), taken(plain)
    if isinstance(expected, list):
        assert found == expected
    else:
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


MAPS = np.broadcast_to(np.eye(2, 3), (2, 2, 3))
REFUSED = {
    "angles must be in degrees, not in m": lambda: lnocl.rotations([5.0] * u.m, (1, 2)),
    "centre must be in pixels, not in arcsec; convert them with the WCS of the images": lambda: (
        lnocl.rotations([5.0], (1, 2) * u.arcsec)
    ),
    "angles come in several units (deg, pix); give them in one": lambda: lnocl.rotations(
        [5.0 * u.deg, 3 * u.pix], (1, 2)
    ),
    "transforms must be numbers without a unit, not in arcsec": lambda: observe(
        transforms=MAPS * u.arcsec
    ),
    "positions must be in pixels, not in arcsec; convert them with the WCS of the images": (
        lambda: a_field([(0, 0), (100, 0)] * u.arcsec)
    ),
    "psfs in mag are not linear; give them in linear units, as physical does of a Magnitude": (
        lambda: observe(psfs=PSF * u.mag)
    ),
    "halos in dex are not linear; give them in linear units, as physical does of a Magnitude": (
        lambda: observe(halos=FRAME * u.dex)
    ),
    "background must be counts per pixel, not adu; multiply by the gain (electrons per adu)": (
        lambda: observe().replace(background=[1, 2] * u.adu)
    ),
    "exposure must be in seconds, not in m": lambda: observe().replace(exposure=[1, 2] * u.m),
    "rotate must be in degrees, not in m": lambda: psf_of(rotate=5 * u.m),
    "saturation must be in adu, not in electron": lambda: psf_of(saturation=50 * u.electron),
    "saturation must be numbers without a unit, not in adu": lambda: find_stars(
        FRAME, saturation=50 * u.adu
    ),
    "threshold must be numbers without a unit, not in adu": lambda: find_stars(
        FRAME, threshold=5 * u.adu
    ),
    "truth must be in m, not in s": lambda: metrics.restoration_error(FRAME * u.m, FRAME * u.s),
}


@pytest.mark.parametrize("message", REFUSED)
def test_a_unit_without_a_meaning_is_refused(message):
    with pytest.raises(lnocl.InputError) as caught:
        REFUSED[message]()
    assert str(caught.value) == message


def test_widths_and_probabilities_may_be_quantities():
    observation = lnocl.Observation(FRAME, PSF, background=10.0)
    run = {"stop": None, "n_iter": 2, "engine": "numpy"}
    result = lnocl.deconvolve(observation, [(22, 18)], **run)
    found = result.significance(3 * u.pix, 1 * u.percent)
    assert (found.width, found.false_alarms) == (3.0, 0.01)
    np.testing.assert_array_equal(found.limit(50 * u.percent), found.limit(0.5))
    names = found.contrast_curves([50, 90] * u.percent).colnames
    assert [name for name in names if name.startswith("flux")] == ["flux50", "flux90"]
    with pytest.raises(lnocl.InputError, match="width must be in pixels, not in arcsec"):
        result.significance(3 * u.arcsec)
