"""Set the simulated Fizeau PSF beside a real one and compare their fringe spacing.

The real one is a frame of Altair taken at 4.05 um with LMIRcam of the Large Binocular Telescope
Interferometer. Its core is clipped and the two beams are not quite in phase, so its bright fringe
is off the centre; the spacing of the fringes does not depend on either.

    python examples/real/psf_lbti.py [lm_180507_009030.fits] [-o psf_lbti.png]
"""

import argparse
import math
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.io import fits
from scipy.ndimage import gaussian_filter
from scipy.optimize import minimize

from lnocl.simulation import fizeau_psf
from lnocl.simulation.telescope import BASELINE

FRAME = Path(__file__).parents[3] / "shared/data/lbti-fizeau-altair/lm_180507_009030.fits"
WAVELENGTH = 4.05 * u.um  # Br alpha
PIXEL_SCALE = 10.7 * u.mas  # LMIRcam
STREHL = 0.8  # a plausible one: the frame is clipped, so its own cannot be measured
STAR = 205, 202  # x, y of the star in the frame
HALF = 64  # pixels from there to the edge of what is compared
RADIUS = 45  # pixels around the star in which fringes are seen


def read_frame(path: Path) -> np.ndarray:
    """Return the real frame around the star, shape (128, 128), its noise clipped at 0."""
    x, y = STAR
    frame = fits.getdata(path)[y - HALF : y + HALF, x - HALF : x + HALF]
    return frame.astype(float).clip(0)


def simulated_psf(angle: float) -> np.ndarray:
    """Return the simulated PSF, shape (128, 128), with its baseline at this angle, degrees."""
    whole = fizeau_psf((4 * HALF, 4 * HALF), angle * u.deg, WAVELENGTH, PIXEL_SCALE, STREHL)
    return whole[HALF : 3 * HALF, HALF : 3 * HALF]


def contrast(image: np.ndarray) -> np.ndarray:
    """Return the contrast of the fringes against the image without them, fading to the rim."""
    smooth = gaussian_filter(image, 4.0)
    y, x = np.mgrid[-HALF:HALF, -HALF:HALF]
    window = np.cos(np.pi / 2 * np.minimum(np.hypot(x, y) / RADIUS, 1)) ** 2
    return window * (image - smooth) / np.maximum(smooth, 1e-6 * smooth.max())


def amplitude(fringes: np.ndarray, frequency: tuple[float, float]) -> float:
    """Return the amplitude of one spatial frequency (fx, fy), cycles per pixel."""
    n = np.arange(-HALF, HALF)
    x, y = (np.exp(-2j * np.pi * f * n) for f in frequency)
    return float(np.abs(y @ fringes @ x) / fringes.size)


def fringe_spacing(image: np.ndarray) -> tuple[float, float]:
    """Return spacing (pixels) and angle (degrees) of the strongest fringes of 3 to 9 pixels."""
    fringes = contrast(image)
    n = 512
    spectrum = np.abs(np.fft.fft2(fringes, s=(n, n)))
    fy, fx = np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)
    f = np.hypot(fx, fy)
    spectrum[(f < 1 / 9) | (f > 1 / 3) | (fx + 0 * fy < 0)] = 0
    ky, kx = np.unravel_index(spectrum.argmax(), spectrum.shape)
    best = minimize(
        lambda at: -amplitude(fringes, at),
        [fx[kx], fy[ky, 0]],
        method="Nelder-Mead",
        options={"xatol": 1e-7, "fatol": 1e-12},
    ).x
    return 1 / math.hypot(*best), math.degrees(math.atan2(best[1], best[0]))


def draw(real: np.ndarray, simulated: np.ndarray, path: Path) -> None:
    """Draw both, and the amplitude of their fringes against spacing."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.7), layout="constrained", dpi=80)
    spacings = np.linspace(3.5, 9, 400)
    titles = ("LBTI frame of Altair", f"lnocl.simulate, Strehl ratio {STREHL}")
    for axis, image, title, colour in zip(
        axes, (real, simulated), titles, ("#D55E00", "#0072B2"), strict=False
    ):
        spacing, angle = fringe_spacing(image)
        scaled = np.log10(np.clip(image / image.max(), 1e-3, 1))
        shown = axis.imshow(
            scaled, origin="lower", cmap="cividis", extent=(-HALF, HALF, -HALF, HALF)
        )
        axis.set(title=title, xlabel=f"x (pixels of {PIXEL_SCALE:.1f})", ylabel="y (pixels)")
        axis.set(xlim=(-RADIUS, RADIUS), ylim=(-RADIUS, RADIUS))
        fringes = contrast(image)
        direction = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        curve = [amplitude(fringes, (direction[0] / s, direction[1] / s)) for s in spacings]
        label = f"{'real' if image is real else 'simulated'}: {spacing:.2f} pixels"
        axes[2].plot(spacings, np.array(curve) / max(curve), color=colour, label=label)
    figure.colorbar(shown, ax=axes[:2], label="log10 of peak", shrink=0.8)
    theory = (WAVELENGTH / BASELINE * u.rad / PIXEL_SCALE).to_value(u.one)
    axes[2].axvline(theory, color="0.4", linestyle=":", label=f"wavelength / B: {theory:.2f}")
    axes[2].set(title="Fringes", xlabel="spacing (pixels)", ylabel="amplitude / largest")
    axes[2].set_ylim(0, 1.45)
    axes[2].legend(loc="upper right", frameon=False)
    figure.savefig(path, pil_kwargs={"optimize": True})


def main() -> None:
    """Draw the picture and print the spacings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frame", type=Path, nargs="?", default=FRAME, help=FRAME.name)
    parser.add_argument("-o", "--output", type=Path, default=Path("psf_lbti.png"))
    options = parser.parse_args()
    if not options.frame.exists():
        print(f"skipped: {options.frame} is not there")
        return
    real = read_frame(options.frame)
    spacing, angle = fringe_spacing(real)
    simulated = simulated_psf(angle)
    expected, _ = fringe_spacing(simulated)
    print(f"fringe spacing: real {spacing:.3f}, simulated {expected:.3f} pixels; angle {angle:.1f}")
    draw(real, simulated, options.output)
    print(f"wrote {options.output}")


if __name__ == "__main__":
    main()
