"""What happens at the edges of a frame and at its bad pixels.

    python benchmarks/frames.py PART [--device SPEC] [--output STEM] [--figure FILE.png]

Parts, each a table, written to STEM-PART.ecsv with --output:

edges    a source that runs over three edges of the frame, on frames of 256 x 256 and 200 x 150
         pixels, one image through a Moffat PSF or four through Fizeau PSFs, with and without a
         star near an edge: errors in the 10 pixels along those edges and in the middle, for pad 0
         to 64 and that of the rule; with --figure the picture of it
gaps     the same on square frames of 256 - 2 N pixels, whose grid leaves just N pixels on each side
pixels   the paper's experiment with 5 % dead pixels and ten dead columns: the smallest rho'
holes    the same with one image and square holes of 3 to 15 pixels in the jet

The sky of "edges" is a random field, the same everywhere in the mean: it is as bright and as rough
at the edge as in the middle. It is made on 768 x 768 pixels, seen through the PSF, given Poisson
noise, and cut. An error is the root mean square of reconstruction less truth, over that of the
truth, in the 10 pixels along the three edges, or 40 pixels and more from every edge; both at the
iteration at which the middle's is smallest. "smoothed" is the same after a Gaussian of sigma 2.
"whole sky" is the error of the same pixels along the edges where all of the 768 x 768 pixels of the
same counts are given: what no frame that ends there can beat.
"""

import argparse
import warnings
from functools import cache, lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np
import parts
from parts import paper
from scipy.ndimage import gaussian_filter

import lnocl
import lnocl.core.scene.grid
from lnocl.core.scene.padding import recommend_pad
from lnocl.metrics import restoration_error
from lnocl.simulation import Experiment, fizeau_psf, hh34, simulate

SKY = 768
FRAMES = ((256, 256), (150, 200))
PADS = (0, 4, 8, 16, 32, 64)
BAND, MIDDLE, SMOOTH = 10, 40, 2.0
MEAN, BACKGROUND = 300.0, 100.0
STAR_FLUX = 3e5
N_ITER = {"sgm": 600, "sgp": 80}
SEEDS = range(3)


@cache
def psfs(kind):
    """Return one Moffat PSF (FWHM 4 pixels, beta 3), or four Fizeau PSFs on the whole sky."""
    if kind == "moffat":
        y, x = np.indices((127, 127)) - 63
        width = 4.0 / 2 / np.sqrt(2 ** (1 / 3) - 1)
        psf = (1 + (x**2 + y**2) / width**2) ** -3
        return psf[None] / psf.sum()
    return np.stack(
        [
            fizeau_psf((SKY, SKY), angle * u.deg, 2.12 * u.um, 5 * u.mas, 0.7, seed)
            for seed, angle in enumerate((0, 45, 90, 135))
        ]
    )


def radius(psf, share):
    """Return the radius, pixels, that holds this share of the PSF's light."""
    y, x = np.indices(psf.shape)
    r = np.hypot(y - psf.shape[0] // 2, x - psf.shape[1] // 2).ravel()
    order = np.argsort(r)
    return r[order][np.searchsorted(np.cumsum(psf.ravel()[order]) / psf.sum(), share)]


class Sky:
    """A sky that runs over the left, right and lower edge of a frame in its middle."""

    def __init__(self, kind, shape, has_star, seed):
        self.kind, self.shape = kind, shape
        ny, nx = shape
        self.y, self.x = (SKY - ny) // 2, (SKY - nx) // 2
        rng = np.random.default_rng(seed)
        ky, kx = np.fft.fftfreq(SKY), np.fft.rfftfreq(SKY)
        k2 = ky[:, None] ** 2 + kx**2
        amplitude = (k2 + 0.025**2) ** -0.75 * np.exp(-2 * (np.pi * 1.5) ** 2 * k2)
        field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SKY, SKY))) * amplitude)
        rows = np.arange(SKY) - self.y  # of the frame
        fade = 0.08 * ny
        top = np.clip((rows - 0.75 * ny) / fade, 0, 1)
        below = np.clip((rows + 240) / 40, 0, 1)
        self.envelope = ((1 + np.cos(np.pi * top)) / 2 * below)[:, None]
        self.truth = np.exp(0.8 * field / field.std() - 0.32) * MEAN * self.envelope
        self.stars = [(7, round(0.45 * ny))] if has_star else []
        lit = self.truth.copy()
        for x, y in self.stars:
            lit[self.y + y, self.x + x] += STAR_FLUX
        otf = np.zeros((len(psfs(kind)), SKY, SKY))
        size = psfs(kind).shape[1]
        otf[:, :size, :size] = psfs(kind)
        otf = np.fft.rfft2(np.roll(otf, (-(size // 2), -(size // 2)), axis=(1, 2)))
        expected = np.fft.irfft2(otf * np.fft.rfft2(lit)).clip(0) + BACKGROUND
        self.counts = rng.poisson(expected).astype(float)

    def cut(self, array):
        """Return the frame's part of an array of the whole sky."""
        ny, nx = self.shape
        return array[..., self.y : self.y + ny, self.x : self.x + nx]

    def regions(self):
        """Return where edges and middle are, masks of the frame."""
        ny, nx = self.shape
        y, x = np.indices(self.shape)
        lit = y < 0.75 * ny
        from_edge = np.minimum(np.minimum(x, nx - 1 - x), y)
        return lit & (from_edge < BAND), lit & (from_edge >= MIDDLE)

    def errors(self, found):
        """Return errors of edges and middle, then the same smoothed."""
        truth = self.cut(self.truth)
        errors = []
        for f, t in (
            (found, truth),
            (gaussian_filter(found, SMOOTH), gaussian_filter(truth, SMOOTH)),
        ):
            errors += [np.linalg.norm((f - t)[r]) / np.linalg.norm(t[r]) for r in self.regions()]
        return np.array(errors)

    def observation(self):
        """Return what is known of the frame."""
        return lnocl.Observation(self.cut(self.counts), psfs(self.kind), background=BACKGROUND)

    def reconstruct(self, solver, pad, device, whole=False):
        """Return iteration, errors and the extended source at the middle's smallest error."""
        if whole:
            observation = lnocl.Observation(self.counts, psfs(self.kind), background=BACKGROUND)
            stars = [(x + self.x, y + self.y) for x, y in self.stars]
        else:
            observation, stars = self.observation(), self.stars
        best = None

        def look(iteration, estimate):
            nonlocal best
            if solver == "sgm" and iteration % 5:
                return False
            extended = self.cut(estimate.extended) if whole else estimate.extended
            errors = self.errors(extended)
            if best is None or errors[1] < best[1][1]:
                best = iteration, errors, extended
            return iteration > 1.5 * best[0] + 10

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", lnocl.LnoclWarning)  # PSFs wrap, and data run over
            paper(
                observation,
                stars,
                solver=solver,
                n_iter=N_ITER[solver],
                pad=pad,
                callback=look,
                device=device,
            )
        return best


def grid_of(kind, shape, pad):
    """Return the grid that lnocl takes."""
    observation, grid = sky(kind, shape, False, 0).observation(), lnocl.core.scene.grid
    return grid.grid_of(observation, grid.pad_of(observation, pad))


def measure(kind, shape, has_star, pad, solver, device):
    """Return a row: the mean over the seeds."""
    iterations, errors = zip(
        *(
            sky(kind, shape, has_star, seed).reconstruct(solver, pad, device)[:2]
            for seed in (SEEDS if kind == "moffat" else SEEDS[:1])
        ),
        strict=True,
    )
    edge, middle, smooth_edge, smooth_middle = np.mean(errors, axis=0)
    return {
        "psf": kind,
        "frame": f"{shape[1]} x {shape[0]}",
        "star": has_star,
        "solver": solver,
        "pad": pad,
        "grid": "{1} x {0}".format(*grid_of(kind, shape, pad)),
        "at": float(np.mean(iterations)),
        "edges": edge,
        "middle": middle,
        "ratio": edge / middle,
        "smoothed edges": smooth_edge,
        "smoothed middle": smooth_middle,
        "smoothed ratio": smooth_edge / smooth_middle,
    }


@lru_cache(maxsize=4)
def sky(kind, shape, has_star, seed):
    """Return a sky, made once."""
    return Sky(kind, shape, has_star, seed)


def pads(kind, shape):
    """Return the pads that are compared, one of them that of the rule."""
    return sorted({*PADS, recommend_pad(sky(kind, shape, False, 0).observation())})


def edges(given):
    """Yield rows of the part "edges"."""
    for kind in ("moffat", "fizeau"):
        for shape in FRAMES:
            for has_star in (False, True):
                for solver in ("sgm", "sgp"):
                    known = {}
                    for pad in pads(kind, shape):
                        grid = grid_of(kind, shape, pad)
                        if grid not in known:
                            known[grid] = measure(kind, shape, has_star, pad, solver, given.device)
                        yield known[grid] | {"pad": pad}
                found = sky(kind, shape, has_star, 0).reconstruct("sgp", 0, given.device, True)
                yield {
                    "psf": kind,
                    "frame": f"{shape[1]} x {shape[0]}",
                    "star": has_star,
                    "solver": "sgp",
                    "pad": -1,
                    "grid": "whole sky",
                    "at": float(found[0]),
                    "edges": found[1][0],
                    "middle": found[1][1],
                    "ratio": found[1][0] / found[1][1],
                    "smoothed edges": found[1][2],
                    "smoothed middle": found[1][3],
                    "smoothed ratio": found[1][2] / found[1][3],
                }
    if given.figure:
        draw(given.figure, given.device)


def gaps(given):
    """Yield rows of the part "gaps"."""
    cases = [(256 - 2 * pad, pad) for pad in (0, 1, 2, 4, 8, 16, 32, 64)]
    for kind, more in (("moffat", []), ("fizeau", [(256, 128), (256, 384)])):
        for size, pad in cases + more:
            row = measure(kind, (size, size), False, pad, "sgp", given.device)
            light = [
                sum(psf[np.hypot(*ring(psf)) <= pad].sum() for psf in psfs(kind)) / len(psfs(kind))
            ]
            yield row | {"light within pad": float(light[0])}


def ring(psf):
    """Return y and x of each pixel from the PSF's middle."""
    y, x = np.indices(psf.shape)
    return y - psf.shape[0] // 2, x - psf.shape[1] // 2


def smallest(simulation, mask, device):
    """Return the smallest rho' of SGP, where it is, and the extended source there."""
    best = None

    def look(iteration, estimate):
        nonlocal best
        found = estimate.extended
        error = restoration_error(found, simulation.extended)
        if best is None or error < best[0]:
            best = error, iteration, found
        return iteration > 1.5 * best[1] + 20

    paper(observe(simulation, mask), simulation.stars, solver="sgp", callback=look, device=device)
    return best


def observe(simulation, mask, values=0.0):
    """Return the observation with bad pixels, which hold these values."""
    return lnocl.Observation(
        simulation.images if mask is None else np.where(mask, values, simulation.images),
        simulation.psfs,
        background=simulation.background,
        read_noise=simulation.read_noise,
        mask=mask,
    )


def dead(shape, n_images, is_same, seed, columns=None):
    """Return 5 % dead pixels and ten dead columns, anew for each image or the same in all."""
    rng = np.random.default_rng(seed)
    masks = []
    for _ in range(1 if is_same else n_images):
        mask = rng.random(shape) < 0.05
        mask[:, rng.choice(shape[1], 10, replace=False) if columns is None else columns] = True
        masks.append(mask)
    return np.broadcast_to(masks, (n_images, *shape)).copy()


ANGLES = {1: 0.0 * u.deg, 4: (0.0, 45.0, 90.0, 135.0) * u.deg}


def pixels(given):
    """Yield rows of the part "pixels"."""
    for size in (256, 512):
        for n_images, angles in ANGLES.items():
            simulation = simulate(hh34(size), Experiment(angles=angles))
            shape = simulation.extended.shape
            whole, at, _ = smallest(simulation, None, given.device)
            axis = simulation.stars[0][0]
            kinds = {"different": (False, None), "same": (True, None)}
            kinds["same, a column on the jet's axis"] = True, [*range(3, 255, 28), axis + 3]
            if n_images == 1:
                del kinds["different"]
            for kind, (is_same, columns) in kinds.items():
                found = []
                for seed in range(5):
                    mask = dead(shape, n_images, is_same, seed, columns)
                    found.append(smallest(simulation, mask, given.device)[:2])
                errors, ats = np.array(found).T
                yield {
                    "size": size,
                    "images": n_images,
                    "masks": kind,
                    "bad": float(mask.mean()),
                    "rho' without": whole,
                    "without at": at,
                    "rho'": float(errors.mean()),
                    "at": float(ats.mean()),
                    "rise": float(errors.mean() / whole - 1),
                    "largest rise": float(errors.max() / whole - 1),
                }
    mask = dead(shape, n_images, False, 0)
    results = [
        paper(observe(simulation, mask, v), simulation.stars, solver="sgp", n_iter=20)
        for v in (0.0, np.nan, 1e30, -1e30, np.inf)
    ]
    assert all(np.array_equal(results[0].extended, r.extended) for r in results)
    print("0, nan, 1e30, -1e30, inf in the bad pixels: the same result, bit for bit")


def holes(given):
    """Yield rows of the part "holes"."""
    for n_images, angles in ANGLES.items():
        simulation = simulate(hh34(256), Experiment(angles=angles))
        truth, (star,) = simulation.extended, simulation.stars
        whole = smallest(simulation, None, given.device)
        for side in (1, 3, 5, 7, 9, 15):
            for in_all in (True, False) if n_images > 1 else (True,):
                hole = np.zeros(truth.shape, bool)
                for y in range(star[1] + 16, star[1] + 150, 26):
                    hole[y : y + side, star[0] - side // 2 : star[0] - side // 2 + side] = True
                mask = np.zeros(simulation.images.shape, bool)
                mask[slice(None) if in_all else 0] = hole
                error, at, found = smallest(simulation, mask, given.device)
                norm = np.linalg.norm(truth[hole])
                yield {
                    "images": n_images,
                    "holes in": "all" if in_all else "one",
                    "side": side,
                    "rho'": error,
                    "at": at,
                    "rise": error / whole[0] - 1,
                    "error in holes": np.linalg.norm((found - truth)[hole]) / norm,
                    "without holes": np.linalg.norm((whole[2] - truth)[hole]) / norm,
                    "flux in holes": found[hole].sum() / truth[hole].sum(),
                }


def draw(path, device):
    """Draw truth, periodic and padded model, and their errors."""
    from matplotlib.figure import Figure

    seen = sky("moffat", (256, 256), False, 0)
    truth = seen.cut(seen.truth)
    images = {"image": seen.cut(seen.counts)[0] - BACKGROUND, "truth": truth}
    rule = recommend_pad(seen.observation())
    for name, pad in (("periodic model (pad 0)", 0), (f"padded model (pad {rule})", rule)):
        _, errors, images[name] = seen.reconstruct("sgp", pad, device)
        images[name] = images[name], errors
    figure = Figure(figsize=(13, 6.9), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    top = np.percentile(truth, 99.5)
    panels = [("truth", truth)] + [
        (f"{name}\nerror {e[0]:.0%} at the edges, {e[1]:.0%} in the middle", f)
        for name, (f, e) in list(images.items())[2:]
    ]
    for axis, (name, f) in zip(axes[0], panels, strict=True):
        shown = axis.imshow(f, origin="lower", vmin=0, vmax=top, cmap="viridis")
        axis.set_title(name, fontsize=10)
    figure.colorbar(shown, ax=axes[0], label="electrons per pixel")
    axes[1, 0].imshow(images["image"], origin="lower", vmin=0, vmax=top, cmap="viridis")
    axes[1, 0].set_title("the image", fontsize=10)
    for axis, (name, f) in zip(axes[1, 1:], panels[1:], strict=True):
        shown = axis.imshow(f - truth, origin="lower", vmin=-top / 2, vmax=top / 2, cmap="RdBu_r")
        axis.set_title(f"{name.splitlines()[0]} less truth", fontsize=10)
    figure.colorbar(shown, ax=axes[1], label="electrons per pixel")
    figure.savefig(path, dpi=80)


PARTS = {part.__name__: part for part in (edges, gaps, pixels, holes)}


def main():
    """Run one part."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--device")
    parser.add_argument("--output")
    parser.add_argument("--figure", help="with the part edges: where to draw it")
    given = parser.parse_args()
    parts.report(PARTS[given.part](given), given.part, given.device, given.output)


if __name__ == "__main__":
    main()
