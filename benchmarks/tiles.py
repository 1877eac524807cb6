"""PSFs that vary over the field, and frames in tiles: accuracy, seams and cost.

``python benchmarks/tiles.py PART``, PART one of

- ``operators``: models of a field whose PSF grows by half and turns by 60 degrees from the middle
  to the corner, against a PSF for each of its 192 x 192 pixels: error over the image's peak, and
  transforms in those of one PSF for all.
- ``field``: such a field of 2048 x 2048 pixels with 100 stars and extended structure: tiles with a
  3 x 3 grid of PSFs, and one PSF for all; errors, jumps across seams, seconds in turn.
- ``whole``: tiles beside the whole, 2048 x 2048, one PSF, for solvers and numbers of iterations.
- ``frame``: 8192 x 8192 in tiles: device memory and seconds.
- ``kinds``: tiles beside the whole, 192 x 192, for shifted and turned images, larger pixels, epochs
  and a transmission; both against the sky and the stars that were simulated.
- ``components``: line and continuum, 384 x 384, 20 stars, by default: tiles beside the whole.
"""

import argparse
import itertools
import logging
import re
import time
import warnings

import numpy as np
from scipy.signal import fftconvolve

import lnocl
from lnocl.core.scene.shifting import MovablePsf
from lnocl.metrics import restoration_error

warnings.simplefilter("ignore", lnocl.LnoclWarning)


def make_psf(x, y, size, half=24, fwhm=3.5):
    """Return an elliptical Moffat function, half as wide again in the corners and turned there."""
    middle = (size - 1) / 2.0
    r = np.hypot(x - middle, y - middle) / np.hypot(middle, middle)
    width, angle = fwhm * (1.0 + 0.5 * r), np.deg2rad(60.0 * r)
    v, u = np.mgrid[-half : half + 1, -half : half + 1].astype(float)
    scale = 2.0 * np.sqrt(2.0 ** (1.0 / 2.5) - 1.0) / width
    along = scale * np.sqrt(0.8) * (u * np.cos(angle) + v * np.sin(angle))
    across = scale / np.sqrt(0.8) * (v * np.cos(angle) - u * np.sin(angle))
    psf = (1.0 + along**2 + across**2) ** -2.5
    return psf / psf.sum()


def make_field(n, size, **how):
    """Return the PSFs at n x n nodes, from corner to corner."""
    nodes = np.linspace(0.0, size - 1.0, n)
    positions = [(x, y) for y in nodes for x in nodes]
    return lnocl.PsfField([make_psf(x, y, size, **how) for x, y in positions], positions)


def make_sky(size, seed, n_sources):
    """Return exponential discs of many sizes and angles on a faint level."""
    rng = np.random.default_rng(seed)
    sky = np.full((size, size), 2.0)
    for _ in range(n_sources):
        (cx, cy), scale = rng.uniform(0, size, 2), rng.uniform(2.0, 12.0)
        reach = int(12 * scale)
        rows = slice(max(int(cy) - reach, 0), int(cy) + reach)
        columns = slice(max(int(cx) - reach, 0), int(cx) + reach)
        y, x = np.mgrid[rows, columns][:, : size - rows.start, : size - columns.start]
        y, x = y[: size - rows.start], x[: size - rows.start]
        angle, ratio = rng.uniform(0, np.pi), rng.uniform(0.4, 1.0)
        u = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        v = ((y - cy) * np.cos(angle) - (x - cx) * np.sin(angle)) / ratio
        there = sky[rows, columns]
        there += rng.uniform(20, 200) * np.exp(
            -np.hypot(u, v)[: there.shape[0], : there.shape[1]] / scale
        )
    return sky


def hats(nodes, size):
    """Return the weights of bilinear interpolation along an axis, shape (nodes, size)."""
    at = np.arange(size)
    return np.array([np.interp(at, nodes, row) for row in np.eye(len(nodes))])


def see(sky, field, n):
    """Return the image of a sky, its PSFs bilinear between n x n nodes: weights come before."""
    size, half = len(sky), field.shape[0] // 2
    nodes = np.linspace(0.0, size - 1.0, n)
    weights = hats(nodes, size)
    image = np.zeros((size + 2 * half, size + 2 * half))
    for j, y in enumerate(nodes):
        rows = np.flatnonzero(weights[j])
        for i, x in enumerate(nodes):
            columns = np.flatnonzero(weights[i])
            part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            light = sky[part] * np.outer(weights[j][part[0]], weights[i][part[1]])
            image[
                part[0].start : part[0].stop + 2 * half, part[1].start : part[1].stop + 2 * half
            ] += fftconvolve(light, field.at(x, y))
    return image[half:-half, half:-half]


def operators():
    """Compare models of a field with a PSF for each pixel."""
    size, half = 192, 24
    for scene, sky in (
        ("discs of 2 to 12 pixels", make_sky(size, 0, 25)),
        ("one point a pixel bright", np.pad(np.ones((1, 1)), ((70, 121), (140, 51)))),
    ):
        exact = np.zeros((size + 2 * half, size + 2 * half))
        for (y, x), light in np.ndenumerate(sky):
            if light:
                exact[y : y + 2 * half + 1, x : x + 2 * half + 1] += light * make_psf(x, y, size)
        exact = exact[half:-half, half:-half]
        print(f"\n{scene}: largest and rms error over the peak")

        def report(name, image, cost, exact=exact):
            error = abs(image - exact)[half:-half, half:-half] / exact.max()
            print(f"{name:58s} {error.max():.4f} {np.sqrt((error**2).mean()):.5f}  {cost}")

        field = make_field(3, size)
        report("one PSF for all", fftconvolve(sky, field.at(95.5, 95.5), "same"), "1")
        for n in (3, 4, 6, 8, 10):
            edges = np.linspace(0, size, n + 1).astype(int)
            image = np.zeros_like(sky)
            for a, b in itertools.pairwise(edges):
                for c, d in itertools.pairwise(edges):
                    psf = field.at((c + d - 1) / 2, (a + b - 1) / 2)
                    image[a:b, c:d] = fftconvolve(sky, psf, "same")[a:b, c:d]
            report(f"{n} x {n} tiles, PSFs of their middles from 3 x 3 nodes", image, "margins")
        for n in (3, 5):
            cost = "2.5, and margins"  # four skies there for each pixel, one image back
            grid = make_field(n, size)
            report(f"{n} x {n} nodes, weights before", see(sky, grid, n), cost)
            nodes = np.linspace(0, size - 1, n)
            weights = hats(nodes, size)
            after = sum(
                np.outer(weights[j], weights[i]) * fftconvolve(sky, grid.at(x, y), "same")
                for j, y in enumerate(nodes)
                for i, x in enumerate(nodes)
            )
            report(f"{n} x {n} nodes, weights after", after, cost)


def observe(size, seed, n_stars, field):
    """Return counts of a field whose PSFs are bilinear between 33 x 33 nodes, sky and stars."""
    rng = np.random.default_rng(seed)
    sky = make_sky(size, seed, size * size // 4000)
    stars = rng.uniform(20, size - 20, (n_stars, 2))
    fluxes = 10.0 ** rng.uniform(3.5, 5.5, n_stars)
    image = see(sky, field, 33) + 10.0
    for (x, y), flux in zip(stars, fluxes, strict=True):
        cutout = MovablePsf(field.at(x, y), (size, size)).at(x, y)
        cutout.add_to(image, (0, 0), (size, size), flux)
    return rng.poisson(np.maximum(image, 0.0)).astype(float), sky, stars, fluxes


def jumps(found, truth, edges):
    """Return the rms step of the error across seams, over that across all other lines."""
    error = np.diff(found - truth, axis=0)
    rms = np.sqrt((error**2).mean(axis=1))
    seams = np.zeros(len(rms), bool)
    seams[np.asarray(edges) - 1] = True
    return float(np.median(rms[seams]) / np.median(rms[~seams]))


def rows_of(tiles):
    """Return the rows at which tiles begin, but for the first."""
    return sorted({int(y) for y in tiles["y"]} - {0})


def field():
    """Compare tiles with one PSF for all, where the PSF varies."""
    size = 2048
    exact = make_field(33, size)
    for seed in (0, 1):
        counts, sky, stars, fluxes = observe(size, seed, 100, exact)
        varied = lnocl.Observation(counts, make_field(3, size), background=10.0)
        one = lnocl.Observation(counts, make_psf(1023.5, 1023.5, size), background=10.0)
        for stop in (None, "held-out"):
            run = {"stop": stop, "n_iter": 150 if stop is None else 1000}

            def whole(observation=one, stars=stars, run=run):
                result = lnocl.deconvolve(observation, stars, **run)
                result.star_flux_errors, result.star_residuals(), result.models()
                return result

            def tiled(observation=varied, stars=stars, run=run):
                return lnocl.deconvolve_tiles(observation, stars, **run)

            seconds = {}
            for _ in range(2 if stop is None else 1):
                for name, solve in (("one PSF", whole), ("tiles", tiled)):
                    begun = time.perf_counter()
                    result = solve()
                    seconds.setdefault(name, []).append(time.perf_counter() - begun)
                    off = abs(result.star_fluxes / fluxes - 1.0)
                    bright = fluxes > 3e4
                    rms = result.fit().rms
                    error = restoration_error(result.extended, sky)
                    if len(seconds[name]) == 1:
                        print(
                            f"seed {seed}, stop {stop}: {name}: {result.n_iter} iterations, "
                            f"smoothing {result.smoothing:.2g}, error of the extended source "
                            f"{error:.4f}, residuals {rms:.3f}, fluxes of stars above 3e4 off by "
                            f"{np.median(off[bright]):.4f}, at most {off[bright].max():.3f}"
                        )
            print(
                f"  {len(result.tiles)} tiles; steps across seams over those elsewhere "
                f"{jumps(result.extended, sky, rows_of(result.tiles)):.3f}; seconds "
                f"{np.median(seconds['tiles']):.1f} and {np.median(seconds['one PSF']):.1f}: "
                f"{np.median(seconds['tiles']) / np.median(seconds['one PSF']):.2f} times"
            )


def whole():
    """Compare tiles with the whole, one PSF for all."""
    size = 2048
    psf = make_psf(1023.5, 1023.5, size)
    same = lnocl.PsfField([psf], [(0, 0)])
    for run, n_stars in (
        ({"solver": "sgm", "n_iter": 100, "smoothing": 0.0, "stop": None}, 0),
        ({"n_iter": 60, "stop": None}, 100),
        ({"n_iter": 300, "stop": None}, 100),
        ({"n_iter": 2000, "smoothing": 0.02, "stop": None}, 100),
        ({}, 100),
    ):
        counts, sky, of, _ = observe(size, 5, n_stars, same)
        observation = lnocl.Observation(counts, psf, background=10.0)
        one = lnocl.deconvolve(observation, of, **run)
        for tile in (512, 1024):
            result = lnocl.deconvolve_tiles(observation, of, tile=tile, **run)
            peak = np.percentile(one.extended, 99.99)
            difference = abs(result.extended - one.extended) / peak
            inner = np.zeros(difference.shape, bool)
            for each in result.tiles:
                x, y, w, h = (int(each[name]) for name in ("x", "y", "width", "height"))
                inner[y + h // 4 : y + h * 3 // 4, x + w // 4 : x + w * 3 // 4] = True
            blends = ~inner
            blends[:24] = blends[-24:] = blends[:, :24] = blends[:, -24:] = False
            errors = [restoration_error(each.extended, sky) for each in (result, one)]
            off = abs(result.star_fluxes / one.star_fluxes - 1.0).max() if len(of) else 0.0
            print(
                f"{run}, tiles of {tile}: largest difference over the peak in the middle "
                f"{difference[inner].max():.1e}, elsewhere {difference[blends].max():.1e}, rms "
                f"{np.sqrt((difference[inner] ** 2).mean()):.1e}; fluxes {off:.1e}; errors "
                f"{errors[0]:.4f} and {errors[1]:.4f}; iterations {result.n_iter}, {one.n_iter}"
            )


class _Announced(logging.Handler):
    """Remembers the largest scene that is announced, MiB."""

    most = 0.0

    def emit(self, record):
        found = re.search(r"the scene takes ([\d.]+) MiB", record.getMessage())
        if found:
            self.most = max(self.most, float(found[1]))


def frame():
    """Reconstruct 8192 x 8192 pixels in tiles."""
    size = 8192
    psf = make_psf(4095.5, 4095.5, size)
    small = 2048
    counts, _, stars, _ = observe(small, 6, 100, lnocl.PsfField([psf], [(0, 0)]))
    counts = np.tile(counts, (size // small, size // small))
    shifts = [(x, y) for y in range(0, size, small) for x in range(0, size, small)]
    stars = np.concatenate([stars + shift for shift in shifts])[::4]
    observation = lnocl.Observation(counts, psf, background=10.0)
    del counts
    heard = _Announced()
    log = logging.getLogger("lnocl")
    log.addHandler(heard)
    log.setLevel(logging.INFO)
    for tile in (1024, 2048):
        heard.most = 0.0
        begun = time.perf_counter()
        result = lnocl.deconvolve_tiles(observation, stars, tile=tile, n_iter=50, stop=None)
        print(
            f"{len(result.tiles)} tiles of {tile}: {time.perf_counter() - begun:.0f} s, "
            f"{heard.most:.0f} MiB of the device's memory; residuals {result.fit().rms:.3f}"
        )


def gaussian(dx, dy, covariance):
    """Return a Gaussian of unit flux at these distances from its middle."""
    (a, b), (_, c) = np.linalg.inv(covariance)
    exponent = a * dx**2 + 2 * b * dx * dy + c * dy**2
    return np.exp(-0.5 * exponent) / (2 * np.pi * np.sqrt(np.linalg.det(covariance)))


def lopsided(dx, dy, covariance):
    """Return a Gaussian with a ghost beside it."""
    ghost = gaussian(dx - 1.4, dy + 0.9, covariance)
    return 0.75 * gaussian(dx, dy, covariance) + 0.25 * ghost


SIZE = 192
PSF_COVARIANCES = [[[1.8, 0.4], [0.4, 1.2]], [[1.3, 0], [0, 1.7]], [[1.4, -0.3], [-0.3, 1.5]]]
TURNED = lnocl.rotations([0.0, 17.0, -75.0], (96.0, 90.0))
SCALED = np.concatenate([TURNED[:2], [[[0.6, 0.1, -6.0], [-0.1, 0.6, 36.0]]]])
KINDS = {
    "as they are": {},
    "shifted by up to 23 pixels": {"offsets": [(0, 0), (14.4, -23.3), (-20.0, 9.5)]},
    "turned by 0, 17 and -75 degrees": {"transforms": TURNED},
    "turned, and pixels 1.64 as large": {"transforms": SCALED},
    "two epochs": {"epochs": [0, 1, 0]},
    "behind a transmission": {"transmission": True},
    "turned, epochs, transmission": {"transforms": TURNED, "epochs": [0, 1, 0]}
    | {"transmission": True},
}


def see_sources(sources, turn, shift, psf):
    """Return the image of Gaussian sources: flux, place and covariance of each."""
    y, x = np.indices((SIZE, SIZE))
    image = np.zeros((SIZE, SIZE))
    for flux, place, covariance in sources:
        at, wide = turn @ place + shift, turn @ covariance @ turn.T + psf
        reach = int(6 * np.sqrt(wide.max())) + 4
        first, last = (np.clip(np.round(at).astype(int) + n, 0, SIZE) for n in (-reach, reach))
        there = np.s_[first[1] : last[1], first[0] : last[0]]
        image[there] += flux * lopsided(x[there] - at[0], y[there] - at[1], wide)
    return image


def behind(sources, mask):
    """Return Gaussian sources less what a Gaussian mask hides of each, which is one too."""
    depth, middle, width = mask
    parts = []
    for flux, place, covariance in sources:
        share = depth * 2 * np.pi * np.sqrt(np.linalg.det(width))
        share *= gaussian(*(place - middle), covariance + width)
        if covariance.any():
            inverses = np.linalg.inv(covariance), np.linalg.inv(width)
            both = np.linalg.inv(sum(inverses))
            at = both @ (inverses[0] @ place + inverses[1] @ middle)
            parts += [(flux, place, covariance), (-share * flux, at, both)]
        else:
            parts.append(((1.0 - share) * flux, place, covariance))
    return parts


def kinds():
    """Compare tiles with the whole in several kinds of scenes, and both with the truth."""
    y, x = np.indices((SIZE, SIZE))
    mask = 0.8, np.array([90.0, 100.0]), np.diag([150.0, 90.0])
    for name, given in KINDS.items():
        rng, given = np.random.default_rng(3), dict(given)
        has_mask, epochs = given.pop("transmission", False), given.get("epochs", [0, 0, 0])
        sources = []
        for _ in range(25):
            a, b, c = rng.uniform((4, 4, -3), (30, 30, 3))
            flux, place = 10 ** rng.uniform(3.5, 5), rng.uniform(20, SIZE - 20, 2)
            sources.append((flux, place, np.array([[a, c], [c, b]])))
        stars = rng.uniform(10, SIZE - 10, (15, 2))
        fluxes = 10.0 ** rng.uniform(3.7, 5.0, (2, 15))
        maps = np.array(given.get("transforms", [np.eye(2, 3)] * 3))
        if "offsets" in given:
            maps[:, :, 2] = given["offsets"]
        counts = []
        for j in range(3):
            pairs = zip(fluxes[epochs[j]], stars, strict=True)
            seen = sources + [(flux, at, np.zeros((2, 2))) for flux, at in pairs]
            seen = behind(seen, mask) if has_mask else seen
            mean = see_sources(seen, maps[j, :, :2], maps[j, :, 2], PSF_COVARIANCES[j])
            counts.append(rng.poisson(mean + 5.0))
        if has_mask:
            peak = 2 * np.pi * np.sqrt(np.linalg.det(mask[2]))
            hidden = gaussian(x - mask[1][0], y - mask[1][1], mask[2])
            given["transmission"] = 1.0 - mask[0] * peak * hidden
        v, u = np.mgrid[-8:9, -8:9]
        psfs = [lopsided(u, v, np.array(each)) for each in PSF_COVARIANCES]
        observation = lnocl.Observation(np.array(counts), psfs, background=5.0, **given)
        sky = sum(flux * gaussian(x - at[0], y - at[1], c) for flux, at, c in sources)
        truth = fluxes[: max(epochs) + 1].T.ravel()
        run = {"n_iter": 200, "smoothing": 0.02, "stop": None}
        seconds, results = [], []
        for solve in (lnocl.deconvolve, lambda *a, **k: lnocl.deconvolve_tiles(*a, tile=112, **k)):
            begun = time.perf_counter()
            results.append(solve(observation, stars, **run))
            results[-1].star_flux_errors  # noqa: B018
            seconds.append(time.perf_counter() - begun)
        one, tiles = results
        peak = np.percentile(one.extended, 99.9)
        off = abs(tiles.star_fluxes - one.star_fluxes) / one.star_flux_errors
        pulls = [(each.star_fluxes - truth) / each.star_flux_errors for each in results]
        errors = [restoration_error(each.extended, sky) for each in results]
        print(
            f"{name}: {len(tiles.tiles)} tiles; largest difference over the peak "
            f"{abs(tiles.extended - one.extended).max() / peak:.1e}; star fluxes, in errors, "
            f"{off.max():.3f}; rms of (flux - truth) / error {np.std(pulls[1]):.2f} and "
            f"{np.std(pulls[0]):.2f}; errors {errors[1]:.4f} and {errors[0]:.4f}; "
            f"{seconds[1]:.0f} and {seconds[0]:.0f} s",
            flush=True,
        )


def components():
    """Compare line and continuum in tiles, by default, with the whole, and both with the truth."""
    size, weights = 384, np.array([(1.0, 1.0), (0.0, 1.0), (1.0, 0.8), (0.0, 1.2)])
    psfs = [make_psf(x, y, 384, 16) for x, y in ((191, 191), (300, 300), (330, 60), (120, 260))]
    names = {"line": weights[:, 0], "continuum": weights[:, 1]}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        skies = np.array([make_sky(size, [seed, k], n) for k, n in enumerate((30, 50))])
        skies[0, :, size // 2 :] = 0.0  # lopsided
        stars, fluxes = rng.uniform(15, size - 15, (20, 2)).round(), rng.uniform(2e4, 3e5, 20)
        points = np.zeros((size, size))
        np.add.at(points, tuple(stars.astype(int).T[::-1]), fluxes)
        seen = np.einsum("jk,kyx->jyx", weights, skies) + weights[:, 1, None, None] * points
        means = [fftconvolve(each, psf, "same") for each, psf in zip(seen, psfs, strict=True)]
        counts = rng.poisson(np.clip(means, 0.0, None) + 30.0)
        observation = lnocl.Observation(
            counts, psfs, background=30.0, psf_error=0, components=names
        )
        for tile in (None, 180):
            start = time.perf_counter()
            found = (
                lnocl.deconvolve(observation, stars)
                if tile is None
                else lnocl.deconvolve_tiles(observation, stars, tile=tile)
            )
            flux, error = found.extended_flux
            errors = [restoration_error(*each) for each in zip(found.extended, skies, strict=True)]
            print(
                f"seed {seed}, {'the whole' if tile is None else f'{len(found.tiles)} tiles'}: "
                f"errors {errors[0]:.3f} (line) and {errors[1]:.3f}, {found.n_iter} iterations, "
                f"smoothing {found.smoothing:.3g}; light, in its errors, "
                f"{np.round((flux - skies.sum(axis=(1, 2))) / error, 1)}; "
                f"{time.perf_counter() - start:.1f} s",
                flush=True,
            )


PARTS = {each.__name__: each for each in (operators, field, whole, frame, kinds, components)}


def main():
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=PARTS)
    PARTS[parser.parse_args().part]()


if __name__ == "__main__":
    main()
