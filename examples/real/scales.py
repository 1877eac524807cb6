"""Fit a sharp image of Hubble and a deep one of Subaru, of larger pixels, as one sky.

    python examples/real/scales.py [FOLDER] [--field {1,2}] [--picture FILE.png]

The files of the folder hst-hsc-cosmos are cut-outs of two fields in COSMOS. Hubble (ACS, F814W) has
pixels of 0.03 arcsec, Hyper Suprime-Cam (HSC) on Subaru 0.168, in five bands. fetch.py fetches
them. Their units are arbitrary, so what the fit needs is measured: levels and noise in dark places,
then ratio and offset of the two by what the sky of Hubble alone predicts of HSC. F814W covers the
bands i and z, and HSC's image is their sum with 30 % of the light from z.

Each fit is judged by light that it has not seen, by Gaussian thinning. With noise n like that of
an image, and k times its variance, ``a = image + n`` is a shallower image and ``b = image - n / k``
is independent of it. The noise of drizzled pixels is correlated, so n has the covariance measured.
The squared distance of the model of Hubble's image to b, less the variance of b, is then the error
of the model, but for the error of the variance, which is the same for all fits. It is given in
variances of a: for pixels, and smoothed by Gaussians of 0.21 and 0.56 arcsec FWHM. Ratio and offset
are those of the whole images, as zero points and astrometry give them, or those by a alone.
"""

import argparse
import logging
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import center_of_mass, gaussian_filter, map_coordinates, median_filter
from scipy.optimize import minimize

import lnocl
from lnocl.io import sky

FOLDER = Path(__file__).parents[3] / "shared/data/hst-hsc-cosmos"
NAMES = {1: "1", 2: ""}
I_BAND, Z_BAND, Z_SHARE = 2, 3, 0.3
# Hubble's exposure of 2028 s has sky noise of about 14 electrons in a pixel of 0.03 arcsec, which
# is 2.3 units. Beside HSC's sky the light of galaxies is faint: many electrons, so that its noise
# is that of the dark sky.
GAIN, HSC_GAIN = 6.0, 1e4
# Of what a model predicts of HSC, as colours and PSFs vary over a galaxy.
MODEL_ERROR = 0.02
DARK = 0.2  # share of HSC's pixels that levels and noise are measured in
LAGS = 2  # pixels, within which the noise of Hubble is correlated
EDGE = 6  # pixels of HSC, within which light from beyond Hubble's image matters
SPLIT, SEEDS = 9, (0, 1, 2)  # k: a tenth of the exposure
SCALES = 0.0, 3.0, 8.0  # rms radii, pixels of Hubble, of Gaussians that errors are smoothed by
GALAXIES, APERTURE = 4, 20.0  # number, and radius in pixels of Hubble


def noise_spectrum(image, dark):
    """Return the power of an image's noise, by the covariance of dark pixels close together."""
    ny, nx = image.shape
    values = np.where(dark, image, np.nan)
    covariance = np.zeros((ny, nx))
    for dy in range(LAGS + 1):
        for dx in range(-LAGS, LAGS + 1):
            first = values[: ny - dy, max(-dx, 0) : nx - max(dx, 0)]
            second = values[dy:, max(dx, 0) : nx + min(dx, 0)]
            covariance[dy, dx] = covariance[-dy, -dx] = np.nanmean(first * second)
    return np.fft.fft2(covariance).real.clip(0)


class Field:
    """Images of one field, levels taken off, with what was measured in dark places.

    Parameters
    ----------
    folder : Path
        With the files.
    field : int
        1 or 2.
    """

    def __init__(self, folder, field):
        sharp, header = fits.getdata(folder / f"Cut_HST{NAMES[field]}.fits", header=True)
        bands, hsc_header = fits.getdata(folder / f"Cut_HSC{NAMES[field]}.fits", header=True)
        self.psf = fits.getdata(folder / "PSF_HST.fits").astype(float)
        psfs = fits.getdata(folder / "PSF_HSC.fits")
        light = bands[:, EDGE:-EDGE, EDGE:-EDGE].sum(axis=(1, 2))
        z = Z_SHARE / (1.0 - Z_SHARE) * light[I_BAND] / light[Z_BAND]
        self.hsc = (1.0 - Z_SHARE) * (bands[I_BAND] + z * bands[Z_BAND])
        self.hsc_psf = (1.0 - Z_SHARE) * psfs[I_BAND] + Z_SHARE * psfs[Z_BAND]
        shapes = [sharp.shape, self.hsc.shape]
        self.maps = sky.transforms([header, hsc_header], ["HST", "HSC"], shapes)
        self.inner = np.zeros(self.hsc.shape, bool)
        self.inner[EDGE:-EDGE, EDGE:-EDGE] = True
        smooth = median_filter(self.hsc, 3)
        limits = np.quantile(smooth[self.inner], (DARK, 0.9))
        y, x = np.indices(sharp.shape)
        at_hsc = np.einsum("ij,jyx->iyx", self.maps[1], np.array([x, y, np.ones(x.shape)]))[::-1]
        there = map_coordinates(smooth, at_hsc, order=1, mode="nearest")
        self.dark, self.bright = there < limits[0], there > limits[1]
        # Where both see the sky.
        self.both = map_coordinates(self.inner.astype(float), at_hsc, order=0) > 0
        self.bright &= self.both
        self.places = self.both, self.bright
        is_dark = smooth < limits[0]
        self.hsc -= self.hsc[is_dark].mean()
        over_areas = np.sqrt(noise_spectrum(self.hsc, is_dark)[0, 0])
        self.hsc_noise = np.hypot(over_areas, MODEL_ERROR * smooth.clip(0))
        self.hst = sharp - sharp[self.dark].mean()
        self.spectrum = noise_spectrum(self.hst, self.dark)
        self.variance = self.spectrum.mean()
        self.white = np.sqrt(self.spectrum[0, 0])

    def local_variance(self):
        """Return the variance of Hubble's pixels: sky, and the counts of sources."""
        counts = gaussian_filter(self.hst, 2.0).clip(0) / GAIN
        return self.variance * (1.0 + counts / self.white**2)

    def thinned(self, seed):
        """Return a and b, images with independent noise."""
        white = np.random.default_rng(seed).normal(size=self.hst.shape)
        noise = np.fft.ifft2(np.fft.fft2(white) * np.sqrt(self.spectrum / self.variance)).real
        noise *= np.sqrt(SPLIT * self.local_variance())
        return self.hst + noise, self.hst - noise / SPLIT

    def errors(self, model, b):
        """Return the errors of a model of Hubble's image by b, in variances of the noise of a.

        Shape (number of `SCALES`, 2): where both images see the sky, and in bright places.
        """
        v, u = (np.fft.fftfreq(n) for n in b.shape)
        found = []
        for scale in SCALES:
            gaussian = np.exp(-2.0 * (np.pi * scale) ** 2 * (v[:, None] ** 2 + u**2))
            share = (self.spectrum * gaussian**2).mean() / self.variance
            variance = share * self.local_variance()
            square = gaussian_filter(model - b, scale) ** 2 if scale else (model - b) ** 2
            error = square - (1.0 + 1.0 / SPLIT) * variance
            of_a = (1.0 + SPLIT) * variance
            found.append([error[each].mean() / of_a[each].mean() for each in self.places])
        return np.array(found)


def fit(field, hst, share, maps, ratio, use):
    """Return the extended source in units of Hubble's image, both models, seconds and iterations.

    Parameters
    ----------
    field : Field
        What is fitted.
    hst : ndarray of float64
        Image of Hubble.
    share : float
        Its exposure, relative to the whole.
    maps : ndarray of float64, shape (2, 2, 3)
        From the sky to both images.
    ratio : float
        Unit of HSC's image over that of Hubble's.
    use : tuple of bool
        Whether each image is fitted, or only predicted.
    """
    gain = share * GAIN
    images = [gain * hst, HSC_GAIN * field.hsc]
    noise = [np.full(hst.shape, gain * field.white / np.sqrt(share)), HSC_GAIN * field.hsc_noise]
    mask = [np.full(image.shape, not each) for image, each in zip(images, use, strict=True)]
    exposure = [1.0, HSC_GAIN * ratio / gain]
    start = time.perf_counter()
    with warnings.catch_warnings():
        # The noise of a pixel is below that given, which is meant for an area.
        warnings.filterwarnings("ignore", "the noise of image")
        observation = lnocl.Observation(
            images, [field.psf, field.hsc_psf], read_noise=noise, mask=mask, exposure=exposure,
            transforms=maps, psf_centre="fit",
        )  # fmt: skip
        result = lnocl.deconvolve(observation)
    models = [
        (model - level)[: image.shape[0], : image.shape[1]] / scale
        for model, level, image, scale in zip(
            result.models(), observation.background, images, (gain, HSC_GAIN), strict=True
        )
    ]
    return result.extended / gain, models, time.perf_counter() - start, result.n_iter


def moved(maps, offset):
    """Return maps with HSC's image moved by some of its pixels, x and y."""
    return maps + np.array([np.zeros((2, 3)), np.column_stack([np.zeros((2, 2)), offset])])


def aligned(field, hst, share):
    """Return the fit of Hubble alone, and maps, ratio and offset by what it predicts of HSC."""
    alone = fit(field, hst, share, field.maps, 1.0, (True, False))
    model, seen = alone[1][1], field.hsc[field.inner]
    rows, columns = np.indices(model.shape, float)

    def scaled(offset):
        there = [rows - offset[1], columns - offset[0]]
        values = map_coordinates(model, there, order=5, mode="nearest")[field.inner]
        terms = np.stack([values, np.ones(values.size)], axis=1)
        found = np.linalg.lstsq(terms, seen)[0]
        return found[0], (seen - terms @ found).std()

    best = minimize(lambda offset: scaled(offset)[1], (0.0, 0.0), method="Nelder-Mead")
    ratio, rms = scaled(best.x)
    return alone, moved(field.maps, best.x), ratio, best.x, rms


def galaxies(image, places):
    """Return centroids and fluxes in apertures round some places (x, y)."""
    y, x = np.indices(image.shape)
    for at in places:
        weight = image * (np.hypot(x - at[0], y - at[1]) < APERTURE)
        yield *center_of_mass(weight.clip(0))[::-1], weight.sum()


def brightest(image, inside):
    """Return (x, y) of the brightest peaks of a smoothed image, two apertures apart."""
    left = np.where(inside, gaussian_filter(image, 5.0), 0.0)
    y, x = np.indices(image.shape)
    for _ in range(GALAXIES):
        row, column = np.unravel_index(left.argmax(), left.shape)
        yield column, row
        left[np.hypot(x - column, y - row) < 2.0 * APERTURE] = 0.0


def draw(path, field, ratio, skies):
    """Draw both images and the skies."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    area = 1.0 / np.linalg.det(field.maps[1, :, :2])
    panels = {"HST (F814W)": field.hst, "HSC (i + z)": field.hsc / (area * ratio)}
    panels |= {f"sky by {name}": sky for name, sky in skies.items()}
    figure, axes = plt.subplots(1, len(panels), figsize=(3.2 * len(panels), 3.5))
    for axis, (title, image) in zip(axes, panels.items(), strict=True):
        axis.imshow(np.arcsinh(image / 2.0), origin="lower", cmap="magma", vmin=-0.5, vmax=3.5)
        axis.set_title(title)
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main():
    """Fit, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=FOLDER)
    parser.add_argument("--field", type=int, choices=NAMES, default=1)
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    if not (given.folder / "PSF_HSC.fits").is_file():
        print(f"the data are missing from {given.folder}: fetch.py fetches the set hst-hsc-cosmos")
        sys.exit()
    logging.getLogger("lnocl").setLevel(logging.WARNING)
    field = Field(given.folder, given.field)
    alone, maps, ratio, offset, rms = aligned(field, field.hst, 1.0)
    print(
        f"noise of a pixel: HST {np.sqrt(field.variance):.3f}, {field.white:.3f} over areas; "
        f"HSC {field.hsc_noise.min():.3f} over areas\n"
        f"HSC moved by {offset[0]:+.3f}, {offset[1]:+.3f} of its pixels against the headers, "
        f"ratio 1/{1 / ratio:.2f}; HST alone predicts it with rms {rms:.3f}"
    )
    fits_of = {
        "HST": fit(field, field.hst, 1.0, maps, ratio, (True, False)),
        "HSC": fit(field, field.hst, 1.0, maps, ratio, (False, True)),
        "both": fit(field, field.hst, 1.0, maps, ratio, (True, True)),
        "both, by headers": fit(field, field.hst, 1.0, field.maps, ratio, (True, True)),
    }
    print("\nresiduals: mean and rms in the whole, rms in bright places; iterations, seconds")
    hsc_bright = field.inner & (field.hsc > np.quantile(field.hsc[field.inner], 0.9))
    for name, (_, models, seconds, n_iter) in fits_of.items():
        sharp, deep = field.hst - models[0], field.hsc - models[1]
        of_sharp = sharp[field.both].mean(), sharp[field.both].std(), sharp[field.bright].std()
        of_deep = deep[field.inner].mean(), deep[field.inner].std(), deep[hsc_bright].std()
        numbers = " ".join(f"{value:7.3f}" for value in (*of_sharp, *of_deep))
        print(f"{name:17} {numbers} {n_iter:5d} {seconds:6.1f}")
    skies = {name: each[0] for name, each in fits_of.items()}
    print("\ngalaxies: x, y, flux within 0.6 arcsec")
    places = list(brightest(skies["both"], field.both))
    shown = {"image": field.hst, "HST": skies["HST"], "both": skies["both"]}
    for found in zip(*(galaxies(image, places) for image in shown.values()), strict=True):
        row = (f"{name} {x:.1f} {y:.1f} {flux:.0f}" for name, (x, y, flux) in
               zip(shown, found, strict=True))  # fmt: skip
        print("  ".join(row))
    rows, ratios = {"HST": [], "HSC": [], "both": [], "both, aligned by a": []}, []
    for seed in SEEDS:
        a, b = field.thinned(seed)
        share = 1.0 / (1.0 + SPLIT)
        alone, *of_a, _, _ = aligned(field, a, share)
        found = (
            alone,
            fits_of["HSC"],
            *(fit(field, a, share, *known, (True, True)) for known in ((maps, ratio), of_a)),
        )
        for errors, each in zip(rows.values(), found, strict=True):
            errors.append(field.errors(each[1][0], b))
        ratios.append(1.0 / of_a[1])
    print(
        f"\nerrors of Hubble's image by held-out light, from 1/{SPLIT + 1} of its exposure; "
        f"ratios by it 1/{min(ratios):.2f} to 1/{max(ratios):.2f}"
    )
    for place, where in enumerate(("whole", "bright")):
        for name, errors in rows.items():
            of_scales = zip(
                np.mean(errors, axis=0)[:, place], np.ptp(errors, axis=0)[:, place], strict=True
            )
            numbers = ", ".join(f"{mean:.4f} (range {spread:.4f})" for mean, spread in of_scales)
            print(f"{where:6} {name:18} {numbers}")
    if given.picture:
        skies.pop("both, by headers")
        draw(given.picture, field, ratio, skies)


if __name__ == "__main__":
    main()
