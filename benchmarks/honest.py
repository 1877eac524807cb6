"""Star fluxes in their own stated errors, where PSFs, counts and zero points are not as given.

    python benchmarks/honest.py [LINE ...] [--seeds FIRST LAST] [--psf-error SHARE] [--no-scatter]
        [--output FILE.ecsv]

Backgrounds are right, stars are given where they are unless a line says otherwise, and all else is
by default. Each run prints the mean flux over the truth, the mean relative error stated, the
largest error over that stated, the same of the light of the extended source in the frame, kappa,
seconds, and what was told. The summary has for each line the mean flux over the truth, the median
error stated, the rms of the actual errors, that of the errors over those stated, and the shares of
fluxes within 1, 2 and 3 stated errors. An error that is not finite is within none. A line holds
where none is beyond 3 stated errors, nine of ten are within 2, and the error stated is at most 2 %
or 3 times the actual one.
"""

import argparse
import time
import warnings
import zlib
from functools import partial
from typing import NamedTuple

import numpy as np
from astropy.table import Table
from scipy.ndimage import map_coordinates

import lnocl
from lnocl.psf import make_psf

FWHM = 2.3548


class Scene(NamedTuple):
    """What `lnocl.deconvolve` is given, and the truth."""

    images: object
    psfs: object
    known: dict
    stars: object
    fluxes: object
    light: float
    tile: int | None = None
    of_interest: slice = slice(None)


def psf(side, width, beta=3.0, skew=0.0, stretch=1.0, light=1.0):
    """Return a Moffat function, or for beta 0 a Gaussian, of a FWHM in pixels, of a sum."""
    y, x = np.indices((side, side)) - side // 2
    along, across = (x + y) / np.sqrt(2 * stretch), (y - x) * np.sqrt(stretch / 2)
    square = along**2 + across**2
    if beta:
        values = (1 + square * 4 * (2 ** (1 / beta) - 1) / width**2) ** -beta
    else:
        values = np.exp(-4 * np.log(2) * square / width**2)
    values *= 1 + skew * np.tanh((across + 0.5 * along) / width)
    return light * values / values.sum()


def seen(n, kernel, stars=(), fluxes=(), sky=None):
    """Return n x n pixels of stars and of a sky of n x n through a PSF of unit sum."""
    size = n + len(kernel)
    v, u = np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)
    spectrum = np.zeros((size, len(u)), complex) if sky is None else np.fft.rfft2(sky, (size, size))
    for (x, y), flux in zip(np.reshape(stars, (-1, 2)), fluxes, strict=True):
        spectrum = spectrum + flux * np.exp(-2j * np.pi * (u * x + v * y))
    back = np.exp(2j * np.pi * (u + v) * (len(kernel) // 2))
    image = np.fft.irfft2(spectrum * back * np.fft.rfft2(kernel, (size, size)), (size, size))
    return image[:n, :n].clip(0)


def blob(n, light, at, width, power=2.0, ratio=1.0):
    """Return a source exp(-(r / width)^power) of a light in the frame."""
    y, x = np.indices((n, n))
    r = np.hypot(x - at[0], (y - at[1]) * ratio)
    values = np.exp(-((r / width) ** power))
    return light * values / values.sum()


def ring(n, light, at, radius, width=2.0):
    """Return a ring that is brighter on one side, of a light in the frame."""
    y, x = np.indices((n, n)) - np.reshape(at, (2, 1, 1))[::-1]
    r = np.hypot(x, y)
    values = np.exp(-((r - radius) ** 2) / 2 / width**2) * (1 + 0.6 * x / (r + 1))
    return light * values / values.sum()


def jet(n, light, at):
    """Return knots along a line from a place."""
    knots = ((1.0, 6.0, 1.6), (0.7, 11.0, 2.0), (1.2, 17.0, 2.4))
    parts = [blob(n, a, (at[0] + 0.8 * d, at[1] + 0.6 * d), w) for a, d, w in knots]
    return light * sum(parts) / sum(parts).sum()


def middle(rng, n):
    """Return a place within half a pixel of the middle of n x n."""
    return n // 2 + rng.uniform(-0.5, 0.5, 2)


def moffat(rng, sky=3e5, width=3.2, off=0.0, n=64):
    """Return a bright star on a bright sky, FWHM 3.5, whose PSF or place is not as given."""
    star, turn = middle(rng, n), rng.uniform(0, 2 * np.pi)
    image = rng.poisson(sky + seen(n, psf(63, 3.5), star, [1.2e7]))
    given = star + off * np.array([np.cos(turn), np.sin(turn)])
    return Scene(image, psf(63, width), {"background": sky}, [given], [1.2e7], 0.0)


def host(rng, p=4, wrong=1.03, n=64):
    """Return a star of 1e5 on an exponential host of 1e5, in p images."""
    star, true = middle(rng, n), psf(41, 3.2)
    sky = blob(n, 1e5, star, 4.0, 1.0)
    images = [rng.poisson(100 + seen(n, true, star, [1e5], sky)) for _ in range(p)]
    return Scene(images, psf(41, 3.2 * wrong), {"background": 100.0}, [star], [1e5], 1e5)


def host_like_psf(rng, n=64):
    """Return a star of 2e5 on a host of 1e5 of the profile of the PSF, which is right."""
    star, true = middle(rng, n), psf(41, 2 * FWHM, 0)
    sky = blob(n, 1e5, star, 2 * np.sqrt(2))
    image = rng.poisson(100 + seen(n, true, star, [2e5], sky))
    return Scene(image, true, {"background": 100.0}, [star], [2e5], 1e5)


def cut(rng, share=0.974, n=96):
    """Return a star of 1e6 whose PSF file ends where it holds a share of the light."""
    star, true = middle(rng, n), psf(2001, 3.0, 2.0)
    image = rng.poisson(100 + seen(n, true[850:1151, 850:1151], star, [1e6]))
    sums = [true[1000 - k : 1001 + k, 1000 - k : 1001 + k].sum() for k in range(95)]
    k = int(np.argmin(abs(np.array(sums) - share)))
    given = true[1000 - k : 1001 + k, 1000 - k : 1001 + k]
    return Scene(image, given, {"background": 100.0}, [star], [1e6], 0.0)


def pedestal(rng, share=0.05, n=64):
    """Return a star of 2e5 beside a jet of 1e5; the PSF given has a pedestal."""
    star, true = middle(rng, n), psf(41, 3.5, skew=0.1)
    image = rng.poisson(100 + seen(n, true, star, [2e5], jet(n, 1e5, star)))
    given = true + share / true.size
    return Scene(image, given, {"background": 100.0}, [star], [2e5], 1e5)


def cosmics(rng, n=64):
    """Return four images of a star of 1e5 beside a jet, one with five cosmic rays of two pixels."""
    star, depths = middle(rng, n), rng.uniform(0.6, 1.4, 4)
    psfs = [psf(41, width, skew=0.1) for width in rng.uniform(3.0, 3.6, 4)]
    sky = jet(n, 5e4, star)
    images = np.array(
        [
            rng.poisson(100 + depth * seen(n, kernel, star, [1e5], sky))
            for depth, kernel in zip(depths, psfs, strict=True)
        ]
    )
    for x, y in rng.integers(8, n - 8, (5, 2)):
        images[2, y, x : x + 2] += rng.integers(2000, 20000, 2)
    known = {"background": 100.0, "exposure": depths}
    return Scene(images, psfs, known, [star], [1e5], 5e4)


def saturated(rng, how="clip", n=64):
    """Return a star whose core is clipped, 0 or wrapped, beside a jet."""
    star, true = middle(rng, n), psf(41, 3.5, 0)
    flux = 1.2e6 if how == "wrap" else 3e5
    image = rng.poisson(100 + seen(n, true, star, [flux], jet(n, 5e4, star)))
    if how == "clip":
        image = image.clip(max=8000)
    if how == "zero":
        image[image > 8000] = 0
    if how == "wrap":
        image = image.astype(np.int16)
    return Scene(image, true, {"background": 100.0}, [star], [flux], 5e4)


def exact(rng, kind="alone", n=72):
    """Return three images that differ in depth and width, through lopsided PSFs that are right."""
    star, fluxes = middle(rng, n), [1e5]
    sky = {"jet": jet, "ring": partial(ring, radius=8.0)}.get(kind)
    sky = np.zeros((n, n)) if sky is None else sky(n, 1e5, star)
    stars = [star]
    if kind == "crowded":
        while len(stars) < 8:
            other = rng.uniform(8, n - 8, 2)
            if min(np.hypot(*(other - each)) for each in stars) > 5:
                stars.append(other)
        fluxes = 10 ** rng.uniform(4.0, 5.5, 8)
        sky = blob(n, 1e5, (30, 40), 12.0, ratio=1.4)
    depths, widths = rng.uniform(0.4, 1.6, 3), rng.uniform(2.8, 3.8, 3)
    psfs = [psf(41, width, 3.5, 0.15, 1.15) for width in widths]
    images = [
        rng.poisson(60 + depth * seen(n, kernel, stars, fluxes, sky))
        for depth, kernel in zip(depths, psfs, strict=True)
    ]
    known = {"background": 60.0, "exposure": depths}
    return Scene(images, psfs, known, stars, fluxes, sky.sum())


def zero_points(rng, each_night=False, n=48):
    """Return six images of four stars, of transparencies .6 to 1.1, of mean 1, not given."""
    stars = middle(rng, n) + np.array([(0, 0), (-11, 7), (8, 12), (4, -13)])
    clear, fluxes = rng.permutation(np.linspace(0.6, 1.1, 6)), np.array([3e4, 2e4, 4e4, 1e4])
    psfs = [psf(31, width, skew=0.1) for width in rng.uniform(3.0, 3.8, 6)]
    sky = jet(n, 3e4, stars[0])
    images = [
        rng.poisson(100 + depth * seen(n, kernel, stars, fluxes, sky))
        for depth, kernel in zip(clear / clear.mean(), psfs, strict=True)
    ]
    known = {"background": 100.0} | ({"epochs": range(6)} if each_night else {})
    return Scene(images, psfs, known, stars, np.repeat(fluxes, 6 if each_night else 1), 3e4)


def epochs(rng, off=(3.0, -4.0), made=None, nights=6, n=64, light=1e5):
    """Return nights of a star on or off the nucleus of a host, each with a PSF and depth."""
    star, images, psfs = middle(rng, n), [], []
    fluxes, depths = 3e4 * rng.uniform(0.8, 1.2, nights), rng.uniform(0.6, 1.4, nights)
    sky = blob(n, light, star - off, 8.5, ratio=2.0)
    for flux, depth in zip(fluxes, depths, strict=True):
        true = psf(41, rng.uniform(3.0, 4.2), skew=0.1, stretch=1.1)
        images.append(rng.poisson(100 + depth * seen(n, true, star, [flux], sky)))
        psfs.append(true if made is None else made(rng, true))
    known = {"background": 100.0, "epochs": range(nights), "exposure": depths}
    return Scene(images, psfs, known, [star], fluxes, light)


def of_stars(rng, true, n_stars=3, flux=1e5, vary=0.0):
    """Return the PSF that lnocl makes of stars of a frame, whose widths may vary."""
    size, n = len(true) - 8, 160
    places = [(31, 33), (86, 38), (52, 87), (126, 34), (118, 80), (30, 128), (78, 130), (126, 124)]
    stars = np.array(places[:n_stars]) + rng.uniform(-0.5, 0.5, (n_stars, 2))
    frame = np.full((n, n), 100.0)
    for star, of_star in zip(stars, flux * rng.uniform(0.5, 1.5, n_stars), strict=True):
        step = 1 + vary * rng.standard_normal()
        y, x = (np.indices(true.shape) - len(true) // 2) / step + len(true) // 2
        own = map_coordinates(true, [y, x], order=5) if vary else true
        frame += seen(n, own / own.sum(), [star], [of_star])
    return make_psf(rng.poisson(frame), stars, size=size)


def beside_made(rng, kind, n=64, **made):
    """Return a star of 1e5 alone, beside a companion of 3 % or on a host, with a made PSF."""
    star, turn = middle(rng, n), rng.uniform(0, 2 * np.pi)
    true, stars, fluxes, sky = psf(41, 3.4, stretch=1.15), [star], [1e5], None
    if kind == "companion":
        stars = [star, star + 7 * np.array([np.cos(turn), np.sin(turn)])]
        fluxes = [1e5, 3e3]
    if kind == "host":
        sky = blob(n, 5e4, star, 4.0, 1.0, 1.3)
    image = rng.poisson(100 + seen(n, true, stars, fluxes, sky))
    given = of_stars(rng, true, **made)
    light = 0.0 if sky is None else sky.sum()
    return Scene(image, given, {"background": 100.0}, stars, fluxes, light)


def rolls(rng, wrong=1.05, n=44):
    """Return two turned images of a star of 1e6 on a ring of a fifth of its light."""
    star, turns = middle(rng, n), [0.0, 40.0]
    maps = lnocl.rotations(turns, star)
    true = psf(31, 3.4, 3.5, 0.15)
    y, x = np.indices((n, n))
    images = []
    for to_image in maps:
        at = np.einsum("ji,jyx->iyx", to_image[:, :2], np.array([x, y]) - star[:, None, None])
        light = np.exp(-((np.hypot(at[0], at[1] * 1.4) - 10) ** 2) / 8) * (1.5 + np.sign(at[0]))
        sky = 2e5 * light / light.sum()
        images.append(rng.poisson(50 + seen(n, true, star, [1e6], sky)))
    known = {"background": 50.0, "transforms": maps}
    given = psf(31, 3.4 * wrong, 3.5, 0.15)
    return Scene(images, given, known, [star], [1e6], 2e5)


def tiles(rng, n=96):
    """Return a field of five stars for tiles, the PSF given of sigma 1.8 for 2."""
    stars = [rng.uniform(40, 56, 2)]
    while len(stars) < 5:
        other = rng.uniform(12, n - 12, 2)
        if min(np.hypot(*(other - each)) for each in stars) > 16:
            stars.append(other)
    fluxes = np.append(2e5, rng.uniform(2e4, 1e5, 4))
    sky = blob(n, 2e5, (40, 55), 15.0, ratio=1.4)
    image = rng.poisson(50 + seen(n, psf(25, 2 * FWHM, 0), stars, fluxes, sky))
    given = psf(25, 1.8 * FWHM, 0)
    return Scene(image, given, {"background": 50.0}, stars, fluxes, 2e5, tile=80)


def coarse(image, q):
    """Return the sums over q x q pixels."""
    n = len(image) // q
    return image.reshape(n, q, n, q).sum(axis=(1, 3))


def undersampled(rng, width=1.6, wrong=1.0, p=1, q=2, power=1.0, n=48):
    """Return dithers of a star of 5e4 on a host of 5e4, the sky q times as fine as they are."""
    fine, side = 3 * q, 31 * q + 1 - q % 2
    star, ratio = middle(rng, n), rng.uniform(1.0, 1.5)
    steps = rng.uniform(-1, 1, (p, 2)) if p > 1 else np.zeros((1, 2))
    true, images = psf(3 * side, width * fine), []
    for step in steps:
        at = fine * (star + step + 0.5) - 0.5
        sky = blob(n * fine, 5e4, at, 4.0 * power**2 * fine, power, ratio)
        images.append(rng.poisson(60 + coarse(seen(n * fine, true, at, [5e4], sky), fine)))
    given = coarse(psf(3 * side, wrong * width * fine), 3)
    known = {"background": 60.0, "oversample": q, "offsets": steps}
    return Scene(images, given, known, [star], [5e4], 5e4)


def companion(rng, n=64, flux=1e7):
    """Return a companion of contrast 1e-3 at 10 pixels, the PSF a star twice as bright."""
    star, turn = middle(rng, n), rng.uniform(0, 2 * np.pi)
    stars = [star, star + 10 * np.array([np.cos(turn), np.sin(turn)])]
    y, x = np.indices((63, 63)) - 31
    waves = rng.uniform(-0.8, 0.8, (12, 2))
    speckles = sum(np.sin(a * x + b * y + rng.uniform(0, 6)) for a, b in waves).clip(-3, 3)
    true = psf(63, 3.4) * (1 + 0.25 * speckles * (1 - np.exp(-((np.hypot(x, y) / 5) ** 4))))
    true /= true.sum()
    fluxes = [flux, 1e-3 * flux]
    image = rng.poisson(100 + seen(n, true, stars, fluxes))
    given = rng.poisson(100 + 2 * flux * true) - 100.0
    return Scene(image, given, {"background": 100.0}, stars, fluxes, 0.0, of_interest=slice(1, 2))


LINES = {
    "moffat-bright": moffat,
    "moffat-1e6": partial(moffat, sky=1e6),
    "moffat-off-1e6": partial(moffat, sky=1e6, width=3.5, off=0.3),
    "moffat-off-3e6": partial(moffat, sky=3e6, width=3.5, off=0.3),
    "host-3-p4": host,
    "host-3-p1": partial(host, p=1),
    "host-like-psf": host_like_psf,
    "cut-974": cut,
    "cut-988": partial(cut, share=0.988),
    "cut-996": partial(cut, share=0.996),
    "pedestal": pedestal,
    "cosmics": cosmics,
    "clipped": saturated,
    "zeroed": partial(saturated, how="zero"),
    "wrapped": partial(saturated, how="wrap"),
    "zero-points": zero_points,
    "zero-points-nights": partial(zero_points, each_night=True),
    "epochs-off-nucleus": epochs,
    "epochs-on-nucleus": partial(epochs, off=(0.0, 0.0)),
    "curves-made-psfs": partial(epochs, made=of_stars),
    "curves-20-alone": partial(epochs, made=of_stars, nights=20, light=0.0),
    "curves-20-host": partial(epochs, made=of_stars, nights=20),
    "rolls-wide": rolls,
    "rolls-narrow": partial(rolls, wrong=0.95),
    "tiles": tiles,
    "undersampled-right": undersampled,
    "undersampled-wrong": partial(undersampled, wrong=1.04),
    "cusp-coarse-right": partial(undersampled, q=1, power=0.6),
    "cusp-coarse-wrong": partial(undersampled, q=1, power=0.6, wrong=1.04),
    "dithers": partial(undersampled, width=1.3, p=8),
    "dithers-coarse": partial(undersampled, width=1.3, p=8, q=1),
    "companion": companion,
    **{
        f"made-{kind}-{k}": partial(beside_made, kind=kind, n_stars=k, flux=3e4, vary=0.01)
        for kind in ("alone", "companion", "host")
        for k in (1, 2, 3, 8)
    },
    "exact-alone": exact,
    "exact-jet": partial(exact, kind="jet"),
    "exact-ring": partial(exact, kind="ring"),
    "exact-crowded": partial(exact, kind="crowded"),
}


def run(scene, **options):
    """Return the result, fluxes, extended light, each with its error, kappa, and what is told."""
    result, told, nan = None, [], np.full(len(scene.fluxes), np.nan)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            observation = lnocl.Observation(scene.images, scene.psfs, **scene.known)
            if scene.tile:
                result = lnocl.deconvolve_tiles(
                    observation, scene.stars, tile=scene.tile, **options
                )
            else:
                result = lnocl.deconvolve(observation, scene.stars, **options)
            found = np.ravel(result.star_fluxes), np.ravel(result.star_flux_errors)
            light = (np.nan, np.nan) if scene.tile else result.extended_flux
            told = list(result.verdict())
            refinement = getattr(result, "psf_refinement", None)
            kappa = refinement.psf_error if refinement else 0.0
        except lnocl.LnoclError as error:
            found, light, kappa, told = (nan, nan), (np.nan, np.nan), np.nan, [f"refused: {error}"]
    told += [str(each.message) for each in caught]
    return result, *found, *light, kappa, list(dict.fromkeys(told))


def without_scatter(psfs):
    """Return PSFs, those that lnocl made without their scatter."""
    if isinstance(psfs, list):
        return [getattr(each, "psf", each) for each in psfs]
    return getattr(psfs, "psf", psfs)


def measure(line, seed, scatter=True, **known):
    """Print a run, and yield a row for each flux."""
    scene = LINES[line](np.random.default_rng([seed, zlib.crc32(line.encode())]))
    scene = scene._replace(known=scene.known | known)
    if not scatter:
        scene = scene._replace(psfs=without_scatter(scene.psfs))
    begun = time.perf_counter()
    _, found, errors, light, light_error, kappa, told = run(scene)
    seconds = time.perf_counter() - begun
    fluxes = np.ravel(scene.fluxes).astype(float)[scene.of_interest]
    found, errors = found[scene.of_interest], errors[scene.of_interest]
    pulls = (found - fluxes) / errors
    of_light = (light - scene.light) / light_error
    worst = pulls[np.argmax(abs(pulls))]
    print(
        f"{line:16} {seed:4} {np.mean(found / fluxes):7.4f} +- {np.mean(errors / fluxes):.4f} "
        f"{worst:+7.2f}  light {light:.4g} of {scene.light:.4g} {of_light:+6.2f}  "
        f"kappa {kappa:.3f} {seconds:5.1f} s  {'; '.join(each[:70] for each in told)}",
        flush=True,
    )
    for ratio, stated, pull in zip(found / fluxes, errors / fluxes, pulls, strict=True):
        yield {
            "line": line,
            "seed": seed,
            "flux": ratio,
            "stated": stated,
            "sigmas": pull,
            "light": light,
            "light_truth": float(scene.light),
            "light_sigmas": of_light,
            "kappa": kappa,
            "seconds": seconds,
            "told": " | ".join(told),
        }


def summarise(table):
    """Return a row for each line."""
    rows = []
    for line in dict.fromkeys(table["line"]):
        of_line = table[table["line"] == line]
        off, sigmas = of_line["flux"] - 1, abs(of_line["sigmas"])
        lights, stated = of_line["light_sigmas"], np.median(of_line["stated"])
        actual = np.sqrt(np.mean(off**2))
        rows.append(
            {
                "line": line,
                "runs": len(set(of_line["seed"])),
                "flux": np.mean(of_line["flux"]),
                "stated": stated,
                "actual": actual,
                "sigmas": np.sqrt(np.mean(sigmas**2)),
                **{f"within {k}": np.mean(sigmas <= k) for k in (1, 2, 3)},
                "light": np.sqrt(np.mean(lights**2)),
                "seconds": np.mean(of_line["seconds"]),
                "holds": bool(
                    (sigmas <= 3).all()
                    and np.mean(sigmas <= 2) >= 0.9
                    and stated <= max(3 * actual, 0.02)
                ),
            }
        )
    found = Table(rows)
    for name in found.colnames[2:-1]:
        found[name].format = "%.2f" if name in ("sigmas", "light", "seconds") else "%.4f"
    return found


def options_of(given):
    """Return what of `lnocl.Observation` is given; older versions have none of it."""
    return {} if given.psf_error is None else {"psf_error": given.psf_error}


def main():
    """Print and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lines", nargs="*", metavar="LINE", help=", ".join(LINES))
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 4), metavar=("FIRST", "LAST"))
    parser.add_argument("--psf-error", type=float, help="that of Observation, which has to have it")
    parser.add_argument("--no-scatter", action="store_true", help="that of PSFs made is not given")
    parser.add_argument("--output", metavar="FILE.ecsv")
    given = parser.parse_args()
    rows = []
    for line in given.lines or LINES:
        for seed in range(given.seeds[0], given.seeds[1] + 1):
            rows += measure(line, seed, not given.no_scatter, **options_of(given))
            if given.output:
                Table(rows).write(given.output, overwrite=True)
    summarise(Table(rows)).pprint(max_lines=-1, max_width=-1)


if __name__ == "__main__":
    main()
