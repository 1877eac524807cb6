"""Stars between pixels: fluxes and positions against the Fisher bound, and what a wrong one costs.

    python benchmarks/positions.py PART [--device SPEC] [--output STEM]

Parts, each a table, written to STEM-PART.ecsv with --output:

injection  200 stars at random fractional positions on structured emission, of five fluxes, by SGP:
           flux bias and scatter, positions, with the true position fixed, the nearest whole pixel
           refined, and the nearest whole pixel as it is
smoothed   the same with the smoothing that held-out counts choose for the first frame
sgm        the same as the first for two fluxes by the split-gradient method
held       the iteration that held-out counts choose for those frames, true positions given
bound      how far the Fisher bound rises when the emission is not known, only its power spectrum
choices    when positions are refined, and the extended source restarted then; mu
offsets    the paper's experiment: rho'' for an error of 0 to 2 pixels in the star's position, with
           and without refinement
between    the same with the true star between pixels
basin      from how far away the first fit finds the star, for one image and for four
figure     draws the smallest rho'' of STEM-offsets.ecsv to docs/validation/positions.png; no table

The Fisher bound here owes nothing to lnocl: derivatives by phases on the whole grid, in NumPy.
"""

import argparse
import contextlib
from unittest.mock import patch

import astropy.units as u
import experiment
import numpy as np
import parts
from astropy.table import Table
from parts import paper
from sgp import make

from lnocl.core.runs.run import Run
from lnocl.core.scene.forward_model import Model
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.penalty import recommend_smoothing
from lnocl.core.scene.scene import Scene
from lnocl.core.solvers.positions import StarFit, Stars
from lnocl.metrics import restoration_error, star_rows

SIZE, FRAMES, STARS = 128, 8, 25
FLUXES = (1e4, 3e4, 1e5, 3e5, 1e6)
BACKGROUND, EMISSION = 20.0, 100.0
KY, KX = np.fft.fftfreq(SIZE)[:, None], np.fft.fftfreq(SIZE)[None]
MODES = ("true", "refined", "whole")


def hst_psf():
    """Return an Airy pattern of HST's kind, lambda / D 2.8 pixels (F814W at 25 mas), 65 x 65."""
    frequency = np.fft.fftfreq(1024)
    radius, edge = np.hypot(frequency[:, None], frequency) * 2 * 2.8, 2 * 2.8 / 1024
    pupil = np.clip((1 - radius) / edge + 0.5, 0, 1) - np.clip((0.33 - radius) / edge + 0.5, 0, 1)
    psf = np.fft.fftshift(abs(np.fft.fft2(pupil)) ** 2)[480:545, 480:545]
    distance = np.hypot(*np.mgrid[-32:33, -32:33])
    psf = psf * np.cos(np.pi / 2 * np.clip((distance - 16) / 16, 0, 1)) ** 2
    return psf / psf.sum()


PSF = hst_psf()
OTF = np.fft.fft2(np.roll(np.pad(PSF, (0, SIZE - 65)), (-32, -32), (0, 1)))


def star_columns(x, y):
    """Return the image of a star of unit flux and its derivatives along x and y."""
    spectrum = OTF * np.exp(-2j * np.pi * (KX * x + KY * y))
    return [np.fft.ifft2(f * spectrum).real for f in (1, -2j * np.pi * KX, -2j * np.pi * KY)]


def emission(rng):
    """Return noise smoothed over 6 pixels (standard deviation) and a winding ridge."""
    smooth = np.exp(-2 * (6 * np.pi) ** 2 * (KX**2 + KY**2))
    noise = np.fft.ifft2(smooth * np.fft.fft2(rng.normal(size=(SIZE, SIZE)))).real
    noise = EMISSION * (noise - noise.min()) / np.ptp(noise)
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    angle = rng.uniform(0, np.pi)
    along, across = np.array([[-np.sin(angle), np.cos(angle)], [np.cos(angle), np.sin(angle)]]) @ [
        x.ravel(),
        y.ravel(),
    ]
    ridge = np.exp(-0.5 * ((across + 8 * np.sin(along / 15)) / 3) ** 2).reshape(x.shape)
    return noise + EMISSION * ridge


def place_stars(rng):
    """Return random positions, 12 pixels or more apart, 9 from the edge."""
    found = []
    while len(found) < STARS:
        place = rng.uniform(9, SIZE - 10, 2)
        if all(np.hypot(*(place - other)) > 12 for other in found):
            found.append(place)
    return np.array(found)


class Frame:
    """A simulated frame, its truth, and the Fisher bound of flux, x and y, shape (3, n)."""

    def __init__(self, seed, flux):
        rng = np.random.default_rng(seed)
        sky, self.stars, self.flux = emission(rng), place_stars(rng), flux
        columns = np.array([star_columns(*star) for star in self.stars])
        diffuse = np.fft.ifft2(OTF * np.fft.fft2(sky)).real
        self.mean = diffuse + BACKGROUND + flux * columns[:, 0].sum(axis=0)
        self.image = rng.poisson(self.mean)
        columns[:, 1:] *= flux
        self.columns = columns.transpose(1, 0, 2, 3).reshape(3 * STARS, -1)
        information = (self.columns / self.mean.ravel()) @ self.columns.T
        self.bound = np.sqrt(np.diag(np.linalg.inv(information))).reshape(3, STARS)

    def deconvolve(self, mode, looks, **settings):
        """Return star fluxes and positions after some iterations."""
        observation = Observation(self.image, PSF, background=BACKGROUND)
        given = self.stars if mode == "true" else np.round(self.stars)
        curve = {}

        def look(iteration, estimate):
            if iteration in looks:
                curve[iteration] = estimate.star_fluxes, estimate.star_positions

        paper(
            observation,
            [tuple(star) for star in given],
            n_iter=max(looks),
            callback=look,
            refine_positions=mode == "refined",
            **settings,
        )
        return curve


def measure(flux, mode, looks, **settings):
    """Yield rows of errors over all frames, one for each number of iterations."""
    frames = [Frame(seed, flux) for seed in range(FRAMES)]
    curves = [frame.deconvolve(mode, looks, **settings) for frame in frames]
    bounds = np.array([frame.bound for frame in frames])
    truth = np.array([frame.stars for frame in frames])
    for iteration in looks:
        found = [curve.get(iteration, curve[max(curve)]) for curve in curves]
        fluxes, positions = (np.array([each[i] for each in found]) for i in range(2))
        errors = fluxes / flux - 1
        moved = (positions - truth).transpose(0, 2, 1)
        yield {
            "flux": flux,
            "stars": mode,
            "iterations": iteration,
            "bias": errors.mean(),
            "bias error": errors.std() / np.sqrt(errors.size),
            "scatter": errors.std(),
            "scatter / bound": float(np.std((fluxes - flux) / bounds[:, 0])),
            "position px": float(np.sqrt(np.mean(moved**2))),
            "position / bound": float(np.sqrt(np.mean((moved / bounds[:, 1:]) ** 2))),
        }


def injection(device):
    """Yield rows of the part "injection"."""
    for flux in FLUXES:
        for mode in MODES:
            yield from measure(flux, mode, (6, 12, 24, 48), solver="sgp", device=device)


def smoothed(device):
    """Yield rows of the part "smoothed"."""
    for flux in FLUXES:
        observation = Observation(Frame(0, flux).image, PSF, background=BACKGROUND)
        smoothing = recommend_smoothing(observation)
        settings = {"solver": "sgp", "device": device, "smoothing": smoothing}
        for mode in MODES[:2]:
            for row in measure(flux, mode, (12, 24, 48), **settings):
                yield {"smoothing": settings["smoothing"]} | row


def sgm(device):
    """Yield rows of the part "sgm"."""
    for flux in (1e5, 1e6):
        for mode in MODES[:2]:
            yield from measure(flux, mode, (50, 100, 200), solver="sgm", device=device)


def held(device):
    """Yield rows of the part "held"."""
    for flux in FLUXES:
        chosen, errors = [], []
        for seed in range(3):
            frame = Frame(seed, flux)
            observation = Observation(frame.image, PSF, background=BACKGROUND)
            stars = [tuple(star) for star in frame.stars]
            result = paper(
                observation, stars, solver="sgp", n_iter=150, stop="held-out", device=device
            )
            chosen.append(result.n_iter)
            errors.append((result.star_fluxes - flux) / frame.bound[0])
        bias = np.mean(errors) * frame.bound[0].mean() / flux
        yield {
            "flux": flux,
            "chosen": " ".join(map(str, chosen)),
            "bias": bias,
            "scatter / bound": float(np.std(errors)),
        }


def bound(device):
    """Yield rows of the part "bound": joint information of the stars and of modes of the sky."""
    distance = KX**2 + KY**2
    spectra = [np.exp(-((2 * np.pi * width) ** 2) * distance) for width in (6, 3)]
    power = sum(0.5 * each / each.sum() for each in spectra) * SIZE**2 * 30.0**2
    y, x = np.mgrid[:SIZE, :SIZE]
    modes = []
    for a, b in np.argwhere(power > 1e-4 * power.max()):
        conjugate = (-a % SIZE, -b % SIZE)
        if (a, b) > conjugate:
            continue
        wave = OTF[a, b] * np.exp(2j * np.pi * (a * y + b * x) / SIZE) * np.sqrt(power[a, b]) / SIZE
        if (a, b) == conjugate:
            modes.append(wave.real.ravel())
        else:
            modes += [np.sqrt(2) * wave.real.ravel(), np.sqrt(2) * wave.imag.ravel()]
    modes = np.array(modes)
    for flux in FLUXES:
        frame = Frame(0, flux)
        columns = np.vstack([frame.columns, modes])
        information = (columns / frame.mean.ravel()) @ columns.T
        known = np.arange(3 * STARS, len(columns))
        information[known, known] += 1.0  # modes are scaled to unit variance
        unknown = np.sqrt(np.diag(np.linalg.inv(information)))[: 3 * STARS].reshape(3, STARS)
        ratios = (unknown / frame.bound) ** 2
        yield {
            "flux": flux,
            "bound, share": float(np.mean(frame.bound[0]) / flux),
            "bound px": float(np.mean(frame.bound[1:])),
            "flux / bound": float(np.sqrt(ratios[0].mean())),
            "position / bound": float(np.sqrt(ratios[1:].mean())),
        }


def restarted(until):
    """Reset the extended source to a flat one at each refinement up to this iteration."""
    refine = Run._refine

    def refine_and_restart(run):
        refine(run)
        if run.done > until:
            return
        flat, _ = run.scene.start(None, None)
        fluxes, run.engine.scaling = run._prepare(flat, run.engine.star_fluxes())
        run.engine.start(flat, fluxes)

    return patch.object(Run, "_refine", refine_and_restart)


def choices(device):
    """Yield rows of the part "choices"."""
    variants = {
        "lnocl": contextlib.nullcontext,
        "first at 1": lambda: patch("lnocl.core.runs.run.FIRST_REFINED", 1),
        "first at 12": lambda: patch("lnocl.core.runs.run.FIRST_REFINED", 12),
        "restarted at 3": lambda: restarted(3),
        "restarted at 3, 6": lambda: restarted(6),
        "mu 1e-4": contextlib.nullcontext,
    }
    for flux in (1e6, 1e5):
        for name, variant in variants.items():
            mu = float(name.split()[1]) if name.startswith("mu") else 0.0
            with variant():
                settings = {"solver": "sgp", "device": device, "mu": mu}
                for row in measure(flux, "refined", (6, 12, 24), **settings):
                    yield {"variant": name} | row


DIRECTIONS = {"x": (1.0, 0.0), "y": (0.0, 1.0), "xy": (0.5**0.5, 0.5**0.5)}
ERRORS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.25, 0.5, 1.0, 2.0)
LOOK = 250


def follow(observation, truth, star, given, refine, n_iter, solver="sgp", every=1, device=None):
    """Return what a run with the star given there comes to."""
    rows = star_rows((round(star[0]), round(star[1])), truth.shape)
    curve = []

    def look(iteration, estimate):
        if iteration % every == 0:
            rho = restoration_error(estimate.extended, truth, rows)
            curve.append((iteration, rho, np.hypot(*(estimate.star_positions[0] - star))))

    result = paper(
        observation,
        [given],
        solver=solver,
        n_iter=n_iter,
        callback=look,
        refine_positions=refine,
        device=device,
    )
    curve = np.array(curve)
    least = curve[np.argmin(curve[:, 1])]
    fixed = curve[min(LOOK * n_iter // 400 // every, len(curve)) - 1]
    return {
        "rho''": least[1],
        "at": least[0],
        "rho'' fixed": fixed[1],
        "start px": curve[0, 2],
        "end px": curve[-1, 2],
        "flux": result.star_fluxes[0],
    }


def averaged(found):
    """Return the means over directions, and the largest rho''."""
    row = {key: float(np.mean([each[key] for each in found])) for key in found[0]}
    return row | {"worst rho''": max(each["rho''"] for each in found)}


def offsets(device):
    """Yield rows of the part "offsets"."""
    cases = [(256, 1.0, "sgp", 400, ERRORS), (256, 30.0, "sgp", 400, ERRORS)]
    cases += [(256, 1.0, "sgm", 4000, (0.0, 0.5)), (512, 1.0, "sgp", 250, (0.0, 0.5, 2.0))]
    for size, contrast, solver, n_iter, errors in cases:
        simulation = make("hh34", size, None, contrast)
        observation, star = experiment.observe(simulation), simulation.stars[0]
        directions = DIRECTIONS if (size, solver) == (256, "sgp") else {"x": (1.0, 0.0)}
        for error in errors:
            for refine in (False, True):
                if refine and 0 < error < 0.1:
                    continue
                found = [
                    follow(
                        observation,
                        simulation.extended,
                        star,
                        (star[0] + error * dx, star[1] + error * dy),
                        refine,
                        n_iter,
                        solver,
                        1 if solver == "sgp" else 50,
                        device,
                    )
                    for dx, dy in list(directions.values())[: 1 if error == 0 else None]
                ]
                row = averaged(found)
                row["flux"] = row["flux"] / simulation.star_fluxes[0] - 1
                yield {
                    "size": size,
                    "contrast": contrast,
                    "solver": solver,
                    "error": error,
                    "refined": refine,
                } | row


def moved_star(simulation, dx, dy, seed=0):
    """Return an observation of the experiment with its star moved, by phases on the whole grid."""
    (x, y), flux = simulation.stars[0], simulation.star_fluxes[0]
    _, ny, nx = simulation.psfs.shape
    otfs = np.fft.fft2(np.fft.ifftshift(simulation.psfs, axes=(1, 2)))
    ky, kx = np.fft.fftfreq(ny)[:, None], np.fft.fftfreq(nx)
    star = flux * np.exp(-2j * np.pi * (kx * (x + dx) + ky * (y + dy)))
    images = np.fft.ifft2(otfs * (star + np.fft.fft2(simulation.extended))).real.clip(min=0)
    rng = np.random.default_rng(seed)
    images = rng.poisson(images + simulation.background[:, None, None])
    noise = rng.normal(0.0, simulation.read_noise, images.shape)
    return Observation(
        images + noise,
        simulation.psfs,
        background=simulation.background,
        read_noise=simulation.read_noise,
    )


def between(device):
    """Yield rows of the part "between"."""
    for contrast in (1.0, 30.0):
        simulation = make("hh34", 256, None, contrast)
        x, y = simulation.stars[0]
        for dx, dy in ((0.5, 0.0), (0.3, -0.4), (0.5, 0.5)):
            star = (x + dx, y + dy)
            observation = moved_star(simulation, dx, dy)
            for name, given, refine in (
                ("true", star, False),
                ("true, refined", star, True),
                ("whole pixel", (x, y), False),
                ("whole pixel, refined", (x, y), True),
            ):
                row = follow(
                    observation, simulation.extended, star, given, refine, 400, device=device
                )
                row["flux"] = row["flux"] / simulation.star_fluxes[0] - 1
                yield {"contrast": contrast, "dx": dx, "dy": dy, "given": name} | row


def basin(device):
    """Yield rows of the part "basin": the first fit alone, the extended source flat."""
    turns = np.arange(8) * np.pi / 4
    for contrast in (1.0, 30.0):
        for angles in ((0,), (0, 45, 90, 135)):
            simulation = make("hh34", 256, None, contrast, angles=angles * u.deg)
            star, observation = np.array(simulation.stars[0]), experiment.observe(simulation)
            for distance in (1.0, 2.0, 2.5, 2.9):
                left, plain = [], []
                for turn in turns:
                    given = star + distance * np.array([np.cos(turn), np.sin(turn)])
                    scene = Scene(observation, [given], max_shift=3.0)
                    extended, fluxes = scene.start(None, None)
                    fit = StarFit(scene, Model(scene), extended, scene.stars)
                    given = Stars(fluxes, scene.stars)
                    for found, begin in ((plain, given), (left, fit.look_round(given))):
                        moved = fit.minimise(begin).positions[0] - star
                        found.append(float(np.hypot(*moved)))
                yield {
                    "contrast": contrast,
                    "images": len(angles),
                    "distance": distance,
                    "median px": float(np.median(left)),
                    "worst px": max(left),
                    "within 1 px": sum(each < 1 for each in left),
                    "worst px, without the eight starts": max(plain),
                    "within 1 px, without the eight starts": sum(each < 1 for each in plain),
                }


def figure(stem):
    """Draw what "offsets" has written."""
    from matplotlib import pyplot

    table = Table.read(f"{stem}-offsets.ecsv")
    table = table[(table["size"] == 256) & (table["solver"] == "sgp")]
    _, axes = pyplot.subplots(figsize=(6, 4), layout="constrained")
    for contrast, colour in ((1.0, "C0"), (30.0, "C1")):
        for refined, line in ((False, "--o"), (True, "-o")):
            rows = table[(table["contrast"] == contrast) & (table["refined"] == refined)]
            name = f"contrast {contrast:g}, " + ("refined" if refined else "as given")
            axes.plot(rows["error"], 100 * rows["rho''"], line, color=colour, label=name)
    axes.set_xscale("symlog", linthresh=0.003, linscale=0.5)
    axes.set_yscale("log")
    axes.set_xticks([0, 0.003, 0.01, 0.03, 0.1, 0.25, 0.5, 1, 2])
    axes.set_xticklabels(["0", "0.003", "0.01", "0.03", "0.1", "0.25", "0.5", "1", "2"])
    axes.set_yticks([5, 10, 20, 50, 100])
    axes.set_yticklabels(["5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.set_xlabel("error of the star's given position, pixels")
    axes.set_ylabel("smallest rho'', %")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    pyplot.savefig("docs/validation/positions.png", dpi=120)


PARTS = {
    part.__name__: part
    for part in (injection, smoothed, sgm, held, bound, choices, offsets, between, basin)
}


def main():
    """Run one part."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=[*PARTS, "figure"])
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    if given.part == "figure":
        figure(given.output)
        return
    parts.report(PARTS[given.part](given.device), given.part, given.device, given.output)


if __name__ == "__main__":
    main()
