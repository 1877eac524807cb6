"""What is timed: lnocl's iteration, and the same iteration (RLM) written with other libraries.

Each side is made from a `Scene` and a dtype, does `count` iterations when called, waits for the
last, and gives its `extended` source, so that all can be seen to do the same work. The others
record no objective. They compute in the precision given, in place where their library can.
"""

import importlib.util
import os

import numpy as np
import scipy.fft

import lnocl
from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.scene.forward_model import Model
from lnocl.core.solvers.scaling import prepare

WORKERS = os.cpu_count()


def observation(size, n_images, psf_size=64, mask=False, **known):
    """Return seeded Poisson images through Gaussian PSFs of different widths."""
    rng = np.random.default_rng(0)
    axis = np.arange(psf_size) - psf_size // 2
    widths = 2.0 + 0.5 * np.arange(n_images)
    # The small constant makes the PSFs as large as they are said to be.
    psfs = [np.exp(-(axis**2)[:, None] / w - axis**2 / (2 * w)) + 1e-9 for w in widths]
    images = rng.poisson(100.0, (n_images, size, size))
    bad = rng.random(images.shape) < 0.01 if mask else None
    return lnocl.Observation(images, np.array(psfs), background=10.0, mask=bad, **known)


class Lnocl:
    """The engine's own iterations, with the objective recorded."""

    def __init__(self, scene, dtype, device=None, tuning=None):
        precision = "double" if dtype == np.float64 else "single"
        self.engine = OpenCLEngine(scene, precision, device, 1_000_000, tuning)
        self.engine.start(*scene.start(None, None))

    def __call__(self, count):
        """Do some iterations and wait for the last."""
        self.enqueue(count)
        self.engine.look()

    def enqueue(self, count):
        """Do some iterations as `lnocl.deconvolve` does them."""
        self.engine.go_on(1_000_000, 0.0)
        for _ in range(count):
            self.engine.tick()

    @property
    def extended(self):
        """The extended source."""
        return self.engine.extended()


class Steps:
    """The scaled gradient projection method's own iterations, line search included."""

    def __init__(self, scene, dtype, device=None):
        precision = "double" if dtype == np.float64 else "single"
        extended, star_fluxes = scene.start(None, None)
        star_fluxes, scaling = prepare(scene, Model(scene), extended, star_fluxes)
        self.engine = OpenCLEngine(scene, precision, device, 1_000_000, scaling=scaling)
        self._start = extended, star_fluxes
        self._begin()

    def _begin(self):
        self.engine.start(*self._start)

    def __call__(self, count):
        """Do some iterations and wait for the last, as a run does."""
        goal = self.engine.look().done + count
        while True:
            self.engine.go_on(goal + 1, 0.0)
            for _ in range(goal - self.engine.look().done):
                self.engine.tick()
            while self.engine.look().going:
                self.engine.tick()
            if self.engine.look().done == goal:
                return
            goal -= self.engine.look().done  # at the minimum
            self._begin()


class Peer:
    """One iteration in NumPy, around the forward and inverse transforms of a library."""

    def __init__(self, scene, dtype):
        self.p = dtype(scene.n_images)
        self.images = np.array(list(scene.images()), dtype)
        self.background = scene.background().astype(dtype)[:, None, None]
        psfs = np.array([scene.psf(j) for j in range(scene.n_images)])
        self.otfs = scipy.fft.rfft2(psfs).astype(np.result_type(dtype, np.complex64))
        self.adjoint_otfs = self.otfs.conj()
        self.extended = scene.start(None, None)[0].astype(dtype)

    def __call__(self, count):
        """Do some iterations."""
        for _ in range(count):
            self.iterate()

    def iterate(self):
        """Do one iteration."""
        model = self.inverse(self.otfs * self.forward(self.extended.copy()))
        model += self.background
        np.divide(self.images, model, out=model)
        spectra = self.forward(model)
        spectra *= self.adjoint_otfs
        self.extended *= self.inverse(spectra.sum(axis=0))
        self.extended /= self.p


class SciPy(Peer):
    """scipy.fft with as many workers as there are processors."""

    workers = WORKERS

    def forward(self, pixels):
        """Half spectra of pixels, which may be overwritten."""
        return scipy.fft.rfft2(pixels, workers=self.workers, overwrite_x=True)

    def inverse(self, spectra):
        """Pixels of half spectra, which may be overwritten."""
        return scipy.fft.irfft2(spectra, workers=self.workers, overwrite_x=True)


class SciPySerial(SciPy):
    """scipy.fft with one worker."""

    workers = 1


class MultiComponent(SciPy):
    """The paper's iteration: stars by sums over their images, and no Tikhonov term; single."""

    def __init__(self, scene):
        super().__init__(scene, np.float32)
        self.fluxes = scene.start(None, None)[1].astype(np.float32)
        stars = [
            [scene.star_image(j, s) for j in range(scene.n_images)] for s in range(scene.n_stars)
        ]
        self.stars = np.array(stars, np.float32)

    def iterate(self):
        """Do one iteration."""
        model = self.inverse(self.otfs * self.forward(self.extended.copy()))
        model += self.background
        model += np.einsum("s,sjyx->jyx", self.fluxes, self.stars)
        np.divide(self.images, model, out=model)
        self.fluxes *= np.einsum("sjyx,jyx->s", self.stars, model) / self.p
        spectra = self.forward(model)
        spectra *= self.adjoint_otfs
        self.extended *= self.inverse(spectra.sum(axis=0))
        self.extended /= self.p


class MKL(Peer):
    """Intel's MKL by mkl_fft, with its default threads."""

    def __init__(self, scene, dtype):
        import mkl_fft

        self.forward, self.inverse = mkl_fft.rfft2, mkl_fft.irfft2
        super().__init__(scene, dtype)


class FFTW:
    """FFTW by pyFFTW: plans measured, transforms into arrays that are there already."""

    def __init__(self, scene, dtype):
        import pyfftw

        plain = Peer(scene, dtype)
        ny, nx = scene.grid
        self.p, self.images, self.background = plain.p, plain.images, plain.background
        # FFTW does not normalise its inverse; the OTFs do it, forward and adjoint.
        self.otfs, self.adjoint_otfs = plain.otfs / (ny * nx), plain.adjoint_otfs / (ny * nx)
        self.otfs = self.otfs.astype(plain.otfs.dtype)
        self.adjoint_otfs = self.adjoint_otfs.astype(plain.otfs.dtype)
        half = (ny, nx // 2 + 1)
        self.model = pyfftw.empty_aligned((scene.n_images, ny, nx), dtype)
        self.spectra = pyfftw.empty_aligned((scene.n_images, *half), plain.otfs.dtype)
        self.extended = pyfftw.empty_aligned((ny, nx), dtype)
        self.correction = pyfftw.empty_aligned((ny, nx), dtype)
        self.spectrum = pyfftw.empty_aligned(half, plain.otfs.dtype)

        def plan(source, target, direction, *flags):
            return pyfftw.FFTW(
                source,
                target,
                axes=(-2, -1),
                direction=direction,
                flags=("FFTW_MEASURE", *flags),
                threads=WORKERS,
            ).execute

        destroy = "FFTW_DESTROY_INPUT"
        self.forward = plan(self.extended, self.spectrum, "FFTW_FORWARD")
        self.model_of = plan(self.spectra, self.model, "FFTW_BACKWARD", destroy)
        self.spectra_of = plan(self.model, self.spectra, "FFTW_FORWARD", destroy)
        self.inverse = plan(self.spectrum, self.correction, "FFTW_BACKWARD", destroy)
        self.extended[:] = plain.extended

    def __call__(self, count):
        """Do some iterations."""
        for _ in range(count):
            self.forward()
            np.multiply(self.otfs, self.spectrum, out=self.spectra)
            self.model_of()
            self.model += self.background
            np.divide(self.images, self.model, out=self.model)
            self.spectra_of()
            self.spectra *= self.adjoint_otfs
            self.spectra.sum(axis=0, out=self.spectrum)
            self.inverse()
            self.extended *= self.correction
            self.extended /= self.p


class Jax:
    """JAX on the CPU: the whole iteration jitted, its input donated."""

    def __init__(self, scene, dtype):
        import jax

        jax.config.update("jax_enable_x64", True)
        jnp = jax.numpy
        plain = Peer(scene, dtype)
        arrays = plain.images, plain.background, plain.otfs, plain.adjoint_otfs
        images, background, otfs, adjoint_otfs = map(jnp.asarray, arrays)

        def iterate(extended, images, background, otfs, adjoint_otfs):
            model = jnp.fft.irfft2(otfs * jnp.fft.rfft2(extended)) + background
            spectra = adjoint_otfs * jnp.fft.rfft2(images / model)
            return extended * jnp.fft.irfft2(spectra.sum(axis=0)) / plain.p

        self.iterate = jax.jit(iterate, donate_argnums=0)
        self.arrays = images, background, otfs, adjoint_otfs
        self.extended = jnp.asarray(plain.extended)

    def __call__(self, count):
        """Do some iterations and wait for the last."""
        for _ in range(count):
            self.extended = self.iterate(self.extended, *self.arrays)
        self.extended.block_until_ready()


class VkFFT:
    """VkFFT by pyvkfft on an OpenCL device, with PyOpenCL's elementwise kernels around it."""

    def __init__(self, scene, dtype, device=None):
        import pyopencl as cl
        import pyopencl.array as cla
        from pyopencl.elementwise import ElementwiseKernel
        from pyvkfft.opencl import VkFFTApp

        from lnocl.core.opencl.device import choose

        context = cl.Context([choose(device).device])
        self.queue = cl.CommandQueue(context)
        plain = Peer(scene, dtype)

        def put(array):
            return cla.to_device(self.queue, np.ascontiguousarray(array))

        self.images, self.otfs = put(plain.images), put(plain.otfs)
        self.background = put(plain.background.ravel())
        self.source, self.spectrum = put(plain.extended), put(plain.otfs[0])
        self.correction = cla.empty_like(self.source)
        self.model, self.spectra = cla.empty_like(self.images), cla.empty_like(self.otfs)
        shape, single = plain.images.shape, plain.extended.shape
        keywords = {"ndim": 2, "inplace": False, "r2c": True}
        self.many = VkFFTApp(shape, dtype, self.queue, **keywords)
        self.one = VkFFTApp(single, dtype, self.queue, **keywords)
        real = "double" if dtype == np.float64 else "float"
        half = self.spectrum.size
        p = scene.n_images

        def kernel(arguments, body):
            arguments = arguments.replace("complex", f"{real}2").replace("real", real)
            return ElementwiseKernel(context, arguments, body)

        times = "({0}2)({1}.x * {2}.x - {1}.y * {2}.y, {1}.x * {2}.y + {1}.y * {2}.x)"
        self.apply = kernel(
            "complex *out, const complex *k, const complex *f",
            f"out[i] = {times.format(real, 'k[i]', f'f[i % {half}]')}",
        )
        self.divide = kernel(
            "real *m, const real *g, const real *b",
            f"m[i] = g[i] / (m[i] + b[i / {self.source.size}])",
        )
        terms = " + ".join(
            times.format(real, f"k[i + {j * half}]", f"r[i + {j * half}]").replace(
                f"k[i + {j * half}].y", f"(-k[i + {j * half}].y)"
            )
            for j in range(p)
        )
        self.correlate = kernel(
            "complex *out, const complex *k, const complex *r", f"out[i] = {terms}"
        )
        self.scale = kernel("real *f, const real *c", f"f[i] *= c[i] / {p}")

    def __call__(self, count):
        """Do some iterations and wait for the last."""
        for _ in range(count):
            self.one.fft(self.source, self.spectrum)
            self.apply(*self._as_pairs(self.spectra, self.otfs, self.spectrum))
            self.many.ifft(self.spectra, self.model)
            self.divide(self.model, self.images, self.background)
            self.many.fft(self.model, self.spectra)
            self.correlate(
                *self._as_pairs(self.spectrum, self.otfs, self.spectra),
                range=slice(self.spectrum.size),
            )
            self.one.ifft(self.spectrum, self.correction)
            self.scale(self.source, self.correction)
        self.queue.finish()

    def _as_pairs(self, *arrays):
        import pyopencl.array as cla

        pair = cla.vec.double2 if self.source.dtype == np.float64 else cla.vec.float2
        return [array.view(pair) for array in arrays]

    @property
    def extended(self):
        """The extended source."""
        return self.source.get()


# Name: (class, module that it needs).
PEERS = {
    "SciPy, 1 worker": (SciPySerial, "scipy"),
    f"SciPy, {WORKERS} workers": (SciPy, "scipy"),
    "FFTW": (FFTW, "pyfftw"),
    "MKL": (MKL, "mkl_fft"),
    "JAX": (Jax, "jax"),
    "VkFFT": (VkFFT, "pyvkfft"),
}


def peers_here():
    """Return those of the peers whose library is installed."""
    return {
        name: side for name, (side, module) in PEERS.items() if importlib.util.find_spec(module)
    }
