"""Scenes with right and wrong PSFs by the defaults: light near stars and star fluxes.

    python benchmarks/defaults.py --seeds FIRST LAST [--images P ...] [--errors NAME ...]
        [--kinds NAME ...] [--fine N] [--drizzled] [--best] [--apertures]
        [--processes N] [--device SPEC] --output FILE.ecsv
    python benchmarks/defaults.py --report FILE.ecsv

Each scene has 96 x 96 pixels, a star 0.3 to 30 times as bright as its extended source, 1e5 to 2e6
electrons of that in each image, and a PSF of a telescope behind adaptive optics, lambda / D being
2.5 pixels. Kinds: a jet, a host with a cusp, four stars on a ring with a galaxy inside, a disc; and
on request a star alone, whose errors of the extended source are relative to its flux.
The images are made with PSFs that differ from those given:

right     in nothing
shift     by up to 0.25 pixels along x and y
blur      by a Gaussian with a variance of 0.2 to 0.8 square pixels
strehl    the Strehl ratio given is 0.75 or 1.3 times the true one
phase     by aberrations of 0.15 to 0.3 rad rms, up to coma
speckles  12 other phase screens instead of 100
star      the PSF given is the image of another star, with its noise and as it is

Columns: the relative error of the extended source, in all and within 12 pixels of the stars; the
mean relative error of the star fluxes, and the largest; the errors in units of those stated; the
relative error of the PSFs given, and of those used; the error that was found; whether PSFs were
refined; the sum of the models over that of the counts; iterations; seconds, and those of a
run with one weight that judges no PSFs.

--fine 2     pixels are twice as large, so that lambda / D is 1.25 of them, the images dithered, and
             the PSFs given those of a star in the middle of a pixel
--drizzled   each image is four dithered ones with pixels twice as large, dropped on its pixels, so
             that neighbours share their noise
--best       adds the least error near the stars of any weight of the smoothing and any iteration,
             judged by the truth, with the PSFs given and with those that jitter, shift and free
             places make of them; and the star flux error there
--apertures  adds the errors of four circles of radius 4 over those stated, from 20 replicas
"""

import argparse
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product

import numpy as np
from astropy.table import Table

import lnocl
from lnocl.core.scene.penalty import recommend_smoothing

N = 96
KINDS = ("jet", "host", "ring", "disc", "alone")
# Of the smoothing that is recommended, for --best.
WEIGHTS, ITERATIONS = (0, 1, 3, 10, 30, 100), 300
ERRORS = ("right", "shift", "blur", "strehl", "phase", "speckles", "star")
Y, X = np.indices((N, N)).astype(float)
V, U = np.fft.fftfreq(N)[:, None], np.fft.rfftfreq(N)[None, :]
# What `drizzled` does to a spectrum: pixels twice as large, and drops as large as they.
DROP = (np.cos(np.pi * U) * np.cos(np.pi * V)) ** 2


def filtered(image, otf):
    """Return an image whose spectrum was multiplied."""
    return np.fft.irfft2(np.fft.rfft2(image) * otf, image.shape)


def moved(image, dx, dy):
    """Return an image moved by these pixels."""
    return filtered(image, np.exp(-2j * np.pi * (U * dx + V * dy)))


class Optics:
    """A round pupil, and phase screens that adaptive optics have flattened below a frequency."""

    def __init__(self, width=2.5, control=9.0):
        radius = N / width / 2.0
        self.x, self.y = (X - N // 2) / radius, (Y - N // 2) / radius
        self.r = np.hypot(self.x, self.y)
        self.open = (self.r <= 1) & (self.r >= 0.2)
        frequency = 2.0 * radius * np.hypot(np.fft.fftfreq(N)[:, None], np.fft.fftfreq(N))
        self.amplitude = np.zeros_like(frequency)
        np.power(frequency, -11 / 6, out=self.amplitude, where=frequency > 0)
        self.amplitude[frequency < control] *= 0.25

    def psf(self, seed, strehl, static, n_screens):
        """Return the mean PSF of some screens, with a static phase."""
        rng = np.random.default_rng(seed)
        noise = rng.standard_normal((n_screens, N, N))
        screens = np.fft.ifft2(np.fft.fft2(noise) * self.amplitude).real
        screens -= screens[:, self.open].mean(axis=1)[:, None, None]
        scale = np.sqrt(-np.log(strehl)) / np.sqrt(screens[:, self.open].var(axis=1).mean())
        fields = self.open * np.exp(1j * (scale * screens + static))
        psf = np.fft.fftshift((abs(np.fft.fft2(fields)) ** 2).sum(axis=0))
        return psf / psf.sum()

    def static(self, rng, rms):
        """Return random defocus, astigmatism and coma."""
        x, y, r = self.x, self.y, self.r
        modes = (2 * r**2 - 1, x * x - y * y, 2 * x * y, (3 * r**2 - 2) * x, (3 * r**2 - 2) * y)
        phase = sum(z * mode for z, mode in zip(rng.standard_normal(5), modes, strict=True))
        phase -= phase[self.open].mean()
        return phase * rms / phase[self.open].std()


def sky(kind, rng):
    """Return an extended source, stars, and relative fluxes."""
    centre = N / 2 + rng.uniform(-3, 3, 2)
    dx, dy = X - centre[0], Y - centre[1]
    r, angle = np.hypot(dx, dy), rng.uniform(0, 2 * np.pi)
    along = dx * np.cos(angle) + dy * np.sin(angle)
    across = dy * np.cos(angle) - dx * np.sin(angle)
    if kind == "alone":
        light = np.zeros((N, N))
    elif kind == "jet":
        bent = across - 1.5 * np.sin(along / 7)
        light = np.exp(-(bent**2) / 2.9 - along / 25) * (along > 2)
        for _ in range(3):
            place, height = rng.uniform(8, 35), rng.uniform(0.5, 3)
            light += height * np.exp(-((along - place) ** 2 + bent**2) / 4.5)
    elif kind == "host":
        ratio, index, radius = rng.uniform(0.5, 1), rng.uniform(1, 3), rng.uniform(6, 12)
        fine = (np.indices((4 * N, 4 * N)) + 0.5) / 4 - 0.5 - centre[::-1, None, None]
        a = fine[1] * np.cos(angle) + fine[0] * np.sin(angle)
        b = fine[0] * np.cos(angle) - fine[1] * np.sin(angle)
        shape = (np.sqrt(a * a * ratio + b * b / ratio) / radius) ** (1 / index)
        light = np.exp(-(2 * index - 1 / 3) * (shape - 1)).reshape(N, 4, N, 4).mean(axis=(1, 3))
        light += 0.02 * light.max() * np.exp(-((dx - 14) ** 2 + (dy - 9) ** 2) / 8)
    elif kind == "ring":
        radius, ratio, size = rng.uniform(15, 20), rng.uniform(0.6, 1), rng.uniform(4, 7)
        theta = np.arctan2(dy, dx)
        light = np.exp(-((r - radius) ** 2) / 6.5) * (1 + 0.5 * np.cos(2 * (theta - angle)))
        lens = np.exp(-4.5 * ((np.sqrt(dx**2 * ratio + dy**2 / ratio + 0.3) / size) ** 0.4 - 1))
        light += 0.5 * light.sum() * lens / lens.sum()
        angles = angle + np.array([0.2, 1.5, 3.3, 4.6]) + rng.uniform(-0.2, 0.2, 4)
        places = radius * rng.uniform(0.93, 1.07, 4) * np.array([np.cos(angles), np.sin(angles)])
        return light, centre + places.T, rng.uniform(0.4, 1, 4)
    else:
        ratio, radius = rng.uniform(0.35, 0.95), rng.uniform(12, 25)
        deprojected = np.hypot(along, across / ratio)
        light = np.exp(-((deprojected - radius) ** 2) / 12.5) * (
            1 + 0.6 * along / (deprojected + 1)
        )
        inner = (deprojected < radius) & (deprojected > 5)
        light += 0.3 * np.exp(-deprojected / 10) * inner
    return light, centre[None], np.ones(1)


def psf_pair(error, optics, rng):
    """Return the PSF that is given, and the true one."""
    strehl, static = rng.uniform(0.4, 0.8), optics.static(rng, rng.uniform(0, 0.3))
    seed = int(rng.integers(2**31))
    true = given = optics.psf(seed, strehl, static, 100)
    if error == "shift":
        true = moved(given, *rng.uniform(-0.25, 0.25, 2))
    elif error == "blur":
        true = filtered(given, np.exp(-2 * np.pi**2 * rng.uniform(0.2, 0.8) * (U**2 + V**2)))
    elif error == "strehl":
        wrong = np.clip(strehl * rng.choice([0.75, 1.3]), 0.3, 0.9)
        given = optics.psf(seed, wrong, static, 100)
    elif error == "phase":
        more = optics.static(rng, rng.uniform(0.15, 0.3))
        true = optics.psf(seed, strehl, static + more, 100)
    elif error == "speckles":
        true = optics.psf(seed + 1, strehl, static, 12)
    elif error == "star":
        image = optics.psf(seed + 1, strehl, static, 100) * 10 ** rng.uniform(5, 6) + 5
        given = rng.poisson(image) - 5.0
        given /= given.sum()
    return given, true


class Scene:
    """Images of a case, the PSFs given and true, and the truth."""

    def __init__(self, kind, error, p, seed, fine, is_drizzled):
        rng = np.random.default_rng([seed, KINDS.index(kind), ERRORS.index(error), p])
        light, stars, fluxes = sky(kind, rng)
        self.contrast, counts = 10 ** rng.uniform(-0.5, 1.5), 10 ** rng.uniform(5, 6.3)
        self.background = 10 ** rng.uniform(0.5, 2.3)
        light *= counts / (light.sum() or 1.0)
        self.fluxes = fluxes * self.contrast * counts / fluxes.sum()
        optics = Optics()
        given, true = np.swapaxes([psf_pair(error, optics, rng) for _ in range(p)], 0, 1)
        offsets = rng.uniform(-fine, fine, (p, 2)) * (fine > 1)
        self.images = []
        for psf, offset in zip(true, offsets, strict=True):
            origin = moved(np.fft.ifftshift(psf), *offset)
            mean = filtered(light, np.fft.rfft2(origin))
            mean += sum(
                c * moved(origin, *star) for c, star in zip(self.fluxes, stars, strict=True)
            )
            observe = partial(drizzled, rng) if is_drizzled else rng.poisson
            self.images.append(observe(binned(mean.clip(0.0), fine) + self.background))
        if is_drizzled:
            given, true = (
                np.array([filtered(psf, DROP) for psf in psfs]) for psfs in (given, true)
            )
        # A star at the middle of a large pixel lies half a small one beyond that pixel's first.
        to_middle = (fine - 1) / 2
        self.given, self.true = (
            np.array([binned(moved(psf, to_middle, to_middle), fine) for psf in psfs])
            for psfs in (given, true)
        )
        self.light = binned(light, fine)
        self.stars = (stars - to_middle) / fine
        self.offsets = offsets / fine if fine > 1 else None
        y, x = np.indices(self.light.shape)
        r = np.min([np.hypot(x - sx, y - sy) for sx, sy in self.stars], axis=0)
        self.near = r < 12 / fine

    def observation(self, psfs):
        """Return the images with these PSFs."""
        images = np.array(self.images, float)
        return lnocl.Observation(images, psfs, background=self.background, offsets=self.offsets)

    def error_near(self, extended):
        """Return the relative error of an extended source near the stars."""
        off = (extended - self.light)[self.near]
        return np.linalg.norm(off) / (np.linalg.norm(self.light[self.near]) or self.fluxes.sum())

    def flux_error(self, fluxes):
        """Return the mean relative error of star fluxes."""
        return float((fluxes / self.fluxes - 1.0).mean())


def drizzled(rng, mean):
    """Return the sum of four images with pixels twice as large, dropped on these."""
    total = np.zeros_like(mean)
    for by in product((0, 1), repeat=2):
        seen = rng.poisson(binned(np.roll(mean, by, (0, 1)), 2) / 4.0)
        dropped = seen.repeat(2, axis=0).repeat(2, axis=1) / 4.0
        total += np.roll(dropped, (-by[0], -by[1]), (0, 1))
    return total


def binned(image, fine):
    """Return an image in pixels that many times as large."""
    n = len(image) // fine
    return image.reshape(n, fine, n, fine).sum(axis=(1, 3))


def run(case):
    """Return a row of the table."""
    *scene, device, asks_best, asks_apertures = case
    kind, error, p, seed = scene[:4]
    scene = Scene(*scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        observation = scene.observation(scene.given)
        begin = time.perf_counter()
        result = lnocl.deconvolve(observation, scene.stars, pad=0, device=device)
        seconds = time.perf_counter() - begin
        stated = result.star_flux_errors
        weight = 3.0 * recommend_smoothing(observation)
        begin = time.perf_counter()
        lnocl.deconvolve(
            observation, scene.stars, pad=0, device=device, smoothing=weight, stop=1e-6
        )
        seconds_of_a_run = time.perf_counter() - begin
        more = best(scene, result, device) if asks_best else {}
        more |= apertures(scene, result) if asks_apertures else {}
    off, wrong = result.extended - scene.light, result.star_fluxes - scene.fluxes
    found = result.psf_refinement
    return {
        "kind": kind,
        "error": error,
        "images": p,
        "seed": seed,
        "contrast": scene.contrast,
        "all": np.linalg.norm(off) / (np.linalg.norm(scene.light) or scene.fluxes.sum()),
        "near": scene.error_near(result.extended),
        "flux": scene.flux_error(result.star_fluxes),
        "flux worst": float(abs(wrong / scene.fluxes).max()),
        "of stated": float(np.median(abs(wrong / stated))),
        "psf given": relative(scene.given, scene.true),
        "psf used": relative(result.psfs, scene.true),
        "found": 0.0 if found is None else found.psf_error,
        "refined": found is not None and found.is_accepted,
        "light": float(result.models().sum() / np.sum(scene.images)),
        "iterations": result.n_iter,
        "seconds": seconds,
        "seconds of a run": seconds_of_a_run,
        **more,
    }


def best(scene, result, device):
    """Return the least errors near the stars of all weights and iterations, by the truth."""
    found = []
    asked = lnocl.deconvolve(
        scene.observation(scene.given),
        scene.stars,
        pad=0,
        device=device,
        n_iter=20,
        stop=None,
        smoothing=0.0,
        refine_positions=True,
        refine_psfs=("jitter",) if len(scene.images) == 1 else ("jitter", "shift"),
    )
    for psfs, stars in ((scene.given, scene.stars), (asked.psfs, asked.star_positions)):
        observation = scene.observation(psfs)
        recommended = recommend_smoothing(observation)
        for weight in WEIGHTS:

            def look(iteration, estimate):
                if iteration & (iteration - 1) == 0 or iteration % 25 == 0:
                    at = scene.error_near(estimate.extended)
                    found.append((at, scene.flux_error(estimate.star_fluxes)))

            lnocl.deconvolve(
                observation,
                stars,
                pad=0,
                device=device,
                n_iter=ITERATIONS,
                stop=None,
                smoothing=weight * recommended,
                callback=look,
            )
    error, flux = min(found)
    return {"best": error, "best flux": flux}


def apertures(scene, result):
    """Return how many stated errors the light of four circles is off."""
    from regions import CirclePixelRegion, PixCoord

    x, y = scene.stars[0]
    places = [(x + 6, y), (x, y - 9), (x - 12, y), (x, y + 16)]
    circles = [CirclePixelRegion(PixCoord(*at), 4.0) for at in places]
    found = result.bootstrap(20, regions=circles)
    truth = [(circle.to_mask("exact").multiply(scene.light)).sum() for circle in circles]
    values = [
        (quantity.value - bias, error)
        for quantity, bias, error in zip(
            found.quantities, found.bias, found.standard_errors, strict=True
        )
        if not quantity.name.startswith("star")
    ]
    return {
        f"circle {k + 1}": float((value - light) / error)
        for k, ((value, error), light) in enumerate(zip(values, truth, strict=True))
    }


def relative(psfs, true):
    """Return the mean relative error of PSFs."""
    errors = np.linalg.norm(psfs - true, axis=(1, 2)) / np.linalg.norm(true, axis=(1, 2))
    return float(errors.mean())


def report(table):
    """Print a line for each error and number of images."""
    print(
        "median, 90 % and largest: error near the stars | flux error | median of: PSF given, used"
    )
    for error, p in product(ERRORS, sorted(set(table["images"]))):
        rows = table[(table["error"] == error) & (table["images"] == p)]
        if not len(rows):
            continue
        near, flux = (
            " ".join(f"{v:.3f}" for v in np.percentile(abs(rows[name]), (50, 90, 100)))
            for name in ("near", "flux")
        )
        psfs = " ".join(f"{np.median(rows[f'psf {name}']):.3f}" for name in ("given", "used"))
        held = [float((rows["of stated"] < z).mean()) for z in (1, 2)]
        print(
            f"{error:8} {p} images, {len(rows):3}: {near} | {flux} | {psfs} | refined in "
            f"{rows['refined'].sum()}, errors found in {(rows['found'] > 0).sum()}; within 1, 2 "
            f"stated errors {held[0]:.2f} {held[1]:.2f}; {np.median(rows['seconds']):.1f} s, "
            f""
            f"{np.median(rows['seconds'] / rows['seconds of a run']):.1f} runs"
        )
        if "best" in rows.colnames:
            ratios = np.percentile(rows["near"] / rows["best"], (50, 90, 100))
            print(
                "         over the best: " + " ".join(f"{each:.2f}" for each in ratios),
                f"| flux error there {np.median(abs(rows['best flux'])):.3f}",
            )
        if "circle 1" in rows.colnames:
            off = abs(np.array([rows[f"circle {k}"] for k in range(1, 5)]))
            print(
                f"         circles within 1, 2 errors {(off < 1).mean():.2f} {(off < 2).mean():.2f}"
            )


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "LAST"), default=(0, 1))
    parser.add_argument("--images", nargs="+", type=int, default=(1, 4), metavar="P")
    parser.add_argument("--errors", nargs="+", choices=ERRORS, default=ERRORS)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS[:4])
    parser.add_argument("--fine", type=int, default=1, metavar="N")
    parser.add_argument("--drizzled", action="store_true")
    parser.add_argument("--best", action="store_true")
    parser.add_argument("--apertures", action="store_true")
    parser.add_argument("--processes", type=int, default=2, metavar="N")
    parser.add_argument("--device", metavar="SPEC")
    parser.add_argument("--output", metavar="FILE.ecsv")
    parser.add_argument("--report", metavar="FILE.ecsv")
    given = parser.parse_args()
    if given.report:
        report(Table.read(given.report))
        return
    seeds = range(*given.seeds)
    cases = [
        (
            *(kind, error, p, seed, given.fine, given.drizzled),
            *(given.device, given.best, given.apertures),
        )
        for seed, p, error, kind in product(seeds, given.images, given.errors, given.kinds)
    ]
    with ProcessPoolExecutor(given.processes) as pool:
        table = Table(rows=list(pool.map(run, cases)))
    for name in table.colnames:
        if table[name].dtype.kind == "f":
            table[name].info.format = ".5g"
            table[name] = [float(f"{value:.5g}") for value in table[name]]
    if given.output:
        table.write(given.output, overwrite=True)
    report(table)


if __name__ == "__main__":
    main()
