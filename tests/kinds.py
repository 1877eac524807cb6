"""Scenes of every kind with a truth: a bright and a faint star, and a host.

They are drawn from Gaussians at exact positions, by no code of lnocl. A kind is a word, or several
with " + " between them.
"""

from functools import cache

import numpy as np

import lnocl

N = 48
STARS, FLUXES = np.array([(20.6, 25.3), (36.2, 13.4)]), np.array([1e6, 6e4])
HOST, HOST_FLUX, HOST_WIDTH = (13.4, 36.2), 3e4, 2.5
# Of components the host is the continuum; a knot as bright and wide is in the line.
KNOT = 34.2, 34.7
# Variances along x of the PSFs' cores: true, and such as are given where they are too narrow.
TRUE, NARROW = 1.69, 1.44
SHIFT, ANGLE, SCALE, CENTRE = (1.4, -2.3), 25.0, 0.7, (N - 1) / 2
SMALLER = 41, 44
HALO, BRIGHTER, LEVELS = 4e5, 1.2, np.array([60.0, 150.0])
Y, X = np.indices((N, N))
# What one image has; where all words are of these, there is one.
SINGLE = {
    "masked", "exposure map", "padded", "finer sky", "halos", "PSF field", "transmission",
    "star PSFs", "level",
}  # fmt: skip


def gaussian(x, y, xx, yy):
    return np.exp(-0.5 * (x**2 / xx + y**2 / yy)) / (2 * np.pi * np.sqrt(xx * yy))


def psf(x, y, xx):
    """Return a lopsided PSF, a core and wings, the variance of whose core along x is given."""
    more = xx - TRUE
    wings = gaussian(x - 0.24, y + 0.2, 8.0 + more, 6.5 + more)
    return 0.8 * gaussian(x + 0.06, y - 0.05, xx, 1.3 + more) + 0.2 * wings


def behind(x, y):
    """Return the PSF behind a mask: lopsided speckles, with a share of 0.1 of the light."""
    return (
        0.1 * gaussian(x + 0.3, y, 12, 10) * (1.0 + 0.8 * np.cos(1.2 * x + 0.5) * np.cos(1.4 * y))
    )


def transmission(x, y):
    """Return the share of light that goes through: less to the right, and none in a hole."""
    return np.where(np.hypot(x - 9, y - 10) < 5, 0.0, 1 - 0.6 * x / N)


def maps(words):
    """Return where a place of the sky is in each image, shape (p, 2, 3)."""
    found = np.tile(np.eye(2, 3), (1 if words <= SINGLE else 2, 1, 1))
    if words & {"offsets", "several shapes"}:
        found[1, :, 2] = SHIFT
    if words & {"turned", "scaled"}:
        turned = lnocl.rotations([ANGLE * ("turned" in words)], (CENTRE, CENTRE))[0]
        found[1] = SCALE * turned if "scaled" in words else turned
        found[1, :, 2] += (CENTRE, CENTRE) - found[1] @ (CENTRE, CENTRE, 1)
    return found


def place_in(to_image, place):
    return to_image @ (*place, 1.0)


def psf_in(words, j, place, x, y, xx):
    """Return the PSF of image j at a place in it."""
    xx = xx + 0.3 * j * bool(words & {"plain", "components"})
    if "PSF field" not in words:
        return psf(x, y, xx)
    share = np.clip(place[0] / (N - 1), 0, 1)
    return (1 - share) * psf(x, y, xx - 0.08) + share * psf(x, y, xx + 0.08)


def psfs(words, p, xx):
    """Return the PSFs that are given."""
    q = 2 if "finer sky" in words else 1
    v, u = (np.indices((36 * q + 1,) * 2) - 18 * q) / q
    nodes = [(0, 0), (N - 1, 0)]
    if "PSF field" not in words:
        return np.array([psf_in(words, j, nodes[0], u, v, xx) for j in range(p)])
    fields = [[psf_in(words, j, at, u, v, xx) for at in nodes] for j in range(p)]
    return [lnocl.PsfField(each, nodes) for each in fields]


def light(words, j, to_image, fluxes):
    """Return stars and host in an image, electrons."""
    y, x = np.indices((2 * N, 2 * N)) - N // 2
    host = HOST_FLUX * gaussian(x - HOST[0], y - HOST[1], HOST_WIDTH**2, HOST_WIDTH**2)
    if "components" in words and j == 0:
        host += HOST_FLUX * gaussian(x - KNOT[0], y - KNOT[1], HOST_WIDTH**2, HOST_WIDTH**2)
    is_lit = host > 1e-6 * HOST_FLUX
    sources = [*zip(STARS, fluxes, strict=True)]
    image = np.zeros((N, N))
    if "star PSFs" in words:
        dx, dy = place_in(to_image, STARS[0])
        image += fluxes[0] * behind(X - dx, Y - dy)
        sources = sources[1:]
    sources += zip(np.argwhere(is_lit)[:, ::-1] - N // 2, host[is_lit], strict=True)
    for place, flux in sources:
        dx, dy = place_in(to_image, place)
        share = transmission(*place) if "transmission" in words else 1.0
        image += flux * share * psf_in(words, j, (dx, dy), X - dx, Y - dy, TRUE)
    return image


@cache
def observe(kind, xx=TRUE):
    """Return an observation with PSFs of this width, and the true fluxes."""
    words = set(kind.split(" + "))
    to_images = maps(words)
    p = len(to_images)
    times = np.array([1.0, BRIGHTER]) if "epochs" in words else np.ones(p)
    images = [light(words, j, to_images[j], times[j] * FLUXES) for j in range(p)]
    bad = [np.hypot(X - x, Y - y) < 3.2 for x, y in (place_in(to, STARS[0]) for to in to_images)]
    known = {"mask": np.array(bad) & ("plain" not in words)}
    for word in words:
        match word:
            case "masked":
                known["mask"] |= np.random.default_rng(5).random((N, N)) < 0.1
            case "exposures":
                known["mask"][0] = False  # the short exposure is not saturated
                known["exposure"] = [1.0, 3.0]
                images[1] *= 3.0
            case "exposure map":
                known["exposure"] = 1 + X / N
                images = [each * known["exposure"] for each in images]
            case "offsets":
                known["offsets"] = to_images[:, :, 2]
            case "several shapes" | "turned" | "scaled":
                known["transforms"] = to_images
            case "finer sky":
                known |= {"oversample": 2, "effective_psfs": True}
            case "epochs":
                known["epochs"] = range(p)
            case "halos":
                shape = np.exp(-np.hypot(X - 20, Y - 25) / 9)
                known["halos"] = [shape]
                images = [each + HALO * shape / shape.sum() for each in images]
            case "transmission":
                known["transmission"] = transmission(X, Y)
            case "star PSFs":
                y, x = np.indices((51, 53)) - np.array([25, 26])[:, None, None]
                known |= {"star_psfs": behind(x, y), "star_places": STARS[0]}
            case "level":
                known["background_error"] = 1.0
            case "components":
                known["components"] = {"line": [1, 0], "continuum": [1, 1]}
    means = np.array(images) + LEVELS[:p, None, None]
    counts = np.random.default_rng(31).poisson(means).astype(float)
    known["background"] = LEVELS[:p] + 0.7 * ("level" in words)
    if "several shapes" in words:
        ny, nx = SMALLER
        counts, known["mask"] = ([each[0], each[1, :ny, :nx]] for each in (counts, known["mask"]))
    if "halos" in words and "several shapes" in words:
        known["halos"] = [known["halos"][0], known["halos"][0][:ny, :nx]]
    shown = times if "components" in words else np.unique(times)
    fluxes = np.outer(FLUXES, shown).ravel()
    return lnocl.Observation(counts, psfs(words, p, xx), **known), fluxes
