"""Look for companions of beta Pictoris and of a quasar, and say how faint they could be.

    python examples/real/detections.py [BETA_PICTORIS [QUASAR]]

The files of the folder naco-betapic are those of rolls.py, and fetch.py fetches them: 61 frames of
beta Pictoris (NaCo, L'; Absil et al. 2013), their parallactic angles and the PSF. Here no planet is
given, so that no place can be left out of what the star's PSF is made of. The background of each
frame is the mean of all frames and five principal components, in four rings. A planet is partly in
it, so that only a share of its light is left, its throughput.

First it is asked what the frames show. Then beta Pictoris b is taken out, with a flux found so.
Planets that are put into the raw frames, before the background is made, give the throughput.
Limits over throughput are contrasts, and those of VIP stand beside them. In the end planets of the
fluxes of these limits are put in, and those found are counted.

The threshold is 5. Contrasts are those of sources five standard deviations of their ring bright, as
measured without b. Rings near the star have few resolutions. Contrasts are therefore raised, as
VIP's are, to where Student's distribution has as few false alarms as a Gaussian beyond 5.

The folder hst-quasar-j0005 has one frame of a quasar of redshift 5.85 (HST, F125W) and the PSF of a
star near it; github.com/mmechtley/psfMC has both. It is reconstructed with defaults, and sources of
the fluxes of limits are put in by lnocl itself.
"""

import sys
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
from astropy.io import fits
from scipy import stats
from scipy.ndimage import map_coordinates, shift

import lnocl
from lnocl.psf.make import make_psf

SHARED = Path(__file__).parents[3] / "shared/data"

# As in rolls.py, where they are explained, but for rings and components of the background.
CENTRE, GAIN, GROUP, RINGS, COMPONENTS, FWHM = 51.0, 10.0, 2.0, (8, 16, 24, 34, 99), 5, 4.6
APERTURE, STAR = 1.227, 764939.6
PLANET, FLUX = (16.583, 44.721), 634.4  # flux by such a background, VIP's unit

EDGE = 46  # no planet is farther from the star, pixels
ALARMS = 0.0485  # false alarms that make the threshold 5
RADII = (10, 12, 14, 16.6, 20, 24, 28, 32, 36, 40)  # of contrasts, pixels
TURNS = 3  # angles at which planets give the throughput
ROUNDS = 7  # for each completeness, of planets put in together
TOGETHER = 6

# Contrasts by VIP 2.1.1 at RADII, of the same frames without beta Pictoris b, 99 x 99 pixels round
# the star. Its `contrast_curve` made them, which puts fake companions in by itself: of the PSF
# normalised to a FWHM of 4.6, with sigma=5, nbranch=3, imlib="vip-fft" and student=True. The names
# have the numbers of components; `pca_annular` had asize=8, radius_int=8 and delta_rot=0.
VIP = {
    "median_sub": (4.579e-3, 2.854e-3, 1.810e-3, 1.257e-3, 7.897e-4, 4.184e-4, 2.797e-4, 1.787e-4,
                   1.226e-4, 8.463e-5),
    "pca, 5": (6.604e-3, 3.507e-3, 1.756e-3, 8.211e-4, 4.243e-4, 2.585e-4, 1.718e-4, 1.202e-4,
               9.974e-5, 6.998e-5),
    "pca, 10": (3.356e-3, 2.003e-3, 8.877e-4, 5.290e-4, 2.601e-4, 1.694e-4, 1.424e-4, 1.165e-4,
                9.126e-5, 6.372e-5),
    "annular, 5": (4.624e-3, 2.315e-3, 1.200e-3, 7.412e-4, 4.461e-4, 2.192e-4, 1.640e-4, 1.599e-4,
                   1.487e-4, 8.324e-5),
}  # fmt: skip


class Rolls:
    """Frames whose field turns, and what lnocl finds in them.

    Parameters
    ----------
    folder : Path
        Of the files of beta Pictoris.
    """

    def __init__(self, folder):
        self.cube, angles, psf = (
            fits.getdata(folder / f"naco_betapic_{name}.fits").astype(float)
            for name in ("cube", "pa", "psf")
        )
        self.angles, self.unit = angles.ravel(), APERTURE / psf.sum()
        self.psf = psf / psf.sum()
        self.n = self.cube.shape[-1]
        rows, columns = np.indices((self.n, self.n))
        self.radius = np.hypot(rows - CENTRE, columns - CENTRE)
        self.mask = (self.radius < RINGS[0]) | (self.radius > EDGE + 1)
        group = ((self.angles - self.angles.min()) // GROUP).astype(int)
        self.groups = [np.flatnonzero(group == i) for i in np.unique(group)]
        angles = np.array([self.angles[i].mean() for i in self.groups])
        self.transforms = lnocl.rotations(-angles, (CENTRE, CENTRE))
        self.scatter = np.ones_like(self.radius)

    def grouped(self, frames):
        """Return the means of the frames of each group."""
        return np.array([frames[i].mean(axis=0) for i in self.groups])

    def planet(self, position):
        """Return images of a planet of flux 1 in VIP's unit, one for each frame."""
        side = self.psf.shape[0] + 2
        wide, half = np.pad(self.psf, 1), side // 2
        images = np.zeros((len(self.angles), self.n + 2 * side, self.n + 2 * side))
        places = lnocl.rotations(-self.angles, (CENTRE, CENTRE)) @ (*position, 1)
        for image, (x, y) in zip(images, places, strict=True):
            row, column = round(y), round(x)
            window = image[row + side - half :, column + side - half :]
            window[:side, :side] = shift(wide, (y - row, x - column))
        return images[:, side:-side, side:-side] / self.unit

    def halo(self, frames):
        """Return mean and principal components of frames, ring by ring."""
        model = np.repeat(frames.mean(axis=0)[None], len(frames), axis=0)
        for inner, outer in pairwise(RINGS):
            ring = (self.radius >= inner) & (self.radius < outer)
            varying = frames[:, ring] - model[:, ring]
            vectors = np.linalg.eigh(varying @ varying.T)[1][:, -COMPONENTS:]
            model[:, ring] += vectors @ (vectors.T @ varying)
        return model

    def by_radius(self, of_ring):
        """Return at each pixel what a function says of the pixels at its distance."""
        at = np.arange(RINGS[0], EDGE + 2)
        return np.interp(self.radius, at, [of_ring(abs(self.radius - r) < 2) for r in at])

    def significance(self, frames):
        """Return what lnocl finds in frames."""
        background = self.grouped(self.halo(frames))
        images = self.grouped(frames)
        left = images - background
        noise = self.by_radius(lambda ring: 1.4826 * np.median(abs(left[:, ring])))
        noise = GAIN * noise * self.scatter
        # The counts have noise of their own, which read noise need not have.
        read_noise = np.sqrt((noise**2 - GAIN * background.clip(0)).clip(1))
        with warnings.catch_warnings():
            # A pixel's noise is below the read noise given, as that is meant for a whole planet.
            warnings.filterwarnings("ignore", "the (noise|background) of image")
            warnings.filterwarnings("ignore", "overflow encountered")
            observation = lnocl.Observation(
                GAIN * images, self.psf, background=GAIN * background, read_noise=read_noise,
                mask=self.mask, transforms=self.transforms,
            )  # fmt: skip
            result = lnocl.deconvolve(observation, stop=None, n_iter=20)
            return result.significance(false_alarms=ALARMS)

    def learn_scatter(self, frames):
        """Have the signal-to-noise scatter as much at all distances from the star.

        The noise of neighbouring pixels is correlated, by more or less from ring to ring. lnocl
        measures that for the whole field.
        """
        self.scatter = np.ones_like(self.radius)
        ratio = self.significance(frames).signal_to_noise[: self.n, : self.n]
        self.scatter = self.by_radius(lambda ring: 1.4826 * np.nanmedian(abs(ratio[ring])))


def place(r, theta):
    """Return (x, y) in the sky of a radius and an angle from the x axis towards the y axis."""
    return CENTRE + r * np.cos(np.radians(theta)), CENTRE + r * np.sin(np.radians(theta))


def at(values, position):
    """Return the value of a map between its pixels."""
    x, y = position
    return float(map_coordinates(np.nan_to_num(values), [[y], [x]], order=1)[0])


def few_resolutions(r):
    """Return how much a ring of few resolutions raises a limit of 5 (Mawet et al. 2014)."""
    n = 2 * np.pi * r / FWHM
    return stats.t.isf(stats.norm.sf(5), n - 1) * np.sqrt(1 + 1 / n) / 5


def list_detections(found, middle, unit, name):
    """Print detections, their places round (x, y), and fluxes in a unit."""
    print(f"{name}: {len(found.detections)} above {found.threshold:.2f}")
    for row in found.detections:
        dx, dy = row["x"].value - middle, row["y"].value - middle
        flux, error = row["flux"].value * unit, row["flux_error"].value * unit
        print(
            f"  x {dx + middle:.1f} y {dy + middle:.1f}, r {np.hypot(dx, dy):.1f} theta "
            f"{np.degrees(np.arctan2(dy, dx)) % 360:.1f}, signal-to-noise "
            f"{row['significance']:.1f}, flux {flux:.0f} +- {error:.0f}, {row['kind']}"
        )


def look_at_rolls(folder):
    """Print detections, contrasts and how many planets are found, of the rolls."""
    rolls = Rolls(folder)
    unit = rolls.unit / GAIN
    rolls.learn_scatter(rolls.cube)
    found = rolls.significance(rolls.cube)
    list_detections(found, CENTRE, unit, "beta Pictoris")
    frames = rolls.cube - FLUX * rolls.planet(place(*PLANET))
    rolls.learn_scatter(frames)
    found = rolls.significance(frames)
    list_detections(found, CENTRE, unit, "without b")
    inside = rolls.radius < EDGE
    deviations = found.signal_to_noise[: rolls.n, : rolls.n][inside]
    print(f"  its signal-to-noise: {np.nanmean(deviations):.2f} +- {np.nanstd(deviations):.2f}")

    # Every other radius at a time, so that planets stay apart; about as bright as what is found.
    limits = found.limit()[: rolls.n, : rolls.n] * unit
    of_ratio = found.signal_to_noise[: rolls.n, : rolls.n]
    rings = [abs(rolls.radius - r) < FWHM / 2 for r in RADII]
    limit = np.array([np.nanmedian(limits[ring]) for ring in rings])
    spread = np.array([np.nanstd(of_ratio[ring]) for ring in rings])
    shares = np.zeros((TURNS, len(RADII)))
    for turn in range(TURNS):
        for first in (0, 1):
            put_in = [(i, place(RADII[i], 360 * turn / TURNS + 110 * i + 20)) for i in
                      range(first, len(RADII), 2)]  # fmt: skip
            fluxes = {i: 2 * limit[i] / guess(RADII[i]) for i, _ in put_in}
            other = rolls.significance(
                frames + sum(fluxes[i] * rolls.planet(where) for i, where in put_in)
            )
            for i, where in put_in:
                shares[turn, i] = at(other.flux - found.flux, where) * unit / fluxes[i]
    throughput = shares.mean(axis=0)
    print("contrasts, 5 sigma:")
    print(
        "   r  share found  scatter     lnocl  "
        + "  ".join(f"{name:>10}" for name in VIP)
        + "  student"
    )
    for i, r in enumerate(RADII):
        contrast = spread[i] * limit[i] / throughput[i] * few_resolutions(r) / STAR
        others = "  ".join(f"{curve[i]:10.2e}" for curve in VIP.values())
        print(
            f"{r:4}  {throughput[i]:.3f} +- {shares[:, i].std():.3f}  {spread[i]:.2f}  "
            f"{contrast:8.2e}  {others}"
            f"  {few_resolutions(r):7.2f}"
        )

    rng = np.random.default_rng(1)
    for completeness in (0.5, 0.9):
        limits = found.limit(completeness)[: rolls.n, : rolls.n] * unit
        rows = []
        for _ in range(ROUNDS):
            polar = apart(rng)
            fluxes = [
                at(limits, place(r, theta)) / np.interp(r, RADII, throughput) for r, theta in polar
            ]
            planets = (
                f * rolls.planet(place(*each)) for f, each in zip(fluxes, polar, strict=True)
            )
            seen = rolls.significance(frames + sum(planets)).detections
            seen = seen[seen["kind"] == "point"]
            for r, theta in polar:
                x, y = place(r, theta)
                away = np.hypot(seen["x"].value - x, seen["y"].value - y)
                rows.append((r, (away < 0.7 * found.resolution).any()))
        count(f"planets, completeness {completeness}", *np.array(rows).T, (8, 18, 30, EDGE))


def guess(r):
    """Return about what the throughput is, to choose how bright planets are put in."""
    return np.interp(r, (10, 40), (0.08, 0.45))


def apart(rng):
    """Return planets' radii and angles, more than four widths from each other."""
    chosen = []
    while len(chosen) < TOGETHER:
        r, theta = rng.uniform(RADII[0], RADII[-1]), rng.uniform(0, 360)
        x, y = place(r, theta)
        if all(np.hypot(x - a, y - b) > 4 * FWHM for a, b in (place(*each) for each in chosen)):
            chosen.append((r, theta))
    return chosen


def count(name, distance, is_found, edges):
    """Print which share of sources was found, by their distance."""
    parts = [f"{name}: {int(is_found.sum())} of {len(is_found)}"]
    for inner, outer in pairwise(edges):
        ring = (distance >= inner) & (distance < outer)
        parts.append(f"{inner} to {outer} pixels {int(is_found[ring].sum())} of {ring.sum()}")
    print(", ".join(parts))


def look_at_quasar(folder):
    """Print detections, limits and how many sources are found, of the quasar."""
    rates, weights = (
        fits.getdata(folder / f"{name}_J0005-0006.fits").astype(float) for name in ("sci", "ivm")
    )
    seconds = fits.getheader(folder / "sci_J0005-0006.fits")["EXPTIME"]
    psf = make_psf(fits.getdata(folder / "sci_psf.fits"), size=63, background=0.0,
                   clip_negative=True).psf  # fmt: skip
    observation = lnocl.Observation(
        rates * seconds, psf, background=0.0, read_noise=seconds / np.sqrt(weights)
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the PSFs do not fit the stars")
        result = lnocl.deconvolve(observation, [(64, 64)])
    print(f"quasar: {result.star_fluxes[0]:.3g} electrons")
    found = result.significance()
    list_detections(found, 64.0, 1.0, "round the quasar")
    curve = found.contrast_curves((0.5, 0.9))
    for row in curve[curve["distance"].value < 40]:
        print(
            f"  {row['distance'].value:4.1f} pixels: half of sources of {row['contrast50']:.2e} or "
            f"{row['magnitudes50'].value:.2f} mag, nine tenths of {row['contrast90']:.2e}"
        )
    for completeness in (0.5, 0.9):
        sources = found.inject(200, completeness)
        distance = np.hypot(sources["x"].value - 64, sources["y"].value - 64)
        name = f"sources, completeness {completeness}"
        count(name, distance, sources["found"], (0, 10, 20, 35, 50, 91))


naco, quasar = (
    Path(sys.argv[i]) if len(sys.argv) > i else SHARED / name
    for i, name in ((1, "naco-betapic"), (2, "hst-quasar-j0005"))
)
for folder, needed, look in (
    (naco, "naco_betapic_cube.fits", look_at_rolls),
    (quasar, "sci_J0005-0006.fits", look_at_quasar),
):
    if (folder / needed).is_file():
        look(folder)
    else:
        print(f"skipped: {needed} is missing from {folder}")
