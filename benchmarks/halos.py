"""Planets within the speckle halo of a star: the halo fitted, or given as background.

    python benchmarks/halos.py [--seeds FIRST LAST] [--solvers sgp sgm] [--kinds fitted ...]
        [--device SPEC] [--output FILE.ecsv]
    python benchmarks/halos.py --bias [--seeds FIRST LAST] [--device SPEC]
    python benchmarks/halos.py --times [--device SPEC]

Four images of 128 x 128 pixels of a star behind a coronagraph. Its halo is the light of a round
pupil with random phases of 1 rad rms, lambda / D 3.5 pixels, beyond 1.5 lambda / D, over a smooth
one. It has 4e6 electrons in an image, in the four of them 0.8, 0.9, 1.1 and 1.2 times that. Four
planets lie in it, at 8 to 40 pixels from the star, with 1e4 to 2.5e3 electrons: 400 to 1600 times
fainter. The disc is an inclined ring of 4e4 electrons. Planets and disc have the PSF of a pupil
with phases of 0.3 rad. The background is 20 electrons per pixel, and the noise that of counts.

right      the halo given as background, its amounts those of the truth
mean       the same, but with the mean amount in all images
high, low  the same with amounts that are 10 % too high or low
fitted     lnocl's fit of halos of this shape
reference  lnocl's fit of halos whose shape is that of a reference star, ten times as many counts
joint      the same fit as "fitted", with amounts free in all iterations: smoothing a number

With --bias, the mean relative errors (%) of amounts that are most likely, with amounts free and
without smoothing, after 3 to 300 iterations, and last those of the defaults; of the halo, and of a
flat one as bright.

With --times, what a halo in each of four images costs beside 3 and 30 stars: milliseconds of an
iteration, and seconds before the first, after the last, and for the errors of all fluxes.

Columns: for each planet the mean and the rms of the relative errors of its flux (%), and the rms of
its error over its standard error; the mean and the rms of the relative errors of the amounts (%),
and the rms of these over their standard errors; and the error of the flux of the disc (%). All are
over seeds, of the noise and of the speckles alike.
"""

import argparse
import time
import warnings

import numpy as np
from astropy.table import Table

import lnocl
from lnocl.core.scene.penalty import recommend_smoothing

N, CENTRE, RESOLUTION = 128, 64, 3.5
AMOUNT = 4e6 * np.array([0.8, 0.9, 1.1, 1.2])
PLANETS = ((8.0, 20.0, 1e4), (14.0, 140.0, 5e3), (24.0, 260.0, 2.5e3), (40.0, 70.0, 2.5e3))
DISC, BACKGROUND, REFERENCE = 4e4, 20.0, 10.0
KINDS = "right", "mean", "high", "low", "fitted", "reference", "joint"
Y, X = np.indices((N, N)) - float(CENTRE)
RADIUS = np.hypot(X, Y)


def pupil_psf(rng, rms):
    """Return the PSF of a round pupil with smooth random phases."""
    fine = 2 * N
    f = np.fft.fftfreq(fine)
    u, v = np.meshgrid(f, f)
    frequency = np.hypot(u, v) * RESOLUTION
    inside = frequency <= 0.5
    spectrum = np.fft.fft2(rng.standard_normal((fine, fine)))
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(fine) * fine, np.fft.fftfreq(fine) * fine))
    smooth = np.fft.ifft2(spectrum * np.exp(-((k / 12.0) ** 2)) * (k > 0)).real
    phase = rms * smooth / smooth[inside].std()
    psf = abs(np.fft.fft2(inside * np.exp(1j * phase))) ** 2
    psf = np.fft.fftshift(psf)[fine // 2 - N // 2 :, fine // 2 - N // 2 :][:N, :N]
    return psf / psf.sum()


def make_halo(rng):
    """Return a halo of speckles without the core, which the coronagraph takes, of unit sum."""
    halo = pupil_psf(rng, 1.0) * (1.0 - np.exp(-((RADIUS / (1.5 * RESOLUTION)) ** 4)))
    smooth = 1.0 / (1.0 + (RADIUS / 12.0) ** 3)
    halo = 0.7 * halo / halo.sum() + 0.3 * smooth / smooth.sum()
    return halo / halo.sum()


def make_disc():
    """Return an inclined ring of unit sum."""
    ring = np.hypot(X * 0.8 + Y * 0.6, (Y * 0.8 - X * 0.6) / 0.5)
    disc = np.exp(-0.5 * ((ring - 34.0) / 3.0) ** 2)
    return disc / disc.sum()


def place(radius, angle):
    """Return (x, y) of a planet."""
    angle = np.radians(angle)
    return CENTRE + radius * np.cos(angle), CENTRE + radius * np.sin(angle)


def shifted(psf, x, y):
    """Return a PSF moved by a phase, with its middle at (x, y)."""
    v, u = np.fft.fftfreq(N)[:, None], np.fft.fftfreq(N)
    phase = np.exp(-2j * np.pi * (u * (x - CENTRE) + v * (y - CENTRE)))
    return np.fft.ifft2(np.fft.fft2(psf) * phase).real


def observe(rng, halo=None):
    """Return counts, halo, a halo of a reference star, and PSF."""
    halo, psf = make_halo(rng) if halo is None else halo, pupil_psf(rng, 0.3)
    blur = np.fft.fft2(np.fft.ifftshift(psf))
    light = DISC * np.fft.ifft2(np.fft.fft2(make_disc()) * blur).real
    for radius, angle, flux in PLANETS:
        light += flux * shifted(psf, *place(radius, angle))
    means = AMOUNT[:, None, None] * halo + light + BACKGROUND
    seen = rng.poisson(REFERENCE * AMOUNT.mean() * halo + BACKGROUND) - BACKGROUND
    return rng.poisson(means).astype(float), halo, np.maximum(seen, 0.0), psf


def fit(kind, counts, halo, reference, psf, solver, device):
    """Return the result of one way to treat the halo."""
    factor = {"high": 1.1, "low": 0.9}.get(kind, 1.0)
    amounts = np.full(4, AMOUNT.mean()) if kind == "mean" else factor * AMOUNT
    if kind in ("fitted", "reference", "joint"):
        given = {"halos": reference if kind == "reference" else halo, "background": BACKGROUND}
    else:
        given = {"background": BACKGROUND + amounts[:, None, None] * halo}
    stars = [place(radius, angle) for radius, angle, _ in PLANETS]
    observation = lnocl.Observation(counts, psf, **given)
    smoothing = 3.0 * recommend_smoothing(observation) if kind == "joint" else "auto"
    return lnocl.deconvolve(observation, stars, solver=solver, smoothing=smoothing, device=device)


def rms(values):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def print_bias(seeds, device):
    """Print by how much the most likely amounts are off."""
    free = {"smoothing": 0.0, "stop": None, "device": device}
    settings = [{**free, "n_iter": n} for n in (3, 10, 30, 100, 300)] + [{"device": device}]
    for is_flat in (False, True):
        for solver in ("sgp", "sgm"):
            errors = np.zeros((len(seeds), len(settings)))
            for k, seed in enumerate(seeds):
                rng = np.random.default_rng(seed)
                counts, halo, _, psf = observe(rng, np.full((N, N), N**-2.0) if is_flat else None)
                stars = [place(radius, angle) for radius, angle, _ in PLANETS]
                observation = lnocl.Observation(counts, psf, background=BACKGROUND, halos=halo)
                for i, options in enumerate(settings):
                    result = lnocl.deconvolve(observation, stars, solver=solver, **options)
                    errors[k, i] = 100 * np.mean(result.halo_fluxes / AMOUNT - 1.0)
            words = (f"{each:.2f}" for each in errors.mean(axis=0))
            print("flat" if is_flat else "speckles", solver, *words, flush=True)


def print_times(device):
    """Print what a halo costs."""
    rng = np.random.default_rng(0)
    v, u = np.indices((63, 63)) - 31
    psf = np.exp(-(u**2 + v**2) / 12.5)
    for n, n_stars in ((512, 3), (512, 30), (1024, 3), (1024, 30)):
        y, x = np.indices((n, n)) - n / 2
        halo = 1.0 / (1.0 + np.hypot(x, y) / 20.0)
        counts = rng.poisson(20.0 + 1e6 * halo / halo.sum(), (4, n, n)).astype(float)
        stars = rng.uniform(40, n - 40, (n_stars, 2))
        options = {"stop": None, "n_iter": 40, "refine_psfs": [], "refine_positions": False}
        for halos in (None, halo, None, halo):  # the first two compile kernels
            moments, begin = [], time.time()
            observation = lnocl.Observation(counts, psf, background=20.0, halos=halos)

            def note(*_, moments=moments):
                moments.append(time.time())

            result = lnocl.deconvolve(observation, stars, callback=note, device=device, **options)
            end = time.time()
            assert np.isfinite(result.star_flux_errors).any()
            print(
                f"{n} x {n}, {n_stars} stars, {'halo' if halos is not None else 'none'}: "
                f"{1e3 * np.median(np.diff(moments)):.2f} ms, before {moments[0] - begin:.1f} s, "
                f"after {end - moments[-1]:.1f} s, errors {time.time() - end:.1f} s",
                flush=True,
            )


def main():
    """Print a row for each solver and way to treat the halo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs=2, type=int, default=(800, 809))
    parser.add_argument("--solvers", nargs="+", default=["sgp"])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--bias", action="store_true")
    parser.add_argument("--times", action="store_true")
    parser.add_argument("--device")
    parser.add_argument("--output")
    arguments = parser.parse_args()
    if arguments.bias or arguments.times:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if arguments.bias:
                first, last = arguments.seeds
                print_bias(range(first, last + 1), arguments.device)
            else:
                print_times(arguments.device)
        return
    rows = []
    truth = np.array([flux for *_, flux in PLANETS])
    for solver in arguments.solvers:
        for kind in arguments.kinds:
            errors, pulls, amounts, amount_pulls, discs, begin = [], [], [], [], [], time.time()
            for seed in range(arguments.seeds[0], arguments.seeds[1] + 1):
                given = observe(np.random.default_rng(seed))
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    result = fit(kind, *given, solver, arguments.device)
                errors.append(result.star_fluxes / truth - 1.0)
                pulls.append((result.star_fluxes - truth) / result.star_flux_errors)
                discs.append(result.extended_flux[0] / DISC - 1.0)
                if result.halo_fluxes.size:
                    amounts.append(result.halo_fluxes[0] / AMOUNT - 1.0)
                    off = result.halo_fluxes[0] - AMOUNT
                    amount_pulls.append(off / result.halo_flux_errors[0])
            row = {"solver": solver, "halo": kind}
            for s, (radius, _, flux) in enumerate(PLANETS):
                name = f"{radius:g} px {flux:g}"
                row[f"{name} mean"] = 100 * np.mean(np.array(errors)[:, s])
                row[f"{name} rms"] = 100 * rms(np.array(errors)[:, s])
                row[f"{name} pull"] = rms(np.array(pulls)[:, s])
            row["amount mean"] = 100 * np.mean(amounts) if amounts else np.nan
            row["amount rms"] = 100 * rms(amounts) if amounts else np.nan
            row["amount pull"] = rms(amount_pulls) if amounts else np.nan
            row["disc mean"], row["disc rms"] = 100 * np.mean(discs), 100 * rms(discs)
            row["seconds"] = (time.time() - begin) / len(errors)
            rows.append(row)
            words = (value if isinstance(value, str) else f"{value:.3g}" for value in row.values())
            print(*words, flush=True)
    table = Table(rows=rows)
    for name in table.colnames[2:]:
        table[name].info.format = ".3g"
    if arguments.output:
        table.write(arguments.output, overwrite=True)


if __name__ == "__main__":
    main()
