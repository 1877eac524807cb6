"""What a device can do at most, and what an iteration asks of it.

    python benchmarks/machine.py [--device SPEC]

Prints the copy bandwidth (bytes read plus bytes written) and the rate of fused multiply-adds.
"""

import argparse
import time

import numpy as np
import pyopencl as cl

from lnocl.core.opencl.device import choose, describe

COPY_BYTES = 2**28
ROUNDS = 100_000
SOURCE = """
__kernel void copy(__global float8 *out, __global const float8 *in)
{
    out[get_global_id(0)] = in[get_global_id(0)];
}

/* Twelve independent sums, enough to fill the pipelines. */
__kernel void multiply_add(__global VEC *out, const float factor, const int rounds)
{
    const VEC a = factor, b = 1 - factor;
    VEC s0 = get_global_id(0), s1 = s0 + 1, s2 = s0 + 2, s3 = s0 + 3, s4 = s0 + 4, s5 = s0 + 5;
    VEC s6 = s0 + 6, s7 = s0 + 7, s8 = s0 + 8, s9 = s0 + 9, t0 = s0 + 10, t1 = s0 + 11;
    for (int i = 0; i < rounds; ++i) {
        s0 = s0 * a + b; s1 = s1 * a + b; s2 = s2 * a + b; s3 = s3 * a + b;
        s4 = s4 * a + b; s5 = s5 * a + b; s6 = s6 * a + b; s7 = s7 * a + b;
        s8 = s8 * a + b; s9 = s9 * a + b; t0 = t0 * a + b; t1 = t1 * a + b;
    }
    out[get_global_id(0)] = s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7 + s8 + s9 + t0 + t1;
}
"""


def bytes_moved(n_images, ny, nx, itemsize):
    """Return the bytes that an iteration of RLM reads and writes in the device's memory.

    In arrays of the grid's size, p images: convolve_columns reads f's spectrum and p OTFs and
    writes p spectra; ratio_rows reads p spectra and p images and writes p spectra;
    correlate_columns reads p spectra and p OTFs and writes one; scale_rows reads spectrum and
    extended source and writes both.
    """
    arrays = (1 + 2 * n_images) + 3 * n_images + (2 * n_images + 1) + 4
    return arrays * ny * nx * itemsize


def operations(n_images, ny, nx):
    """Return the operations of an iteration's transforms, 5 n log2 n each of n points.

    Forward and inverse for each image and for the estimate; real pixels cost half.
    """
    transforms = 2 * (n_images + 1)
    return transforms * 2.5 * ny * nx * np.log2(ny * nx)


def measure(device, turns=9):
    """Return the copy bandwidth in bytes and the multiply-adds in operations, a second."""
    context = cl.Context([device])
    queue = cl.CommandQueue(context)
    # As the kernels do it: a vector in one work-item on a CPU, groups of scalars elsewhere.
    lanes, group = (8, 1) if device.type & cl.device_type.CPU else (1, 128)
    program = cl.Program(context, SOURCE).build([f"-DVEC=float{lanes if lanes > 1 else ''}"])
    flags = cl.mem_flags.READ_WRITE
    given, taken = cl.Buffer(context, flags, COPY_BYTES), cl.Buffer(context, flags, COPY_BYTES)
    cl.enqueue_fill_buffer(queue, given, np.float32(1), 0, COPY_BYTES)
    items = device.max_compute_units * 64 * group
    copy, multiply_add = program.copy, program.multiply_add
    copy.set_args(taken, given)
    multiply_add.set_args(taken, np.float32(0.999), np.int32(ROUNDS))

    def seconds(kernel, size, group):
        start = time.perf_counter()
        cl.enqueue_nd_range_kernel(queue, kernel, (size,), (group,))
        queue.finish()
        return time.perf_counter() - start

    rates = []
    for _ in range(turns + 1):
        rates.append(
            (
                2 * COPY_BYTES / seconds(copy, COPY_BYTES // 32, 128),
                items * lanes * ROUNDS * 24 / seconds(multiply_add, items, group),
            )
        )
    return np.median(rates[1:], axis=0)


def main():
    """Measure the device that the arguments choose."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device")
    device = choose(parser.parse_args().device).device
    bandwidth, rate = measure(device)
    print(describe(device))
    print(f"copy          {bandwidth / 1e9:8.1f} GB/s, read and written")
    print(f"multiply-add  {rate / 1e9:8.1f} GFlop/s, single precision")


if __name__ == "__main__":
    main()
