"""Many targets: what a batch costs besides the reconstructions, and what workers gain and lose.

``python benchmarks/batch.py PART [--targets N]``, PART one of

- ``overhead``: N targets of 256 x 256 by ``lnocl batch`` and by a loop over the same calls in one
  process; the difference a target.
- ``lost``: two workers of Dask, of which one is killed with half of the targets done; the
  connection to the scheduler is cut once. Compares all results with those of one process.
- ``workers``: one worker and two, in turn, each with one thread or as many as cores.
- ``scheduler``: tasks that only sleep, on 1 to 256 workers, threads of four processes: what the
  scheduler leaves of the speed of so many.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import chdir
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.signal import fftconvolve

from lnocl.commands import cli

SHAPE = 256, 256
N_ITER = 100


def write_targets(n, n_iter=N_ITER):
    """Write n images of a star on a blob, their PSF, and the table of targets."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    radius = np.hypot(*(np.mgrid[:65, :65] - 32.0))
    psf = (1.0 + (radius / 3.0) ** 2) ** -2.5
    fits.writeto("psf.fits", psf / psf.sum())
    rows = []
    for k in range(n):
        rng = np.random.default_rng(k)
        (cx, cy), height = rng.uniform(100.0, 156.0, 2), rng.uniform(10.0, 60.0)
        sky = height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 800.0) + 2.0
        sky[128, 128] += 1e5
        counts = rng.poisson(fftconvolve(sky, psf / psf.sum(), mode="same") + 5.0)
        fits.writeto(f"t{k:03d}.fits", counts.astype(np.float32))
        rows.append((f"t{k:03d}.fits", "psf.fits", "128,128", 5.0, n_iter, "none"))
    names = ["images", "psf", "star", "background", "n_iter", "stop"]
    Table(rows=rows, names=names).write("targets.csv")
    return rows


def batch(folder, *more):
    """Run ``lnocl batch`` in a process of its own, and return its seconds."""
    begun = time.perf_counter()
    words = [sys.executable, "-m", "lnocl", "batch", "targets.csv", "-o", folder, "--quiet"]
    subprocess.run([*words, *more], check=True)
    return time.perf_counter() - begun


def overhead(n):
    """Compare a batch with the same commands, one after the other in one process."""
    rows = write_targets(n)
    found = []
    for turn in range(3):
        begun = time.perf_counter()
        words = ["batch", "targets.csv", "-o", f"batch{turn}", "--quiet"]
        assert cli.main(words) == 0
        whole = time.perf_counter() - begun
        os.makedirs(f"alone{turn}")
        times = []
        for images, psf, star, background, n_iter, stop in rows:
            begun = time.perf_counter()
            assert cli.main(
                ["deconvolve", images, "--psf", psf, "--star", star, "--background",
                 str(background), "--n-iter", str(n_iter), "--stop", stop, "--quiet",
                 "-o", f"alone{turn}/{images}"]
            ) == 0  # fmt: skip
            times.append(time.perf_counter() - begun)
        found.append((whole / n, np.mean(times)))
        print(f"a target: in the batch {1e3 * found[-1][0]:.1f} ms, its command alone "
              f"{1e3 * found[-1][1]:.1f} ms")  # fmt: skip
    difference = np.median([one - other for one, other in found])
    print(f"overhead a target, median of three: {1e3 * difference:.1f} ms")
    begun = time.perf_counter()
    two = batch("workers", "--parallel", "2")
    print(f"with --parallel 2, start and end of the processes included: {two:.1f} s for {n}")
    records = [json.loads(path.read_text()) for path in Path("workers").glob("t*.json")]
    busy = sum(each["seconds"] for each in records) / 2
    print(f"overhead a target on a worker: {1e3 * 2 * (two - busy) / n:.1f} ms, start included")


def lost(n):
    """Kill a worker and cut a connection; compare the results with those of one process."""
    import distributed

    write_targets(n)
    batch("one")
    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1) as cluster,
        distributed.Client(cluster) as client,
    ):

        def wait(count):
            while len(list(Path("two").glob("*.log"))) < count:
                time.sleep(0.01)

        def disturb():
            wait(n // 2)
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
            wait(n * 3 // 4)
            client.loop.add_callback(client.scheduler_comm.comm.abort)

        thread = threading.Thread(target=disturb)
        thread.start()
        words = ["batch", "targets.csv", "-o", "two", "--parallel", "current-scheduler"]
        assert cli.main(words) == 0
        thread.join()
    n_equal = 0
    for path in Path("one").glob("*.fits"):
        with fits.open(path) as one, fits.open(Path("two") / path.name) as two:
            n_equal += all(
                a.data.tobytes() == b.data.tobytes() for a, b in zip(one, two, strict=True)
            )
    summary = Table.read("two/summary.ecsv")
    print(f"{n_equal} of {n} results are bit for bit those of one process")
    statuses = summary["status"].tolist()
    print(f"status: {({each: statuses.count(each) for each in set(statuses)})}; "
          f"{len(set(summary['process']))} processes")  # fmt: skip


def workers(n):
    """Time one worker and two, in turn."""
    write_targets(n, n_iter=400)
    seconds = {"1": [], "2": [], "one process": []}
    for turn in range(3):
        for count, times in seconds.items():
            more = [] if count == "one process" else ["--parallel", count]
            times.append(batch(f"w{turn}{count}", *more))
    for count, times in seconds.items():
        print(f"{count}: {np.median(times):.1f} s")
    medians = {count: np.median(times) for count, times in seconds.items()}
    print(f"two workers over one: {medians['1'] / medians['2']:.2f} times; over one process "
          f"without workers {medians['one process'] / medians['2']:.2f} times")  # fmt: skip


def make_sleeper():
    """Return a task that takes no processor."""
    return time.sleep


def _sleep(token, make, seconds):
    make()(seconds)
    return seconds, []


def scheduler(n):
    """Time tasks that sleep on many workers: threads of processes, which need no core."""
    import distributed

    from lnocl import parallel

    del n
    parallel._do = _sleep  # lnocl's does one task at a time in each process
    for seconds in (0.1, 1.0):
        for count in (1, 4, 16, 64, 256):
            processes = min(count, 4)
            with (
                distributed.LocalCluster(
                    n_workers=processes,
                    threads_per_worker=count // processes,
                    dashboard_address="127.0.0.1:0",
                    memory_limit=None,
                ) as cluster,
                distributed.Client(cluster),
            ):
                list(parallel.work(make_sleeper, [0.0] * count, parallel.CURRENT))
                n_tasks = 8 * count
                begun = time.perf_counter()
                list(parallel.work(make_sleeper, [seconds] * n_tasks, parallel.CURRENT))
                took = time.perf_counter() - begun
            print(
                f"tasks of {seconds:g} s on {count:3d} workers: efficiency "
                f"{n_tasks * seconds / count / took:.2f}, "
                f"{1e3 * (took - 8 * seconds) / n_tasks:.2f} ms of the scheduler a task",
                flush=True,
            )


PARTS = {each.__name__: each for each in (overhead, lost, workers, scheduler)}


def main():
    """Run one part in a folder of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=PARTS)
    parser.add_argument("--targets", type=int, default=200)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        PARTS[arguments.part](arguments.targets)


if __name__ == "__main__":
    main()
