"""A saturated and a faint star in every kind of scene: what goes together.

The scenes are drawn from Moffat functions at exact positions, by no code of lnocl.
"""

import warnings
from functools import cache
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import lnocl
from lnocl.io.saved_results import read_result

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


def behind(x, y):
    """Return the PSF behind a mask: lopsided speckles, with a share of 0.1 of the light."""
    return 0.1 * moffat(x + 0.3, y, 9.0) * (1.0 + 0.8 * np.cos(1.2 * x + 0.5) * np.cos(1.4 * y))


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
        case "turned oversampled":
            images, psfs = [light(), light(5.0, moved=turned)], [psf(4.0, 2), psf(5.0, 2)]
            known["transforms"] = lnocl.rotations([0.0, ANGLE], (CENTRE, CENTRE))
            known["mask"] = np.array([core(), core(*turned(STARS[0]))])
            known |= {"oversample": 2, "effective_psfs": True}
        case "turned PSF field":
            ends = [(0, 0), (N - 1, 0)]
            images = [light(), light(5.0, moved=turned)]
            psfs = [lnocl.PsfField([psf(w), psf(w)], ends) for w in (4.0, 5.0)]
            known["transforms"] = lnocl.rotations([0.0, ANGLE], (CENTRE, CENTRE))
            known["mask"] = np.array([core(), core(*turned(STARS[0]))])
        case "PSF field":
            psfs = lnocl.PsfField([psf(), psf()], [(0, 0), (N - 1, 0)])
        case "own PSF":
            images = [light(fluxes=FLUXES * [0, 1]) + FLUXES[0] * behind(X - 34.3, Y - 41.6)]
            y, x = np.indices((81, 91)) - np.array([40, 45])[:, None, None]
            known |= {"star_psfs": behind(x, y), "star_places": STARS[0]}
        case "one masked":
            images, psfs = [light(), light(5.0)], [psf(), psf(5.0)]
            known["mask"] = np.array([core(), np.zeros((N, N), bool)])
        case "background measured":
            known |= {"background": 60.7, "background_error": 1.0}
    return np.array(images), psfs, known, fluxes


KINDS = [
    "plain", "depths", "exposures", "exposure map", "offsets", "epochs", "halos", "turned",
    "oversampled", "turned oversampled", "PSF field", "turned PSF field", "own PSF",
    "one masked", "background measured",
]  # fmt: skip


@cache
def observe(kind):
    """Return the observation of a kind, and the true fluxes."""
    images, psfs, known, fluxes = scene(kind)
    background = 60.0 if kind == "background measured" else known["background"]
    mean = images + np.reshape(background, (-1, 1, 1))
    counts = np.random.default_rng(31).poisson(mean).astype(float)
    return lnocl.Observation(counts, psfs, **known), fluxes


def run(kind, stars=STARS, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)  # of stars masked at their peaks
        return lnocl.deconvolve(observe(kind)[0], stars, **options)


def keep_their_light(kind):
    """Four of them fail without the prior of the first star."""
    result, (_, fluxes) = run(kind), observe(kind)
    assert (abs(result.star_fluxes - fluxes) < 3 * result.star_flux_errors).all()
    np.testing.assert_allclose(result.star_fluxes, fluxes, rtol=0.05)


def are_moved(kind):
    """The faint star, which was given elsewhere, is moved to its place."""
    given = [STARS[0], (57.8, 23.2)]
    result = run(kind, given, refine_positions=True, smoothing=1.0, stop=1e-4)
    errors = result.star_position_errors[-1]
    assert np.hypot(*(result.star_positions[-1] - STARS[-1])) < 0.05
    assert (abs(result.star_positions[-1] - STARS[-1]) < 4 * errors).all()


def have_errors_by_replicas(kind):
    result, (_, fluxes) = run(kind), observe(kind)
    found = result.bootstrap(12, seed=3)
    stars = [k for k, each in enumerate(found.quantities) if each.name.startswith("star")]
    assert len(stars) == len(fluxes)
    low, high = (each[stars] for each in found.interval(0.95))
    assert ((low < fluxes) & (fluxes < high)).mean() >= 0.5
    assert (abs(found.values[stars] - fluxes) < 4 * found.standard_errors[stars]).all()


def are_detected(kind):
    """The faint star, where the bright one alone is known."""
    found = run(kind, STARS[:1]).significance(false_alarms=0.01)
    table = found.detections
    distances = np.hypot(table["x"].value - STARS[1][0], table["y"].value - STARS[1][1])
    nearest = table[int(distances.argmin())]
    assert distances.min() < 0.3
    assert abs(nearest["flux"].value - FLUXES[1]) < 4 * nearest["flux_error"].value
    assert (found.limit(0.5) > 0).any()


def go_on_from_a_checkpoint(kind):
    with TemporaryDirectory() as folder:
        path = f"{folder}/run.fits"
        given = {"n_iter": 12, "stop": None, "smoothing": 0.3}
        whole = run(kind, **given)
        run(kind, **given, checkpoint=path, callback=lambda k, _: k == 5)
        found = run(kind, **given, resume=path)
    for name in ("extended", "star_fluxes", "history"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))


def agree_with_the_reference(kind):
    given = {"n_iter": 12, "stop": None, "smoothing": 0.3}
    expected = run(kind, **given, engine="numpy")
    for precision, allowed in (("double", 1e-9), ("single", 2e-3)):
        found = run(kind, **given, precision=precision)
        for name in ("extended", "star_fluxes"):
            values = getattr(expected, name)
            difference = abs(getattr(found, name) - values).max()
            assert difference < allowed * abs(values).max(), (precision, name, difference)


def are_written_and_read(kind):
    result = run(kind, n_iter=5, stop=None)
    with TemporaryDirectory() as folder:
        path = f"{folder}/result.fits"
        result.write(path)
        again = read_result(path)
        np.testing.assert_array_equal(again.extended, result.extended)
        np.testing.assert_array_equal(np.ravel(again.star_fluxes), result.star_fluxes)


DONE = [
    keep_their_light,
    are_moved,
    have_errors_by_replicas,
    are_detected,
    go_on_from_a_checkpoint,
    agree_with_the_reference,
    are_written_and_read,
]
# What does not go together yet, and the message that says so.
REFUSED = {
    ("turned PSF field", are_detected): "sources are tested with one PSF for each image",
    ("PSF field", are_detected): "sources are tested with one PSF for each image",
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("done", DONE, ids=lambda done: done.__name__)
@pytest.mark.parametrize("kind", KINDS)
def test_stars_of_every_kind(kind, done):
    """Kinds of scenes, down, and what is done with each, across: each cell by its numbers."""
    if (kind, done) not in REFUSED:
        done(kind)
        return
    with pytest.raises(lnocl.errors.InputError) as refused:
        done(kind)
    assert refused.value.message.startswith(REFUSED[kind, done])
