"""Fit a planet, and planets that are put in, jointly to frames whose field rotates.

    python examples/real/rolls.py [FOLDER]

The files of the folder naco-betapic are 61 frames of beta Pictoris behind a vortex coronagraph
(NaCo, L'; Absil et al. 2013), their parallactic angles and the PSF beside the coronagraph; fetch.py
fetches them. The field turns by 81 degrees.

The star behind the mask has PSFs of its own, and the planet that beside the mask. Those of the star
are made of the frames: each is the mean and the principal components of the others in which the
field is turned so far that the planet is elsewhere, as they fit a ring without the planet's place.
What is found of the planet is taken out of the frames that they are made of, until both agree. So
the flux is that of the fit: nothing is corrected for what a planet loses to the star.

The noise of neighbouring pixels is correlated. Read noise is therefore that of a pixel, times the
scatter of fluxes at empty places of the same radius, found alike, over their formal error.
"""

import sys
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import shift

import lnocl

FOLDER = Path(__file__).parents[3] / "shared/data/naco-betapic"
CENTRE = 51.0  # x and y of the dark hole behind which the star is, the same in all frames to 0.06
GAIN = 10.0  # makes the noise of counts small beside that of speckles
GROUP = 2.0  # degrees; frames within are averaged
INNER, OUTER = 8, 47  # pixels; what is nearer or farther is masked
RING = 10  # of so many pixels on each side of the planet the star's PSF is fitted
COMPONENTS = 15
FWHM = 4.6
APART, NEAR = 0.7, 1.2  # FWHM that a planet has moved, and round its place that is left out
ROUNDS = 8

# VIP's unit of flux is the light within one FWHM. Its tutorials have 1.227 counts of the PSF there
# and 764939.6 of the star; they take beta Pictoris b out at this place (r, theta) with flux 700. A
# public script that uses VIP does so at r = 16.62, after Absil et al., with flux 648.2.
APERTURE, STAR = 1.227, 764939.6
PLANET = (16.583, 44.721)

# Planets put in, one at a time: radius (pixels), angle (degrees), flux (VIP's unit).
PUT_IN = ((12.5, 290, 1000), (16.6, 150, 700), (22, 240, 400), (28, 10, 250), (36, 100, 100))

folder = Path(sys.argv[1] if len(sys.argv) > 1 else FOLDER)
if not (folder / "naco_betapic_cube.fits").is_file():
    print(f"the data are missing from {folder}: fetch.py fetches the set naco-betapic")
    sys.exit()
cube, angles, psf = (
    fits.getdata(folder / f"naco_betapic_{name}.fits").astype(float)
    for name in ("cube", "pa", "psf")
)
angles, unit = angles.ravel(), APERTURE / psf.sum()
psf /= psf.sum()
n = cube.shape[-1]
rows, columns = np.indices((n, n))
radius = np.hypot(rows - CENTRE, columns - CENTRE)
group = ((angles - angles.min()) // GROUP).astype(int)
groups = [np.flatnonzero(group == i) for i in np.unique(group)]
grouped_angles = np.array([angles[i].mean() for i in groups])


def grouped(frames):
    """Return the means of the frames of each group."""
    return np.array([frames[i].mean(axis=0) for i in groups])


def place(r, theta):
    """Return (x, y) in the sky of a radius and an angle from the x axis towards the y axis."""
    return CENTRE + r * np.cos(np.radians(theta)), CENTRE + r * np.sin(np.radians(theta))


def planet(position, sign=-1):
    """Return images of a planet of flux 1, and its places: the sky turns as angles fall."""
    side = psf.shape[0] + 2
    wide, half = np.pad(psf, 1), side // 2
    images = np.zeros((len(angles), n + 2 * side, n + 2 * side))
    places = lnocl.rotations(sign * angles, (CENTRE, CENTRE)) @ (*position, 1)
    for image, (x, y) in zip(images, places, strict=True):
        row, column = round(y), round(x)
        window = image[row + side - half :, column + side - half :]
        window[:side, :side] = shift(wide, (y - row, x - column))
    return grouped(images[:, side:-side, side:-side]), grouped(places)


def ring_of(r):
    """Return the pixels in which a planet at a radius is fitted."""
    return (radius > max(INNER, r - RING)) & (radius < min(OUTER, r + RING))


def star_light(images, places, r):
    """Return the light of the star in the ring of each image, of the others."""
    ring = ring_of(r)
    pixels, light = images[:, ring], np.zeros_like(images)
    x, y = columns[ring], rows[ring]
    for j, place in enumerate(places):
        away = 2 * r * np.sin(np.radians(abs(grouped_angles - grouped_angles[j])) / 2)
        others = pixels[away > APART * FWHM]
        mean = others.mean(axis=0)
        vectors = np.linalg.eigh((others - mean) @ (others - mean).T)[1][:, -COMPONENTS:]
        parts = np.vstack([mean, vectors.T @ (others - mean)])
        is_far = np.hypot(x - place[0], y - place[1]) > NEAR * FWHM
        far = parts[:, is_far]
        light[j, ring] = np.linalg.solve(far @ far.T, far @ pixels[j, is_far]) @ parts
    return light


def least_squares(images, source, places, r, flux=0.0, rounds=ROUNDS):
    """Return the flux of a planet by least squares, and what the images have beside the star."""
    ring = ring_of(r)
    for _ in range(rounds):
        left = images - star_light(images - flux * source, places, r)
        flux = (source * left)[:, ring].sum() / (source[:, ring] ** 2).sum()
    return flux, left


def pixel_noise(left, ring):
    """Return the noise of a pixel by its radius, robust against what stands out."""
    at = np.arange(radius[ring].min(), radius[ring].max())
    rings = [left[:, ring & (abs(radius - r) < 2)] for r in at]
    return np.interp(radius, at, [1.4826 * np.median(abs(each)) for each in rings])


def scatter(images, r, theta, noise):
    """Return the scatter of fluxes at empty places on a circle over their formal error."""
    step, ring, in_errors = np.degrees(FWHM / r), ring_of(r), []
    for each in np.arange(theta + 2 * step, theta + 360 - 2 * step, step):
        source, places = planet(place(r, each))
        flux, _ = least_squares(images, source, places, r)
        error = np.sqrt((source**2 * noise**2)[:, ring].sum()) / (source[:, ring] ** 2).sum()
        in_errors.append(flux / error)
    return np.sqrt(np.mean(np.square(in_errors)))


def fit(images, r, theta, sign=-1):
    """Return the flux of a planet and its error, and that of the star, all in counts."""
    position, ring = place(r, theta), ring_of(r)
    source, places = planet(position, sign)
    flux, left = least_squares(images, source, places, r)
    noise = pixel_noise(left - flux * source, ring)
    noise = noise * scatter(images - flux * source, r, theta, noise)
    transforms = lnocl.rotations(sign * grouped_angles, (CENTRE, CENTRE))
    for _ in range(ROUNDS):
        light = star_light(images - flux * source, places, r)
        # The centre of the star's PSF is the pixel of the star; its flux is that beside the mask.
        star_psfs = np.pad(light, ((0, 0), (0, 2), (0, 2))) / (STAR / unit)
        # The counts have noise of their own, which read noise need not have.
        read_noise = np.sqrt(((GAIN * noise) ** 2 - GAIN * images.clip(0)).clip(1))
        with warnings.catch_warnings():
            # A pixel's noise is below the read noise given, as that is meant for a whole planet.
            warnings.filterwarnings("ignore", "the (noise|background|residuals)")
            observation = lnocl.Observation(
                GAIN * images, psf, read_noise=read_noise, mask=~ring, transforms=transforms,
                star_psfs=star_psfs, star_places=(CENTRE, CENTRE),
            )  # fmt: skip
            result = lnocl.deconvolve(
                observation, [(CENTRE, CENTRE), position], stop=None, n_iter=20
            )
        found, flux = flux, result.star_fluxes[1] / GAIN
        if abs(flux - found) < 0.01 * result.star_flux_errors[1] / GAIN:
            break
    return flux, result.star_flux_errors[1] / GAIN, result.star_fluxes[0] / GAIN


images = grouped(cube)
flux, error, star = fit(images, *PLANET)
print(
    f"beta Pictoris b: flux {flux * unit:.0f} +- {error * unit:.0f} (elsewhere: 648 and 700), "
    f"{-2.5 * np.log10(flux / star):.2f} mag; star {star * unit:.0f}",
    flush=True,
)
wrong, error, _ = fit(images, *PLANET, sign=1)
print(f"the same, turned the wrong way: {wrong * unit:.0f} +- {error * unit:.0f}")
images -= flux * planet(place(*PLANET))[0]
for r, theta, truth in PUT_IN:
    put_in = images + truth / unit * planet(place(r, theta))[0]
    flux, error, _ = (x * unit for x in fit(put_in, r, theta))
    print(
        f"r {r} theta {theta}: flux {flux:.0f} +- {error:.0f} of {truth}, ratio "
        f"{flux / truth:.2f}, {(flux - truth) / error:+.1f} errors",
        flush=True,
    )
