"""A saturated and a faint star in every kind of scene: each keeps its light, within its error.

The scenes are drawn from Moffat functions at exact positions, by no code of lnocl.
"""

import warnings

import numpy as np
import pytest

import lnocl

N = 80
Y, X = np.indices((N, N), float)
STARS, FLUXES = [(34.3, 41.6), (58.2, 22.7)], np.array([2e6, 6e4])
HOST = 22.0, 60.0
SHIFT, ANGLE, CENTRE = (1.4, -2.3), 25.0, (N - 1) / 2


def moffat(x, y, fwhm=4.0):
    """Return an elliptic Moffat function of exponent 3 and unit sum over the plane."""
    square = fwhm**2 / 4 / (2 ** (1 / 3) - 1)
    return (1 + (x**2 + (1.15 * y) ** 2) / square) ** -3 * 1.15 * 2 / np.pi / square


def psf(fwhm=4.0, oversample=1):
    y, x = (np.indices((60 * oversample + 1,) * 2) - 30 * oversample) / oversample
    return moffat(x, y, fwhm)


def core(x=STARS[0][0], y=STARS[0][1]):
    return np.hypot(X - x, Y - y) < 6


def light(fwhm=4.0, fluxes=FLUXES, moved=lambda place: place):
    """Return the stars and a host of 3e4, whose places are moved."""
    image = 3e4 * moffat(X - moved(HOST)[0], Y - moved(HOST)[1], np.hypot(fwhm, 5))
    for place, flux in zip(STARS, fluxes, strict=True):
        image += flux * moffat(X - moved(place)[0], Y - moved(place)[1], fwhm)
    return image


def turned(place):
    c, s = np.cos(np.radians(ANGLE)), np.sin(np.radians(ANGLE))
    x, y = place[0] - CENTRE, place[1] - CENTRE
    return CENTRE + c * x - s * y, CENTRE + s * x + c * y


def shifted(place):
    return place[0] + SHIFT[0], place[1] + SHIFT[1]


def scene(kind):
    """Return means without background, PSFs, options, and the true fluxes."""
    known, fluxes = {"background": 60.0, "mask": core()}, FLUXES
    images, psfs = [light()], [psf()]
    match kind:
        case "depths":
            images, psfs = [light(w) for w in (4.0, 5.0, 3.5)], [psf(w) for w in (4.0, 5.0, 3.5)]
            known["background"] = [60.0, 200.0, 20.0]
        case "exposures":
            images, psfs = [light(), 3 * light(5.0)], [psf(), psf(5.0)]
            known["exposure"] = [1.0, 3.0]
        case "exposure map":
            known["exposure"] = 1 + X / N
            images = [light() * known["exposure"]]
        case "offsets":
            images, psfs = [light(), light(5.0, moved=shifted)], [psf(), psf(5.0)]
            known |= {
                "offsets": [(0, 0), SHIFT],
                "mask": np.array([core(), core(*shifted(STARS[0]))]),
            }
        case "epochs":
            nights = [(4.0, 1.0), (4.6, 1.2), (3.6, 0.8)]
            images = [light(w, share * FLUXES) for w, share in nights]
            psfs, fluxes = [psf(w) for w, _ in nights], np.outer(FLUXES, [1.0, 1.2, 0.8]).ravel()
            known["epochs"] = range(3)
        case "halos":
            halo = np.exp(-np.hypot(X - 34, Y - 41) / 18)
            images, known["halos"] = [light() + 4e5 * halo / halo.sum()], [halo]
        case "turned":
            images, psfs = [light(), light(5.0, moved=turned)], [psf(), psf(5.0)]
            known["transforms"] = lnocl.rotations([0.0, ANGLE], (CENTRE, CENTRE))
            known["mask"] = np.array([core(), core(*turned(STARS[0]))])
        case "oversampled":
            psfs = [psf(4.0, 2)]
            known |= {"oversample": 2, "effective_psfs": True}
        case "PSF field":
            psfs = lnocl.PsfField([psf(), psf()], [(0, 0), (N - 1, 0)])
        case "one masked":
            images, psfs = [light(), light(5.0)], [psf(), psf(5.0)]
            known["mask"] = np.array([core(), np.zeros((N, N), bool)])
        case "background measured":
            known |= {"background": 60.7, "background_error": 1.0}
    return np.array(images), psfs, known, fluxes


KINDS = [
    "plain", "depths", "exposures", "exposure map", "offsets", "epochs", "halos", "turned",
    "oversampled", "PSF field", "one masked", "background measured",
]  # fmt: skip


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", KINDS)
def test_stars_keep_their_light_within_their_errors(kind):
    """Four of them fail without the prior of the first star."""
    images, psfs, known, fluxes = scene(kind)
    background = 60.0 if kind == "background measured" else known["background"]
    mean = images + np.reshape(background, (-1, 1, 1))
    counts = np.random.default_rng(31).poisson(mean).astype(float)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)  # of stars masked at their peaks
        result = lnocl.deconvolve(lnocl.Observation(counts, psfs, **known), STARS)
    assert (abs(result.star_fluxes - fluxes) < 3 * result.star_flux_errors).all()
    np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=0.05)
