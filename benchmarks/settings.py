"""What precision, padding and fewer iterations cost, in time and in accuracy.

    python benchmarks/settings.py [--size N] [--n-iter N] [--accuracy A] [--device SPEC]
        [--output STEM] [IMAGE ... --psf PSF ... [--background B ...] [--read-noise R ...]
        [--star X,Y ...]]

The paper's iteration (sgm) of the demo's scene, or of images in files, in single and double
precision, without padding and with half the PSF's larger side. Each is measured after an eighth, a
quarter, half and all of the iterations: its deviation ||f - f_d|| / ||f_d|| from all iterations in
double precision without padding, in the 24 rows round the first star where they fit in the image,
and its error where the truth is known. The last line names the fastest within the accuracy. With
--output the table goes to STEM.ecsv, and deviations against time to STEM.png.
"""

import argparse
import math
import time
import warnings

from astropy.table import Table
from parts import paper

import lnocl
from lnocl.io.calibration import Calibration
from lnocl.io.frames import read_frames
from lnocl.metrics import restoration_error, star_rows
from lnocl.opencl.device import choose, describe
from lnocl.plotting.figure import line_style, new_figure
from lnocl.simulation import hh34, simulate

PARTS = 8, 4, 2, 1


class IterationTimer:
    """A callback that times iterations, and stores the estimates at some of them.

    The clock starts after the first iteration, and so holds neither compilation nor start-up. It
    holds the few copies of an estimate from the device, and stands while it is stored.
    """

    def __init__(self, iterations):
        self.estimates, self.seconds = {}, 0.0
        self._iterations, self._resumed = iterations, math.nan

    def __call__(self, iteration, estimate):
        """Store the estimate if this iteration is one of them."""
        if iteration == 1 or iteration in self._iterations:
            extended = estimate.extended  # which waits for the device
            if iteration > 1:
                self.seconds += time.perf_counter() - self._resumed
            if iteration in self._iterations:
                self.estimates[iteration] = extended
            self._resumed = time.perf_counter()


def demo(size):
    """Return the demo's scene, its stars and its true extended source."""
    made = simulate(hh34(size))
    background, read_noise = made.background, made.read_noise
    observation = lnocl.Observation(
        made.images, made.psfs, background=background, read_noise=read_noise
    )
    return observation, made.stars, made.extended


def compare(observation, stars, truth, rows, n_iter, device):
    """Yield a row for each setting and number of iterations."""
    half = max(observation.psfs.shape[1:]) // 2
    reference = None
    for pad in dict.fromkeys((0, half)):
        for precision in ("double", "single"):
            given = {"precision": precision, "pad": pad, "device": device}
            paper(observation, stars, n_iter=1, **given)  # which compiles
            timer = IterationTimer({n_iter // part for part in PARTS})
            found = paper(observation, stars, n_iter=n_iter, callback=timer, **given).extended
            reference = found if reference is None else reference
            each = timer.seconds / (n_iter - 1)
            for iterations, extended in timer.estimates.items():
                row = {"precision": precision, "pad": pad, "iterations": iterations}
                row |= {"ms": 1e3 * each, "seconds": each * iterations}
                row["deviation"] = restoration_error(extended, reference, rows)
                if truth is not None:
                    row["error"] = restoration_error(extended, truth, rows)
                yield row


def advise(table, accuracy):
    """Return a sentence that names the fastest setting within an accuracy, if there is one."""
    good = [row for row in table if row["deviation"] <= accuracy]
    if not good:
        return f"for an accuracy of {accuracy:g}: no setting is so close to the reference"
    best = min(good, key=lambda row: row["seconds"])
    padding = f"{best['pad']} pixels of padding" if best["pad"] else "no padding"
    return (
        f"for an accuracy of {accuracy:g}: {best['precision']} precision, {padding}, "
        f"{best['iterations']} iterations: {best['seconds']:.2g} s, "
        f"deviation {best['deviation']:.1e}"
    )


def draw(table, measure, path):
    """Draw deviations against time; that of 0, of the reference, has no place on the axis."""
    figure = new_figure(6.5, 4.5)
    axis = figure.subplots()
    for i, part in enumerate(table.group_by(["pad", "precision"]).groups):
        pad = f"pad {part['pad'][0]}" if part["pad"][0] else "no padding"
        shown = part[part["deviation"] > 0]
        style = line_style(i) | {"marker": "o", "label": f"{part['precision'][0]}, {pad}"}
        axis.plot(shown["seconds"], shown["deviation"], **style)
    axis.set(xscale="log", yscale="log", xlabel="time (s)", ylabel=f"deviation, {measure}")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=9)
    figure.savefig(path)


def main():
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", nargs="*")
    parser.add_argument("--psf", nargs="+", dest="psfs")
    parser.add_argument("--background", nargs="+", type=float, default=[0.0])
    parser.add_argument("--read-noise", nargs="+", type=float, default=[0.0])
    parser.add_argument("--star", action="append", default=[], dest="stars")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--n-iter", type=int, default=400)
    parser.add_argument("--accuracy", type=float, default=1e-3)
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    if given.images:
        calibration = Calibration(given.background, given.read_noise)
        observation = read_frames(given.images, given.psfs, calibration).observation
        stars, truth = [tuple(map(float, each.split(","))) for each in given.stars], None
    else:
        observation, stars, truth = demo(given.size)
    rows, measure = slice(None), "all rows"
    if stars:
        rows = star_rows(tuple(map(round, stars[0])), observation.shape)
        measure = "24 rows round the star"
    device = describe(choose(given.device).device)
    print(f"{measure}, against {given.n_iter} iterations in double precision, on {device}")
    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", lnocl.LnoclWarning)
        for row in compare(observation, stars, truth, rows, given.n_iter, given.device):
            print(
                "  ".join(
                    f"{name} {value:.4g}" if isinstance(value, float) else f"{name} {value}"
                    for name, value in row.items()
                ),
                flush=True,
            )
            found.append(row)
    print(advise(found, given.accuracy))
    if given.output:
        table = Table(
            found, meta={"device": device, "measure": measure, "lnocl": lnocl.__version__}
        )
        table.write(f"{given.output}.ecsv", overwrite=True)
        draw(table, measure, f"{given.output}.png")


if __name__ == "__main__":
    main()
