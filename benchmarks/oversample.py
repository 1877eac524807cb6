"""Skies finer than the images: speed, stars that detectors undersample, resolution won.

    python benchmarks/oversample.py PART [--device SPEC] [--output STEM]

Parts, each a table, written to STEM-PART.ecsv with --output:

speed     milliseconds of an iteration on n x n images with a sky 2 and 4 times as fine, beside a
          sky of 2n x 2n and 4n x 4n pixels that the images share; bytes on the device
placing   largest error of the image of a star at random places, as a share of its peak, of PSFs as
          fine as the images, twice and four times as fine; PSFs on the images' pixels are centred
stars     flux and position of a star of 1e5 electrons on a sky of 20 a pixel, 100 seeds: bias,
          scatter over the Fisher bound; one image, and four dithered by half a pixel
pairs     two points 1 and 1.5 pixels apart, FWHM 1.5: their positions are sought from 0.2 pixels
          off; error of the distance, and its Fisher bound
extended  relative error of a spiral galaxy seen through a PSF of FWHM 1.3 pixels in 1, 4 and 9
          dithers, at four times the images' sampling: oversample 1, 2, 4, and drizzle with
          Richardson-Lucy, each at its best iteration and at that of held-out counts
made      error of a fine PSF that --refine-psfs pixels makes of a Gaussian and 4, 12 or 36 stars
          of one frame: the largest of its images at 12 random places, over the peak

The images are made here, of profiles integrated over pixels at 16 x 16 points; those of the
galaxy of a sky eight times as fine. No seed was tuned on.
"""

import argparse
import time
import warnings
from functools import partial

import numpy as np
import parts
import scipy.fft
import scipy.ndimage
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.special import j1

import lnocl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.scene.detector import movable_psfs
from lnocl.core.scene.scene import Scene

FINE = 16
KINDS = ("gaussian", "moffat", "airy")
SKY = 20.0
DITHERS = {
    1: [(0.0, 0.0)],
    4: [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5)],
    9: [(x / 3, y / 3) for x in range(3) for y in range(3)],
}
HALF = 16


def profile(kind, fwhm, r):
    """Return the light of a profile at a radius, of any total."""
    if kind == "gaussian":
        return np.exp(-4 * np.log(2) * (r / fwhm) ** 2)
    if kind == "moffat":
        alpha = fwhm / 2 / np.sqrt(2 ** (1 / 2.5) - 1)
        return (1 + (r / alpha) ** 2) ** -2.5
    u = np.maximum(3.2327 * r / fwhm, 1e-9)  # half the light at u = 1.6163
    return (2 * j1(u) / u) ** 2


def make_star(kind, fwhm, n, x, y, side=1.0, points=FINE):
    """Return a star integrated over n x n pixels of this side, the first centred on (0, 0)."""
    at = ((np.arange(n * points) + 0.5) / points - 0.5) * side
    light = profile(kind, fwhm, np.hypot(at[:, None] - y, at - x))
    return light.reshape(n, points, n, points).sum(axis=(1, 3)) * (side / points) ** 2


def total(kind, fwhm):
    """Return all light of a profile within the PSFs."""
    n = 2 * HALF + 1
    return make_star(kind, fwhm, n, HALF, HALF).sum()


def make_psf(kind, fwhm, q):
    """Return the PSF on pixels q times as fine."""
    n = 2 * HALF * q + 1
    return make_star(kind, fwhm, n, HALF, HALF, 1 / q, max(4, FINE // q))


def speed(device):
    """Yield rows of the part "speed"."""
    rng = np.random.default_rng(0)
    for n, p in ((256, 4), (512, 4), (1024, 4), (512, 1), (1024, 1)):
        runs = {}
        for q in (2, 4):
            if q * n > 2048:
                continue
            for name, shape, oversample in (("finer", n, q), ("shared", q * n, 1)):
                psf = make_psf("gaussian", 1.3, q)
                images = rng.poisson(100.0, (p, shape, shape))
                observation = lnocl.Observation(images, psf, background=10.0, oversample=oversample)
                scene = Scene(observation, pad=0)
                engine = OpenCLEngine(scene, "single", device, 4000)
                engine.start(*scene.start(None, None))
                runs[q, name] = engine
        times = {key: [] for key in runs}
        for turn in range(9):
            for key, engine in runs.items():
                count = 12 if turn else 2
                begin = time.perf_counter()
                engine.go_on(4000, 0.0)
                for _ in range(count):
                    engine.tick()
                engine.look()
                if turn:
                    times[key].append(1e3 * (time.perf_counter() - begin) / count)
        for q in sorted({q for q, _ in runs}):
            finer, shared = (np.array(times[q, name]) for name in ("finer", "shared"))
            yield {
                "images": p,
                "n": n,
                "oversample": q,
                "ms": float(np.median(finer)),
                "ms shared": float(np.median(shared)),
                "ratio": float(np.median(finer / shared)),
                "bytes ratio": runs[q, "finer"].bytes_needed / runs[q, "shared"].bytes_needed,
            }


def placing(device):
    """Yield rows of the part "placing"."""
    rng = np.random.default_rng(24)
    for kind in KINDS:
        for fwhm in (1.0, 1.5, 2.0):
            light, errors = total(kind, fwhm), {}
            places = rng.uniform(HALF - 0.5, HALF + 0.5, (20, 2))
            n = 2 * HALF + 1
            for q in (1, 2, 4):
                observation = lnocl.Observation(
                    np.ones((n, n)), make_psf(kind, fwhm, q), oversample=q
                )
                (psf,) = movable_psfs(observation.psfs, observation, (64, 64))
                errors[f"q = {q}"] = max(
                    float(
                        abs(
                            psf.at(x, y).on_grid((64, 64))[:n, :n]
                            - make_star(kind, fwhm, n, x, y) / light
                        ).max()
                    )
                    for x, y in places
                ) / float(make_star(kind, fwhm, 1, 0, 0)[0, 0] / light)
            yield {"profile": kind, "FWHM": fwhm, **errors}


def bound(stars, others, fluxes, kind, fwhm, offsets, n):
    """Return the Fisher bounds of fluxes and positions of stars, the sky's level known."""
    light, step = total(kind, fwhm), 1e-4
    information = 0.0
    for dx, dy in offsets:
        means = np.full((n, n), SKY)
        slopes = []
        for (x, y), flux in zip(stars, fluxes, strict=True):
            x, y = x + dx, y + dy
            means = means + flux * make_star(kind, fwhm, n, x, y) / light
            slopes.append(make_star(kind, fwhm, n, x, y) / light)
            for ex, ey in ((step, 0), (0, step)):
                ahead, behind = (make_star(kind, fwhm, n, x + s * ex, y + s * ey) for s in (1, -1))
                slopes.append(flux * (ahead - behind) / (2 * step * light))
        jacobian = np.reshape(slopes, (len(slopes), -1))
        information = information + (jacobian / means.ravel()) @ jacobian.T
    return np.linalg.inv(information)


def solve(images, psf, q, offsets, given, device, **settings):
    """Return the result of lnocl with positions refined, noise and warnings left out."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        observation = lnocl.Observation(images, psf, background=SKY, offsets=offsets, oversample=q)
        return lnocl.deconvolve(
            observation,
            given,
            refine_positions=True,
            pad=0,
            device=device,
            **({"n_iter": 40, "stop": None, "smoothing": "auto"} | settings),
        )


def stars(device, seeds=range(100), flux=1e5):
    """Yield rows of the part "stars"."""
    n = 32
    for kind in KINDS:
        for fwhm in (1.0, 1.5, 2.0):
            light = total(kind, fwhm)
            for count in (1, 4):
                offsets = DITHERS[count]
                errors = {q: [] for q in (1, 2, 4)}
                scale = []
                for seed in seeds:
                    rng = np.random.default_rng([seed, 24])
                    x, y = rng.uniform(15, 17, 2)
                    each = flux / count
                    means = [
                        SKY + each * make_star(kind, fwhm, n, x + dx, y + dy) / light
                        for dx, dy in offsets
                    ]
                    images = rng.poisson(means)
                    near = np.add((x, y), rng.uniform(-0.2, 0.2, 2))
                    covariance = bound([(x, y)], [], [each], kind, fwhm, offsets, n)
                    scale.append(np.sqrt(np.diag(covariance)))
                    for q in errors:
                        psf = make_psf(kind, fwhm, q)
                        found = solve(images, psf, q, offsets, [near], device)
                        errors[q].append(
                            (found.star_fluxes[0] - each, *(found.star_positions[0] - (x, y)))
                        )
                for q, each in errors.items():
                    flux_errors, *moved = np.array(each).T
                    flux_scale, *position_scale = np.array(scale).T
                    pulls = np.concatenate(
                        [m / s for m, s in zip(moved, position_scale, strict=True)]
                    )
                    yield {
                        "profile": kind,
                        "FWHM": fwhm,
                        "images": count,
                        "oversample": q,
                        "bias %": float(100 * flux_errors.mean() / (flux / count)),
                        "bias error %": float(
                            100 * flux_errors.std() / (flux / count) / np.sqrt(len(flux_errors))
                        ),
                        "flux over bound": float(np.sqrt(np.mean((flux_errors / flux_scale) ** 2))),
                        "position over bound": float(np.sqrt(np.mean(pulls**2))),
                    }


def pairs(device, seeds=range(40)):
    """Yield rows of the part "pairs"."""
    n, kind, fwhm = 32, "gaussian", 1.5
    light = total(kind, fwhm)
    for distance in (1.0, 1.5):
        for flux in (1e4, 1e6):
            for count, offsets in DITHERS.items():
                errors, scale = {q: [] for q in (1, 2, 4)}, []
                for seed in seeds:
                    rng = np.random.default_rng([seed, 240])
                    angle = rng.uniform(0, 2 * np.pi)
                    half = distance / 2 * np.array([np.cos(angle), np.sin(angle)])
                    middle = rng.uniform(15, 17, 2)
                    places, fluxes = [middle - half, middle + half], [flux / count] * 2
                    means = [
                        SKY
                        + sum(
                            f * make_star(kind, fwhm, n, x + dx, y + dy) / light
                            for f, (x, y) in zip(fluxes, places, strict=True)
                        )
                        for dx, dy in offsets
                    ]
                    images = rng.poisson(means)
                    given = np.array(places) + rng.uniform(-0.2, 0.2, (2, 2))
                    covariance = bound(places, [], fluxes, kind, fwhm, offsets, n)
                    along = np.zeros(6)
                    along[1:3], along[4:6] = -half / (distance / 2), half / (distance / 2)
                    scale.append(float(np.sqrt(along @ covariance @ along)))
                    for q in errors:
                        found = solve(images, make_psf(kind, fwhm, q), q, offsets, given, device)
                        apart = np.hypot(*np.diff(found.star_positions, axis=0)[0])
                        errors[q].append(apart - distance)
                for q, each in errors.items():
                    yield {
                        "apart": distance,
                        "S/N": flux**0.5,
                        "images": count,
                        "oversample": q,
                        "bound": float(np.sqrt(np.mean(np.square(scale)))),
                        "bias": float(np.mean(each)),
                        "rms over bound": float(
                            np.sqrt(np.mean(np.square(np.divide(each, scale))))
                        ),
                    }


def galaxy(n):
    """Return a spiral with knots on n x n pixels, of unit total, flat at the edges."""
    rng = np.random.default_rng(24)
    y, x = (np.indices((n, n)) - n / 2) / n
    r, angle = np.hypot(x, 1.6 * y), np.arctan2(1.6 * y, x)
    arms = 0.5 + 0.5 * np.cos(2 * angle - 14 * np.log(r + 0.03))
    sky = np.exp(-r / 0.09) * (0.15 + arms**3)
    knots = np.zeros((n, n))
    at = (n * (0.5 + rng.normal(0, 0.13, (60, 2)))).astype(int).clip(0, n - 1)
    knots[tuple(at.T)] = rng.pareto(2, 60)
    sky += 30 * gaussian_filter(knots, n / 200)
    return sky / sky.sum()


def drizzled(images, offsets, q):
    """Return images laid on q times finer pixels by their areas, and the weights."""
    shape = q * images.shape[1], q * images.shape[2]
    total_light, weight = np.zeros(shape), np.zeros(shape)
    for image, (dx, dy) in zip(images, offsets, strict=True):
        fine = np.kron(image, np.ones((q, q))) / q**2
        by = round(-q * dy), round(-q * dx)
        total_light += np.roll(fine, by, (0, 1))
        weight += 1.0
    return total_light / weight


def extended(device, fluxes=(3e5, 1e7)):
    """Yield rows of the part "extended"."""
    n, fine, judged = 64, 8, 4
    truth = galaxy(n * fine)
    k = 2 * HALF * fine + 1
    blur = make_star("gaussian", 1.3, k, HALF, HALF, 1 / fine, 4)
    otf = scipy.fft.rfft2(
        np.roll(np.pad(blur / blur.sum(), (0, n * fine - k)), (-(k // 2),) * 2, (0, 1))
    )
    convolved = scipy.fft.irfft2(otf * scipy.fft.rfft2(truth), truth.shape)
    at_judged = truth.reshape(n * judged, 2, n * judged, 2).sum(axis=(1, 3))

    def error(sky, flux):
        q = judged * n // len(sky)
        wide = np.kron(sky, np.ones((q, q))) / q**2 if q > 1 else sky
        return float(np.linalg.norm(wide - flux * at_judged) / np.linalg.norm(flux * at_judged))

    def record(curve, count, _, estimate):
        curve.append(error(count * estimate.extended, flux))

    for flux in fluxes:
        for count, offsets in DITHERS.items():
            rng = np.random.default_rng(240)
            moved = [np.round(np.array(o) * fine) / fine for o in offsets]
            means = [
                SKY
                + flux
                / count
                * np.roll(convolved, (round(fine * dy), round(fine * dx)), (0, 1))
                .reshape(n, fine, n, fine)
                .sum(axis=(1, 3))
                for dx, dy in moved
            ]
            images = rng.poisson(means)
            for q in (1, 2, 4):
                curve = []
                observation = lnocl.Observation(
                    images,
                    make_psf("gaussian", 1.3, q),
                    background=SKY,
                    offsets=np.array(moved),
                    oversample=q,
                )
                settings = {"pad": 0, "device": device}
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", lnocl.LnoclWarning)
                    lnocl.deconvolve(
                        observation,
                        n_iter=150,
                        stop=None,
                        smoothing=0,
                        callback=partial(record, curve, count),
                        **settings,
                    )
                    chosen = lnocl.deconvolve(observation, n_iter=400, **settings)
                yield {
                    "flux": flux,
                    "images": count,
                    "oversample": str(q),
                    "best": min(curve),
                    "at": int(np.argmin(curve)) + 1,
                    "held-out": error(count * chosen.extended, flux),
                    "n_iter": chosen.n_iter,
                    "smoothing": chosen.smoothing,
                }
            on_grid = drizzled(images, np.round(np.array(moved) * 2) / 2, 2)
            pixel = np.pad(np.ones((2, 2)), ((1, 2), (1, 2)))
            psf = scipy.ndimage.convolve(make_psf("gaussian", 1.3, 2), pixel, mode="constant")
            curve = []
            observation = lnocl.Observation(
                on_grid * count, psf, background=SKY * count / 4, psf_centre="fit"
            )
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", lnocl.LnoclWarning)
                parts.paper(
                    observation,
                    n_iter=400,
                    device=device,
                    callback=partial(record, curve, 1),
                )
            yield {
                "flux": flux,
                "images": count,
                "oversample": "drizzle",
                "best": min(curve),
                "at": int(np.argmin(curve)) + 1,
                "held-out": np.nan,
                "n_iter": 0,
                "smoothing": 0.0,
            }


def frame_of_stars(kind, fwhm, count, rng):
    """Return counts of stars of 2e4 to 2e5 electrons at random places, and about where they are."""
    side, light = int(np.ceil(count**0.5)), total(kind, fwhm)
    mean, given = np.full((26 * side + 4,) * 2, SKY), []
    for s in range(count):
        y, x = (14 + 26 * k + rng.uniform(-0.5, 0.5) for k in divmod(s, side))
        flux, row, column = 10 ** rng.uniform(4.3, 5.3), round(y) - 12, round(x) - 12
        star = make_star(kind, fwhm, 25, x - column, y - row)
        mean[row : row + 25, column : column + 25] += flux * star / light
        given.append((x + rng.uniform(-0.1, 0.1), y + rng.uniform(-0.1, 0.1)))
    return rng.poisson(mean), given


def made(device):
    """Yield rows of the part "made"."""
    half = 10
    for kind, fwhm in (("moffat", 1.5), ("airy", 1.2)):
        for count in (4, 12, 36):
            for q in (2, 4):
                rng = np.random.default_rng(5)
                image, given = frame_of_stars(kind, fwhm, count, rng)
                first = make_star("gaussian", fwhm, 2 * half * q + 1, half, half, 1 / q, 4)
                observation = lnocl.Observation(image, first, background=SKY, oversample=q)
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", lnocl.LnoclWarning)
                    found = lnocl.deconvolve(
                        observation,
                        given,
                        refine_positions=True,
                        refine_psfs=["pixels"],
                        n_iter=5,
                        stop=None,
                        pad=0,
                        device=device,
                    )
                changed = lnocl.Observation(
                    np.ones((25, 25)), found.psfs[0], oversample=q, psf_centre="given"
                )
                (psf,) = movable_psfs(changed.psfs, changed, (25, 25))
                errors = []
                for x, y in rng.uniform(11.5, 12.5, (12, 2)):
                    true = make_star(kind, fwhm, 25, x, y) / total(kind, fwhm)
                    # Scale and place are the stars', not the PSF's.
                    fit = least_squares(partial(_left, psf, true, x, y), [1.0, 0.0, 0.0])
                    errors.append(abs(fit.fun).max())
                peak = make_star(kind, fwhm, 1, 0, 0)[0, 0] / total(kind, fwhm)
                yield {
                    "profile": kind,
                    "FWHM": fwhm,
                    "stars": count,
                    "oversample": q,
                    "largest": float(max(errors) / peak),
                    "median": float(np.median(errors) / peak),
                }


def _left(psf, true, x, y, changes):
    scale, dx, dy = changes
    return (scale * psf.at(x + dx, y + dy).on_grid(true.shape) - true).ravel()


PARTS = {part.__name__: part for part in (speed, placing, stars, pairs, extended, made)}


def main():
    """Measure the part that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    parts.report(PARTS[given.part](given.device), given.part, given.device, given.output)


if __name__ == "__main__":
    main()
