"""What frames of any size cost on their grids, over what their own pixels would.

    python benchmarks/grids.py [--count 200] [--most 4200] [--images 4] [--turns 5] [--output STEM]

Square frames of random sizes from 200 up, with a pad of a tenth of the size on each side and
without. An iteration is timed on each grid that they need, and on the grids of powers of two that
they needed once, all taking turns. `over` is the time over that of n^2 log2 n points, n the padded
size, at the pace of powers of two, interpolated between the two beside n; `before` the same for the
next power of two. With --output the table of frames goes to STEM-frames.ecsv, that of grids to
STEM-lengths.ecsv.
"""

import argparse

import numpy as np
import sides
from astropy.table import Table
from iteration import facts, take_turns

from lnocl.core.opencl.device import choose
from lnocl.core.scene.grid import LENGTHS, length_for
from lnocl.core.scene.scene import Scene

LEAST = 200
PAD = 0.1
TOGETHER = 4  # sides in memory at a time


def power_for(n):
    """Return the next power of two."""
    return 1 << (n - 1).bit_length()


def time_grids(lengths, n_images, turns, device):
    """Return milliseconds an iteration by length."""
    found = {}
    for first in range(0, len(lengths), TOGETHER):
        some = lengths[first : first + TOGETHER]
        named = {
            n: sides.Lnocl(Scene(sides.observation(n, n_images), pad=0), np.float32, device)
            for n in some
        }
        found |= dict(zip(some, np.median(take_turns(named, turns), axis=0), strict=True))
    return found


def points(n):
    """Return n^2 log2 n."""
    return n**2 * np.log2(n)


def main():
    """Time what the arguments ask for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--most", type=int, default=4200)
    parser.add_argument("--images", type=int, default=4)
    parser.add_argument("--turns", type=int, default=5)
    parser.add_argument("--device")
    parser.add_argument("--output")
    given = parser.parse_args()
    sizes = np.random.default_rng(0).integers(LEAST, given.most, given.count) | 1
    pads = np.round(PAD * sizes).astype(int)
    sizes, pads = np.tile(sizes, 2), np.r_[0 * pads, pads]
    padded = sizes + 2 * pads
    grids, powers = np.array([(length_for(n), power_for(int(n))) for n in padded]).T
    most = max(grids.max(), powers.max())
    lengths = [n for n in LENGTHS if LEAST <= n <= most]
    times = time_grids(lengths, given.images, given.turns, given.device)
    pace = {n: ms / points(n) for n, ms in times.items() if n & (n - 1) == 0}
    own = points(padded) * np.interp(np.log(padded), np.log(list(pace)), list(pace.values()))
    frames = Table({"size": sizes, "pad": pads, "grid": grids})
    frames["over"] = np.round([times[n] for n in grids] / own, 3)
    frames["before"] = np.round([times[n] for n in powers] / own, 3)
    table = Table({"grid": lengths, "ms": np.round([times[n] for n in lengths], 3)})
    table["ns_per_n2_log2_n2"] = np.round(
        [1e6 * times[n] / (2 * given.images * points(n)) for n in lengths], 4
    )
    table.pprint_all()
    for name in ("over", "before"):
        for is_padded in (False, True):
            values = frames[name][(frames["pad"] > 0) == is_padded]
            print(
                f"{name}, {'a pad of a tenth' if is_padded else 'no pad'}: mean "
                f"{values.mean():.2f}, most {values.max():.2f}"
            )
    print(f"time over before: mean {np.mean(frames['over'] / frames['before']):.2f}")
    if given.output:
        known = facts(choose(given.device).device)
        for name, each in (("frames", frames), ("lengths", table)):
            each.meta |= known | {"turns": given.turns, "images": given.images}
            each.write(f"{given.output}-{name}.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
