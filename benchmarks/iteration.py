"""Milliseconds an iteration, beside a best-effort SciPy iteration in the same run.

    python benchmarks/iteration.py [--size 1024] [--images 4] [--precision single] [--device SPEC]

Both sides take turns, so that a noisy machine is noisy for both; medians are printed, and the
median of the ratios of each turn. SciPy runs with one and with two workers, in the same
precision, in place wherever scipy.fft allows it.
"""

import argparse
import time

import numpy as np
import scipy.fft

import lnocl
from lnocl.opencl import OpenCLEngine
from lnocl.scene import Scene


def observation(size, n_images):
    """Return seeded Poisson images through Gaussian PSFs of different widths."""
    rng = np.random.default_rng(0)
    axis = np.arange(64) - 32
    widths = 2.0 + 0.5 * np.arange(n_images)
    psfs = [np.exp(-(axis**2)[:, None] / w - axis**2 / (2 * w)) for w in widths]
    images = rng.poisson(100.0, (n_images, size, size))
    return lnocl.Observation(images, np.array(psfs), background=10.0)


class SciPyIteration:
    """RLM as one would write it for speed with scipy.fft."""

    def __init__(self, scene, dtype, workers):
        self.images = scene.images().astype(dtype)
        self.background = scene.background().astype(dtype)[:, None, None]
        psfs = np.array([scene.psf(j) for j in range(scene.n_images)]).astype(dtype)
        self.otfs = scipy.fft.rfft2(psfs)
        self.adjoint_otfs = self.otfs.conj()
        self.extended = scene.start(None, None)[0].astype(dtype)
        self.keywords = {"workers": workers, "overwrite_x": True}
        self.p = dtype(scene.n_images)

    def __call__(self):
        """Do one iteration."""
        spectrum = scipy.fft.rfft2(self.extended, workers=self.keywords["workers"])
        model = scipy.fft.irfft2(self.otfs * spectrum, **self.keywords)
        model += self.background
        np.divide(self.images, model, out=model)
        spectra = scipy.fft.rfft2(model, **self.keywords)
        spectra *= self.adjoint_otfs
        correction = scipy.fft.irfft2(spectra.sum(axis=0), **self.keywords)
        self.extended *= correction
        self.extended /= self.p


class OpenCLIterations:
    """The engine's own iterations, with the objective recorded, several at a time."""

    def __init__(self, scene, precision, device, tuning=None):
        self.engine = OpenCLEngine(scene, precision, device, 100_000, tuning)
        self.engine.start(*scene.start(None, None))

    def __call__(self, count):
        """Do several iterations and wait for the last."""
        for _ in range(count):
            self.engine.ratio()
            self.engine.correct()
            self.engine.scale()
        self.engine.star_fluxes()
        self.engine.objectives()


def milliseconds(work):
    """Return how long it takes."""
    start = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - start)


def compare(size, n_images, precision, device, turns):
    """Return a dict of medians in ms, the ratio to the better SciPy, and the device."""
    dtype = np.float64 if precision == "double" else np.float32
    scene = Scene(observation(size, n_images))
    ours = OpenCLIterations(scene, precision, device)
    theirs = {workers: SciPyIteration(scene, dtype, workers) for workers in (1, 2)}
    ours(2)
    for iteration in theirs.values():
        iteration()
    count = max(3, round(2e7 / (size * size * n_images)))
    times = {"lnocl": [], 1: [], 2: []}
    for _ in range(turns):
        times["lnocl"].append(milliseconds(lambda: ours(count)) / count)
        for workers, iteration in theirs.items():
            times[workers].append(np.median([milliseconds(iteration) for _ in range(3)]))
    medians = {name: float(np.median(values)) for name, values in times.items()}
    best = 1 if medians[1] < medians[2] else 2
    ratio = float(np.median(np.array(times[best]) / np.array(times["lnocl"])))
    return {
        "lnocl": medians["lnocl"],
        "scipy 1": medians[1],
        "scipy 2": medians[2],
        "ratio": ratio,
        "device": ours.engine.name,
    }


def main():
    """Run the comparison that the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--precision", choices=("single", "double"), default="single")
    parser.add_argument("--device")
    parser.add_argument("--turns", type=int, default=9)
    given = parser.parse_args()
    row = compare(given.size, given.images, given.precision, given.device, given.turns)
    print(f"{given.images} x {given.size} x {given.size} {given.precision}, {row['device']}")
    print(f"lnocl             {row['lnocl']:8.2f} ms an iteration")
    print(f"SciPy, 1 worker   {row['scipy 1']:8.2f} ms")
    print(f"SciPy, 2 workers  {row['scipy 2']:8.2f} ms")
    print(f"SciPy's better / lnocl, median of {given.turns} turns: {row['ratio']:.2f}")


if __name__ == "__main__":
    main()
