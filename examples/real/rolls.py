"""Fit a planet, and planets that are put in, jointly to frames whose field rotates.

    python examples/real/rolls.py [FOLDER]

The files of the folder naco-betapic are 61 frames of beta Pictoris behind a vortex coronagraph
(NaCo, L'; Absil et al. 2013), their parallactic angles and the PSF beside the coronagraph; fetch.py
fetches them. The field turns by 81 degrees.

The halo of the star hardly turns, and its speckles vary. So the background of each frame is the
mean of all frames and five principal components, in four rings. A planet is in these too. Its first
flux is far too low, and it is then taken out of the frames that the background is made of: flux
found and flux taken out agree in the end, by the secant method. What the first fit finds of a
planet, its throughput, also divides its error.

The noise of neighbouring pixels is correlated. Read noise is therefore that of a pixel, times the
scatter of fluxes at empty places of the same radius over their formal error.
"""

import sys
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy.ndimage import shift

import lnocl

FOLDER = Path(__file__).parents[3] / "shared/data/naco-betapic"
CENTRE = 51.0  # x and y of the dark hole behind which the star is, the same in all frames to 0.06
GAIN = 10.0  # makes the noise of counts small beside that of speckles
GROUP = 2.0  # degrees; frames within are averaged
RINGS = (8, 16, 24, 34, 99)
COMPONENTS = 5
FWHM = 4.6
ROUNDS = 4

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
mask = (radius < RINGS[0]) | (radius > 47)
group = ((angles - angles.min()) // GROUP).astype(int)
groups = [np.flatnonzero(group == i) for i in np.unique(group)]
grouped_angles = np.array([angles[i].mean() for i in groups])


def grouped(frames):
    """Return the means of the frames of each group."""
    return np.array([frames[i].mean(axis=0) for i in groups])


def place(r, theta):
    """Return (x, y) in the sky of a radius and an angle from the x axis towards the y axis."""
    return CENTRE + r * np.cos(np.radians(theta)), CENTRE + r * np.sin(np.radians(theta))


def planet(position, of_angles):
    """Return images of a planet of flux 1: the sky is turned by minus the parallactic angle."""
    side = psf.shape[0] + 2
    wide, half = np.pad(psf, 1), side // 2
    images = np.zeros((len(of_angles), n + 2 * side, n + 2 * side))
    places = lnocl.rotations(-of_angles, (CENTRE, CENTRE)) @ (*position, 1)
    for image, (x, y) in zip(images, places, strict=True):
        row, column = round(y), round(x)
        window = image[row + side - half :, column + side - half :]
        window[:side, :side] = shift(wide, (y - row, x - column))
    return images[:, side:-side, side:-side]


def halo(frames):
    """Return mean and principal components of frames, ring by ring."""
    model = np.repeat(frames.mean(axis=0)[None], len(frames), axis=0)
    for inner, outer in pairwise(RINGS):
        ring = (radius >= inner) & (radius < outer)
        varying = frames[:, ring] - model[:, ring]
        vectors = np.linalg.eigh(varying @ varying.T)[1][:, -COMPONENTS:]
        model[:, ring] += vectors @ (vectors.T @ varying)
    return model


def pixel_noise(left):
    """Return the noise of a pixel by its radius, robust against what stands out."""
    at = np.arange(RINGS[0], 48)
    rings = [left[:, abs(radius - r) < 2] for r in at]
    return np.interp(radius, at, [1.4826 * np.median(abs(each)) for each in rings])


def empty_places(r, theta):
    """Return images of planets on a circle, a FWHM apart, two FWHM from one place."""
    step = np.degrees(FWHM / r)
    others = np.arange(theta + 2 * step, theta + 360 - 2 * step, step)
    return [planet(place(r, each), grouped_angles) for each in others]


def fit(frames, r, theta, sign=-1):
    """Return flux, error, throughput and the flux of the first fit of a planet at a place."""
    position, empty = place(r, theta), empty_places(r, theta)
    images, own = grouped(frames), planet(position, angles)
    transforms = lnocl.rotations(sign * grouped_angles, (CENTRE, CENTRE))
    flux = first = 0.0
    throughput = 0.3
    for i in range(ROUNDS):
        without = frames - flux * own
        background = grouped(halo(without))
        left = grouped(without) - background
        noise = pixel_noise(left)
        weight = np.where(mask, 0.0, noise**-2)
        in_errors = [(p * left * weight).sum() / np.sqrt((p**2 * weight).sum()) for p in empty]
        noise = noise * np.sqrt(np.mean(np.square(in_errors)))
        # The counts have noise of their own, which read noise need not have.
        background = GAIN * background.clip(0)
        read_noise = np.sqrt(((GAIN * noise) ** 2 - background).clip(1))
        with warnings.catch_warnings():
            # A pixel's noise is below the read noise given, as that is meant for a whole planet.
            warnings.filterwarnings("ignore", "the (noise|background) of image")
            observation = lnocl.Observation(
                GAIN * images, psf, background=background, read_noise=read_noise, mask=mask,
                transforms=transforms,
            )  # fmt: skip
            result = lnocl.deconvolve(observation, [position], stop=None, n_iter=20)
        found = result.star_fluxes[0] / GAIN
        if i == 0:
            first = found
        elif flux > 0:
            throughput = np.clip(1 - (found - first) / flux, 0.03, 1.0)
        flux = max(flux + (found - flux) / throughput, 0.0)
    return flux, result.star_flux_errors[0] / GAIN / throughput, throughput, first


flux, error, throughput, first = fit(cube, *PLANET)
print(
    f"beta Pictoris b: flux {flux * unit:.0f} +- {error * unit:.0f} (elsewhere: 648 and 700), "
    f"{-2.5 * np.log10(flux * unit / STAR):.2f} mag; first fit {first * unit:.0f}, "
    f"throughput {throughput:.2f}"
)
wrong = fit(cube, *PLANET, sign=1)[3]
print(f"the same, turned the wrong way: first fit {wrong * unit:.0f}")
cube -= flux * planet(place(*PLANET), angles)
for r, theta, truth in PUT_IN:
    frames = cube + truth / unit * planet(place(r, theta), angles)
    flux, error, throughput, first = (x * unit for x in fit(frames, r, theta))
    print(
        f"r {r} theta {theta}: flux {flux:.0f} +- {error:.0f} of {truth}, ratio "
        f"{flux / truth:.2f}, {(flux - truth) / error:+.1f} errors; first fit "
        f"{first / truth:.2f}, throughput {throughput / unit:.2f}"
    )
