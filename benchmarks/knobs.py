"""What lnocl might do for speed or accuracy and does not, and what that would change.

    python benchmarks/knobs.py [--device SPEC] [--turns N] [--output STEM]

Each knob changes the kernels' text, the options they are built with, or the radices. Timed are
iterations of four 1024 x 1024 images in single precision, without a star, all sides taking turns
as in iteration.py; `off` is the largest difference from plain's extended source after three of
them, as a share of its maximum. `all`, `near` and `star` are the deviations of precision.py, on its
scene at 256 x 256: single precision with the knob from double without, after 1000 iterations;
`objective` is the largest relative deviation of J in any of them. A side marked "timing only"
computes nonsense, and is a bound. One whose kernels do not build is left out, and says so.

The second table is of a NumPy twin of the iteration on that scene with brighter stars: float32
from float64 after 600 iterations, the star's image and correction made inside the transforms, as
those of one more pixel, or outside, by adding c_s P_js and by inner products, as lnocl does. Both
transform r - 1 back. With --output both tables go to STEM.ecsv.
"""

import argparse
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
import sides
from astropy.table import Table, hstack, vstack
from iteration import facts, rows, take_turns
from parts import paper
from precision import scene

from lnocl.core.opencl import program
from lnocl.core.opencl.device import choose, describe
from lnocl.core.scene.scene import MIN_MODEL, Scene
from lnocl.errors import DeviceError
from lnocl.metrics import star_rows

TIMED_SIZE, N_IMAGES = 1024, 4
ITERATIONS, STAR_ITERATIONS = 1000, 600
CONTRASTS = (1.0, 1e2, 1e4, 1e6)
DEVIATIONS = ("all", "near", "star")

# Halfs take the first half of the OTFs' buffer; the factor, a power of two, keeps off underflow.
VLOAD_HALF = "PASTE(vload_half, WIDTH)(at, (__global const half *)otf)"
HALF_OTF = (
    (
        "#define MIRROR(t)",
        "#define OTF_FACTOR ((real)4 * NX * NY)\n"
        f"#define OTF_VEC(at) ({VLOAD_HALF} / OTF_FACTOR)\n"
        "#define OTF(k, i) ((cvec){OTF_VEC((k) - otf + 2 * (i) * SIDE), \\\n"
        "                          OTF_VEC((k) - otf + (2 * (i) + 1) * SIDE)})\n"
        "#define MIRROR(t)",
    ),
    (
        "k[i] = z[i] * norm",
        "PASTE(vstore_half, WIDTH)(z[i] * (norm * OTF_FACTOR), k - otf + i, (__global half *)otf)",
    ),
    (
        "__global real *column_0 = (__global real *)k",
        "__global half *column_0 = (__global half *)otf + (k - otf) * LANES",
    ),
    ("column_0[0] = (a_re + b_re) * norm / 4", "vstore_half((a_re + b_re) / 4, 0, column_0)"),
    (
        "column_0[BLOCK] = (a_im + b_im) * norm / 4",
        "vstore_half((a_im + b_im) / 4, BLOCK, column_0)",
    ),
    ("LOAD(k + lane,", "OTF(k + lane,"),
)
# The same by the x86 instruction, which PoCL 3's vload_half does not know; for 8 lanes.
F16C = (VLOAD_HALF, "__builtin_ia32_vcvtph2ps256(((__global const short8 *)otf)[at])")
# Every two points read the OTF of one.
HALF_BYTES = (
    ("LOAD(k + lane, t + q)", "LOAD(k + lane, (t + q) / 2)"),
    ("LOAD(k + lane, t)", "LOAD(k + lane, t / 2)"),
)

RADIX_16 = (
    (
        "INLINE void twiddle_forward(",
        """
#define COS_16 ((real)0.92387953251128675613)
#define SIN_16 ((real)0.38268343236508977173)
INLINE void rotate_16(cvec *a, const real sign)
{
    a[9] = rotate(a[9], COS_16, sign * SIN_16);
    a[10] = rotate(a[10], SQRT_HALF, sign * SQRT_HALF);
    a[11] = rotate(a[11], SIN_16, sign * COS_16);
    a[12] = sign < 0 ? times_minus_i(a[12]) : times_i(a[12]);
    a[13] = rotate(a[13], -SIN_16, sign * COS_16);
    a[14] = rotate(a[14], -SQRT_HALF, sign * SQRT_HALF);
    a[15] = rotate(a[15], -COS_16, sign * SIN_16);
}
INLINE void dif_16(cvec *a)
{
    UNROLL
    for (int i = 0; i < 8; ++i)
        butterfly(a + i, a + i + 8);
    rotate_16(a, -1);
    dif(a, 8);
    dif(a + 8, 8);
}
INLINE void dit_16(cvec *a)
{
    dit(a, 8);
    dit(a + 8, 8);
    rotate_16(a, 1);
    UNROLL
    for (int i = 0; i < 8; ++i)
        butterfly(a + i, a + i + 8);
}
INLINE void twiddle_forward(""",
    ),
    ("dif(a, LAST(n))", "dif_16(a)"),
    ("dit(a, LAST(n))", "dit_16(a)"),
    ("dit(a, LAST(NY))", "dit_16(a)"),
    ("cvec a[8]", "cvec a[16]"),
)


@dataclass(frozen=True)
class Knob:
    """Pairs (old, new) of text, options, the radix of the last pass, and what `off` may be."""

    text: tuple[tuple[str, str], ...] = ()
    options: tuple[str, ...] = ()
    last: int | None = None
    tolerance: float = 2e-6

    def turned(self):
        """Return a context in which lnocl builds its kernels so."""
        text, build = program.source(), program._build
        for old, new in self.text:
            assert old in text, old
            text = text.replace(old, new)
        changes = {
            "source": lambda: text,
            "_build": lambda context, text, options: build(
                context, text, (*options, *self.options)
            ),
        }
        if self.last:
            changes["radices"] = self.radices
        return patch.multiple(program, **changes)

    def radices(self, n):
        """Return odd factor and radices, as lnocl.core.opencl.program does; n is a power of two."""
        outer = n // self.last
        while outer > 8:
            outer //= 8
        return 1, outer, self.last


KNOBS = {
    "plain": Knob(),
    "plain again": Knob(),
    "-cl-fast-relaxed-math": Knob(options=("-cl-fast-relaxed-math",)),
    "-cl-mad-enable": Knob(options=("-cl-mad-enable",)),
    "native_divide": Knob((("g / modelled", "native_divide(g, modelled)"),)),
    "radix 16": Knob(RADIX_16, last=16),
    "OTFs of halfs, vload_half": Knob(HALF_OTF, tolerance=1e-2),
    "OTFs of halfs, F16C": Knob((*HALF_OTF, F16C), tolerance=1e-2),
    "half of the OTFs' bytes, timing only": Knob(HALF_BYTES, tolerance=np.inf),
}


def deviations(found, double, star):
    """Return by how much (extended, flux) strays: all rows, rows round the star, star flux."""
    (extended, flux), (true, true_flux) = found, double
    near = star_rows(star, true.shape)
    return (
        np.linalg.norm(extended - true) / np.linalg.norm(true),
        np.linalg.norm((extended - true)[near]) / np.linalg.norm(true[near]),
        abs(flux / true_flux - 1),
    )


def time_knobs(device, turns):
    """Return the table of times of the knobs that build."""
    given, named = Scene(sides.observation(TIMED_SIZE, N_IMAGES)), {}
    for name, knob in KNOBS.items():
        try:
            with knob.turned():
                named[name] = sides.Lnocl(given, np.float32, device)
        except DeviceError as error:
            print(f"{name}: {error}")
            continue
        named[name](3)
    plain = named["plain"].extended
    off = [np.abs(side.extended - plain).max() / plain.max() for side in named.values()]
    for name, value in zip(named, off, strict=True):
        if not value <= KNOBS[name].tolerance:
            raise SystemExit(f"{name} does other work: its estimate is {value:.1e} off")
    times = take_turns(named, turns)
    table = rows("knobs", TIMED_SIZE, N_IMAGES, np.float32, list(named), times)
    table["off"] = off
    return table


def deviate(names, device):
    """Yield what `deviations` returns of each knob, and the objective's; NaN if only timed."""
    observation, star = scene()

    def run(precision, knob):
        with knob.turned():
            result = paper(
                observation, [star], n_iter=ITERATIONS, precision=precision, device=device
            )
        return (result.extended, result.star_fluxes[0]), result.history["objective"]

    double, true_objective = run("double", Knob())
    for knob in map(KNOBS.get, names):
        if knob.tolerance == np.inf:
            yield (np.nan,) * 4
            continue
        found, objective = run("single", knob)
        yield *deviations(found, double, star), np.abs(objective / true_objective - 1).max()


def twin(given, dtype, inside):
    """Return extended source and star flux from NumPy, the star inside the transforms or not."""
    side = sides.SciPySerial(given, dtype)
    ((x, y),) = given.stars
    p_s = np.array([given.star_image(j, 0) for j in range(given.n_images)]).astype(dtype)
    flux = dtype(given.start(None, None)[1][0])
    for _ in range(STAR_ITERATIONS):
        sky = side.extended.copy()
        if inside:
            sky[y, x] += flux
        model = side.inverse(side.otfs * side.forward(sky)) + side.background
        if not inside:
            model += flux * p_s
        ratio = np.where(model > MIN_MODEL, side.images / np.maximum(model, MIN_MODEL), 0)
        excess = ratio - 1
        # In float64, which is as good as lnocl's compensated sums.
        product = (p_s * excess).sum(dtype=np.float64)
        correction = side.inverse((side.adjoint_otfs * side.forward(excess)).sum(axis=0))
        of_star = correction[y, x] if inside else product
        flux = dtype(flux * max(1 + of_star / given.star_weights[0], 0))
        side.extended *= np.maximum(1 + correction / side.p, 0)
    return side.extended.astype(np.float64), float(flux)


def star_inside():
    """Yield rows: sweep, side, contrast, then what `deviations` returns."""
    for contrast in CONTRASTS:
        observation, star = scene(contrast=contrast)
        given = Scene(observation, [star])
        for inside in (True, False):
            single, double = (twin(given, dtype, inside) for dtype in (np.float32, np.float64))
            side = "inside" if inside else "outside"
            yield "star", side, contrast, *deviations(single, double, star)


def main():
    """Time the knobs, measure their deviations, then the twin's."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device")
    parser.add_argument("--turns", type=int, default=21)
    parser.add_argument("--output")
    given = parser.parse_args()
    device = choose(given.device).device
    print(describe(device), flush=True)
    knobs = time_knobs(given.device, given.turns)
    found = list(deviate(knobs["side"], given.device))
    knobs = hstack([knobs, Table(rows=found, names=(*DEVIATIONS, "objective"))])
    stars = Table(rows=list(star_inside()), names=("sweep", "side", "contrast", *DEVIATIONS))
    for table in (knobs, stars):
        for name in {"off", "objective", *DEVIATIONS} & set(table.colnames):
            table[name].format = ".1e"
        table.pprint_all()
        print()
    if given.output:
        table = vstack([knobs, stars])
        table.meta |= facts(device) | {"turns": given.turns}
        table.write(f"{given.output}.ecsv", overwrite=True)


if __name__ == "__main__":
    main()
