"""Fluxes of stars and regions in scenes that nothing was tuned on, PSFs right and wrong.

    python benchmarks/blind_psfs.py [--scenes FIRST LAST] [--kinds KIND ...] [--psfs PSF ...]
        [--replicas N] [--psf-error SHARE] [--output FILE.ecsv]

Scenes 0 to 199 go through eight kinds, eleven PSFs, 1, 4 and 8 images, and four ways:

alone, bright, host, ring (four stars round a lens), jet, disc, clumps, crowded
right, scale (3 %), blur (half a pixel), focus, coma, astigmatism (.3 rad), speckles (others of .25
rad), cut (.97 to .995 of the light), pedestal (2 to 5 %), noisy (a star of 1e5 to 1e6 electrons),
sampling (points where pixels collect light)
plain (dithered), turned, epochs, finer (a sky twice as fine, 1.6 pixels to lambda / D)

True PSFs are those of a pupil with aberrations that are others for each image. All is by default,
but PSFs are not centred. With replicas circles of radius 3, 8 and 20 are measured too. The tables
have, for each kind of PSF and scene, number of images and way, the share of fluxes within intervals
of 68 and 95 %, the medians of errors and of those stated, the rms of one over the other, and
seconds. In shares and rms each scene counts once, whatever its number of stars and epochs.
"""

import argparse
import time
from functools import partial

import numpy as np
from astropy.table import Table
from honest import Scene, coarse, options_of, run, seen
from regions import CirclePixelRegion, PixCoord
from scipy.fft import next_fast_len
from scipy.ndimage import gaussian_filter

import lnocl
from lnocl.io.regions import read_apertures

KINDS = "alone", "bright", "host", "ring", "jet", "disc", "clumps", "crowded"
ERRORS = "right", "scale", "blur", "focus", "coma", "astigmatism", "speckles", "cut", "pedestal"
ERRORS = *ERRORS, "noisy", "sampling"
WAYS = "plain", "turned", "epochs", "finer"
N = 48
MIDDLE = np.array([23.0, 24.0])
CIRCLES = {3: (32, 28), 8: MIDDLE, 20: MIDDLE}


def zernike(u, v):
    """Return focus, coma along x and y, and astigmatism, of 1 rad rms over a pupil."""
    square = u**2 + v**2
    coma = np.sqrt(8) * (3 * square - 2)
    return np.array(
        [
            np.sqrt(3) * (2 * square - 1),
            coma * u,
            coma * v,
            np.sqrt(6) * (u**2 - v**2),
            np.sqrt(24) * u * v,
        ]
    )


def optics(side, resolution, phases, waves, blur=0.0):
    """Return the PSF of a pupil, of unit sum, with lambda / D in pixels.

    Phases are those of `zernike`, rad, and waves rows of cycles across the pupil, phase and rad.
    """
    size = next_fast_len(2 * side)
    v, u = np.meshgrid(*2 * [np.fft.fftfreq(size) * 2 * resolution], indexing="ij")
    r = np.hypot(u, v)
    pupil = np.clip((1 - r) * size / 4 / resolution + 0.5, 0, 1) * (r > 0.2)
    phase = np.tensordot(phases, zernike(u, v), 1)
    for a, b, start, height in waves:
        phase = phase + height * np.cos(np.pi * (a * u + b * v) + start)
    values = np.fft.fftshift(abs(np.fft.fft2(pupil * np.exp(1j * phase))) ** 2)
    first = size // 2 - side // 2
    values = gaussian_filter(values, blur)[first : first + side, first : first + side]
    y, x = np.indices((side, side)) - side // 2
    taper = np.clip((np.hypot(x, y) / (side // 2) - 0.7) / 0.3, 0, 1)
    values = values * np.cos(np.pi / 2 * taper) ** 2
    return values / values.sum()


def speckles(rng, rms=0.25):
    """Return waves of 2 to 5 cycles across the pupil, for `optics`."""
    turns, cycles = rng.uniform(0, 2 * np.pi, (2, 8)), rng.uniform(2, 5, 8)
    heights = rng.normal(size=8)
    heights *= rms * np.sqrt(2) / np.linalg.norm(heights)
    return np.array([cycles * np.cos(turns[0]), cycles * np.sin(turns[0]), turns[1], heights]).T


def make_psfs(rng, error, p, q):
    """Return true PSFs with three samples to each of those given, and these, q to a pixel."""
    side, width = 31 * q + 1 - q % 2, (1.6 if q == 2 else 2.8) * 3 * q
    sign, turn = rng.choice([-1, 1]), rng.uniform(0, 2 * np.pi)
    scale, blur, blurred = 1 + 0.03 * sign * (error == "scale"), 0.3 * q, 0.3 * q
    if error == "blur":
        blur, blurred = (0.3 * q, 0.6 * q)[::sign]
    change = np.zeros(5)
    if error in ("focus", "coma", "astigmatism"):
        axes = {"focus": [0], "coma": [1, 2], "astigmatism": [3, 4]}[error]
        change[axes] = 0.3 * np.array([np.cos(turn), np.sin(turn)] if len(axes) > 1 else [sign])
    true, given = [], []
    for _ in range(p):
        phases, waves = rng.normal(0, 0.15, 5), speckles(rng)
        resolution = width * rng.uniform(0.95, 1.05)
        true.append(optics(3 * side, resolution, phases, waves, 3 * blur))
        waves = speckles(rng) if error == "speckles" else waves
        fine = optics(3 * side, resolution * scale, phases + change, waves, 3 * blurred)
        given.append(9 * fine[1::3, 1::3] if error == "sampling" else coarse(fine, 3))
    return true, [altered(rng, error, each) for each in given]


def altered(rng, error, psf):
    """Return what a file has of a PSF that is cut, on a pedestal, or the image of a star."""
    if error == "cut":
        middle, share = len(psf) // 2, rng.uniform(0.97, 0.995)
        k = 1
        while psf[middle - k : middle + k + 1, middle - k : middle + k + 1].sum() < share:
            k += 1
        return psf[middle - k : middle + k + 1, middle - k : middle + k + 1]
    if error == "pedestal":
        return psf + rng.uniform(0.02, 0.05) / psf.size
    if error == "noisy":
        return rng.poisson(10 ** rng.uniform(5, 6) * psf + 30) - 30.0
    return psf


def source(rng, kind):
    """Return a function of places from the middle, or None, and places of stars from there."""
    near, turn, ratio = rng.uniform(-0.5, 0.5, (1, 2)), rng.uniform(0, 2 * np.pi), rng.uniform(1, 2)

    def turned(x, y):
        return np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x

    def blobs(places, widths, heights):
        def draw(x, y):
            parts = zip(places, widths, heights, strict=True)
            return sum(
                h * np.exp(-((x - a) ** 2 + (y - b) ** 2) / w**2 / 2) for (a, b), w, h in parts
            )

        return draw

    if kind in ("alone", "bright"):
        return None, near
    if kind == "host":
        width, power = rng.uniform(1.0, 4.0), rng.uniform(0.8, 2.0)

        def host(x, y):
            a, b = turned(x - near[0, 0], y - near[0, 1])
            return np.exp(-((np.hypot(a, b * ratio) / width) ** power))

        return host, near
    if kind in ("ring", "disc"):
        radius, width, side = rng.uniform(7, 11), rng.uniform(1.5, 3), rng.uniform(0, 0.8)
        ratio = min(ratio, 1.15) if kind == "ring" else ratio

        def ring(x, y):
            a, b = turned(x, y)
            light = np.exp(-0.5 * ((np.hypot(a, b * ratio) - radius) / width) ** 2)
            light = light * (1 + side * a / radius)
            return light + (kind == "ring") * 3 * np.exp(-0.5 * (x**2 + y**2) / 4)

        around = turn + np.array([0, 1.7, 3.0, 4.4]) + rng.uniform(-0.2, 0.2, 4)
        four = radius * np.array([np.cos(around), np.sin(around)]).T
        return ring, four if kind == "ring" else near
    if kind == "jet":
        along = np.cumsum(rng.uniform(3, 5, 5))
        places = np.array([along * np.cos(turn), along * np.sin(turn)]).T
        places += rng.normal(0, 0.7, places.shape)
        return blobs(places, rng.uniform(1, 2.5, 5), rng.uniform(0.3, 1, 5)), near
    places = rng.uniform(-15, 15, (12, 2))
    draw = blobs(places, rng.uniform(1, 4, 12), rng.uniform(0.2, 1, 12))
    stars = [*near]
    while kind == "crowded" and len(stars) < 8:
        other = rng.uniform(-17, 17, 2)
        if min(np.hypot(*(other - each)) for each in stars) > 5:
            stars.append(other)
    return draw, np.array(stars)


def make_scene(index):
    """Return a scene and what it is of, and the extended source on pixels of the images."""
    rng = np.random.default_rng([index, 55])
    kind, error = KINDS[index % 8], ERRORS[index % 11]
    p, way = (1, 4, 8)[index % 3], WAYS[index // 8 % 4]
    p = 4 if p == 1 and way in ("turned", "epochs") else p
    q = 2 if way == "finer" else 1
    draw, places = source(rng, kind)
    stars, maps = MIDDLE + places, np.array([np.eye(2, 3)] * p)
    level = 10 ** (rng.uniform(4, 6) if kind == "bright" else rng.uniform(1, 2.5))
    flux = 10 ** rng.uniform(4.7, 5.7) * (30 if kind == "bright" else 1)
    fluxes = np.repeat(flux * np.append(1, rng.uniform(0.2, 1, len(stars) - 1))[:, None], p, 1)
    depths = rng.uniform(0.5, 1.5, p)
    known = {"background": level, "exposure": depths, "oversample": q, "psf_centre": "given"}
    if way == "turned":
        known["transforms"] = maps = lnocl.rotations(np.linspace(0, 60, p), MIDDLE)
    elif way == "epochs":
        known["epochs"] = range(p)
        fluxes = fluxes * rng.uniform(0.7, 1.3, fluxes.shape)
    elif p > 1:
        maps[:, :, 2] = known["offsets"] = rng.uniform(-1.5, 1.5, (p, 2))
    fine = 3 * q
    at = (np.arange(N * fine) + 0.5) / fine - 0.5
    pixels = np.array(np.meshgrid(at, at))

    def sky_of(to_image):
        """Return the extended source in fine pixels of an image, and None for none."""
        if draw is None:
            return np.zeros(pixels.shape[1:])
        moved = pixels - to_image[:, 2][:, None, None]
        x, y = np.einsum("ji,jyx->iyx", to_image[:, :2], moved) - MIDDLE[:, None, None]
        return draw(x, y)

    sky = sky_of(np.eye(2, 3))
    light = flux * rng.uniform(0.3, 2) if draw else 0.0
    unit = light / sky.sum() if draw else 0.0
    true, given = make_psfs(rng, error, p, q)
    images = []
    for j in range(p):
        placed = fine * (stars @ maps[j][:, :2].T + maps[j][:, 2] + 0.5) - 0.5
        image = seen(N * fine, true[j], placed, fluxes[:, j], unit * sky_of(maps[j]))
        images.append(rng.poisson(level + depths[j] * coarse(image, fine)))
    fluxes = fluxes.ravel() if way == "epochs" else fluxes[:, 0]
    scene = Scene(images, given, known, stars, fluxes, light)
    of = {"scene": index, "kind": kind, "psf": error, "images": p, "way": way}
    return scene, of, coarse(unit * sky, fine)


def measure(index, replicas, **options):
    """Yield a row for each flux of a scene."""
    scene, of, sky = make_scene(index)
    begun = time.perf_counter()
    result, found, errors, _, _, kappa, told = run(scene, **options)
    seconds = time.perf_counter() - begun
    rows = [("star", *each) for each in zip(scene.fluxes, found, errors, strict=True)]
    if replicas and result is not None:
        circles = [CirclePixelRegion(PixCoord(*at), r) for r, at in CIRCLES.items()]
        said = result.bootstrap(replicas, regions=circles)
        fluxes = [each.flux(sky) for each in read_apertures(circles, None, sky.shape)]
        last = slice(-len(CIRCLES), None)
        values = (said.values - said.bias)[last], said.standard_errors[last]
        names = [f"radius {r}" for r in CIRCLES]
        rows += list(zip(names, fluxes, *values, strict=True))
    for what, truth, value, error in rows:
        yield of | {
            "what": what,
            "truth": float(truth),
            "flux": value,
            "stated": error,
            "sigmas": (value - truth) / error,
            "kappa": kappa,
            "seconds": seconds,
            "told": " | ".join(told),
            "weight": 1 / len(scene.fluxes) if what == "star" else 1.0,
        }


def summarise(table, by):
    """Return a row for each value of a column, and for stars and regions."""
    rows = []
    for what in dict.fromkeys(table["what"]):
        for value in dict.fromkeys(table[by]):
            group = table[(table[by] == value) & (table["what"] == what)]
            sigmas, scale = abs(group["sigmas"]), np.maximum(group["truth"], 1)
            mean = partial(np.average, weights=group["weight"])
            rows.append(
                {
                    by: value,
                    "what": what,
                    "scenes": len(set(group["scene"])),
                    "68": mean(sigmas < 0.994),
                    "95": mean(sigmas < 1.96),
                    "off": np.median(abs(group["flux"] / scale - 1)),
                    "stated": np.median(group["stated"] / scale),
                    "rms": np.sqrt(mean(sigmas**2)),
                    "seconds": mean(group["seconds"]),
                }
            )
    found = Table(rows)
    for name in found.colnames[3:]:
        found[name].format = "%.3f"
    return found


def main():
    """Print and write the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, nargs=2, default=(0, 199), metavar=("FIRST", "LAST"))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--psfs", nargs="+", choices=ERRORS, default=ERRORS)
    parser.add_argument("--replicas", type=int, default=0)
    parser.add_argument("--psf-error", type=float, help="that of deconvolve, which has to have it")
    parser.add_argument("--output", metavar="FILE.ecsv")
    given = parser.parse_args()
    rows = []
    for index in range(given.scenes[0], given.scenes[1] + 1):
        if KINDS[index % 8] not in given.kinds or ERRORS[index % 11] not in given.psfs:
            continue
        new = list(measure(index, given.replicas, **options_of(given)))
        for row in new:
            print(*(f"{x:.4g}" if isinstance(x, float) else str(x)[:70] for x in row.values()))
        rows += new
        if given.output:
            Table(rows).write(given.output, overwrite=True)
    for by in ("psf", "kind", "images", "way"):
        summarise(Table(rows), by).pprint(max_lines=-1, max_width=-1)


if __name__ == "__main__":
    main()
