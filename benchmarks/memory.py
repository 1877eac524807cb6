"""Peak memory of ``lnocl deconvolve``, beside what it announces and what its arrays take.

    python benchmarks/memory.py [--size N] [--images P] [--solver NAME] [--stop RULE]

The images are of float32 with a PSF of 101 x 101 for all. PoCL's device memory is the host's, so
that both announced figures belong to the one process that is measured.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from astropy.io import fits

MIB = 2**20
# Runs a command and prints its peak in KiB. What the system tells of a process is at least what the
# one had that began it: this one is small.
WATCH = """
import os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
print(usage.ru_maxrss)
"""


def measure(size: int, n_images: int, solver: str, stop: str) -> tuple[float, float, float, float]:
    """Return MiB: the peak, those announced on device and host, those of images and answer."""
    with tempfile.TemporaryDirectory() as folder:
        images = [_write_image(Path(folder) / f"{j}.fits", size, j) for j in range(n_images)]
        y, x = np.indices((101, 101)) - 50
        fits.writeto(f"{folder}/psf.fits", np.exp(-(x**2 + y**2) / 8.0))
        command = [
            *(
                sys.executable,
                "-m",
                "lnocl",
                "deconvolve",
                "--verbose",
                *images,
                "--psf",
                f"{folder}/psf.fits",
            ),
            *(
                "--star",
                f"{size // 2},{size // 2}",
                "--background",
                "1",
                "--solver",
                solver,
                "--smoothing",
                "0",
                "--pad",
                "0",
            ),
            *("--n-iter", "3" if stop == "none" else "40", "--stop", stop),
            *("-o", f"{folder}/out.fits"),
        ]
        done = subprocess.run(
            [sys.executable, "-c", WATCH, *command], capture_output=True, text=True, check=False
        )
        device, host = map(float, re.findall(r"([\d.]+) MiB", done.stderr))
    peak = float(done.stdout) * 1024 / MIB
    return peak, device, host, (n_images + 1) * size**2 * 8 / MIB


def _write_image(path: Path, size: int, seed: int) -> str:
    chance = np.random.default_rng(seed)
    image = np.empty((size, size), np.float32)
    for row in image:
        row[:] = chance.poisson(20.0, size)
    fits.writeto(path, image)
    return str(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=4096)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--solver", choices=("sgm", "sgp"), default="sgm")
    parser.add_argument("--stop", choices=("none", "held-out"), default="none")
    given = parser.parse_args()
    peak, device, host, arrays = measure(given.size, given.images, given.solver, given.stop)
    print(
        f"peak {peak:.0f} MiB; announced {device:.0f} on the device and {host:.0f} on the host: "
        f"{peak / (device + host):.2f} of both; images and answer take {arrays:.0f}, and the host "
        f"{(peak - device) / arrays:.2f} times as much"
    )
