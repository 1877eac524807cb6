"""Milliseconds an iteration, beside the same iteration written with other libraries.

    python benchmarks/iteration.py [--sweep NAME ...] [--device SPEC] [--turns N] [--output STEM]

Sweeps: "size" (64 to 4096), "images" (1 to 8), "double", "scene" (what stars, masks, mu and the
recording of the objective cost), and "step" (an iteration of the scaled gradient projection method
beside one of the split-gradient method). Without --sweep all five. All sides of a comparison take
turns in one process, in random order, so that a noisy machine is noisy for all; the table gives
the median over the turns, and the median of each turn's ratio to lnocl (in "scene": to the plain
scene). With --output the table goes to STEM.ecsv and a plot to STEM.png.

SciPy, FFTW, MKL, JAX and VkFFT take part where they are installed: the last four by
`pip install pyfftw mkl_fft jax` and `VKFFT_BACKEND=opencl pip install pyvkfft`.
"""

import argparse
import importlib.metadata
import os
import platform
import random
import time

# Threads that wait for work by spinning would take their time from the next side.
os.environ.setdefault("KMP_BLOCKTIME", "0")

import astropy.units as u
import numpy as np
import sides
from astropy.table import Table, vstack
from experiment import observe
from machine import bytes_moved, measure, operations

from lnocl.core.opencl import program
from lnocl.core.opencl.device import choose, describe
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.scene import Scene
from lnocl.simulation import Experiment, hh34, simulate

SIZES = (64, 128, 256, 512, 1024, 2048, 4096)
IMAGES = (1, 2, 3, 4, 5, 6, 7, 8)
DOUBLE_SIZES = (256, 1024, 2048)
SECONDS_A_TURN = 0.1


def take_turns(named, turns):
    """Return milliseconds an iteration of each side, shape (turns, sides)."""
    counts = {}
    for name, side in named.items():
        side(1)
        start = time.perf_counter()
        side(1)
        counts[name] = max(1, round(SECONDS_A_TURN / (time.perf_counter() - start)))
    times = np.zeros((turns, len(named)))
    order = list(enumerate(named.items()))
    for turn in range(turns):
        for i, (name, side) in random.sample(order, len(order)):
            time.sleep(0.02)
            start = time.perf_counter()
            side(counts[name])
            times[turn, i] = 1e3 * (time.perf_counter() - start) / counts[name]
    return times


def rows(sweep, size, n_images, dtype, names, times):
    """Return the table of one comparison."""
    count = len(names)
    per_point = 1e6 * times / (n_images * size**2 * 2 * np.log2(size))
    return Table(
        {
            "sweep": [sweep] * count,
            "side": names,
            "images": [n_images] * count,
            "size": [size] * count,
            "precision": [np.dtype(dtype).name] * count,
            "ms": np.median(times, axis=0).round(4),
            "ratio": np.median(times / times[:, :1], axis=0).round(3),
            "ns_per_n2_log2_n2": np.median(per_point, axis=0).round(4),
        }
    )


def compare(sweep, size, n_images, dtype, device, turns):
    """Return the table of lnocl and its peers on one scene."""
    scene = Scene(sides.observation(size, n_images))
    named = {"lnocl": sides.Lnocl(scene, dtype, device)}
    for name, side in sides.peers_here().items():
        keywords = {"device": device} if side is sides.VkFFT else {}
        named[name] = side(scene, dtype, **keywords)
    for side in named.values():
        side(3)
    expected = named["lnocl"].extended
    for name, side in named.items():
        error = np.abs(np.asarray(side.extended) - expected).max() / expected.max()
        if error > 1e-4:
            raise SystemExit(f"{name} does other work: its estimate is {error:.1e} off")
    return rows(sweep, size, n_images, dtype, list(named), take_turns(named, turns))


def compare_scenes(device, turns, size=1024, n_images=4):
    """Return the table of what lnocl's iteration costs where a scene has more."""
    plain = sides.observation(size, n_images)
    wide = sides.observation(size, n_images, psf_size=size)
    rng = np.random.default_rng(1)
    stars = [tuple(map(int, rng.integers(0, size, 2))) for _ in range(16)]
    times, shifts = np.arange(1.0, n_images + 1), rng.uniform(-3, 3, (n_images, 2))
    exposure = rng.uniform(0.5, 1.5, plain.images.shape)
    scenes = {
        "plain": Scene(plain),
        "1 star": Scene(plain, stars[:1]),
        "4 stars": Scene(plain, stars[:4]),
        "16 stars": Scene(plain, stars),
        "1 star, PSFs as large as the images": Scene(wide, stars[:1]),
        "4 stars, PSFs as large as the images": Scene(wide, stars[:4]),
        "mask": Scene(sides.observation(size, n_images, mask=True)),
        "mu": Scene(plain, penalty=Penalty(1e-6)),
        "smoothing": Scene(plain, penalty=Penalty(smoothing=1e-4)),
        "1 star between pixels": Scene(plain, [np.add(stars[0], (0.3, -0.4))]),
        "exposure times": Scene(sides.observation(size, n_images, exposure=times)),
        "exposure map": Scene(sides.observation(size, n_images, exposure=exposure)),
        "offsets": Scene(sides.observation(size, n_images, offsets=shifts)),
    }
    named = {name: sides.Lnocl(scene, np.float32, device) for name, scene in scenes.items()}
    named["no objective"] = without_objective(scenes["plain"], device)
    return rows("scene", size, n_images, np.float32, list(named), take_turns(named, turns))


def without_objective(scene, device):
    """Return lnocl's iterations with kernels that leave the objective out."""
    source = program.source
    text = source()
    line = "apart = divergence(modelled, quotient);"
    assert text.count(line) == 1
    text = text.replace(line, "apart = 0;")
    program.source = lambda: text
    try:
        return sides.Lnocl(scene, np.float32, device)
    finally:
        program.source = source


def compare_steps(device, turns, n_images, size):
    """Return the table of the two solvers' iterations on a real scene with one star.

    Those of a smoothed scene are compared with each other too.
    """
    made = simulate(hh34(size), Experiment(angles=np.arange(n_images) * 180.0 / n_images * u.deg))
    scene = Scene(observe(made), made.stars)
    smoothed = Scene(observe(made), made.stars, Penalty(smoothing=1e-4))
    named = {
        "sgm": sides.Lnocl(scene, np.float32, device),
        "sgp": sides.Steps(scene, np.float32, device),
        "sgm, smoothed": sides.Lnocl(smoothed, np.float32, device),
        "sgp, smoothed": sides.Steps(smoothed, np.float32, device),
    }
    return rows("step", size, n_images, np.float32, list(named), take_turns(named, turns))


SWEEPS = {
    "size": lambda *given: [compare("size", n, 4, np.float32, *given) for n in SIZES],
    "images": lambda *given: [compare("images", 1024, p, np.float32, *given) for p in IMAGES],
    "double": lambda *given: [compare("double", n, 4, np.float64, *given) for n in DOUBLE_SIZES],
    "scene": lambda *given: [compare_scenes(*given)],
    "step": lambda *given: [
        compare_steps(*given, n_images=p, size=n) for n in SIZES[:-1] for p in (1, 4)
    ],
}


def facts(device):
    """Return what the figures were measured on and with."""
    bandwidth, rate = measure(device)
    needed = bytes_moved(4, 1024, 1024, 4), operations(4, 1024, 1024)
    packages = ("lnocl", "numpy", "scipy", "pyopencl", "pyfftw", "mkl_fft", "jax", "pyvkfft")
    versions = {}
    for package in packages:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {
        "device": describe(device),
        "processors": os.cpu_count(),
        "python": platform.python_version(),
        "versions": versions,
        "copy_GB_per_s": round(bandwidth / 1e9, 1),
        "multiply_add_GFlop_per_s": round(rate / 1e9, 1),
        "4x1024x1024_MB": round(needed[0] / 1e6, 1),
        "4x1024x1024_ms_at_copy_bandwidth": round(1e3 * needed[0] / bandwidth, 2),
        "4x1024x1024_GFlop_of_transforms": round(needed[1] / 1e9, 3),
        "4x1024x1024_ms_at_multiply_add_rate": round(1e3 * needed[1] / rate, 2),
    }


def plot(table, title, path):
    """Plot time against size and against the number of images."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    for axis, sweep, x in zip(axes, ("size", "images"), ("size", "images"), strict=True):
        part = table[table["sweep"] == sweep]
        for name in dict.fromkeys(part["side"]):
            of_side = part[part["side"] == name]
            width = 2.5 if name == "lnocl" else 1.2
            axis.plot(of_side[x], of_side["ms"], "o-", ms=4, lw=width, label=name)
        axis.set(xlabel=x, ylabel="ms an iteration", yscale="log")
    axes[0].set(xscale="log", title="4 images of size x size, single precision")
    axes[0].set_xticks(SIZES, SIZES)
    axes[0].minorticks_off()
    axes[0].legend()
    axes[1].set(title="images of 1024 x 1024, single precision")
    figure.suptitle(title)
    figure.savefig(path, dpi=120)


def main():
    """Run the sweeps that the arguments ask for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sweep", nargs="+", choices=SWEEPS, default=list(SWEEPS))
    parser.add_argument("--device")
    parser.add_argument("--turns", type=int, default=9)
    parser.add_argument("--output")
    given = parser.parse_args()
    device = choose(given.device).device
    print(describe(device), flush=True)
    tables = []
    for sweep in given.sweep:
        for table in SWEEPS[sweep](given.device, given.turns):
            table.pprint_all()
            print(flush=True)
            tables.append(table)
    table = vstack(tables)
    table.meta |= facts(device) | {"turns": given.turns}
    for name, fact in table.meta.items():
        print(f"{name}: {fact}")
    if given.output:
        table.write(f"{given.output}.ecsv", overwrite=True)
        if {"size", "images"} <= set(given.sweep):
            plot(table, table.meta["device"], f"{given.output}.png")


if __name__ == "__main__":
    main()
