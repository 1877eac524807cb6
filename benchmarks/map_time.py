"""Time of the map of detections, and of limits, over that of a run.

    python benchmarks/map_time.py [--size N] [--turns N]

A star of 3e5 electrons on a sky of 20 in each of N x N pixels, 512 by default; the PSF is a Moffat
function. The run has the defaults; the map is that of `lnocl.Result.significance`, with its
detections; limits are curves of three probabilities. All take turns. The table has medians and
quartiles, seconds, and the medians of the ratios to the run.
"""

import argparse
import time
import warnings

import numpy as np

import lnocl

SKY, STAR = 20.0, 3e5


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--turns", type=int, default=11)
    given = parser.parse_args()
    rows, columns = np.indices((65, 65)) - 32
    psf = (1 + (rows**2 + columns**2) / 9) ** -2.5
    half = given.size // 2
    mean = np.full((given.size, given.size), SKY)
    mean[half - 32 : half + 33, half - 32 : half + 33] += STAR * psf / psf.sum()
    counts = np.random.default_rng(0).poisson(mean).astype(float)
    observation = lnocl.Observation(counts, psf, background=SKY)
    times = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for _ in range(given.turns + 1):  # the first builds the program
            begin = time.perf_counter()
            result = lnocl.deconvolve(observation, [(half, half)])
            run = time.perf_counter()
            found = result.significance()
            mapped = time.perf_counter()
            found.contrast_curves()
            times.append((run - begin, mapped - run, time.perf_counter() - mapped))
    times = np.array(times[1:])
    for name, each in zip(("run", "map", "limits"), times.T, strict=True):
        low, middle, high = np.quantile(each, (0.25, 0.5, 0.75))
        ratio = np.median(each / times[:, 0])
        print(f"{name:7s}{middle:.3f} s ({low:.3f} to {high:.3f}), {ratio:.2f} of a run")
    print(f"iterations of the run: {result.n_iter}")


if __name__ == "__main__":
    main()
