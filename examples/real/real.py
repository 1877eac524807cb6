"""What the shell scripts beside this one need: PSFs made, figures printed and drawn.

python real.py star-psf FRAME OUT X,Y SIZE   PSF of a star in a frame
python real.py centred-psf FRAME OUT SIZE    PSF image without background, centred
python real.py finer-psf PSF OUT Q           the same PSF at Q times as many samples
python real.py airy-psf OUT FWHM HALF Q      Airy pattern in pixels, Q times as fine
python real.py pixel-psf PSF OUT             PSF spread over Chandra's pixels
python real.py offsets ALIGNED IMAGE IMAGE PSF PSF N   two images with their offset and not
python real.py stars-psf SCI EXPTIME OUT     one PSF of the lensed quasar's four images
python real.py figures RESULT...             counts, stars and residuals of results
python real.py draw OUT.png TITLE=FILE[,EXTENSION]:X,Y,HALF:LOW:HIGH...
"""

import sys

import numpy as np
from astropy.io import fits
from scipy.ndimage import convolve1d, map_coordinates, shift
from scipy.special import j1

import lnocl
from lnocl.psf.make import make_psf

# The lensed quasar: its images' brightest pixels (x, y), and what its sky's noise is squared.
IMAGES = ((77, 73), (47, 56), (55, 77), (73, 48))
SKY_VARIANCE = 26.9
HALF = 10  # pixels from the middle to the edge of the PSF made of them
ROUNDS = 16
WINDOW = 3.0  # sigma in pixels of the Gaussian that a source's width is measured through


def pair(text):
    """Return the numbers of X,Y."""
    x, y = map(float, text.split(","))
    return x, y


def star_psf(frame, out, position, size):
    """Write the PSF that a star shows; its background is measured around it."""
    star = make_psf(fits.getdata(frame), pair(position), int(size), clip_negative=True)
    print(*star.steps, sep="\n")
    fits.writeto(out, star.psf, overwrite=True)


def centred_psf(frame, out, size):
    """Write a PSF image without background, centred."""
    star = make_psf(fits.getdata(frame), size=int(size), background=0.0, clip_negative=True)
    print(star.steps[3])
    fits.writeto(out, star.psf, overwrite=True)


def finer_psf(psf, out, finer):
    """Write an effective PSF between the pixels that it is known on, by cubic splines.

    What lies between is a guess: pixels that undersample a PSF do not show it.
    """
    known, finer = fits.getdata(psf).astype(float), int(finer)
    at = [np.arange(finer * (n // 2 - 1) * 2 + 1) / finer + 1 for n in known.shape]
    samples = map_coordinates(known, np.meshgrid(*at, indexing="ij"), order=3)
    fits.writeto(out, samples.clip(0.0), overwrite=True)


def airy_psf(out, fwhm, half, finer):
    """Write the Airy pattern of this FWHM, pixels, on so many times finer ones, to `half` pixels.

    It is integrated over the finer pixels at 8 x 8 points.
    """
    points, n = 8, 2 * int(half) * int(finer) + 1
    side = 1.0 / int(finer)
    at = ((np.arange(n * points) + 0.5) / points - 0.5) * side - int(half)
    u = np.maximum(3.2327 * np.hypot(at[:, None], at) / float(fwhm), 1e-9)
    light = ((2 * j1(u) / u) ** 2).reshape(n, points, n, points).sum(axis=(1, 3))
    fits.writeto(out, light / light.sum(), overwrite=True)


def pixel_psf(psf, out):
    """Write a Chandra PSF of quarter pixels, spread twice over a pixel.

    An event is known to a pixel, wherever in it the photon fell, and the pipeline of 2000 moved
    each at random within one pixel more (RAND_PIX_SIZE=0.5 in the header's history).
    """
    pixel = np.array([0.5, 1, 1, 1, 0.5]) / 4
    spread = fits.getdata(psf).astype(float)
    for axis in (0, 1, 0, 1):
        spread = convolve1d(spread, pixel, axis)
    fits.writeto(out, spread, overwrite=True)


def middle(image, position):
    """Return the square of `HALF` round a position of an image, moved to its middle."""
    x, y = np.floor(np.array(position) + 0.5).astype(int)
    cut = image[y - HALF - 1 : y + HALF + 2, x - HALF - 1 : x + HALF + 2]
    return shift(cut, (y - position[1], x - position[0]), order=1)[1:-1, 1:-1]


def stars_psf(sci, exptime, out, which="0,1,2,3"):
    """Write one PSF of the images of the lensed quasar, the residuals of all put back into it.

    The mean of the images, each centred; then, `ROUNDS` times, the stars are fitted with it and
    what is left at each is moved to the middle and added, weighted by flux: steps of Landweber's
    to the PSF that fits all of them best. Moved is by linear interpolation, which blurs, and the
    rounds mend that; by phases it would ring, which they do not.
    """
    rates, seconds = (fits.getdata(path).astype(float) for path in (sci, exptime))
    chosen = [int(s) for s in which.split(",")]
    centres = [make_psf(rates, IMAGES[s], background=0.0).centre for s in chosen]
    psf = np.mean([middle(rates, centre) for centre in centres], axis=0)
    for _ in range(ROUNDS):
        psf = psf.clip(0) / psf.clip(0).sum()
        noise = np.sqrt(SKY_VARIANCE)
        observation = lnocl.Observation(rates * seconds, psf, read_noise=noise, exposure=seconds)
        fit = lnocl.deconvolve(
            observation, IMAGES, n_iter=10, stop=None, smoothing=0.0, refine_positions=True, pad=4
        )
        left = np.divide(
            observation.images[0] - fit.models()[0],
            seconds, out=np.zeros_like(rates), where=seconds > 0,
        )  # fmt: skip
        weights = fit.star_fluxes / (fit.star_fluxes[chosen] ** 2).sum()
        psf = psf + sum(weights[s] * middle(left, fit.star_positions[s]) for s in chosen)
    psf = psf.clip(0) / psf.clip(0).sum()
    fits.writeto(out, psf, overwrite=True)


def width(image):
    """Return the rms radius of a source round the brightest pixel, seen through `WINDOW`.

    Unlike the brightest pixel it does not depend on where between pixels the source lies.
    """
    rows, columns = np.indices(image.shape)
    y, x = np.unravel_index(image.argmax(), image.shape)
    for _ in range(20):
        distance = (rows - y) ** 2 + (columns - x) ** 2
        seen = image * np.exp(-distance / (2 * WINDOW**2))
        seen = seen / seen.sum()
        y, x = (seen * rows).sum(), (seen * columns).sum()
    return np.sqrt((seen * distance).sum())


def offsets(aligned, first, second, psf1, psf2, n_iter):
    """Print what two images have together with and without their offset, both from half-way.

    Half of the offset is given to each image, so that both are seen from as far between the pixels
    of the sky; without their offset both are moved by half of it, one way or the other.
    """
    images = [fits.getdata(path).astype(float) for path in (first, second)]
    psfs = [fits.getdata(path) for path in (psf1, psf2)]
    header = fits.getheader(aligned)
    half = np.array([header["OFFX2"], header["OFFY2"]]) / 2
    for name, each in {
        "offset": (-half, half),
        "offset 0, both moved by -half": (-half, -half),
        "offset 0, both moved by +half": (half, half),
        "offset the wrong way round": (half, -half),
    }.items():
        observation = lnocl.Observation(images, psfs, offsets=np.array(each))
        result = lnocl.deconvolve(
            observation, solver="sgm", n_iter=int(n_iter), stop=None, smoothing=0.0, pad=24
        )
        share = result.models().sum() / np.sum(images)
        print(
            f"{name}: objective {result.history['objective'][-1]:.1f}, rms radius of the "
            f"brightest source {width(result.extended):.3f}, model / counts {share:.4f}"
        )


def figures(*paths):
    """Print what came out: objective, stars, counts of model and data, residuals."""
    for path in paths:
        with fits.open(path) as hdus:
            extended, stars = hdus[0].data, hdus["STARS"].data
            objective = hdus["HISTORY"].data["objective"][-1]
            line = f"{path}: objective {objective:.1f}, extended {extended.sum():.1f}"
            line += f", brightest pixel {extended.max():.4g}"
            if len(stars):
                line += f", stars {stars['flux'].sum():.1f}"
            if "RESIDUALS" in hdus:
                models, residuals = hdus["MODELS"].data, hdus["RESIDUALS"].data
                data = models + np.sqrt(models) * np.nan_to_num(residuals)
                middle = residuals[:, 40:80, 40:80]
                line += f", model / data {models.sum() / data.sum():.4f}"
                line += f", residuals' rms {np.sqrt(np.nanmean(residuals**2)):.3f}"
                if middle.size:
                    line += f", within [40:80, 40:80] {np.sqrt(np.nanmean(middle**2)):.3f}"
            print(line)
            for star in stars:
                print("  star", ", ".join(f"{name} {star[name]:.6g}" for name in stars.names))


def draw(out, *panels):
    """Draw cut-outs beside each other, each between two levels, in the scale of a square root."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        1, len(panels), figsize=(3.1 * len(panels), 3.5), layout="constrained", dpi=75,
        squeeze=False,
    )  # fmt: skip
    for axis, panel in zip(axes[0], panels, strict=True):
        title, _, what = panel.partition("=")
        path, where, low, high = what.rsplit(":", 3)
        path, _, extension = path.partition(",")
        data = fits.getdata(path, extension or 0)
        data = data[0] if data.ndim == 3 else data
        x, y, half = map(int, where.split(","))
        y0, x0 = max(y - half, 0), max(x - half, 0)
        data = data[y0 : y + half, x0 : x + half]
        vmin, vmax = float(low), float(high)
        extent = (x0 - 0.5, x0 + data.shape[1] - 0.5, y0 - 0.5, y0 + data.shape[0] - 0.5)
        if vmin >= 0:
            data = np.sqrt(np.clip((data - vmin) / (vmax - vmin), 0, 1))
            vmin, vmax, colours = 0, 1, "inferno"
        else:
            colours = "RdBu_r"
        axis.imshow(data, origin="lower", vmin=vmin, vmax=vmax, cmap=colours, extent=extent)
        axis.set_title(f"{title}\n{low} to {high}", fontsize=9, pad=4)
    figure.savefig(out, pil_kwargs={"optimize": True})
    print(f"wrote {out}")


COMMANDS = {
    "star-psf": star_psf,
    "centred-psf": centred_psf,
    "finer-psf": finer_psf,
    "airy-psf": airy_psf,
    "pixel-psf": pixel_psf,
    "offsets": offsets,
    "stars-psf": stars_psf,
    "figures": figures,
    "draw": draw,
}

if __name__ == "__main__":
    if len(sys.argv) < 2:
        print(__doc__)
    elif sys.argv[1] not in COMMANDS:
        sys.exit(f"real.py: no command {sys.argv[1]}; choose from {', '.join(COMMANDS)}")
    else:
        COMMANDS[sys.argv[1]](*sys.argv[2:])
