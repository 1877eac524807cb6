"""PSFs in error, given and refined: the error near the star beside that of the true PSFs.

    python benchmarks/psfs.py [--size N] [--images P] [--seeds FIRST LAST] [--contrasts C ...]
        [--errors NAME ...] [--stars N] [--device SPEC] [--output STEM]

The paper's telescope and jet (hh34), the star C times as bright, P images, and N - 1 more stars of
0.3 to 1 of its flux. The images are made with PSFs that differ from those given:

none     in nothing
shift    by 0.2 pixels in random directions
jitter   by a blur with variances of 0.3 to 1 square pixels
strehl   given with a Strehl ratio of 0.5 for 0.7, and with other speckles
phase    by phases of 0.2 to 0.3 rad rms across the apertures, up to coma
speckle  with other speckles alone
all      in shift, jitter and Strehl ratio

Columns: the best rho'' of 100 iterations with the true, the given and the refined PSFs, and rho''
at the end of a run with the defaults; the relative error of the PSFs given, of those used, and that
which is said of these; the largest relative error of a star's flux at the best iteration; the
misfit; whether the refined ones are used; seconds for the refinement, and for the run after it.
`refine_psfs` is shift, jitter and strehl; pupil for phases; pixels too for several stars. With
--draw FILE.png the rows of STEM-pP.ecsv are drawn instead.
"""

import argparse
import time
import warnings

import astropy.units as u
import numpy as np
from astropy.table import Table

import lnocl
from lnocl.core.scene.psf_families import PsfFamilies, spectrum
from lnocl.core.scene.pupils import Pupil
from lnocl.metrics import restoration_error, star_rows
from lnocl.simulation import Experiment, fizeau_psf, fizeau_pupil, hh34

ERRORS = ("none", "shift", "jitter", "strehl", "phase", "speckle", "all")
FAMILIES = ("shift", "jitter", "strehl")
EXPERIMENT = Experiment()
SCALE = EXPERIMENT.wavelength, EXPERIMENT.pixel_scale


def fizeau(n, angle, strehl, seed=0):
    """Return a PSF of the paper's telescope."""
    return fizeau_psf((n, n), angle * u.deg, *SCALE, strehl, seed)


def aberrated(psf, angle, rng):
    """Return a PSF with phases across its apertures, which are sampled twice as finely as given."""
    n = len(psf)
    pupil = Pupil(fizeau_pupil((2 * n, 2 * n), angle * u.deg, *SCALE))
    z = rng.standard_normal(pupil.n_phases)
    z *= rng.uniform(0.2, 0.3) / np.linalg.norm(z)
    now, ideal = (spectrum(each, (n, n)) for each in (pupil.psf(z), pupil.ideal_psf()))
    ratio = np.divide(now, ideal, out=np.ones_like(now), where=abs(ideal) > 1e-4)
    return np.fft.fftshift(np.fft.irfft2(spectrum(psf, (n, n)) * ratio, (n, n)))


def place_stars(first, n_stars, n, rng):
    """Return positions of stars, no two nearer than a fifth of the image."""
    stars = [first]
    while len(stars) < n_stars:
        at = rng.integers(n // 8, n - n // 8, 2)
        if min(np.hypot(*(at - np.array(stars)).T)) > n / 5:
            stars.append((int(at[0]), int(at[1])))
    return stars


def make_scene(error, contrast, p, seed, n, n_stars=1):
    """Return images, true and given PSFs, what is known of them, sky, stars, and their fluxes."""
    rng = np.random.default_rng([seed, p])
    true, given, ideal, pupils = [], [], [], []
    for j in range(p):
        angle = 180.0 * j / p
        psf = fizeau(n, angle, 0.7, 100 * seed + j)
        other = fizeau(n, angle, 0.5 if error in ("strehl", "all") else 0.7, 100 * seed + j + 50)
        given.append(other if error in ("strehl", "speckle", "all") else psf)
        ideal.append(fizeau(n, angle, 1.0))
        pupils.append(fizeau_pupil((n, n), angle * u.deg, *SCALE))
        turn = rng.uniform(0.0, 2.0 * np.pi)
        values = np.zeros((1, 5))
        if error in ("shift", "all"):
            values[0, :2] = 0.2 * np.cos(turn), 0.2 * np.sin(turn)
        if error in ("jitter", "all"):
            values[0, 2:] = rng.uniform(0.3, 1.0), rng.uniform(-0.2, 0.2), rng.uniform(0.3, 1.0)
        families = PsfFamilies(FAMILIES[:2], lnocl.Observation(np.ones((n, n)), psf))
        (psf,) = families.psfs(families.first()._replace(values=values))
        true.append(aberrated(psf, angle, rng) if error == "phase" else psf)
    target = hh34(n)
    flux = EXPERIMENT.source_electrons(EXPERIMENT.extended_magnitude)
    sky = target.extended / target.extended.sum() * flux
    stars = place_stars((target.stars[0].x, target.stars[0].y), n_stars, n, rng)
    fluxes = contrast * flux * np.append(1.0, rng.uniform(0.3, 1.0, n_stars - 1))
    lit = sky.copy()
    for (x, y), each in zip(stars, fluxes, strict=True):
        lit[y, x] += each
    level = EXPERIMENT.sky_electrons
    spectra = np.fft.rfft2(lit) * np.fft.rfft2(np.fft.ifftshift(true, axes=(1, 2)))
    means = np.fft.irfft2(spectra, lit.shape).clip(0.0) + level
    noise = EXPERIMENT.read_noise.value
    images = rng.poisson(means) + rng.normal(0.0, noise, means.shape)
    return images, true, given, {"ideal_psfs": ideal, "pupils": pupils}, sky, stars, fluxes


def row(error, contrast, p, seed, n, n_stars, device):
    """Return a row of the table."""
    scene = make_scene(error, contrast, p, seed, n, n_stars)
    images, true, given, known, sky, stars, fluxes = scene
    rows, found = star_rows(stars[0], sky.shape), {}
    families = ("pupil",) if error == "phase" else FAMILIES
    if n_stars > 1:
        families = (*families, "pixels")
    known |= {"background": EXPERIMENT.sky_electrons, "read_noise": EXPERIMENT.read_noise.value}
    values = {"error": error, "contrast": contrast, "p": p, "seed": seed}

    def run(psfs, **options):
        observation = lnocl.Observation(images, psfs, psf_centre="given", **known)
        return lnocl.deconvolve(observation, stars, pad=0, device=device, **options)

    def best(psfs):
        errors = []

        def look(_, estimate):
            of_stars = abs(estimate.star_fluxes / fluxes - 1.0).max()
            errors.append((restoration_error(estimate.extended, sky, rows), of_stars))

        run(psfs, n_iter=100, stop=None, smoothing=0.0, callback=look)
        return min(errors)

    start = time.perf_counter()
    result = run(given, refine_psfs=families)
    middle = time.perf_counter()
    found["given"] = run(given)
    plain = time.perf_counter() - middle
    found["refined"], found["true"] = result, run(true)
    psfs = {"true": true, "given": given, "refined": result.psfs}
    norm = np.linalg.norm(true)
    for name, each in psfs.items():
        values[f"best {name}"], values[f"flux {name}"] = best(each)
        values[f"end {name}"] = restoration_error(found[name].extended, sky, rows)
    values |= {
        f"psf {name}": float(np.linalg.norm(np.array(psfs[name]) - true) / norm)
        for name in ("given", "refined")
    }
    refinement = result.psf_refinement
    values["psf said"] = refinement.psf_error
    values |= {"misfit": refinement.misfit[0], "misfit refined": refinement.misfit[1]}
    values |= {"used": refinement.is_accepted, "seconds": middle - start - plain, "run s": plain}
    return values


def draw(table, path):
    """Draw rho'' with true, given and refined PSFs against the contrast, a panel an error."""
    from lnocl.plotting.figure import line_style, new_figure, save_figure

    figure = new_figure(13.0, 6.4)
    axes = figure.subplots(2, 4, sharex=True, sharey=True).ravel()
    axes[-1].remove()
    for axis, error in zip(axes[:-1], ERRORS, strict=True):
        rows = table[table["error"] == error]
        contrasts = sorted(set(rows["contrast"]))
        for i, name in enumerate(("true", "given", "refined")):
            for part, alpha in (("best", 1.0), ("end", 0.35)):
                values = [
                    np.median(rows[rows["contrast"] == c][f"{part} {name}"]) for c in contrasts
                ]
                label = f"{name} PSF" if part == "best" else None
                axis.plot(contrasts, values, **line_style(i), label=label, alpha=alpha)
        axis.set(xscale="log", yscale="log", ylim=(0.05, 4.0), title=error)
        axis.grid(alpha=0.3)
    for axis in axes[3:7]:
        axis.set_xlabel("flux of the star over that of the jet")
    for axis in axes[::4]:
        axis.set_ylabel("error near the star, rho''")
    axes[0].legend(fontsize=9)
    save_figure(figure, path, True)


def main():
    """Print the table, a row a scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 5))
    parser.add_argument("--contrasts", type=float, nargs="+", default=(0.3, 1.0, 10.0, 30.0))
    parser.add_argument("--errors", nargs="+", choices=ERRORS, default=ERRORS)
    parser.add_argument("--stars", type=int, default=1)
    parser.add_argument("--device")
    parser.add_argument("--output", metavar="STEM")
    parser.add_argument("--draw", metavar="FILE.png")
    given = parser.parse_args()
    path = f"{given.output}-p{given.images}{f'-s{given.stars}' * (given.stars > 1)}.ecsv"
    if given.draw:
        draw(Table.read(path), given.draw)
        return
    rows = []
    for error in given.errors:
        for contrast in given.contrasts:
            for seed in range(*given.seeds):
                of_scene = error, contrast, given.images, seed, given.size, given.stars
                rows.append(row(*of_scene, given.device))
                print(*(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}"
                        for k, v in rows[-1].items()), sep="  ", flush=True)  # fmt: skip
                if given.output:
                    Table(rows).write(path, overwrite=True)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        main()
