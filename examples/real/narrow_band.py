"""Take the continuum off a nebula beside a bright star: in one fit, and by subtraction.

    python examples/real/narrow_band.py [FOLDER] [--picture FILE.png]

The files of the folder not-nebula-ou5 are four images of the planetary nebula Ou 5 by the Nordic
Optical Telescope, two in H alpha and two in the continuum; fetch.py fetches them. A star six times
as bright as the nebula's own lies on it. The seeing of the bands differs, so that the star leaves
rings where a scaled continuum is subtracted. The fit has a PSF for each image, and two skies.

The images were interpolated to one grid, in ADU, and no header states a gain. So the noise of
neighbouring pixels is correlated, by 0.2 to 0.3 where linear interpolation makes it 0.25: over
areas its variance is 2.25 times that of a pixel. Here noise is that over areas, for the errors of
the light of areas. The variance of a pixel rises by 1.4 ADU for each ADU on the nebula, over areas
then by 3.2, which is a gain of 0.31 electrons per ADU.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from regions import CirclePixelRegion, PixCoord
from scipy.ndimage import shift
from scipy.signal import fftconvolve

import lnocl
from lnocl.psf import make_psf

FOLDER = Path(__file__).parents[3] / "shared/data/not-nebula-ou5"
NAMES = "ha-00", "ha-01", "cont-00", "cont-01"
EXPOSURE = np.array([1, 1, 1, 0.5])  # by the stars
GAIN, AREAS = 0.31, 1.5  # electrons per ADU; noise over areas over that of pixels
LEVEL = 20.0  # ADU, error of the background
BLANK = np.s_[5:55, 60:130]
SIZE, APERTURE, RING = 41, 14, (18, 26)  # pixels: PSFs, and photometry of stars
# Stars with few neighbours, which make the PSFs and the weight of the continuum.
FIELD = ((30, 217), (166, 328), (287, 350), (327, 259), (366, 222), (46, 116), (142, 60))
X, Y, SIDE = 140, 131, 128  # the part that is fitted
BRIGHT = (207.5, 183.3)
STARS = (BRIGHT, (201, 184), (191, 187.7), (199.5, 199.4), (209.4, 227.2), (217, 159.7),
         (192.3, 150.4), (243.8, 254.3), (251.3, 246))  # fmt: skip
ALIGNED_BY = BRIGHT, (209.4, 227.2)
NEBULA = (178, 213, 12)  # x, y and radius of a part without stars
MATCHED = 1e-3  # noise of the kernel that matches PSFs, over the power of these
REPLICAS = 20

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
parser.add_argument("--picture", help="file for a picture")
options = parser.parse_args()
files = [options.folder / f"nordic-ou5-{name}-regrid.fits" for name in NAMES]
if not files[0].is_file():
    print(f"the data are missing from {options.folder}: fetch.py fetches the set not-nebula-ou5")
    sys.exit()
images = np.array([fits.getdata(file, 1).astype(float) for file in files])
rows, columns = np.indices(images.shape[1:])
window = np.s_[..., Y : Y + SIDE, X : X + SIDE]


def distance(x, y):
    """Return the distance of each pixel from a place."""
    return np.hypot(columns - x, rows - y)


def star_flux(image, star):
    """Return the light in an aperture round a star over the level of the ring round it, ADU."""
    r = distance(*star)
    return (image[r < APERTURE] - np.median(image[(r > RING[0]) & (r < RING[1])])).sum()


def in_bands(values):
    """Return the mean in the line and in the continuum, per exposure, of one for each image."""
    return sum(values[:2]) / EXPOSURE[:2].sum(), sum(values[2:]) / EXPOSURE[2:].sum()


def fit(which, **components):
    """Return the result for some of the images."""
    observation = lnocl.Observation(
        GAIN * images[which][window], psfs[which], exposure=EXPOSURE[which],
        offsets=offsets[which], read_noise=GAIN * noise[which], background_error=GAIN * LEVEL,
        **components,
    )  # fmt: skip
    return lnocl.deconvolve(observation, np.array(STARS) - (X, Y))


def in_frame(sky):
    """Return an extended source, in ADU, in an image of all pixels."""
    frame = np.zeros(images.shape[1:])
    frame[window] = sky / GAIN
    return frame


def matched(image, psf, wider):
    """Return an image with a wider PSF than its own."""
    ours, theirs = (np.fft.fft2(each, image.shape) for each in (psf, wider))
    kernel = theirs * ours.conj() / (abs(ours) ** 2 + MATCHED)
    return np.fft.ifft2(np.fft.fft2(image) * kernel).real


def rings(line):
    """Return the largest mean of rings round the bright star, over the level, and their rms."""
    r, free = distance(*BRIGHT), np.min([distance(*star) for star in STARS[1:]], axis=0) > 5
    over = line - line[free & (r > 9) & (r < 14)].mean()
    means = np.array([over[free & (abs(r - n) < 0.5)].mean() for n in range(2, 9)])
    return abs(means).max(), np.sqrt(np.mean(means**2))


warnings.simplefilter("ignore", lnocl.LnoclWarning)
psfs = [make_psf(image, FIELD, SIZE) for image in images]
centres = np.array([[make_psf(each, star, SIZE).centre for each in images] for star in ALIGNED_BY])
offsets = (centres - centres[:, :1]).mean(axis=0)
print("offsets, pixels:", *offsets.round(2).tolist())
images -= np.median(images[:, *BLANK], axis=(1, 2))[:, None, None]
noise = AREAS * 1.4826 * np.median(abs(images[:, *BLANK]), axis=(1, 2))
fluxes = in_bands([np.array([star_flux(image, star) for star in FIELD]) for image in images])
weight, error = np.mean(fluxes[0] / fluxes[1]), np.std(fluxes[0] / fluxes[1], ddof=1)
print(f"continuum in H alpha: {weight:.2f} +- {error:.2f} of that beside it, by stars")
weights = {"line": [1, 1, 0, 0], "continuum": [weight, weight, 1, 1]}
errors = {"continuum": [error, error, 0, 0]}
together = fit(slice(4), components=weights, component_errors=errors)
print(together, flush=True)
each = fit(slice(2)).extended - weight * fit(slice(2, 4)).extended
on, off = in_bands([shift(image, -by[::-1]) for image, by in zip(images, offsets, strict=True)])
narrow, wide = in_bands([by * psf.psf for by, psf in zip(EXPOSURE, psfs, strict=True)])
lines = {
    "subtraction": on - weight * off,
    "PSFs matched": matched(on, narrow, wide) - weight * off,
    "each alone": in_frame(each),
    "one fit": in_frame(together.component("line")),
}
inside = distance(*NEBULA[:2]) < NEBULA[2]
shown = lines | {"one fit, blurred": fftconvolve(lines["one fit"], wide, mode="same")}
print("rings over the nebula, ADU (largest, rms), and light of a part of it, ADU")
for name, line in shown.items():
    print(f"{name:16} {rings(line)[0]:5.0f} {rings(line)[1]:5.0f} {line[inside].sum():8.0f}")
region = CirclePixelRegion(PixCoord(NEBULA[0] - X, NEBULA[1] - Y), NEBULA[2])
replicas = together.bootstrap(REPLICAS, regions=[region])
names = [quantity.name for quantity in replicas.quantities]
of_line = replicas.standard_errors[names.index("line region 1")] / GAIN
print(f"its error: {of_line:.0f} by the fit; {error * off[inside].sum():.0f} by the weight alone")
if options.picture:
    import matplotlib.pyplot as plt

    panels = {"H alpha": on} | lines
    figure, axes = plt.subplots(1, 5, figsize=(20, 4.3), layout="constrained")
    for axis, (name, panel) in zip(axes, panels.items(), strict=True):
        axis.imshow(panel[window], origin="lower", cmap="gray", vmin=-300, vmax=3000)
        axis.set_title(name)
        axis.axis("off")
    figure.savefig(options.picture)
