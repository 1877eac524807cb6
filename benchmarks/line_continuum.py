"""A jet in a line against star and reflection nebula: one fit, and two ways that are usual.

    python benchmarks/line_continuum.py [--contrasts C ...] [--images N ...] [--wrong SHARE ...]
        [--seeds FIRST LAST] [--replicas N]

The jet of `lnocl.simulation.hh34` is line emission of 3e6 electrons, a lopsided nebula as bright is
continuum, and so is the star, which is brighter by the contrast. Half of the images are on the line
and half beside it, each through a Fizeau PSF of its own angle, phases and Strehl ratio. PSFs are
right, with `psf_error` 0, or stretched by a share, with the default. All else is by default.

- one: line and continuum in one fit (`components` of `lnocl.Observation`);
- after: on and off are deconvolved each, and the skies subtracted;
- before: off is subtracted from on, as bright as the star is, and the difference deconvolved;
- known: images on the line are deconvolved with the exact PSFs, and with the true continuum and the
  true star as their background. No method can know more.

The error is that of the line's sky within 24 rows of the star, over the line there
(`lnocl.metrics.restoration_error`). With replicas the light of three knots is told with its error:
the last columns are the share of knots within that error, and rms of the errors over those told.
"""

import argparse
import time
import warnings

import numpy as np
from astropy import units as u
from regions import CirclePixelRegion, PixCoord
from scipy.ndimage import map_coordinates
from scipy.signal import fftconvolve

import lnocl
from lnocl.metrics import restoration_error, star_rows
from lnocl.simulation import fizeau_psf, hh34

SIZE, LIGHT, SKY, NOISE = 128, 3e6, 50.0, 3.0
COMPONENTS = "line", "continuum"
# Distance from the star along the jet, and radius, of regions with one knot or two. One baseline
# resolves 10 pixels along the jet.
KNOTS = ((9.8, 6.0), (24.4, 6.0), (35.4, 6.0))


def nebula(star):
    """Return a lopsided nebula on one side of the star, brighter towards it."""
    y, x = np.indices((SIZE, SIZE)) - np.reshape(star[::-1], (2, 1, 1))
    r, angle = np.hypot(x, y) + 4.0, np.arctan2(y, x + 3.0)
    values = (r / 12.0) ** -1.5 * np.exp(-r / 40.0) * (1.2 + np.cos(angle - 2.2)) ** 2
    return LIGHT * values / values.sum()


def stretched(psf, share):
    """Return a PSF that is wider by a share."""
    if not share:
        return psf
    middle = np.reshape(np.array(psf.shape) // 2, (2, 1, 1))
    at = middle + (np.indices(psf.shape) - middle) / (1.0 + share)
    wide = map_coordinates(psf, at, order=3, mode="nearest").clip(0.0)
    return wide / wide.sum()


def see(sky, psf, star, flux):
    """Return the image of a sky and a star; what falls beyond its edges is lost."""
    whole = sky.copy()
    whole[star[1], star[0]] += flux
    light = fftconvolve(whole, psf)
    first = np.array(psf.shape) // 2
    return light[first[0] :, first[1] :][: sky.shape[0], : sky.shape[1]].clip(0.0)


def scene(contrast, n_images, wrong, seed):
    """Return images, PSFs and those given, which are on the line, the star, and the line."""
    target = hh34(SIZE)
    star = target.stars[0].x, target.stars[0].y
    line, continuum = LIGHT * target.extended, nebula(star)
    *seeds, of_noise = np.random.SeedSequence([seed, 59]).spawn(n_images + 1)
    rng = np.random.default_rng(of_noise)
    images, psfs, is_on = [], [], []
    for j in range(n_images):
        on = j % 2 == 0
        angle = 180.0 * j / n_images
        strehl = 0.7 if on else 0.6
        psf = fizeau_psf((SIZE, SIZE), angle * u.deg, 2.12 * u.um, 5 * u.mas, strehl, seeds[j])
        seen = see(on * line + continuum, psf, star, contrast * LIGHT)
        images.append(rng.poisson(seen + SKY) + rng.normal(0.0, NOISE, seen.shape))
        psfs.append(psf)
        is_on.append(on)
    given = np.array([stretched(psf, wrong) for psf in psfs])
    return np.array(images), np.array(psfs), given, np.array(is_on), star, line


def observe(images, psfs, wrong, **known):
    """Return the observation of images through PSFs that are exact, or not."""
    error = {} if wrong else {"psf_error": 0}
    given = {"background": SKY, "read_noise": NOISE, **error, **known}
    return lnocl.Observation(images, psfs, **given)


def one(images, psfs, on, star, wrong):
    """Return the result of line and continuum in one fit."""
    weights = {"line": on.astype(float), "continuum": np.ones(len(on))}
    observation = observe(images, psfs, wrong, components=weights)
    return lnocl.deconvolve(observation, [star])


def after(images, psfs, on, star, wrong):
    """Return the line of skies that are subtracted."""
    skies = [
        lnocl.deconvolve(observe(images[of], psfs[of], wrong), [star]).extended for of in (on, ~on)
    ]
    return skies[0] - skies[1]


def before(images, psfs, on, star, wrong):
    """Return the line of images that are subtracted."""
    # Off images are as deep, so that the star leaves by a factor of 1. What is added makes the
    # variance of the difference that of counts.
    pairs = zip(images[on], images[~on], strict=True)
    more = [2.0 * np.mean(off) for _, off in pairs]
    differences = [a - b + m for a, b, m in zip(images[on], images[~on], more, strict=True)]
    noise = np.sqrt(2.0) * NOISE
    observation = observe(
        np.array(differences), psfs[on], wrong, background=np.array(more), read_noise=noise
    )
    return lnocl.deconvolve(observation, [star]).extended


def known(images, psfs, on, star, flux):
    """Return the line where all else is known."""
    backgrounds = np.array([SKY + see(nebula(star), psf, star, flux) for psf in psfs[on]])
    observation = observe(images[on], psfs[on], 0, background=backgrounds)
    return lnocl.deconvolve(observation, []).extended


def knots(star):
    """Return the regions of the knots."""
    return [CirclePixelRegion(PixCoord(star[0], star[1] + d), r) for d, r in KNOTS]


def pulls(result, star, line, n):
    """Return the errors of the light of the knots over those told."""
    found = result.bootstrap(n, regions=knots(star)).to_table()
    rows = [row for row in found if row["name"].startswith("line region")]
    told = np.array([(row["value"] - row["bias"], row["error"]) for row in rows], float)
    truth = [
        float((each.to_mask("exact").to_image(line.shape) * line).sum()) for each in knots(star)
    ]
    return (told[:, 0] - truth) / told[:, 1]


def main():
    """Print a line for each contrast, number of images and error of the PSFs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--contrasts", type=float, nargs="+", default=[1, 10, 100, 1000])
    parser.add_argument("--images", type=int, nargs="+", default=[2, 4])
    parser.add_argument("--wrong", type=float, nargs="+", default=[0.0, 0.02])
    parser.add_argument("--seeds", type=int, nargs=2, default=[0, 10])
    parser.add_argument("--replicas", type=int, default=0)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    print("contrast images wrong   one  after before  known", end="")
    print("  of after  of before  seconds   within  rms")
    for contrast in args.contrasts:
        for n in args.images:
            for wrong in args.wrong:
                errors, seconds, all_pulls = [], [], []
                for seed in range(*args.seeds):
                    images, true, psfs, on, star, line = scene(contrast, n, wrong, seed)
                    begin = time.perf_counter()
                    result = one(images, psfs, on, star, wrong)
                    seconds.append(time.perf_counter() - begin)
                    skies = [
                        result.component("line"),
                        after(images, psfs, on, star, wrong),
                        before(images, psfs, on, star, wrong),
                        known(images, true, on, star, contrast * LIGHT),
                    ]
                    rows = star_rows(star, line.shape)
                    errors.append([restoration_error(sky, line, rows=rows) for sky in skies])
                    if args.replicas:
                        all_pulls.append(pulls(result, star, line, args.replicas))
                found = np.array(errors)
                of = np.median(found[:, :1] / found[:, 1:3], axis=0)
                texts = [f"{contrast:8g} {n:6} {wrong:5g}"]
                texts += [f"{each:6.3f}" for each in np.median(found, axis=0)]
                texts += [f"{of[0]:9.2f} {of[1]:10.2f} {np.median(seconds):8.1f}"]
                if all_pulls:
                    each = np.array(all_pulls)
                    texts.append(f"{(abs(each) < 1).mean():8.2f} {np.sqrt((each**2).mean()):5.2f}")
                print(*texts, flush=True)


if __name__ == "__main__":
    main()
