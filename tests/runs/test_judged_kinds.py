"""PSFs that are too narrow are mended in every kind of scene.

The scenes are drawn from Gaussians at exact positions, by no code of lnocl.
"""

import numpy as np
import pytest

import lnocl

N, STAR, KNOT, GIVEN, TRUE = 40, (18.3, 21.6), (27.0, 14.0), 1.5, 1.65
CENTRE, ANGLE = (N - 1) / 2, 30.0
Y, X = np.indices((N, N), float)
V, U = np.indices((31, 31)) - 15.0


def gaussian(x, y, width):
    return np.exp(-(x**2 + (1.2 * y) ** 2) / (2 * width**2)) * 1.2 / (2 * np.pi * width**2)


def behind(x, y):
    """Return the PSF behind a mask: lopsided speckles, with a share of 0.3 of the light."""
    speckles = 1.0 + 0.8 * np.cos(1.2 * x + 0.5) * np.cos(1.4 * y)
    return 0.3 * gaussian(x + 0.3, y, 3.5) * speckles


def turned(place):
    c, s = np.cos(np.radians(ANGLE)), np.sin(np.radians(ANGLE))
    x, y = place[0] - CENTRE, place[1] - CENTRE
    return CENTRE + c * x - s * y, CENTRE + s * x + c * y


def light(flux, moved=lambda place: place):
    (x, y), (at_x, at_y) = moved(STAR), moved(KNOT)
    return flux * gaussian(X - x, Y - y, TRUE) + 1e5 * gaussian(X - at_x, Y - at_y, 3.5)


def observe(kind):
    """Return an observation with PSFs of sigma 1.5 pixels instead of 1.65, stars and fluxes."""
    fluxes, images, psfs, known = [4e5], [light(4e5)], gaussian(U, V, GIVEN), {}
    if kind.startswith("turned"):
        images.append(light(4e5, turned))
        known["transforms"] = lnocl.rotations([0.0, ANGLE], (CENTRE, CENTRE))
    if kind == "turned, finer":
        psfs = gaussian(*(np.indices((61, 61))[::-1] / 2 - 15.0), GIVEN)
        known |= {"oversample": 2, "effective_psfs": True}
    if kind == "turned field":  # which stays as it is along the way of the star
        psfs = [lnocl.PsfField([psfs, psfs], [(0, 0), (N - 1, 0)])] * 2
    if kind == "epochs":
        fluxes = [4e5, 2e5]
        images.append(light(2e5))
        known["epochs"] = [0, 1]
    if kind == "halos":
        halo = np.exp(-np.hypot(X - 14, Y - 24) / 8)
        images[0] += 2e5 * halo / halo.sum()
        known["halos"] = [halo]
    if kind == "a field":
        share = STAR[0] / (N - 1)
        widths = GIVEN - 0.05 * share, GIVEN + 0.05 * (1 - share)
        psfs = lnocl.PsfField([gaussian(U, V, w) for w in widths], [(0, 0), (N - 1, 0)])
    stars = [STAR]
    if kind == "a star's own":
        fluxes, stars = [4e5, 3e5], [STAR, (10.2, 30.7)]
        images[0] += 3e5 * behind(X - 10.2, Y - 30.7)
        known |= {"star_psfs": behind(U, V), "star_places": stars[1]}
    counts = np.random.default_rng(3).poisson(np.array(images) + 30.0).astype(float)
    return lnocl.Observation(counts, psfs, background=30.0, **known), stars, fluxes


@pytest.mark.parametrize(
    "kind",
    [
        *(
            pytest.param(kind, marks=pytest.mark.exhaustive)
            for kind in ("turned", "turned, finer", "turned field")
        ),
        *("epochs", "halos", "a field", "a star's own"),
    ],
)
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
def test_psfs_that_are_too_narrow_are_mended(kind):
    observation, stars, fluxes = observe(kind)
    run = {"n_iter": 30, "stop": None, "refine_positions": False, "engine": "numpy"}
    found = lnocl.deconvolve(observation, stars, **run)
    assert found.psf_refinement.is_accepted
    np.testing.assert_allclose(found.star_fluxes, fluxes, rtol=0.01)
    assert (abs(found.star_fluxes - fluxes) < 3 * found.star_flux_errors).all()
    wider = found.psf_refinement.values[:, found.psf_refinement.parameters.index("jitter xx")]
    np.testing.assert_allclose(wider, TRUE**2 - GIVEN**2, rtol=0.1)
    given = lnocl.deconvolve(observation, stars, **run, refine_psfs=())
    is_through = np.arange(len(fluxes)) < len(fluxes) - (kind == "a star's own")
    assert (given.star_fluxes < 0.95 * np.array(fluxes))[is_through].all()
