"""What `lnocl.deconvolve` says of PSFs and noise that are wrong, and of scenes that are right.

    python benchmarks/wrong.py PART [--device SPEC] [--output STEM]

Parts, each a table, written to STEM-PART.ecsv with --output; all settings are the defaults:

psfs   a star on a ring and a knot, seen through a Moffat PSF or a core with a halo, with 14 PSFs
       that are wrong, and the right one: what is said, and the error of the extended source
right  50 scenes with right PSFs: 35 of the paper's experiment (seeds 700 to 734), 15 of the above,
       the star 0.2 to 100 times as bright: what is said
noise  wrong gains, a sky that was subtracted, read noise left out, neighbours averaged
images a picture of five of the wrong PSFs, STEM.png: 1000 iterations of the split-gradient method
       with the PSF as given, the defaults, and the defaults with the PSF centred
"""

import argparse
import warnings

import numpy as np
import parts
from sgp import random_scene

import lnocl
from lnocl.errors import DivergedError

SIZE = 128
LEVEL = 30.0
WIDTHS = {"moffat": 5.0, "halo": 4.0}
CONTRASTS = (100.0, 30.0, 10.0, 3.0, 1.0, 0.5, 0.3, 0.2)
STAR = (SIZE // 2, SIZE // 2)
Y, X = np.indices((SIZE, SIZE)) - SIZE // 2
R = np.hypot(X, Y)


def moffat(width, beta=3.0, x=0.0):
    """Return a Moffat profile of unit sum."""
    a = width / (2.0 * np.sqrt(2.0 ** (1.0 / beta) - 1.0))
    psf = (1.0 + ((X - x) ** 2 + Y**2) / a**2) ** -beta
    return psf / psf.sum()


def make_psf(kind, width, x=0.0):
    """Return a Moffat PSF, or a Gaussian core with a third of the light in a halo."""
    if kind == "moffat":
        return moffat(width, x=x)
    core = np.exp(-4.0 * np.log(2.0) * ((X - x) ** 2 + Y**2) / width**2)
    return 0.65 * core / core.sum() + 0.35 * moffat(8.0 * width, 2.0, x)


def make_scene(kind, contrast, seed=0):
    """Return image, extended source, flux of the star, and PSF."""
    psf = make_psf(kind, WIDTHS[kind])
    ring = 120.0 * np.exp(-(((R - 22.0) / 4.0) ** 2)) * (1.0 + 0.8 * X / (R + 1.0))
    extended = ring + 75.0 * np.exp(-((X - 10) ** 2 + (Y - 25) ** 2) / 30.0)
    sky, flux = extended.copy(), contrast * extended.sum()
    sky[STAR[::-1]] += flux
    blurred = np.fft.irfft2(np.fft.rfft2(sky) * np.fft.rfft2(np.fft.ifftshift(psf)), s=sky.shape)
    image = np.random.default_rng(seed).poisson(np.maximum(blurred, 0.0) + LEVEL)
    return image.astype(float), extended, flux, psf


def wrong_psfs(kind):
    """Yield names and PSFs: the right one, and fourteen that are not."""
    width = WIDTHS[kind]
    right = make_psf(kind, width)
    yield "right", right
    for off in (0.3, 1, 5):
        yield f"{off} pixels off", make_psf(kind, width, off)
    yield "FFT order", np.fft.ifftshift(right)
    yield "peak at N / 2 - 1", np.roll(right, (-1, -1), (0, 1))
    for finer in (2, 5):
        yield f"{finer} times too fine", make_psf(kind, finer * width)
    yield "20 % too wide", make_psf(kind, 1.2 * width)
    yield "20 % too narrow", make_psf(kind, width / 1.2)
    yield "background of 1e-3", right / right.max() + 1e-3
    noise = np.random.default_rng(1).standard_normal(right.shape)
    yield "noise of 1 %", right / right.max() + 0.01 * noise
    yield "cut at 3 FWHM", np.where((abs(X) <= 1.5 * width) & (abs(Y) <= 1.5 * width), right, 0.0)
    yield "another band", make_psf(kind, 1.35 * width)
    yield "wings missing", np.exp(-4.0 * np.log(2.0) * R**2 / width**2)


def try_it(image, psf, stars, device=None, **known):
    """Return the result, or None where it is refused, and what was said, in a word each."""
    words = {
        "pixels off its centre": "centre", "does not fit": "width", "pixels from there": "place",
        "negative and were kept": "negative", "too near the end": "length",
        "negative and were set to 0": "negative image", "may exchange light": "exchange",
        "light lies all round": "halo", "no light is left": "dark", "far less than noise": "noise",
        "not that of its counts": "noise",
        "the PSFs do not fit the stars": "error left",
        "the PSFs given do not fit the stars": "error fitted",
    }  # fmt: skip
    result, messages = None, []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            observation = lnocl.Observation(image, psf, **known)
            result = lnocl.deconvolve(observation, stars, pad=0, device=device)
        except lnocl.InputError as error:
            messages.append(f"refused: {error}")
        messages += [str(each.message) for each in caught]
    said = [word for key, word in words.items() if any(key in message for message in messages)]
    said += [f"? {m}" for m in messages if not any(key in m for key in words)]
    if result is None:
        return None, ["refused", *said]
    said += ["mended"] * (result.psf_refinement is not None)
    at_stars = result.star_residuals()
    said += ["residuals"] * any(each.is_misfit for each in at_stars)
    said += ["halo"] * any(each.has_halo for each in at_stars)
    return result, said


def psfs(device):
    """Yield rows of the part "psfs"."""
    for kind in WIDTHS:
        for contrast in (10.0, 0.3):
            image, extended, flux, _ = make_scene(kind, contrast)
            for name, psf in wrong_psfs(kind):
                result, said = try_it(image, psf, [STAR], device, background=LEVEL)
                row = {"scene": kind, "contrast": contrast, "psf": name, "said": ", ".join(said)}
                row |= {"error": np.nan, "flux": np.nan}
                if result is not None:
                    error = np.linalg.norm(result.extended - extended) / np.linalg.norm(extended)
                    row |= {"error": float(error), "flux": float(result.star_fluxes[0] / flux)}
                yield row


def right(device):
    """Yield rows of the part "right"."""
    for seed in range(700, 735):
        simulation, p, *_, contrast = random_scene(seed, None)  # its target is built in
        known = {"background": simulation.background, "read_noise": simulation.read_noise}
        stars = simulation.stars
        _, said = try_it(simulation.images, simulation.psfs, stars, device, **known)
        yield {"scene": f"hh34, {p} images", "contrast": contrast, "said": ", ".join(said)}
    for k, contrast in enumerate(CONTRASTS):
        for kind in WIDTHS if contrast < 100 else ["moffat"]:
            image, *_, psf = make_scene(kind, contrast, 100 + k)
            _, said = try_it(image, psf, [STAR], device, background=LEVEL)
            yield {"scene": kind, "contrast": contrast, "said": ", ".join(said)}


def noise(device):
    """Yield rows of the part "noise"."""
    image, *_, psf = make_scene("moffat", 10.0)
    averaged = sum(np.roll(image, by, (0, 1)) for by in ((0, 0), (0, 1), (1, 0), (1, 1))) / 4.0
    read = np.random.default_rng(2).normal(0.0, 12.0, image.shape)
    for name, images, level in (
        ("right", image, LEVEL),
        ("gain of 2 left out", image / 2.0, LEVEL / 2.0),
        ("gain of 1 / 2 left out", 2.0 * image, 2.0 * LEVEL),
        ("gain of 1000 left out", image / 1000.0, LEVEL / 1000.0),
        ("sky subtracted", image - LEVEL, 0.0),
        ("read noise of 12 left out", image + read, LEVEL),
        ("neighbours averaged", averaged, LEVEL),
    ):
        _, said = try_it(images, psf, [STAR], device, background=level)
        yield {"noise": name, "said": ", ".join(said)}


def draw_images(device, path):
    """Draw what five wrong PSFs lead to, by the paper's iteration and by the defaults."""
    import matplotlib.pyplot as plt

    image, extended, flux, _ = make_scene("moffat", 10.0)
    wrong = dict(wrong_psfs("moffat"))
    names = "1 pixels off", "FFT order", "5 times too fine", "20 % too narrow", "noise of 1 %"
    ways = {
        "paper": (parts.paper, "given", {"n_iter": 1000}),
        "default": (lnocl.deconvolve, "check", {"pad": 0}),
        "centred": (lnocl.deconvolve, "fit", {"pad": 0}),
    }
    figure, axes = plt.subplots(3, 6, figsize=(15, 9.5), layout="constrained")
    shown = {"vmin": 0.0, "vmax": extended.max(), "origin": "lower"}
    for row, (way, (deconvolve, centre, settings)) in zip(axes, ways.items(), strict=True):
        row[0].imshow(extended, **shown)
        row[0].set_title("truth", fontsize=12)
        for axis, name in zip(row[1:], names, strict=True):
            try:
                known = {"background": LEVEL, "psf_centre": centre}
                observation = lnocl.Observation(image, wrong[name], **known)
                result = deconvolve(observation, [STAR], device=device, **settings)
            except (lnocl.InputError, DivergedError) as error:
                end = "refused" if isinstance(error, lnocl.InputError) else "diverges"
                axis.set_title(f"{name}, {way}:\n{end}", fontsize=12)
                continue
            (found,) = result.star_residuals()
            axis.imshow(result.extended, **shown)
            axis.set_title(
                f"{name}, {way}\nflux {result.star_fluxes[0] / flux:.2f}, core rms "
                f"{found.core.rms:.1f}\nhalo {round(found.halo, 2):.4g}",
                fontsize=12,
            )
    for axis in axes.flat:
        axis.set_axis_off()
    figure.savefig(path, dpi=60)


PARTS = {part.__name__: part for part in (psfs, right, noise)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=[*PARTS, "images"])
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    warnings.simplefilter("ignore", lnocl.LnoclWarning)
    if given.part == "images":
        draw_images(given.device, f"{given.output}.png")
    else:
        parts.report(PARTS[given.part](given.device), given.part, given.device, given.output)
