"""Planets beside a star behind the mask of a coronagraph, each with its own PSF.

    python benchmarks/star_psfs.py [--seeds 100 119] [--kind plain]

Two images of different depth and resolution, of a star of 3e7 electrons, three planets 9 to 28
pixels from it, and a disc. Pupils have smooth aberrations that are others for each seed and image.
The PSF behind the mask lacks 97 % of the mean field of the pupil, that beside it lacks nothing.
Planets have the PSF beside the mask. Kinds: "plain"; "turned", in which the second image is turned
by 35 degrees about the star; "epochs"; "one PSF", in which the star has the PSF beside the mask
too; "known", in which the light of the star is given as background, exactly.
"""

import argparse
import warnings

import numpy as np

import lnocl

N, WIDE = 128, 256
STAR, STAR_FLUX = np.array([63.2, 64.4]), 3e7
DISTANCES, FLUXES = (9.3, 16.4, 28.4), np.array([6000.0, 2500.0, 1200.0])
DEPTHS, WIDTHS, SKY, DISC = np.array([1.0, 0.6]), (2.8, 2.4), 20.0, 8000.0
ANGLE = 35.0
WAVES = [(1, 0), (0, 1), (1, 1), (2, 0), (0, 2), (1, -1), (3, 1), (1, 3), (2, 2), (4, -1), (3, -3)]


def make_psfs(rng, width):
    """Return the PSFs beside and behind the mask, as shares of the light beside it."""
    u = np.fft.fftfreq(WIDE)
    v, u = np.meshgrid(u, u, indexing="ij")
    radius = np.hypot(v, u)
    pupil = (radius <= 0.5 / width) & (radius > 0.1 / width)
    phase = sum(
        rng.normal() * np.cos(2 * np.pi * width * (a * u + b * v) + rng.uniform(0, 2 * np.pi))
        for a, b in WAVES
    )
    field = pupil * np.exp(0.25j * phase)
    behind = field - 0.97 * pupil * field.sum() / pupil.sum()
    beside, behind = (np.fft.fftshift(abs(np.fft.ifft2(each)) ** 2) for each in (field, behind))
    return beside / beside.sum(), behind / beside.sum()


def placed(psf, place):
    """Return a PSF at a place of an image, by the phase of its spectrum."""
    k = np.fft.fftfreq(WIDE)
    x, y = np.asarray(place) - WIDE // 2
    phase = np.exp(-2j * np.pi * np.add.outer(k * y, k * x))
    return np.fft.ifft2(np.fft.fft2(psf) * phase).real[:N, :N]


def disc(psf, angle):
    """Return the blurred disc of an image that is turned about the star."""
    y, x = np.indices((N, N)) - STAR[::-1, None, None]
    c, s = np.cos(0.64 + np.radians(angle)), np.sin(0.64 + np.radians(angle))
    light = np.exp(-(((x * c + y * s) / 15) ** 2 + ((y * c - x * s) / 6) ** 2) / 2)
    spectrum = np.fft.fft2(DISC * light / light.sum(), (WIDE, WIDE))
    return np.fft.ifft2(spectrum * np.fft.fft2(np.fft.ifftshift(psf))).real[:N, :N]


def cut(psf, side):
    """Return the middle of a PSF."""
    first = WIDE // 2 - side // 2
    return psf[first : first + side, first : first + side]


def observe(seed, kind):
    """Return an observation, the places of star and planets, and their fluxes."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(0, 2 * np.pi, len(DISTANCES))
    planets = STAR + np.multiply(DISTANCES, [np.cos(turns), np.sin(turns)]).T
    psfs = [make_psfs(rng, width) for width in WIDTHS]
    angles = [0.0, ANGLE if kind == "turned" else 0.0]
    maps = lnocl.rotations(angles, STAR)
    images, light = [], []
    for (beside, behind), depth, angle, to_image in zip(psfs, DEPTHS, angles, maps, strict=True):
        image = disc(beside, angle)
        for place, flux in zip(planets, FLUXES, strict=True):
            image = image + flux * placed(beside, to_image @ (*place, 1))
        light.append(STAR_FLUX * depth * placed(behind, STAR))
        images.append(depth * image + light[-1] + SKY)
    given = {"exposure": DEPTHS, "background": SKY, "psf_centre": "given"}
    if kind == "turned":
        given["transforms"] = maps
    if kind == "epochs":
        given["epochs"] = [0, 1]
    if kind == "known":
        given["background"] = SKY + np.array(light)
    elif kind != "one PSF":
        own = np.array([cut(behind, 201) for _, behind in psfs])
        given |= {"star_psfs": own, "star_places": STAR}
    psfs = np.array([cut(beside, 129) for beside, _ in psfs])
    stars, fluxes = [*planets], FLUXES
    if kind != "known":
        stars, fluxes = [STAR, *planets], np.append(STAR_FLUX, FLUXES)
    return lnocl.Observation(rng.poisson(images), psfs, **given), stars, fluxes


def main():
    """Print how far stars and planets are off, in the mean over seeds."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", nargs=2, type=int, default=(100, 119))
    parser.add_argument("--kind", default="plain")
    arguments = parser.parse_args()
    first, last = arguments.seeds
    pulls, shares = [], []
    for seed in range(first, last + 1):
        observation, stars, fluxes = observe(seed, arguments.kind)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", lnocl.LnoclWarning)
            result = lnocl.deconvolve(observation, stars)
        found = result.star_fluxes.reshape(len(stars), -1)
        errors = result.star_flux_errors.reshape(found.shape)
        pulls.append((found - fluxes[:, None]) / errors)
        shares.append(found / fluxes[:, None] - 1)
    pulls, shares = np.array(pulls), np.array(shares)
    names = ["star", *map(str, DISTANCES)][-pulls.shape[1] :]
    for name, of_pulls, share in zip(
        names, pulls.swapaxes(0, 1), shares.swapaxes(0, 1), strict=True
    ):
        print(
            f"{arguments.kind}, {name}: mean {100 * share.mean():+.3f} %, rms "
            f"{100 * np.sqrt((share**2).mean()):.3f} %; in errors mean {of_pulls.mean():+.2f}, rms "
            f"{np.sqrt((of_pulls**2).mean()):.2f}, most {abs(of_pulls).max():.1f}"
        )


if __name__ == "__main__":
    main()
