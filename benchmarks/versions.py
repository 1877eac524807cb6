"""Time of an iteration of this version of lnocl over that of another, at eight sizes.

    python benchmarks/versions.py CHECKOUT [--turns N] [--seconds S]

CHECKOUT is a folder with the other version, as `git worktree add` makes. Each version has a process
of its own, and they take turns of S seconds, so that a noisy machine is noisy for both. The table
gives the median over the turns of the ratio, and its standard error from the turns' quartiles.
"""

import argparse
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parents[1]
# Size, images, solver, stars.
CASES = [
    (256, 4, "sgm", 0),
    (512, 1, "sgm", 1),
    (512, 4, "sgp", 1),
    (1024, 1, "sgm", 0),
    (1024, 4, "sgm", 1),
    (1024, 4, "sgp", 8),
    (1024, 2, "sgm", 200),
    (2048, 1, "sgm", 1),
]
WORKER = """
import sys, time
import numpy as np
import sides
try:
    from lnocl.core.scene.scene import Scene
except ModuleNotFoundError:  # a version from before the core had a folder
    from lnocl.scene.scene import Scene
size, n_images, n_stars = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[4])
stars = np.random.default_rng(1).uniform(40, size - 40, (n_stars, 2))
scene = Scene(sides.observation(size, n_images), stars)
side = (sides.Lnocl if sys.argv[3] == "sgm" else sides.Steps)(scene, np.float32)
side(5)
for line in sys.stdin:
    begin = time.perf_counter()
    side(int(line))
    print(time.perf_counter() - begin, flush=True)
"""


class Worker:
    """A process with one version and one case."""

    def __init__(self, checkout, case):
        folders = [str(checkout), str(Path(checkout) / "benchmarks")]
        self._process = subprocess.Popen(
            [sys.executable, "-c", WORKER, *map(str, case)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(folders)},
            cwd=checkout,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def __call__(self, count):
        """Return the seconds that so many iterations take."""
        self._process.stdin.write(f"{count}\n")
        self._process.stdin.flush()
        return float(self._process.stdout.readline())

    def stop(self):
        """End the process."""
        self._process.stdin.close()
        self._process.wait()


def compare(other, case, turns, seconds):
    """Return milliseconds an iteration of this version, and the turns' ratios to the other."""
    workers = [Worker(HERE, case), Worker(other, case)]
    count = max(1, round(10 * seconds / workers[0](10)))
    times = np.empty((turns, 2))
    for turn in times:
        order = np.random.default_rng().permutation(2)
        for k in order:
            turn[k] = workers[k](count)
    for worker in workers:
        worker.stop()
    return 1e3 * np.median(times[:, 0]) / count, times[:, 0] / times[:, 1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout")
    parser.add_argument("--turns", type=int, default=40)
    parser.add_argument("--seconds", type=float, default=0.2)
    given = parser.parse_args()
    print("size  images  solver  stars  ms      ratio  error")
    for case in CASES:
        ms, ratios = compare(given.checkout, case, given.turns, given.seconds)
        low, middle, high = np.percentile(ratios, (25, 50, 75))
        error = 1.25 * (high - low) / 1.35 / np.sqrt(len(ratios))
        size, images, solver, stars = case
        what = f"{size:<4}  {images:<6}  {solver:<6}  {stars:<5}"
        print(f"{what}  {ms:<6.3g}  {middle:.3f}  {error:.3f}")
