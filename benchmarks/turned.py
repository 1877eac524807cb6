"""Images that are turned against the sky: the error of the shears, and the time of an iteration.

    python benchmarks/turned.py [--turns N] [--output STEM]

The first table has the error of a turned wave in a round window, by its spatial frequency, over six
angles and eight directions: the largest as a share of the wave, and the root of the mean square.
The second has the time of an iteration with all images turned over that with none, on the same
grid, of both solvers; both sides take turns, and the table has the median and the quartiles of the
ratio. With --output the tables go to STEM_error.ecsv and STEM_time.ecsv.
"""

import argparse
import time

import numpy as np
from astropy.table import Table

import lnocl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.opencl.device import choose, describe
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.core.scene.rotation import Rotation
from lnocl.core.scene.transforms import rotation

FREQUENCIES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
DEGREES = (-45.0, -20.0, 1.0, 10.0, 33.0, 45.0)
DIRECTIONS = 8
# Images whose turned corners fit in the grid.
SIDES = {512: 400, 1024: 860, 2048: 1740}
ANGLES = (4.0, 10.0, -8.0, -10.0)
SECONDS_A_TURN = 0.15


def wave_errors(frequency, n=128):
    """Return the largest and the rms error of a turned wave, as shares of its amplitude."""
    y, x = np.indices((n, n))
    middle, worst, squares = np.array([n / 2, n / 2]), 0.0, []
    for degrees in DEGREES:
        turn = rotation(np.radians(degrees))
        shift = middle - turn @ middle + (0.3, -2.2)
        each = Rotation(np.radians(degrees), shift, (n, n), (range(n), range(n)))
        u, v = np.einsum("ij,jyx->iyx", turn.T, np.array([x, y]) - shift[:, None, None])
        for direction in np.arange(DIRECTIONS) * np.pi / DIRECTIONS:
            along = 2 * np.pi * frequency * np.array([np.cos(direction), np.sin(direction)])
            sky, expected = (
                np.exp(-0.5 * (dx**2 + dy**2) / 13.0**2) * np.cos(along[0] * dx + along[1] * dy)
                for dx, dy in ((at[0] - middle[0], at[1] - middle[1]) for at in ((x, y), (u, v)))
            )
            spectrum = np.fft.rfft2(sky) * each.undone()
            error = each.forward(np.fft.irfft2(spectrum, (n, n))) - expected
            worst = max(worst, abs(error).max())
            squares.append((error**2).sum() / (expected**2).sum())
    return worst, float(np.sqrt(np.mean(squares)))


def make_engine(grid, solver, is_turned):
    """Return an engine of four images with a star on this grid."""
    n = SIDES[grid]
    y, x = np.indices((65, 65)) - 32
    psf = np.exp(-(x**2) / 9.0 - y**2 / 4.0)
    images = np.random.default_rng(0).poisson(100.0, (4, n, n)).astype(float)
    pad = 0 if is_turned else (grid - n) // 2
    middle = ((n - 1) / 2.0, (n - 1) / 2.0)
    maps = {"transforms": lnocl.rotations(ANGLES, middle)} if is_turned else {}
    observation = lnocl.Observation(images, psf, background=50.0, **maps)
    stars = np.array([middle]) + 0.2
    setup = Setup(observation, stars, pad, solver, "single", "opencl", None)
    start = make_start(setup, Penalty(0.0))
    assert start.scene.grid == (grid, grid), start.scene.grid
    scaling = start.scaling if solver == "sgp" else None
    engine = OpenCLEngine(start.scene, "single", None, 10**5, scaling=scaling)
    engine.start(start.extended, start.star_fluxes)
    return engine


def iterate(engine, count):
    """Do some iterations; return seconds an iteration."""
    begin, goal = time.perf_counter(), engine.look().done + count
    engine.go_on(goal + 1, 0.0)
    for _ in range(count):
        engine.tick()
    while engine.look().going:
        engine.tick()
    return (time.perf_counter() - begin) / count


def time_ratio(grid, solver, turns):
    """Return milliseconds without a turn, and the quartiles of the ratio."""
    engines = [make_engine(grid, solver, is_turned) for is_turned in (False, True)]
    for engine in engines:
        iterate(engine, 3)
    count = max(1, round(SECONDS_A_TURN / iterate(engines[0], 3)))
    times = np.array([[iterate(e, count) for e in engines] for _ in range(turns)])
    return 1e3 * np.median(times[:, 0]), *np.quantile(times[:, 1] / times[:, 0], (0.5, 0.25, 0.75))


def main():
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=25)
    parser.add_argument("--output")
    arguments = parser.parse_args()
    errors = Table(names=("frequency", "largest", "rms"))
    for frequency in FREQUENCIES:
        errors.add_row((frequency, *wave_errors(frequency)))
    for name in ("largest", "rms"):
        errors[name].format = "%.1e"
    print(errors)
    print(describe(choose().device))
    names = ("grid", "solver", "ms", "ratio", "lower", "upper")
    times = Table(names=names, dtype=(int, "U3", float, float, float, float))
    for grid in SIDES:
        for solver in ("sgm", "sgp"):
            times.add_row((grid, solver, *time_ratio(grid, solver, arguments.turns)))
    for name in names[2:]:
        times[name].format = "%.3g"
    print(times)
    if arguments.output:
        errors.write(f"{arguments.output}_error.ecsv", overwrite=True)
        times.write(f"{arguments.output}_time.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
