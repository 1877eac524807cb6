"""Images of two scales in one fit: their errors, beside resampling, and the time of an iteration.

    python benchmarks/scales.py [--parts errors time] [--seeds FIRST LAST] [--turns N]
        [--width FWHM] [--smoothing W] [--device SPEC] [--output STEM]

The first table is of simulated images. A star lies beside a jet with knots, or among galaxies with
clumps. A sharp camera has 128 x 128 pixels and a PSF of 2.5 pixels FWHM. A deep one is turned by 20
degrees, has pixels SCALE times as large, a PSF of WIDTH of its own pixels, and 30 times the light.
The extended source has 1e5 electrons in the sharp image and the star as many; the sky has 20
electrons in a pixel of it. All sources and PSFs are Gaussians, so that means are formulae and
exact. All fits are lnocl's with the defaults; with --smoothing 0 star fluxes are not marginal.

sharp      the sharp image alone
deep       the deep image alone, on the pixels of the sharp one
both       both images as they are
resampled  both, the deep image and its PSF first resampled to the sharp one's pixels by cubic
           splines, with a pixel's share of the counts

Column "sky": the L2 norm of estimate minus truth over that of the truth, both at the resolution of
the sharp PSF. "smooth": the same at 9.8 pixels FWHM. "star" is the relative error of its flux.

The second table has the time of an iteration on 1024 x 1024 with the second of two images turned,
of larger pixels, or both, over that with two images of one map; both sides take turns. It has the
median and the quartiles of the ratio. With --output the tables go to STEM_errors.ecsv and
STEM_time.ecsv.
"""

import argparse
import itertools
import time
import warnings

import numpy as np
from astropy.table import Table
from scipy.ndimage import affine_transform, gaussian_filter
from turned import SECONDS_A_TURN, iterate

import lnocl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.opencl.device import choose, describe
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty

N = 128
MIDDLE = np.full(2, (N - 1) / 2.0)
STAR = (61.3, 66.8)
LIGHT, SKY, DEEPER, DEGREES = 1e5, 20.0, 30.0, 20.0
FWHM, SMOOTH = 2.5, 9.8
SIGMA = 1.0 / np.sqrt(8.0 * np.log(2.0))  # of a FWHM of 1
SCALES, KINDS = (2.8, 5.6), ("jet", "galaxies")
Y, X = np.indices((N, N))
INSIDE = np.hypot(X - MIDDLE[0], Y - MIDDLE[1]) < 56.0
GRID, SIDE = 1024, 760
MAPS = {"turned": (20.0, 1.0), "larger": (0.0, 2.8), "turned and larger": (20.0, 2.8)}


def sources(kind, rng):
    """Return light, places and covariances of Gaussians of unit sum."""
    found = []
    if kind == "jet":
        angle = rng.uniform(0.0, 2.0 * np.pi)
        for along in np.sort(rng.uniform(4.0, 46.0, 8)):
            across = 3.0 * np.sin(along / 9.0)
            at = along * _unit(angle) + across * _unit(angle + np.pi / 2.0)
            found.append((rng.uniform(0.4, 1.0), STAR + at, angle, 2.5, 1.5))
    else:
        for _ in range(6):
            place, tilt = MIDDLE + rng.uniform(-38.0, 38.0, 2), rng.uniform(0.0, np.pi)
            light, size = rng.uniform(0.3, 1.0), rng.uniform(4.0, 7.0)
            found.append((light, place, tilt, size, 0.5 * size))
            for _ in range(3):
                clump = place + size * rng.normal(0.0, 0.8, 2)
                found.append((0.1 * light, clump, 0.0, 1.2, 1.2))
    light = np.array([each[0] for each in found])
    places = np.array([each[1] for each in found])
    covariances = []
    for *_, tilt, long, short in found:
        axes = np.column_stack([_unit(tilt), _unit(tilt + np.pi / 2.0)])
        covariances.append(axes @ np.diag([long**2, short**2]) @ axes.T)
    return light / light.sum(), places, np.array(covariances)


def _unit(angle):
    return np.array([np.cos(angle), np.sin(angle)])


def seen(found, to_image, shape, sigma):
    """Return an image of Gaussians, blurred by one of a width in its own pixels."""
    y, x = np.indices(shape)
    image = np.zeros(shape)
    for light, place, covariance in zip(*found, strict=True):
        there = to_image[:, :2] @ place + to_image[:, 2]
        wide = to_image[:, :2] @ covariance @ to_image[:, :2].T + sigma**2 * np.eye(2)
        away = np.stack([x - there[0], y - there[1]])
        distance = np.einsum("iyx,ij,jyx->yx", away, np.linalg.inv(wide), away)
        image += light * np.exp(-0.5 * distance) / (2.0 * np.pi * np.sqrt(np.linalg.det(wide)))
    return image


def gaussian_psf(fwhm):
    """Return a Gaussian PSF."""
    half = int(np.ceil(2.5 * fwhm))
    y, x = np.indices((2 * half + 1, 2 * half + 1)) - half
    psf = np.exp(-0.5 * (x**2 + y**2) / (SIGMA * fwhm) ** 2)
    return psf / psf.sum()


def deep_map(scale, degrees, middle, side):
    """Return the map from the sky to an image of larger pixels with the same middle."""
    linear = lnocl.rotations([degrees], (0, 0))[0, :, :2] / scale
    return np.column_stack([linear, (side - 1) / 2.0 - linear @ middle])


def resampled(image, to_image, shape, fill):
    """Return an image on the pixels of the sky, with their share of its counts."""
    linear, shift = to_image[::-1, 1::-1], to_image[::-1, 2]
    share = abs(np.linalg.det(linear))
    return share * affine_transform(image, linear, shift, shape, order=3, cval=fill)


def fitted(images, psfs, options, **known):
    """Return the extended source and the flux of the star."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        observation = lnocl.Observation(images, psfs, **known)
        result = lnocl.deconvolve(observation, [STAR], **options)
    return result.extended, float(result.star_fluxes[0])


def measure(kind, seed, width, options):
    """Yield a row for each method and scale."""
    rng = np.random.default_rng(seed)
    found = sources(kind, rng)
    star = np.ones(1), np.array([STAR]), np.zeros((1, 2, 2))
    own = np.eye(2, 3)
    truth = LIGHT * seen(found, own, (N, N), 0.0)

    def camera(to_image, shape, fwhm, background):
        mean = LIGHT * sum(seen(each, to_image, shape, SIGMA * fwhm) for each in (found, star))
        return mean + background

    sharp = rng.poisson(camera(own, (N, N), FWHM, SKY)).astype(float)
    psf, deep_psf = gaussian_psf(FWHM), gaussian_psf(width)

    def row(method, scale, *images, **known):
        begin = time.perf_counter()
        estimate, flux = fitted(*images, options, **known)
        seconds = time.perf_counter() - begin
        errors = []
        for fwhm in (FWHM, SMOOTH):
            a, b = (gaussian_filter(each, SIGMA * fwhm)[INSIDE] for each in (estimate, truth))
            errors.append(np.linalg.norm(a - b) / np.linalg.norm(b))
        return (kind, scale, seed, method, *errors, flux / LIGHT - 1.0, seconds)

    yield row("sharp", 1.0, sharp, psf, background=SKY)
    for scale in SCALES:
        side = round(N / scale)
        to_deep = deep_map(scale, DEGREES, MIDDLE, side)
        # As bright as its area: a pixel of it has scale^2 of the sky's.
        background = DEEPER * SKY * scale**2
        mean = DEEPER * camera(to_deep, (side, side), width, SKY * scale**2)
        deep = rng.poisson(mean).astype(float)
        known = {
            "background": [np.full((N, N), SKY), np.full((side, side), background)],
            "exposure": [1.0, DEEPER],
            "transforms": np.array([own, to_deep]),
        }
        images, psfs = [sharp, deep], [psf, deep_psf]
        # Masked, the sharp image says on which pixels the sky is.
        unseen = [np.ones((N, N), bool), np.zeros((side, side), bool)]
        yield row("deep", scale, images, psfs, mask=unseen, **known)
        yield row("both", scale, images, psfs, **known)

        fine = resampled(deep, to_deep, (N, N), np.nan)
        n = 2 * round(0.5 * scale * len(deep_psf)) + 1
        to_psf = deep_map(scale, DEGREES, np.full(2, n // 2), len(deep_psf))
        fine_psf = resampled(deep_psf, to_psf, (n, n), 0.0)
        stack = lnocl.core.scene.transforms.of_one_shape([psf, fine_psf], 0.0, about_centre=True)
        levels = {"background": [SKY, DEEPER * SKY], "exposure": [1.0, DEEPER]}
        both = np.stack([sharp, fine])
        yield row("resampled", scale, both, stack, **levels)


def make_engine(degrees=0.0, scale=1.0):
    """Return an engine of two images with a star; of the second the map may differ."""
    side = round(SIDE / scale)
    rng = np.random.default_rng(0)
    images = [rng.poisson(100.0, (n, n)).astype(float) for n in (SIDE, side)]
    for image in images:
        image[0, 0] = np.nan  # all have a mask, as what is added to smaller images is masked
    middle = np.full(2, (SIDE - 1) / 2.0)
    is_mapped = degrees != 0.0 or scale != 1.0
    maps = [np.eye(2, 3), deep_map(scale, degrees, middle, side)]
    transforms = {"transforms": np.array(maps)} if is_mapped else {}
    y, x = np.indices((65, 65)) - 32
    psf = np.exp(-(x**2) / 9.0 - y**2 / 4.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        observation = lnocl.Observation(
            images if is_mapped else np.array(images), [psf] * 2, background=50.0, **transforms
        )
        for pad in range(0, (GRID - SIDE) // 2 + 1, 4):
            setup = Setup(observation, middle[None] + 0.2, pad, "sgp", "single", "opencl", None)
            start = make_start(setup, Penalty(0.0))
            if start.scene.grid == (GRID, GRID):
                break
        else:
            raise RuntimeError(f"no pad makes the grid {GRID} x {GRID}")
    engine = OpenCLEngine(start.scene, "single", None, 10**5, scaling=start.scaling)
    engine.start(start.extended, start.star_fluxes)
    return engine


def time_ratio(plain, turns, degrees, scale):
    """Return milliseconds of the plain engine, and the quartiles of the ratio."""
    engines = [plain, make_engine(degrees, scale)]
    for engine in engines:
        iterate(engine, "sgp", 3)
    count = max(1, round(SECONDS_A_TURN / iterate(plain, "sgp", 3)))
    times = np.array([[iterate(e, "sgp", count) for e in engines] for _ in range(turns)])
    return 1e3 * np.median(times[:, 0]), *np.quantile(times[:, 1] / times[:, 0], (0.5, 0.25, 0.75))


def measure_errors(given):
    """Return the table of errors; print its medians."""
    options = {"device": given.device}
    if given.smoothing is not None:
        options["smoothing"] = given.smoothing
    names = ("kind", "scale", "seed", "method", "sky", "smooth", "star", "seconds")
    errors = Table(names=names, dtype=("U8", float, int, "U9", *4 * [float]))
    for kind, seed in itertools.product(KINDS, range(given.seeds[0], given.seeds[1] + 1)):
        for row in measure(kind, seed, given.width, options):
            print(*(f"{v:.3g}" if isinstance(v, float) else v for v in row), flush=True)
            errors.add_row(row)
    medians = errors["kind", "scale", "method", "sky", "smooth", "seconds"].copy()
    medians["star"] = abs(errors["star"])
    medians = medians.group_by(["kind", "scale", "method"]).groups.aggregate(np.median)
    for name in ("sky", "smooth", "star", "seconds"):
        medians[name].format = "%.3g"
    medians.pprint_all()
    return errors


def measure_times(turns):
    """Return the table of times, printed."""
    columns = ("second image", "ms", "ratio", "lower", "upper")
    times = Table(names=columns, dtype=("U20", *4 * [float]))
    plain = make_engine()
    for name, each in MAPS.items():
        times.add_row((name, *time_ratio(plain, turns, *each)))
    for name in columns[1:]:
        times[name].format = "%.3g"
    times.pprint_all()
    return times


def main():
    """Print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parts = ("errors", "time")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    parser.add_argument("--seeds", nargs=2, type=int, default=[900, 902])
    parser.add_argument("--turns", type=int, default=25)
    parser.add_argument("--width", type=float, default=3.5)
    parser.add_argument("--smoothing", type=float, help="by default auto")
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    print(describe(choose(given.device).device))
    for part in given.parts:
        table = measure_errors(given) if part == "errors" else measure_times(given.turns)
        if given.output:
            table.write(f"{given.output}_{part}.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
