"""A coronagraph's transmission as a map of exposures: how wrong a source's flux becomes.

    python benchmarks/transmission.py [--output STEM]

A mask in the focal plane dims the sky before the PSF blurs it: the image is ``K * (T f)``. lnocl
has a map after the PSF, `exposure`: ``T (K * f)``. The mask is that of NIRCam's 335R,
``(1 - (2 J1(x) / x)^2)^2``. The PSF is an Airy pattern, of a width of 1/12 to 1/3 of the radius at
which T is 1/2. The table has the flux that a source of flux 1 then gets at some radii, by least
squares in the noise of a background.
"""

import argparse

import numpy as np
from astropy.table import Table
from scipy.special import j1

N = 257
RADII = (0.5, 0.75, 1.0, 1.5, 2.0)  # of T = 1/2
WIDTHS = (1 / 12, 1 / 6, 1 / 3)
HALF_RADIUS = 48.0  # pixels
HALF_AT = 2.1001  # x at which T is 1/2
WIDE_AT = 3.2327  # full width at half maximum of the Airy pattern, in its argument


def jinc(x):
    """Return 2 J1(x) / x."""
    return np.divide(2.0 * j1(x), x, out=np.ones_like(x), where=x > 0)


def transmission(radius):
    """Return T at a radius, in those at which it is 1/2."""
    return (1.0 - jinc(HALF_AT * radius) ** 2) ** 2


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output")
    given = parser.parse_args()
    y, x = np.indices((N, N)) - N // 2
    mask = transmission(np.hypot(x, y) / HALF_RADIUS)
    rows = []
    for width in WIDTHS:
        for radius in RADII:
            away = np.hypot(x - radius * HALF_RADIUS, y)
            psf = jinc(WIDE_AT * away / (width * HALF_RADIUS)) ** 2
            at_source = float(transmission(np.array(radius)))
            found = (at_source * psf * mask * psf).sum() / (mask * psf * mask * psf).sum()
            rows.append((round(width, 3), radius, at_source, found))
    table = Table(rows=rows, names=("width", "radius", "transmission", "flux"))
    table["transmission"].format = table["flux"].format = "%.3f"
    table.pprint_all()
    if given.output:
        table.write(f"{given.output}.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
