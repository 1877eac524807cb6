"""Images that are turned against the sky, fitted jointly, beside derotating, stacking and ADI.

    python benchmarks/rolls.py [--sets two four sixteen] [--contrasts 1 1e2 1e4]
        [--sources jet disc] [--seeds FIRST LAST] [--device SPEC] [--output FILE.ecsv]

A star in the middle of 128 x 128 pixels, CONTRAST times as bright as an extended source: a jet with
knots, or an inclined ring. The PSF is that of a round pupil with random phases of 1 rad rms and
amplitudes, others for each seed; lambda / D is 3.5 pixels. Its speckles stay with the detector, and
it is known exactly. The images of a set have 4e6 electrons of the extended source together, each a
background of 20 electrons per pixel, and Poisson noise. The sky is a formula, turned exactly.

joint    lnocl's fit of all images, with the defaults
stacked  the images derotated about the star (cubic splines) and summed; the sum deconvolved by
         lnocl with the defaults and the mean of the PSFs derotated likewise
median   each image deconvolved alone by lnocl with the defaults, derotated, the median of these
adi      VIP's median-subtracted angular differential imaging
pca      VIP's ADI by 1, 2, 4 or 8 principal components, the number that the truth would choose

Columns "star" and "frame": the L2 norm of estimate minus truth over that of the truth, at 2 to 8
FWHM from the star, and within 60 pixels of it. Deconvolved sources and the truth are convolved with
a Gaussian of the PSF's FWHM first. ADI's images are compared with the truth convolved with the mean
of the derotated PSFs, which is the most they could show. "scaled" is the error of the estimate
times the factor that makes it least. "flux" is the relative error of the star's. Medians over seeds
are printed at the end. ADI is left out where VIP is not installed (pip install vip_hci).
"""

import argparse
import contextlib
import io
import itertools
import time
import warnings

import numpy as np
from astropy.table import Table
from scipy.ndimage import affine_transform

import lnocl
from lnocl.core.opencl.device import choose, describe

try:
    from vip_hci.psfsub import median_sub, pca
except ImportError:
    median_sub = None

N = 128
CENTRE = N // 2
STAR = (CENTRE, CENTRE)
Y, X = np.indices((N, N)) - float(CENTRE)
R = np.hypot(X, Y)
RESOLUTION, REACH = 3.5, 60.0  # lambda / D, and the PSF's radius, pixels
LIGHT, BACKGROUND = 4e6, 20.0
SETS = {"two": [0.0, 10.0], "four": [0.0, 10.0, 20.0, 40.0], "sixteen": np.linspace(0, 40, 16)}
COMPONENTS = (1, 2, 4, 8)


def make_psf(rng):
    """Return a PSF with speckles, and its FWHM, from the area that is above half its peak."""
    fine = 2 * N
    f = np.fft.fftfreq(fine)
    radius = np.hypot(f[:, None], f) * 2.0 * RESOLUTION
    inside = np.clip((1.0 - radius) / (4.0 * RESOLUTION / fine) + 0.5, 0.0, 1.0)
    # The power of the screens is flat up to 2 cycles per pupil, and falls then.
    cycles = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(fine, 1.0 / fine)])) / RESOLUTION
    spectrum = (1.0 + (cycles / 2.0) ** 2) ** -0.75
    noise = rng.normal(size=(2, fine, fine))
    screens = np.fft.ifft2(spectrum * np.fft.fft2(noise)).real
    phase, amplitude = screens / screens[:, inside > 0.5].std(axis=1)[:, None, None]
    field = inside * (1.0 + 0.1 * amplitude) * np.exp(1j * phase)
    window = np.exp(-((R / 2.5) ** 2))
    for _ in range(8):  # bring its core to the centre
        psf = abs(np.fft.fft2(field)) ** 2
        psf = np.fft.fftshift(psf)[CENTRE : CENTRE + N, CENTRE : CENTRE + N]
        core = psf * window
        x, y = (core * X).sum() / core.sum(), (core * Y).sum() / core.sum()
        field *= np.exp(-2j * np.pi * (x * f + y * f[:, None]))
    psf *= np.cos(np.pi / 2.0 * np.clip((R - REACH) / 24.0 + 1.0, 0.0, 1.0)) ** 2
    return psf / psf.sum(), 2.0 * np.sqrt(np.count_nonzero(psf > psf.max() / 2.0) / np.pi)


def source(kind, rng):
    """Return a function of an angle, degrees, that draws a turned extended source of unit sum."""
    tilt, side = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.4, 0.8)
    places = np.sort(rng.uniform(8.0, 46.0, 6))
    heights = rng.uniform(0.4, 1.0, 6)

    def draw(angle):
        turn = tilt + np.radians(angle)
        along, across = np.cos(turn) * X + np.sin(turn) * Y, np.cos(turn) * Y - np.sin(turn) * X
        if kind == "disc":
            radius = np.hypot(along, across / 0.5)
            sky = np.exp(-0.5 * ((radius - 24.0) / 4.5) ** 2)
            sky = sky * (1.0 + side * across / np.hypot(R, 4.0))
        else:
            across = across - 3.0 * np.sin(along / 9.0)
            sky = sum(
                height * np.exp(-0.5 * (((along - at) / 2.5) ** 2 + (across / 2.0) ** 2))
                for at, height in zip(places, heights, strict=True)
            )
        return sky / sky.sum()

    return draw


def convolved(image, psf):
    """Return an image convolved with a PSF of its shape, on twice the grid."""
    shape = 2 * N, 2 * N
    spectra = np.fft.rfft2(image, shape) * np.fft.rfft2(psf, shape)
    return np.fft.irfft2(spectra, shape)[CENTRE : CENTRE + N, CENTRE : CENTRE + N]


def derotated(image, angle):
    """Return an image turned back about the star, by cubic splines; 0 where it has nothing."""
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    back = np.array([[c, s], [-s, c]])
    return affine_transform(image, back, np.array(STAR) - back @ STAR, order=3)


def fitted(images, psfs, background, device, **known):
    """Return lnocl's extended source and the flux of the star, and what it warned of."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        observation = lnocl.Observation(images, psfs, background=background, **known)
        result = lnocl.deconvolve(observation, [STAR], device=device)
    said = [str(w.message) for w in caught if issubclass(w.category, lnocl.LnoclWarning)]
    return result.extended, float(result.star_fluxes[0]), said


def differential(images, angles):
    """Yield names and images of angular differential imaging by VIP."""
    # An odd side: its middle is then that of the image.
    cube, turns = images[:, 1:, 1:], -np.asarray(angles)
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield "adi", np.pad(median_sub(cube, turns, verbose=False), ((1, 0), (1, 0)))
        for n in COMPONENTS:
            if n < len(images):
                yield "pca", np.pad(pca(cube, turns, ncomp=n, verbose=False), ((1, 0), (1, 0)))


def relative(estimate, truth, where):
    """Return the relative error, and that of the estimate times its best factor."""
    a, b = estimate[where], truth[where]
    norm = np.linalg.norm(b)
    best = a * max(a @ b, 0.0) / (a @ a)
    return np.linalg.norm(a - b) / norm, np.linalg.norm(best - b) / norm


def measure(case, device):
    """Yield a row for each method."""
    name, contrast, kind, seed = case
    angles = np.asarray(SETS[name])
    rng = np.random.default_rng(seed)
    psf, fwhm = make_psf(rng)
    draw = source(kind, rng)
    share = LIGHT / len(angles)
    truth = LIGHT * draw(0.0)
    means = [share * (convolved(draw(a), psf) + contrast * psf) + BACKGROUND for a in angles]
    images = rng.poisson(np.maximum(means, 0.0)).astype(float)
    sky_psf = np.mean([derotated(psf, a) for a in angles], axis=0)
    seen = convolved(truth, sky_psf)
    gaussian = np.exp(-4.0 * np.log(2.0) * (R / fwhm) ** 2)
    gaussian /= gaussian.sum()
    sharp = convolved(truth, gaussian)
    places = {"star": abs(R / fwhm - 5.0) < 3.0, "frame": R < REACH}

    def row(method, estimate, expected, seconds, flux=np.nan, said=()):
        found = dict(zip(("set", "contrast", "source", "seed"), case, strict=True))
        found["method"] = method
        for place, where in places.items():
            found[place], found[f"{place}, scaled"] = relative(estimate, expected, where)
        flux = flux / (contrast * LIGHT) - 1.0
        return found | {"flux": flux, "seconds": seconds, "said": " | ".join(said)}

    start = time.perf_counter()
    maps = lnocl.rotations(angles, STAR)
    # The sky is in electrons of one image, of which all have the same exposure.
    sky, flux, said = fitted(images, psf, BACKGROUND, device, transforms=maps)
    p, now = len(angles), time.perf_counter
    yield row("joint", p * convolved(sky, gaussian), sharp, now() - start, p * flux, said)

    start = now()
    total = sum(derotated(image, a) for image, a in zip(images, angles, strict=True))
    missing = sum(derotated(np.ones((N, N)), a) < 0.999 for a in angles) > 0
    sky, flux, said = fitted(total, sky_psf, p * BACKGROUND, device, mask=missing)
    yield row("stacked", convolved(sky, gaussian), sharp, now() - start, flux, said)

    start = now()
    single = [fitted(image, psf, BACKGROUND, device) for image in images]
    skies = [derotated(sky, a) for (sky, _, _), a in zip(single, angles, strict=True)]
    flux = p * float(np.median([flux for _, flux, _ in single]))
    said = sorted({each for *_, warned in single for each in warned})
    sky = p * np.median(skies, axis=0)
    yield row("median", convolved(sky, gaussian), sharp, now() - start, flux, said)

    best = {}
    for method, image in differential(images, angles) if median_sub else ():
        found = row(method, p * image, seen, np.nan)
        if method not in best or found["star"] < best[method]["star"]:
            best[method] = found
    yield from best.values()


def main():
    """Measure all cases, and print the medians over seeds."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    parser.add_argument("--contrasts", nargs="+", type=float, default=[1.0, 1e2, 1e4])
    parser.add_argument("--sources", nargs="+", choices=["jet", "disc"], default=["jet", "disc"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[700, 703])
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    seeds = range(given.seeds[0], given.seeds[1] + 1)
    rows = []
    for case in itertools.product(given.sets, given.contrasts, given.sources, seeds):
        for row in measure(case, given.device):
            print(*(f"{v:.3g}" if isinstance(v, float) else v for v in row.values()), flush=True)
            rows.append(row)
    table = Table(rows)
    cases = table.group_by(["set", "contrast", "source", "method"])
    numbers = [each for each in table.colnames if table[each].dtype.kind == "f"]
    cases[cases.groups.keys.colnames + numbers[1:]].groups.aggregate(np.median).pprint_all()
    table.meta |= {"device": describe(choose(given.device).device), "lnocl": lnocl.__version__}
    if given.output:
        table.write(given.output, overwrite=True)


if __name__ == "__main__":
    main()
