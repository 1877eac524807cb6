"""The iteration's verbs on an OpenCL device: buffers and launches; the engine ``"opencl"``."""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from lnocl.errors import DeviceError, InputError, refuse_not_finite
from lnocl.opencl.device import choose, describe
from lnocl.opencl.faults import guarded
from lnocl.opencl.fft import READ_WRITE, Launch, Launcher, Layout
from lnocl.opencl.program import SOURCES, STEP_SOURCES, Program, Tuning
from lnocl.scene.observation import Array
from lnocl.scene.scene import LEAST_MODEL, Scene
from lnocl.solvers.scaling import Scaling

log = logging.getLogger("lnocl")

# The host waits once in so many iterations, for those before them: often enough that an interrupt
# is answered soon, seldom enough that the device never waits for the host.
ITERATIONS_AHEAD = 4
# And looks at the objectives once in so many, at those of as many before: a transfer costs the host
# as much as launching an iteration.
ITERATIONS_UNSEEN = 64

# Which argument of collect_sums is the iteration, the only one that changes in a run.
COLLECT_ITERATION = 7
# And which of step_rows are alpha and the share.
STEP_ALPHA, STEP_SHARE = 11, 12
# Which arguments are the estimate and the one before it, which change places at every base.
GRADIENT_EXTENDED, GRADIENT_PREVIOUS = 3, 4
STEP_EXTENDED, STEP_PREVIOUS = 1, 4
SMOOTH_EXTENDED = 3


class Transfer:
    """Numbers on their way from the device, while it goes on.

    Parameters
    ----------
    queue : pyopencl.CommandQueue
        In whose order they are read.
    dtype : numpy.dtype
        Of the numbers.
    *ranges : tuple of (pyopencl.Buffer, int, int)
        Where they are: the buffer, from which byte on, and how many bytes.
    """

    def __init__(
        self, queue: cl.CommandQueue, dtype: np.dtype, *ranges: tuple[cl.Buffer, int, int]
    ) -> None:
        self._arrays = [np.empty(size // dtype.itemsize, dtype) for _, _, size in ranges]
        self._events = [
            cl.enqueue_copy(queue, array, buffer, src_offset=offset, is_blocking=False)
            for array, (buffer, offset, _) in zip(self._arrays, ranges, strict=True)
        ]

    def wait(self) -> list[Array]:
        """Return the arrays, as float64, when they have come."""
        cl.wait_for_events(self._events)
        return [array.astype(np.float64) for array in self._arrays]


@guarded
class OpenCLEngine:
    """A scene on a device.

    Whatever makes an estimate convolves it too: with steps the host waits for their sums meanwhile.

    Parameters
    ----------
    scene : Scene
        What is modelled.
    precision : {"single", "double"}
        Arithmetic.
    device : str, optional
        As for `lnocl.opencl.device.choose`.
    n_iter : int
        Most iterations that will be done: objectives are recorded for one more.
    tuning : Tuning, optional
        By default that of `lnocl.opencl.program.tune`.
    scaling : Scaling, optional
        For the scaled gradient projection method; without it its verbs are not there.

    Raises
    ------
    InputError
        No such device, or values too large for the precision.
    DeviceError
        No device, no double precision where it is asked for, or too little memory. Every verb
        raises it where the device fails, and in a process that was forked from this one.
    """

    def __init__(
        self,
        scene: Scene,
        precision: str,
        device: str | None,
        n_iter: int,
        tuning: Tuning | None = None,
        scaling: Scaling | None = None,
    ) -> None:
        self.name, self.bytes_needed = "the device", 0
        self._n_objectives = self._n_restored = 0
        chosen = choose(device).device
        self.name = describe(chosen)
        self.scene, self.scaling = scene, scaling
        self._context = cl.Context([chosen])
        self.program = Program(
            self._context,
            scene.grid,
            np.dtype(np.float64 if precision == "double" else np.float32),
            tuning,
            SOURCES if scaling is None else STEP_SOURCES,
            n_images=scene.n_images,
            n_stars=scene.n_stars,
            has_mu=scene.mu > 0,
            has_smoothing=scene.smoothing > 0,
            has_weights=scene.weights is not None,
            has_exposure_map=scene.has_exposure_map,
            has_background_map=self._has_background_map,
            least_model=LEAST_MODEL,
        )
        self.layout = Layout(self.program)
        windows = [self.layout.window(scene.star_rows(s)) for s in range(scene.n_stars)]
        self._first_blocks = np.array([first for first, _ in windows], np.int32)
        self._star_blocks = max((count for _, count in windows), default=1)
        self.bytes_needed = self._refuse_if_too_large(n_iter)
        self._launcher = Launcher(self.program)
        self._queue = self._launcher.queue
        self._pending_objective: Transfer | None = None
        self._n_scaled = 0
        self._last_mark: cl.Event | None = None
        self._unseen: Transfer | None = None
        self._allocate(n_iter)
        self._bind()
        self._upload_scene()
        if scaling is not None:
            self._bind_steps()
            self.set_scaling(scaling)

    @property
    def is_proven(self) -> bool:
        """Whether every kernel of an iteration has been launched."""
        return self._n_objectives > self._n_restored + 1

    @property
    def _has_background_map(self) -> bool:
        return self.scene.has_exposure_map or self.scene.observation.background.ndim == 3

    def _sizes(self, n_iter: int) -> dict[str, int]:
        """Return the bytes of each buffer, by name."""
        program, layout = self.program, self.layout
        p, n, item = program.n_images, program.n_stars, program.dtype.itemsize
        return {
            "images": p * layout.pixels_bytes,
            "otfs": p * layout.pixels_bytes,
            "otf_edges": p * program.grid[0] * 2 * item,
            "spectra": p * layout.spectra_bytes,
            "extended": layout.pixels_bytes,
            "inverse_weight": layout.pixels_bytes if self.scene.weights is not None else item,
            "background": p * (layout.pixels_bytes if self._has_background_map else item),
            "exposure": p * layout.pixels_bytes if self.scene.has_exposure_map else item,
            "star_images": max(n * p * self._star_blocks * layout.block_bytes, item),
            "first_blocks": max(n, 1) * self._first_blocks.itemsize,
            "star_fluxes": max(n, 1) * item,
            "star_weights": max(n, 1) * item,
            "star_corrections": max(n, 1) * item,
            "ratio_sums": program.row_blocks * p * (1 + n) * 2 * item,
            "square_sums": program.row_blocks * 2 * item,
            "slope": layout.pixels_bytes if self.scene.smoothing else item,
            "curvature": layout.pixels_bytes if self.scene.smoothing else item,
            "smooth_sums": program.row_blocks * 2 * item,
            "objectives": (n_iter + 1) * 2 * item,
            **({} if self.scaling is None else self._step_sizes()),
            "scratch and roots": Launcher.bytes_needed(program),
        }

    def _step_sizes(self) -> dict[str, int]:
        """Return the bytes of the buffers that only steps need, by name."""
        program, layout = self.program, self.layout
        pair = 2 * program.dtype.itemsize
        return {
            "previous": layout.pixels_bytes,
            "gradient": layout.pixels_bytes,
            "shift": layout.pixels_bytes,
            "cross_information": max(program.n_stars * layout.pixels_bytes, pair),
            "change_sums": program.row_blocks * 2 * pair,
            "step_sums": program.row_blocks * (1 + program.n_stars) * pair,
        }

    def _refuse_if_too_large(self, n_iter: int) -> int:
        """Return the bytes that the scene takes on the device, all buffers together; log them."""
        sizes = self._sizes(n_iter)
        device = self._context.devices[0]
        total = sum(sizes.values())
        largest = max(sizes, key=lambda name: sizes[name])
        if total > device.global_mem_size or sizes[largest] > device.max_mem_alloc_size:
            raise DeviceError(
                f"the scene needs {total / 2**20:.0f} MiB, {sizes[largest] / 2**20:.0f} MiB of it "
                f"for {largest}; {self.name} has {device.global_mem_size / 2**20:.0f} MiB and "
                f"gives {device.max_mem_alloc_size / 2**20:.0f} MiB at once: take fewer or "
                "smaller images, fewer stars, precision single, or another device"
            )
        log.info("%s: the scene takes %.1f MiB", self.name, total / 2**20)
        return total

    def _allocate(self, n_iter: int) -> None:
        self._buffers = {
            name: cl.Buffer(self._context, READ_WRITE, size)
            for name, size in self._sizes(n_iter).items()
            if name != "scratch and roots"  # the launcher's own
        }

    def _bind(self) -> None:
        """Bind the kernels of an iteration, in its order."""
        buffers, launcher = self._buffers, self._launcher
        otfs = buffers["otfs"], buffers["otf_edges"]
        mu = self.program.dtype.type(self.scene.mu)
        self._convolve = launcher.columns("convolve_columns", buffers["spectra"], *otfs)
        self._ratio = launcher.rows(
            "ratio_rows",
            buffers["spectra"],
            buffers["ratio_sums"],
            buffers["images"],
            buffers["background"],
            buffers["exposure"],
            buffers["star_images"],
            buffers["first_blocks"],
            np.int32(self._star_blocks),
            buffers["star_fluxes"],
            blocks=self.program.row_blocks * self.program.n_images,
        )
        self._collect = launcher.one_group(
            "collect_sums",
            buffers["objectives"],
            buffers["star_corrections"],
            buffers["ratio_sums"],
            buffers["square_sums"],
            buffers["smooth_sums"],
            buffers["star_weights"],
            mu,
            np.int32(0),
        )
        if self.scene.smoothing:
            self._smooth = self._bind_smooth()
        self._correlate = launcher.columns("correlate_columns", buffers["spectra"], *otfs)
        self._scale = launcher.rows(
            "scale_rows",
            buffers["spectra"],
            buffers["extended"],
            buffers["square_sums"],
            buffers["star_fluxes"],
            buffers["inverse_weight"],
            buffers["star_corrections"],
            buffers["slope"],
            buffers["curvature"],
            mu,
        )

    def _bind_smooth(self) -> Launch:
        buffers, real = self._buffers, self.program.dtype.type
        return self._launcher.blocks(
            "smooth",
            buffers["slope"],
            buffers["curvature"],
            buffers["smooth_sums"],
            buffers["extended"],
            real(self.scene.smoothing),
            real(self.scene.edge),
        )

    def _bind_steps(self) -> None:
        """Bind the kernels of the scaled gradient projection method."""
        buffers, launcher = self._buffers, self._launcher
        real = self.program.dtype.type
        self._gradient = launcher.rows(
            "gradient_rows",
            buffers["spectra"],
            buffers["change_sums"],
            buffers["gradient"],
            buffers["extended"],
            buffers["previous"],
            buffers["shift"],
            buffers["inverse_weight"],
            buffers["slope"],
            buffers["curvature"],
            real(self.scene.mu),
        )
        self._step = launcher.rows(
            "step_rows",
            buffers["spectra"],
            buffers["extended"],
            buffers["step_sums"],
            buffers["square_sums"],
            buffers["previous"],
            buffers["gradient"],
            buffers["shift"],
            buffers["inverse_weight"],
            buffers["curvature"],
            buffers["cross_information"],
            real(self.scene.mu),
            real(0),
            real(0),
        )

    def _upload_scene(self) -> None:
        scene = self.scene
        images = scene.images()
        if scene.weights is not None and scene.has_exposure_map:
            self._upload_pixels("exposure", scene.weights)
        elif scene.weights is not None:
            images[~scene.weights] = -1.0  # how the kernels know an unobserved pixel
        self._upload_pixels("images", images)
        background = scene.background()
        if background.ndim == 3:
            self._upload_pixels("background", background)
        else:
            self._upload("background", background)
        self._make_otfs()
        if scene.n_stars:
            cl.enqueue_copy(self._queue, self._buffers["first_blocks"], self._first_blocks)
            self.move_stars()
        self._observed: NDArray[np.bool_] | None = None
        if scene.weights is not None:
            self._invert_weights(scene.weights)

    def set_scaling(self, scaling: Scaling) -> None:
        """Measure steps with this from now on."""
        self.scaling = scaling
        self._upload_pixels("shift", [scaling.shift])
        self._upload_pixels("cross_information", scaling.cross_information)

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""
        scene = self.scene
        windows = [self.layout.rows_of(first, self._star_blocks) for first in self._first_blocks]
        self._upload_pixels(
            "star_images",
            (
                scene.star_image(j, s)[rows]
                for s, rows in enumerate(windows)
                for j in range(scene.n_images)
            ),
        )
        self._upload("star_weights", scene.star_weights)

    def _make_otfs(self) -> None:
        buffers = self._buffers
        for j in range(self.scene.n_images):
            self._upload_pixels("extended", [self.scene.psf(j)])
            self._launcher.rows("rfft_rows", buffers["spectra"], buffers["extended"])()
            self._launcher.columns(
                "otf_columns",
                buffers["otfs"],
                buffers["otf_edges"],
                buffers["spectra"],
                np.int32(j),
            )()

    def _invert_weights(self, weights: NDArray) -> None:
        """Make 1 / sum_j A_j^T w_j, 0 where nothing was observed."""
        buffers, size = self._buffers, self.layout.spectra_bytes
        transform = self._launcher.rows("rfft_rows", buffers["spectra"], buffers["extended"])
        for j in reversed(range(len(weights))):
            self._upload_pixels("extended", [weights[j]])
            transform()
            if j > 0:  # the first array is where transforms come out
                cl.enqueue_copy(
                    self._queue,
                    buffers["spectra"],
                    buffers["spectra"],
                    byte_count=size,
                    dst_offset=j * size,
                )
        self.correct()
        self._launcher.rows("irfft_rows", buffers["extended"], buffers["spectra"])()
        total = self.extended()
        self._observed = self.scene.observed(total)
        inverse = np.divide(1.0, total, out=np.zeros_like(total), where=self._observed)
        self._upload_pixels("inverse_weight", [inverse])

    def start(self, extended: Array, star_fluxes: Array) -> None:
        """Begin from this estimate, on the grid and scaled; unobserved pixels are set to 0."""
        if self._observed is not None:
            extended = np.where(self._observed, extended, 0.0)
        self._upload_pixels("extended", [extended])
        self._transform_estimate()
        if self.scene.n_stars:
            self._upload("star_fluxes", star_fluxes)
        squares = np.zeros(self._buffers["square_sums"].size // self.program.dtype.itemsize)
        squares[0] = (extended**2).sum()
        self._upload("square_sums", squares)
        if self.scaling is not None:
            self._upload_pixels("previous", [extended])
            self._upload_pixels("gradient", [np.zeros_like(extended)])

    def ratio(self) -> None:
        """Make the ratios of the estimate; record its objective."""
        self._ratio()
        if self.scene.smoothing:
            self._smooth_buffer("extended")
        self._collect.kernel.set_arg(COLLECT_ITERATION, np.int32(self._n_objectives))
        self._collect()
        self._n_objectives += 1
        # Steps are judged by it: on its way before what comes next, which need not wait for it.
        self._pending_objective = None if self.scaling is None else self._fetch_objective()

    def _smooth_buffer(self, name: str) -> None:
        """Make the slope and the curvature of these pixels."""
        self._smooth.kernel.set_arg(SMOOTH_EXTENDED, self._buffers[name])
        self._smooth()

    def correct(self) -> None:
        """Back-project the ratios to the correction."""
        self._correlate()

    def scale(self) -> None:
        """Scale the estimate by its correction; look at the objectives of some iterations ago."""
        event = self._scale()
        self._convolve()
        self._n_scaled += 1
        if self._n_scaled % ITERATIONS_AHEAD == 0:
            if self._last_mark is not None:
                self._last_mark.wait()
            self._last_mark = event
        if self._n_scaled % ITERATIONS_UNSEEN == 0:
            if self._unseen is not None:
                refuse_not_finite(*self._unseen.wait()[0])
            unseen = self._last_objectives(ITERATIONS_UNSEEN)
            self._unseen = Transfer(self._queue, self.program.dtype, unseen)

    def gradient(self) -> tuple[float, float]:
        """Take the estimate for the base of steps; return ``<D y, s>`` and ``<D y, D y>``."""
        self._gradient()
        change_step, change_change = self._sums("change_sums", 2)
        self._make_estimate_the_base()
        return float(change_step), float(change_change)

    def _make_estimate_the_base(self) -> None:
        """Exchange the estimate and the one before it: the next is written over what was before."""
        buffers = self._buffers
        buffers["extended"], buffers["previous"] = buffers["previous"], buffers["extended"]
        self._gradient.kernel.set_arg(GRADIENT_EXTENDED, buffers["extended"])
        self._gradient.kernel.set_arg(GRADIENT_PREVIOUS, buffers["previous"])
        self._step.kernel.set_arg(STEP_EXTENDED, buffers["extended"])
        self._step.kernel.set_arg(STEP_PREVIOUS, buffers["previous"])

    def star_gradient(self) -> Array:
        """Return the gradient of the objective in the star fluxes."""
        if not self.scene.n_stars:
            return np.zeros(0)  # without waiting for the device
        return -self._wait_for_objective()[1][1:]

    def step(self, alpha: float, share: float) -> tuple[float, Array]:
        """Step from the base; return ``<gradient, d>`` and ``<reach_s, d>``."""
        if self.scene.smoothing and share < 1:  # the curvature is that of a longer step by now
            self._smooth_buffer("previous")
        real = self.program.dtype.type
        self._step.kernel.set_arg(STEP_ALPHA, real(alpha))
        self._step.kernel.set_arg(STEP_SHARE, real(share))
        self._step()
        buffer = self._buffers["step_sums"]
        transfer = Transfer(self._queue, self.program.dtype, (buffer, 0, buffer.size))
        self._convolve()  # which the host need not wait for
        (pairs,) = transfer.wait()
        sums = self._sum_blocks(pairs, 1 + self.scene.n_stars)
        return float(sums[0]), sums[1:]

    def set_star_fluxes(self, star_fluxes: Array) -> None:
        """Make these the star fluxes."""
        if self.scene.n_stars:
            self._upload("star_fluxes", star_fluxes)

    def objective(self) -> float:
        """Return the objective recorded last, scaled."""
        return self._wait_for_objective()[0]

    def _wait_for_objective(self) -> tuple[float, Array]:
        """Return the objective recorded last, and the sums that `ratio` left."""
        if self._pending_objective is None:
            self._pending_objective = self._fetch_objective()
        pair, sums = self._pending_objective.wait()
        return float(pair.sum()), self._sum_blocks(sums, 1 + self.scene.n_stars)

    def _fetch_objective(self) -> Transfer:
        sums = self._buffers["ratio_sums"], 0, self._buffers["ratio_sums"].size
        return Transfer(self._queue, self.program.dtype, self._last_objectives(1), sums)

    def _last_objectives(self, count: int) -> tuple[cl.Buffer, int, int]:
        """Return where the objectives recorded last are: buffer, first byte, and bytes."""
        pair = 2 * self.program.dtype.itemsize
        return self._buffers["objectives"], (self._n_objectives - count) * pair, count * pair

    def forget_objective(self) -> None:
        """Take the objective recorded last off the record."""
        self._n_objectives -= 1
        self._pending_objective = None

    def extended(self) -> Array:
        """Return the extended source, on the grid and scaled."""
        packed = np.empty(self.layout.pixels_shape, self.program.dtype)
        cl.enqueue_copy(self._queue, packed, self._buffers["extended"])
        return self.layout.unpack_pixels(packed)

    def star_fluxes(self) -> Array:
        """Return the star fluxes, scaled."""
        return self._download("star_fluxes", self.scene.n_stars)

    def data_term(self) -> float:
        """Return the data term of the objective recorded last, scaled."""
        return float(self._wait_for_objective()[1][0])

    def objectives(self) -> Array:
        """Return the objectives recorded so far, scaled."""
        pairs = self._download("objectives", 2 * self._n_objectives)
        return pairs.reshape(-1, 2).sum(axis=1)

    def state(self) -> dict[str, NDArray]:
        """Return what `restore` needs, as it is between iterations, as it lies on the device."""
        state = {}
        for name in self._stateful:
            state[name] = np.empty(self._buffers[name].size, np.uint8).view(self.program.dtype)
            cl.enqueue_copy(self._queue, state[name], self._buffers[name])
        state["objectives"] = state["objectives"][: 2 * self._n_objectives]
        state["star_fluxes"] = state["star_fluxes"][: self.scene.n_stars]
        return state

    @property
    def _stateful(self) -> tuple[str, ...]:
        estimate = "extended", "star_fluxes", "square_sums", "objectives"
        return estimate if self.scaling is None else (*estimate, "previous", "gradient")

    def restore(self, state: dict[str, NDArray]) -> None:
        """Go on from this state."""
        for name in self._stateful:
            if name in state and state[name].size:  # there may be no objective yet, and no star
                cl.enqueue_copy(self._queue, self._buffers[name], state[name])
        self._transform_estimate()
        n_objectives = len(state.get("objectives", ())) // 2
        if not self.is_proven:
            self._n_restored = n_objectives
        self._n_objectives = n_objectives

    def _transform_estimate(self) -> None:
        """Make the row spectrum of an estimate that came from the host, and convolve it."""
        self._launcher.rows("rfft_rows", self._buffers["spectra"], self._buffers["extended"])()
        self._convolve()
        self._pending_objective = None

    def _upload(self, name: str, values: Array) -> None:
        cl.enqueue_copy(self._queue, self._buffers[name], self._rounded(name, values))

    def _upload_pixels(self, name: str, arrays: Iterable[NDArray]) -> None:
        """Upload arrays of pixels, one behind the other."""
        offset = 0
        for array in arrays:
            packed = self.layout.pack_pixels(self._rounded(name, array))
            cl.enqueue_copy(self._queue, self._buffers[name], packed, dst_offset=offset)
            offset += packed.nbytes

    def _rounded(self, name: str, values: NDArray | float) -> NDArray:
        """Return values in the engine's precision, none of them too large for it."""
        with np.errstate(over="ignore"):
            rounded = np.asarray(values).astype(self.program.dtype)
        if not np.isfinite(rounded).all():
            raise InputError(
                f"{name.replace('_', ' ')} as large as {np.abs(values).max() * self.scene.scale:g} "
                f"cannot be held in {self.program.dtype}: scale the scene, or take precision double"
            )
        return rounded

    def _sums(self, name: str, n_sums: int) -> Array:
        """Return sums over pixels from the pairs that each block left."""
        n_pairs = self._buffers[name].size // self.program.dtype.itemsize
        return self._sum_blocks(self._download(name, n_pairs), n_sums)

    @staticmethod
    def _sum_blocks(pairs: Array, n_sums: int) -> Array:
        return pairs.reshape(-1, n_sums, 2).sum(axis=(0, 2))

    def _download(self, name: str, count: int) -> Array:
        values = np.empty(count, self.program.dtype)
        if count:
            cl.enqueue_copy(self._queue, values, self._buffers[name])
        return values.astype(np.float64)
