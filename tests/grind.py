"""What test_oclgrind.py runs under Oclgrind: every kernel of a case, whole or with a fault planted.

``grind.py CASE DTYPE [OLD NEW KERNEL]``: the last three put NEW in the place of OLD, once, in the
kernels' source, and run that one kernel. Names what was launched, as JSON.
"""

import functools
import json
import sys
import warnings
from types import SimpleNamespace

import kernel_comparison as comparison
import kernel_harness as harness
import numpy as np
import pyopencl as cl
from kernel_scenes import FOUR_TIMES_AS_FINE, SCENES
from scenes import Recipe, worst

from lnocl.core.opencl import launch, program
from lnocl.core.opencl.device import choose
from lnocl.core.opencl.tuning import Tuning
from lnocl.core.runs.run import complete_together, make_runs
from lnocl.core.runs.start import Setup, make_start
from lnocl.core.scene.penalty import Penalty
from lnocl.errors import MisfitWarning

DTYPES = {"s": np.float32, "d": np.float64}

ON_GPU = "as on a GPU"
DECONVOLUTION = "deconvolution"

# As those of kernel_cases.py, and smaller: grid, tuning, scene, precision. Without a tuning the
# one for a CPU, of one work-item a group; in a group of several, all barriers count.
CASES = {
    "smallest grid": ((2, 2), None, "two images, star, mu", "s"),
    "an item a block": ((16, 16), None, harness.THREE_IMAGES, "d"),
    "several vectors a block": ((16, 16), Tuning(4, 8), "exposure map, mu", "S"),
    "middle passes and spans": ((128, 4), Tuning(2, 2, chunk=8), "mask, mu, smoothing", "S"),
    "odd factors 3 and 5": ((12, 40), Tuning(2, 2, chunk=2), harness.THREE_IMAGES, "s"),
    "odd factors 7 and 9": ((28, 36), Tuning(2, 2), "exposure map, mu", "d"),
    "group": ((16, 32), ON_GPU, harness.THREE_IMAGES, "d"),
    "sky twice as fine": ((16, 24), Tuning(2, 2), harness.TWICE_AS_FINE, "s"),
    "group, sky four times as fine": (
        (16, 32),
        Tuning(1, 2, group=4),
        FOUR_TIMES_AS_FINE,
        "s",
    ),
    "two skies": ((12, 40), Tuning(2, 2, chunk=2), harness.TWO_SKIES, "s"),
    "group, two skies": ((16, 32), ON_GPU, harness.TWO_SKIES, "s"),
    "group, in registers": (
        (24, 40),
        Tuning(1, 2, group=4, points=20),
        harness.TWICE_AS_FINE,
        "s",
    ),
    "turned": ((16, 32), Tuning(4, 4), harness.TURNED, "D"),
    "group, turned": ((32, 48), Tuning(1, 4, group=4), harness.TURNED, "s"),
    "group, exposure map": ((32, 16), Tuning(1, 8, group=4), "exposure map, mu", "s"),
    "group, mu": ((16, 16), ON_GPU, "two images, star, mu", "D"),
    "group, odd factors": ((36, 40), Tuning(1, 2, group=4), "mask, mu, smoothing", "d"),
    "group larger than its work": ((8, 8), Tuning(1, 2, group=16), "mask, mu, smoothing", "s"),
    "group of vectors": ((16, 16), Tuning(4, 8, group=2), "mask, mu, smoothing", "D"),
    "group, middle pass along x": ((4, 128), Tuning(1, 2, group=16, chunk=8), "plain", "s"),
    "group, middle pass along y": ((128, 4), Tuning(1, 2, group=16, chunk=8), "plain", "D"),
    "group, all passes": ((2, 1024), Tuning(1, 1, group=8), "plain", "S"),
    "group, global scratch": (
        (32, 32),
        Tuning(1, 2, group=4, scratch_is_global=True),
        "mask, mu, smoothing",
        "s",
    ),
    "group, deconvolution": ((16, 16), ON_GPU, DECONVOLUTION, "s"),
    "deconvolution": ((16, 16), None, DECONVOLUTION, "D"),
}
# Fewer groups than blocks to share the scratch.
DEVICE_OPTIONS = {"group, global scratch": ["--compute-units", "1"]}


class Layout(harness.SpectraLayout):
    """Leaves the padding of spectra out, which no kernel may read."""

    def pack_columns(self, columns):
        packed = super().pack_columns(columns)
        packed[:, self.grid[0] :] = np.nan
        return packed


class KernelHarness(harness.KernelHarness):
    """Buffers that end where their values do, and hold nothing where those are NaN."""

    def __init__(self, *given, **scene):
        super().__init__(*given, **scene)
        self.layout = Layout(self.program)

    def put(self, values, dtype=None):
        packed = np.ascontiguousarray(values, dtype or self.dtype).reshape(-1)
        buffer = cl.Buffer(
            self.program.context, launch.READ_WRITE, max(packed.nbytes, packed.itemsize)
        )
        given = np.flatnonzero(~np.isnan(packed))
        for run in np.split(given, np.flatnonzero(np.diff(given) > 1) + 1):
            if len(run):
                part, offset = packed[run[0] : run[-1] + 1], int(run[0]) * packed.itemsize
                cl.enqueue_copy(self.launcher.queue, buffer, part, dst_offset=offset)
        return buffer

    def take(self, buffer, shape):
        values = np.empty(buffer.size // self.dtype.itemsize, self.dtype)
        cl.enqueue_copy(self.launcher.queue, values, buffer)
        return values.reshape(shape)


# Oclgrind 21.10 loses track of what is initialised where the host writes a part of a buffer, which
# it takes for all of it, and where a buffer gets the place of one that was released.
PUT_PART = """
kernel void put_part(
    global uint *to, global const uint *from, const uint offset, const uint first)
{
    to[offset + get_global_id(0)] = from[first + get_global_id(0)];
}
"""


class Kept(cl.Buffer):
    """A buffer that is never released."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        BUFFERS.append(self)


BUFFERS = []


def keep_track():
    """Make PyOpenCL fill and keep buffers so that Oclgrind knows what is initialised."""
    cl.Buffer = Kept
    copy = cl.enqueue_copy

    @functools.cache
    def put_part(context):
        return cl.Program(context, PUT_PART).build().put_part

    def copied(queue, to, given, *, dst_offset=0, src_offset=0, byte_count=None, **others):
        if not isinstance(to, cl.Buffer):
            return copy(queue, to, given, src_offset=src_offset, **others)
        if dst_offset == 0 and to.size == nbytes_of(given):
            return copy(queue, to, given, **others)
        if isinstance(given, cl.Buffer):
            size = byte_count
        else:
            size, flags = given.nbytes, cl.mem_flags.COPY_HOST_PTR
            given = cl.Buffer(queue.context, flags, hostbuf=np.ascontiguousarray(given))
        event = put_part(queue.context)(
            queue,
            (size // 4,),
            None,
            to,
            given,
            np.uint32(dst_offset // 4),
            np.uint32(src_offset // 4),
        )
        event.wait()
        return event

    def filled(queue, buffer, pattern, offset, size):
        return copied(
            queue, buffer, np.full(size // pattern.itemsize, pattern[0]), dst_offset=offset
        )

    cl.enqueue_copy, cl.enqueue_fill_buffer = copied, filled


def nbytes_of(given):
    return None if isinstance(given, cl.Buffer) else given.nbytes


def record_launches():
    """Return the set that the names of launched kernels go to."""
    launched = set()
    genuine = launch.Launch.__call__

    def recorded(self):
        launched.add(self._name)
        return genuine(self)

    launch.Launch.__call__ = recorded
    return launched


def plant(old, new):
    """Build all kernels from a source with one place changed."""
    source = program.source

    def planted():
        text = source()
        assert text.count(old) == 1, f"{text.count(old)} places hold {old}"
        return text.replace(old, new)

    program.source = planted


def tune_as_on_gpu():
    tune = program.tune

    def tuned(device, *scene):
        gpu = SimpleNamespace(
            type=cl.device_type.GPU,
            max_work_group_size=device.max_work_group_size,
            max_compute_units=device.max_compute_units,
            local_mem_size=device.local_mem_size,
            name=device.name,
            platform=device.platform,
            driver_version=device.driver_version,
        )
        return tune(gpu, *scene)

    program.tune = tuned


def run_kernels(case, dtype, names):
    grid, tuning, scene, _ = CASES[case]
    context = cl.Context([choose().device])
    tuning = None if tuning == ON_GPU else tuning
    bare = KernelHarness(context, grid, dtype, tuning, **SCENES[scene])
    assert (bare.program.tuning.group > 1) == case.startswith("group")
    assert bare.program.tuning.scratch_is_global == (case in DEVICE_OPTIONS)
    given = harness.inputs(bare)
    for name in names or comparison.kernels_of(bare.scene):
        for found, expected in comparison.KERNELS[name](bare, given):
            # Measured over other grids, what is allowed is a little small for some of these.
            assert comparison.relative(found, expected) <= 4 * comparison.ALLOWED[dtype], name


def run_deconvolution(case, dtype):
    """Deconvolve, with buffers as large as the host makes them and filled as it fills them."""
    shape, precision = CASES[case][0], "double" if dtype == np.float64 else "single"
    recipes = {
        "sgp": Recipe(
            shape, 2, 1, mu=1e-3, smoothing=1e-2, masked=0.05, background="map", psf_shape=(5, 6)
        ),
        "sgm": Recipe(shape, 2, 2, exposure="map", psf_shape=(5, 6)),
    }
    for solver, recipe in recipes.items():
        found, expected = (
            recipe.make().deconvolve(precision=precision, engine=engine, solver=solver, n_iter=2)
            for engine in ("opencl", "numpy")
        )
        assert "Oclgrind" in found.device
        assert worst(found.extended, expected.extended) <= 1e-4
    run_batch(recipes["sgp"].make(), precision)


def run_batch(made, precision):
    """Iterate two members together, each image behind a transmission of its own."""
    shares = np.linspace(0.5, 1.0, made.images[0].size).reshape(made.images[0].shape)
    observation = made.observation().replace(transmission=np.array([shares, shares[::-1]]))
    setup = Setup(observation, made.stars, 0, "sgp", precision, "opencl", None)
    start = make_start(setup, Penalty(1e-3, smoothing=1e-2))
    runs = make_runs([start, start], 2)
    complete_together(runs)
    assert (runs[0].extended() == runs[1].extended()).all()


def main(case, dtype, old=None, new=None, kernel=None):
    assert choose().device.platform.name == "Oclgrind"
    keep_track()
    launched = record_launches()
    if CASES[case][1] == ON_GPU:
        tune_as_on_gpu()
    if old is not None:
        plant(old, new)
    dtype = DTYPES[dtype]
    warnings.simplefilter("ignore", MisfitWarning)  # of runs that end early
    if CASES[case][2] == DECONVOLUTION:
        run_deconvolution(case, dtype)
    else:
        run_kernels(case, dtype, None if kernel is None else [kernel])
    json.dump(sorted(launched), sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:])
