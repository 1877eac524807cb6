"""What real PSFs miss real stars by: the priors of a PSF's error, measured.

    python benchmarks/psf_priors.py NAME --image FITS (--psf FITS | --make) [--positions FILE]
        [--sigma FITS] [--gain G] [--oversample N] [--integrate] [--half W] [--least-snr S]
        [--saturation V] [--most N] [--kind KIND] --output FILE.ecsv
    python benchmarks/psf_priors.py --report FILE.ecsv ... [--held-out NAME ...]
    python benchmarks/psf_priors.py --exposures CUBE POSITIONS CUBE POSITIONS [--half R]
    python benchmarks/psf_priors.py --edges PSF.fits ...

An image is a frame, or a cube of stamps with one star in the middle of each. Positions are lines of
x and y, pixels from 0; without them stars are found by photutils, those alone within the window.
With --make the PSF is that of `lnocl.psf.make_psf` from every second star, and the others are
measured. --integrate is for a fine PSF of the optics alone: the image's pixels integrate it.

Each star is fitted by least squares within 2 W + 1 pixels: flux, place, level, and the PSF's
stretch (log scale) and blur (covariance of a Gaussian, square pixels over FWHM squared; negative
where the PSF is too wide). The noise is --sigma, or that of the window's border and of the
electrons (--gain, electrons a unit), and the field below. Pixels 5 sigma off beyond 2.5 FWHM, and
3 pixels, are others' and left out. "width" is the stretch where no blur is fitted.

What is left is a field: an error of each pixel in proportion to the PSF smoothed by a Gaussian of
sigma 2 pixels, or not smoothed, beyond the noise. Errors contain it.

"level" is the slope of the levels of a set's stars against their fluxes, times the pixels of the
window: a pedestal of the PSF, or light that it does not have, over the star's.

--exposures compares light within R pixels of the same stars in two exposures: the zero point
between them, and the scatter of the stars about it.

--edges prints what `lnocl.core.scene.psf_edge` tells of PSFs, and of parts of them, beside the
light that is beyond a part and within the whole.

The report has for each set the mean and the scatter of each parameter beyond its errors, by maximum
likelihood, and then a prior: a normal distribution of mean 0 whose width the sets not held out
give, each set with equal weight, and how many stars of those held out lie within 1 and 2 of it.
"""

import argparse
from contextlib import suppress
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.stats import mad_std, sigma_clipped_stats
from astropy.table import Table
from photutils.detection import DAOStarFinder
from scipy.ndimage import binary_dilation, gaussian_filter, spline_filter, uniform_filter
from scipy.ndimage import map_coordinates as sampled
from scipy.optimize import least_squares, minimize_scalar

from lnocl.core.scene.cores import fwhm, off_centre
from lnocl.core.scene.psf_edge import psf_edge
from lnocl.errors import InputError
from lnocl.psf import make_psf

SMOOTHED, ALIEN, FAR, FIELD, LEAST = 2.0, 5.0, 2.5, 0.02, 15.0
PARTS = 0.25, 0.4, 0.6, 0.8
PARAMETERS = "width", "stretch", "blur_xx", "blur_xy", "blur_yy"
FIELDS = "field", "field_core", "field_plain"


class Model:
    """A PSF that can be stretched, blurred and moved.

    Parameters
    ----------
    psf : ndarray, shape (ky, kx)
        The PSF, its pixels `oversample` to one of the image.
    """

    def __init__(self, psf, oversample):
        psf = np.pad(psf / psf.sum(), 4 * oversample)
        self.psf, self.oversample = psf, oversample
        self.middle = np.array(psf.shape) // 2 + np.array(off_centre(psf))[::-1]
        self.fwhm = fwhm(psf) / oversample
        v, u = (np.fft.fftfreq(n) * oversample for n in psf.shape)
        self.v, self.u = v[:, None], u[: psf.shape[1] // 2 + 1]
        self.u = abs(self.u)
        self.spectrum = np.fft.rfft2(psf)
        self.held = None, None

    def coefficients(self, blur):
        """Return spline coefficients of the PSF with a blur of (xx, xy, yy), square pixels."""
        if self.held[0] != tuple(blur):
            xx, xy, yy = blur
            power = self.u**2 * xx + 2 * self.u * self.v * xy + self.v**2 * yy
            spectrum = self.spectrum * np.exp(np.clip(-2 * np.pi**2 * power, None, 1.0))
            self.held = tuple(blur), spline_filter(np.fft.irfft2(spectrum, self.psf.shape), 3)
        return self.held[1]

    def at(self, shape, x, y, stretch=0.0, blur=(0.0, 0.0, 0.0)):
        """Return the light of a star of flux 1 in an image."""
        scale = self.oversample * np.exp(-stretch)
        rows, columns = (np.arange(n) for n in shape)
        r = (rows - y) * scale + self.middle[0]
        c = (columns - x) * scale + self.middle[1]
        places = np.stack(np.meshgrid(r, c, indexing="ij"))
        light = sampled(self.coefficients(blur), places, order=3, prefilter=False, mode="constant")
        return light * scale**2


def fit(model, data, sigma, used, n, guess):
    """Return the first n parameters of a star, their errors and its model."""
    unit = model.fwhm**2

    def image(theta):
        stretch, *blur = np.append(theta[4:], np.zeros(8 - n))
        star = model.at(data.shape, *theta[1:3], stretch, unit * np.array(blur))
        return theta[0] * star + theta[3]

    scale = np.array([abs(guess[0]), 1.0, 1.0, np.median(sigma), 0.1, 0.1, 0.1, 0.1])
    found = least_squares(
        lambda theta: ((image(theta * scale[:n]) - data) / sigma)[used],
        guess[:n] / scale[:n],
        x_scale=1.0,
        diff_step=1e-4,
        max_nfev=30,
    )
    errors = scale[:n] * np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
    return found.x * scale[:n], errors, image(found.x * scale[:n])


def field_of(left, noise, shape, used):
    """Return the standard deviation of errors in proportion to a shape, beyond the noise."""
    left, noise, shape = left[used], noise[used], shape[used]

    def misfit(logarithm):
        variance = noise**2 + (np.exp(logarithm) * shape) ** 2
        return (left**2 / variance + np.log(variance)).sum()

    return float(np.exp(minimize_scalar(misfit, (-9.0, 0.0), bounds=(-9.0, 0.0)).x))


def measure(model, data, sigma, gain):
    """Return what a PSF misses a star in the middle of a window by, or None."""
    _, level, spread = sigma_clipped_stats(border(data))
    if sigma is None:
        sigma = np.sqrt(spread**2 + np.maximum(data - level, 0) / gain)
    finite = np.isfinite(data) & np.isfinite(sigma) & (sigma > 0)
    data, sigma = np.where(finite, data, level), np.where(finite, sigma, 1.0)
    middle = np.array(data.shape)[::-1] // 2
    light = data - level
    peak = light[middle[1] - 2 : middle[1] + 3, middle[0] - 2 : middle[0] + 3]
    y, x = np.unravel_index(peak.argmax(), peak.shape)
    x, y = middle[0] + x - 2, middle[1] + y - 2
    flux = light[y, x] / model.at((1, 1), 0.0, 0.0).max()
    theta = np.array([flux, x, y, level, 0.0, 0.0, 0.0, 0.0])
    rows, columns = np.indices(data.shape)
    used, size, image = finite, FIELD, None
    for turn, n in enumerate((4, 5, 8, 8)):
        star = model.at(data.shape, *theta[1:3])
        smooth = abs(theta[0]) * gaussian_filter(star, SMOOTHED)
        total = np.hypot(sigma, size * smooth)
        if turn == 1:
            far = np.hypot(rows - theta[2], columns - theta[1]) > max(FAR * model.fwhm, 3.0)
            alien = far & (abs(image - data) > ALIEN * total)
            used = finite & ~binary_dilation(alien, np.ones((3, 3)))
            plain = theta.copy()
        theta[:n], errors, image = fit(model, data, total, used, n, theta)
        if turn:
            size = field_of(data - image, sigma, smooth, used)
    width, width_errors, _ = fit(model, data, total, used, 5, plain)
    near = used & (np.hypot(rows - theta[2], columns - theta[1]) <= model.fwhm)
    row = dict(
        flux=theta[0],
        flux_error=errors[0],
        level=theta[3],
        level_error=errors[3],
        pixels=int(used.sum()),
        snr=theta[0] / np.sqrt((total**2 * star / star.sum()).sum() / (star**2).sum() * star.sum()),
        width=width[4],
        width_error=width_errors[4],
        field=size,
        field_core=field_of(data - image, sigma, smooth, near),
        field_plain=field_of(data - image, sigma, abs(theta[0]) * star, used),
        fwhm=model.fwhm,
    )
    for k, name in enumerate(PARAMETERS[1:], 4):
        row[name], row[f"{name}_error"] = theta[k], errors[k]
    return row


def border(data):
    """Return the finite pixels along the edges of a window."""
    edge = np.ones(data.shape, bool)
    edge[2:-2, 2:-2] = False
    return data[edge & np.isfinite(data)]


def stars_of(frame, half, fwhm_guess, least_snr, saturation):
    """Return the places of stars that are alone in their windows, the brightest first."""
    _, level, spread = sigma_clipped_stats(frame[np.isfinite(frame)])
    finder = DAOStarFinder(threshold=least_snr * spread, fwhm=fwhm_guess)
    found = finder(np.nan_to_num(frame - level))
    if found is None:
        raise SystemExit("no stars found")
    found = found[np.argsort(-found["peak"])]
    x, y = (np.array(found[name]) for name in ("x_centroid", "y_centroid"))
    ny, nx = frame.shape
    places = []
    for k in range(len(found)):
        near = np.hypot(x - x[k], y - y[k]) < half * 1.2
        rivals = found["peak"][near] > 0.1 * found["peak"][k]
        inside = half < x[k] < nx - half - 1 and half < y[k] < ny - half - 1
        cut = frame[round(y[k]) - half : round(y[k]) + half + 1]
        cut = np.nan_to_num(cut[:, round(x[k]) - half : round(x[k]) + half + 1])
        is_highest = cut.size and cut[half - 1 : half + 2, half - 1 : half + 2].max() == cut.max()
        if rivals.sum() == 1 and inside and is_highest and cut.max() < saturation:
            places.append((x[k], y[k]))
    return np.array(places)


def windows(given, half, image, sigma):
    """Return windows round stars, with their sigmas or None."""
    for x, y in given:
        row, column = round(y), round(x)
        cut = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
        yield image[cut], None if sigma is None else sigma[cut]


def made(cutouts):
    """Return the PSF that `lnocl psf` makes of windows, side by side on one frame.

    Those in which it finds no star in the middle are left out.
    """
    flat = [np.pad(each - sigma_clipped_stats(border(each))[1], 8) for each in cutouts]
    n, m = flat[0].shape
    size = min(n, m) // 2 * 2 - 21
    kept = []
    for each in flat:
        with suppress(InputError):
            make_psf(each, position=(m // 2, n // 2), size=size, background=0.0)
            kept.append(each)
    places = [(m * k + m // 2, n // 2) for k in range(len(kept))]
    return make_psf(np.hstack(kept), position=places, size=size, background=0.0).psf


def measured(options):
    """Return a table of the stars of one set."""
    image = np.array(fits.getdata(options.image), float)
    sigma = None if options.sigma is None else np.array(fits.getdata(options.sigma), float)
    half = options.half
    if image.ndim == 3:
        at = image.shape[1] // 2, image.shape[2] // 2
        cut = (slice(None), *(slice(max(n - half, 0), n + half + 1) for n in at))
        sigmas = [None] * len(image) if sigma is None else sigma[cut]
        pairs = list(zip(image[cut], sigmas, strict=True))
    else:
        if options.positions is None:
            stars = options.fwhm, options.least_snr, options.saturation
            places = stars_of(image, half, *stars)[: options.most]
        else:
            places = np.loadtxt(options.positions, ndmin=2)
        pairs = list(windows(places, half, image, sigma))
    pairs = [pair for pair in pairs if np.nanmax(pair[0]) < options.saturation]
    pairs = sorted(pairs, key=lambda pair: -np.nanmax(pair[0]))[: options.most]
    if options.make:
        psf = made([data for data, _ in pairs[::2]])
        pairs = pairs[1::2]
    else:
        psf = np.array(fits.getdata(options.psf), float)
    if options.integrate:
        psf = uniform_filter(psf, options.oversample, mode="constant")
    model, edge = Model(psf, options.oversample), psf_edge(psf)
    rows = [measure(model, data, s, options.gain) for data, s in pairs]
    rows = [row for row in rows if row["flux"] > LEAST * row["flux_error"]]
    if not rows:
        raise SystemExit("no star is bright enough")
    table = Table(rows)
    table["set"], table["kind"] = options.name, options.kind
    table["beyond"], table["beyond_error"] = edge.share, edge.light_error
    table["pedestal"], table["pedestal_error"] = edge.level, edge.level_error
    return table


def beyond_errors(values, errors):
    """Return mean and scatter of values beyond their errors, and the rms about 0.

    Those four deviations off the median are no stars, or not alone, and are left out.
    """
    values, errors = np.asarray(values), np.asarray(errors)
    far = abs(values - np.median(values)) > 4 * np.hypot(errors, mad_std(values))
    values, errors = values[~far], errors[~far]

    def misfit(logarithm, about):
        variance = errors**2 + np.exp(2 * logarithm)
        mean = (values / variance).sum() / (1 / variance).sum() if about is None else about
        return ((values - mean) ** 2 / variance + np.log(variance)).sum()

    found = []
    for about in (None, 0.0):
        best = minimize_scalar(misfit, bounds=(-9.0, 1.0), args=(about,), method="bounded").x
        found.append(float(np.exp(best)))
    weights = 1 / (errors**2 + found[0] ** 2)
    return float((values * weights).sum() / weights.sum()), found[0], found[1]


def zero_point(cubes, positions, radius):
    """Print the zero point between two exposures of the same stars."""
    fluxes = []
    for cube in (np.array(fits.getdata(path), float) for path in cubes):
        y, x = (np.arange(n) - n // 2 for n in cube.shape[1:])
        near = np.hypot(y[:, None], x) <= radius
        levels = np.array([sigma_clipped_stats(border(each))[1] for each in cube])
        fluxes.append(np.nansum((cube - levels[:, None, None])[:, near], axis=1))
    places = [np.loadtxt(path, ndmin=2) for path in positions]
    shift, pairs = np.zeros(2), []
    for near in (30.0, 3.0):
        distances = np.linalg.norm(places[0][:, None] + shift - places[1], axis=-1)
        pairs = [(i, int(row.argmin())) for i, row in enumerate(distances) if row.min() < near]
        first, second = np.transpose(pairs)
        shift = np.median(places[1][second] - places[0][first], axis=0)
    ratios = np.log(fluxes[1][second] / fluxes[0][first])
    found = ratios[np.argsort(-fluxes[0][first])][: max(len(ratios) // 2, 3)]
    print(f"{len(ratios)} stars, shift {shift.round(2)}: zero point {100 * np.median(found):.2f} %")
    print(f"stars about it, the brighter half: {100 * mad_std(found):.2f} %")


def edges(paths):
    """Print light beyond PSFs and levels in them, and how these hold for parts of known wholes."""
    pulls = []
    for path in paths:
        psf = np.array(fits.getdata(path), float)
        edge = psf_edge(psf)
        print(
            f"{path.name}: beyond {100 * edge.share:.2f} +- {100 * edge.light_error:.2f} %, "
            f"level {100 * edge.level:.2f} +- {100 * edge.level_error:.2f} %"
        )
        y, x = (n // 2 + round(by) for n, by in zip(psf.shape, off_centre(psf)[::-1], strict=True))
        most = min(y, x, psf.shape[0] - 1 - y, psf.shape[1] - 1 - x)
        whole = psf[y - most : y + most + 1, x - most : x + most + 1]
        for half in (int(share * most) for share in PARTS):
            part = psf[y - half : y + half + 1, x - half : x + half + 1]
            edge = psf_edge(part)
            if not edge.light:
                continue
            found, true = edge.wing(whole.shape).sum(), whole.sum() / part.sum() - 1.0
            error = edge.light_error * found / edge.light
            pulls.append((found - true) / error)
            print(
                f"  {part.shape}: {100 * found:.2f} +- {100 * error:.2f} %, true "
                f"{100 * true:.2f}; level {100 * edge.level:.2f} +- {100 * edge.level_error:.2f} %"
            )
    words = f"{np.median(np.abs(pulls)):.2f}, rms {np.sqrt(np.mean(np.square(pulls))):.2f}"
    print(f"{len(pulls)} parts: error over that stated {words}")


def level_slope(table):
    """Return light in a level over a star's, and its error, from the stars of a set."""
    if len(table) < 4:
        return np.nan, np.nan
    flux, level = np.array(table["flux"]), np.array(table["level"])
    spread = max(mad_std(level), np.median(table["level_error"]))
    weights = 1 / (np.array(table["level_error"]) ** 2 + spread**2)
    centred = flux - (weights * flux).sum() / weights.sum()
    power = (weights * centred**2).sum()
    pixels = np.median(table["pixels"])
    return (weights * centred * level).sum() / power * pixels, pixels / np.sqrt(power)


def report(tables, held_out):
    """Print what each set has, priors from those not held out, and their coverage on the others."""
    given = {}
    for table in tables:
        name = table["set"][0]
        words = [f"| {name} | {table['kind'][0]} | {len(table)} | {np.median(table['fwhm']):.1f}"]
        given[name] = {}
        for parameter in PARAMETERS:
            mean, scatter, about = beyond_errors(table[parameter], table[f"{parameter}_error"])
            given[name][parameter] = about
            words.append(f"{100 * mean:.1f}, {100 * scatter:.1f}")
        for parameter in FIELDS:
            given[name][parameter] = np.median(table[parameter])
            words.append(f"{100 * given[name][parameter]:.1f}")
        slope, error = level_slope(table)
        words.append(f"{100 * slope:.1f} +- {100 * error:.1f}")
        first = table[0]
        words.append(f"{100 * first['beyond']:.2f} +- {100 * first['beyond_error']:.2f}")
        words.append(f"{100 * first['pedestal']:.2f} +- {100 * first['pedestal_error']:.2f} |")
        print(" | ".join(words))
    used = [name for name in given if name not in held_out]
    out = [table for table in tables if table["set"][0] in held_out]
    for parameter in (*PARAMETERS, *FIELDS):
        values = np.array([given[name][parameter] for name in used])
        prior = np.sqrt((values**2).mean())
        median = np.median(values)
        line = f"{parameter}: rms {100 * prior:.2f} %, median of sets {100 * median:.2f} %"
        if out and parameter in PARAMETERS:
            shares = []
            for width in (prior, median):
                pulls = [abs(t[parameter]) / np.hypot(t[f"{parameter}_error"], width) for t in out]
                shares += [np.mean([(p < k).mean() for p in pulls]) for k in (1, 2)]
            line += "; held out within 1 and 2: " + ", ".join(f"{s:.2f}" for s in shares)
        elif out:
            others = [given[t["set"][0]][parameter] for t in out]
            line += f"; held out {100 * np.sqrt(np.mean(np.square(others))):.2f} %"
        print(line)


def main():
    """Measure a set, or report on several."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", nargs="?")
    parser.add_argument("--image", type=Path)
    parser.add_argument("--psf", type=Path)
    parser.add_argument("--make", action="store_true")
    parser.add_argument("--positions", type=Path)
    parser.add_argument("--sigma", type=Path)
    parser.add_argument("--gain", type=float, default=1.0)
    parser.add_argument("--oversample", type=int, default=1)
    parser.add_argument("--integrate", action="store_true")
    parser.add_argument("--half", type=int, default=12)
    parser.add_argument("--fwhm", type=float, default=3.0)
    parser.add_argument("--least-snr", type=float, default=30.0)
    parser.add_argument("--saturation", type=float, default=np.inf)
    parser.add_argument("--most", type=int, default=60)
    parser.add_argument("--kind", default="library")
    parser.add_argument("--output", type=Path)
    parser.add_argument("--report", nargs="+", type=Path)
    parser.add_argument("--held-out", nargs="*", default=())
    parser.add_argument("--exposures", nargs=4, type=Path)
    parser.add_argument("--edges", nargs="+", type=Path)
    options = parser.parse_args()
    if options.edges:
        edges(options.edges)
        return
    if options.exposures:
        zero_point(options.exposures[::2], options.exposures[1::2], options.half)
        return
    if options.report:
        tables = [t for path in options.report for t in Table.read(path).group_by("set").groups]
        report(tables, options.held_out)
        return
    table = measured(options)
    table.write(options.output, overwrite=True)
    report([table], ())


if __name__ == "__main__":
    main()
