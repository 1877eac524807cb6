"""The iteration's verbs on an OpenCL device: the engine ``"opencl"``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from lnocl.core.engines.needs import (
    buffer_sizes,
    cross_sizes,
    has_background_map,
    host_bytes,
    scaling_sizes,
)
from lnocl.core.opencl.device import choose, context_of, describe, tell
from lnocl.core.opencl.faults import guarded
from lnocl.core.opencl.launch import Launch, Launcher
from lnocl.core.opencl.layout import Layout
from lnocl.core.opencl.memory import Memory, Transfer, announce, refuse_if_too_large
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.transmitted import TransmittedSky
from lnocl.core.opencl.tuning import Tuning, describe_tuning
from lnocl.core.opencl.turned import TurnedImages
from lnocl.core.opencl.windows import StarWindows
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import spread
from lnocl.core.scene.scene import MIN_MODEL, Scene
from lnocl.core.scene.stars import covered_box
from lnocl.core.solvers.engine import State
from lnocl.core.solvers.scaling import Scaling

# The host waits once in so many iterations, for those before them: often enough that an interrupt
# is answered soon, seldom enough that the device never waits for the host.
ITERATIONS_AHEAD = 4
# And looks at the objectives once in so many, at those of as many before: a transfer costs the host
# as much as launching an iteration.
FETCH_EVERY = 64
# What the images hold where a pixel was not observed.
UNSEEN = -1.0
# Share of the objective that single precision may round a step's fall by: 8e-7 and less were seen.
ROUNDING = 3e-7


@guarded
class OpenCLEngine:
    """A scene on a device.

    Every estimate is convolved as soon as it is made: the host waits for sums of steps meanwhile.

    Parameters
    ----------
    scene : Scene
        The model.
    precision : {"single", "double"}
        Arithmetic.
    device : str, optional
        As for `lnocl.core.opencl.device.choose`.
    n_iter : int
        Most iterations that will be done: objectives are recorded for one more.
    tuning : Tuning, optional
        By default that of `lnocl.core.opencl.tuning.tune`.
    scaling : Scaling, optional
        For the scaled gradient projection method, whose verbs need it.
    half : {0, 1}, optional
        Which half of the counts the scene is of, where both are on the device.

    Raises
    ------
    InputError
        There is no such device, or values are too large for the precision.
    DeviceError
        There is no device, no double precision where it is asked for, or too little memory. Every
        verb raises it where the device fails, and in a process that was forked from this one.
    """

    def __init__(
        self,
        scene: Scene,
        precision: str,
        device: str | None,
        n_iter: int,
        tuning: Tuning | None = None,
        scaling: Scaling | None = None,
        half: int | None = None,
    ) -> None:
        self.name, self.bytes_needed = "the device", 0
        self._forget_record()
        choice = choose(device)
        tell(choice)
        chosen = choice.device
        self.name = describe(chosen)
        self.scene, self.scaling = scene, scaling
        self.program = Program(
            context_of(chosen),
            scene.grid,
            np.dtype(np.float64 if precision == "double" else np.float32),
            tuning,
            oversample=1 if scene.rotations else scene.oversample,
            has_mu=scene.mu > 0,
            has_smoothing=scene.is_smoothed,
            has_smoothing_map=scene.smoothing_map is not None,
            has_weights=scene.weights is not None,
            has_exposure_map=scene.has_exposure_map,
            has_background_map=has_background_map(scene),
            has_turns=bool(scene.rotations),
            min_model=MIN_MODEL,
        )
        self.rounding = ROUNDING if precision == "single" else 0.0
        self.layout = Layout(self.program)
        self._turned = self._turned_images()
        self._stars = StarWindows(
            self.layout.images,
            [[scene.star_box(j, s) for j in range(scene.n_images)] for s in range(scene.n_fluxes)],
            scene.n_images,
            self._turned.rolls if self._turned else [],
            scene.shown,
            self._spacing,
        )
        self._cross = self._cross_windows()
        sizes = buffer_sizes(scene, self.program, self.layout, self._stars, n_iter)
        if self._turned:
            sizes |= self._turned.sizes()
        if scaling is not None:
            sizes |= scaling_sizes(scene, self.program, self.layout, self._cross)
        self.bytes_needed = refuse_if_too_large(
            chosen,
            {**sizes, "scratch and roots": Launcher.bytes_needed(self.program)},
            1 if half is None else 2,
        )
        if half != 1:
            dtype, halves = self.program.dtype, half == 0
            of_device = self.bytes_needed if chosen.type & cl.device_type.CPU else 0
            announce(
                chosen,
                (1 + halves) * self.bytes_needed,
                host_bytes(scene, scaling, of_device, dtype.itemsize, halves),
                describe_tuning(chosen, dtype, self.program.tuning),
            )
        self._launcher = Launcher(self.program)
        self._queue = self._launcher.queue
        self._memory = Memory(self._queue, self.layout, scene.scale)
        self._observed: NDArray[np.bool_] | None = None
        self._star_fluxes: Array | None = None  # as they are on the device, where that is known
        self._memory.allocate(**sizes)
        self._upload_scene()
        self._bind_iteration()
        if scaling is not None:
            self._upload_scaling(scaling)

    def _turned_images(self) -> TurnedImages | None:
        rotations = self.scene.rotations
        return TurnedImages(rotations, self.program, self.layout) if rotations else None

    @property
    def _spacing(self) -> int:
        """Pixels of an image here to one of the scene's: turned images lie on pixels of the sky."""
        return self.program.image_grid[0] // self.scene.image_grid[0]

    @property
    def is_proven(self) -> bool:
        """Whether every kernel of an iteration has been launched."""
        return self._n_objectives > self._n_restored + 1

    @property
    def _observed_blocks(self) -> int:
        """Blocks of row pairs of the images' grid that hold rows of the images."""
        rows = self._spacing * self.scene.observation.shape[0]
        return -(-rows // (2 * self.program.tuning.block))

    def _cross_windows(self) -> StarWindows:
        cutouts = self.scaling.cross_information if self.scaling is not None else []
        return StarWindows(
            self.layout, [[covered_box([cutout], self.scene.grid)] for cutout in cutouts], 1
        )

    def _bind(self, name: str, **others: object) -> Launch:
        scene = self.scene
        numbers = {
            "n_images": scene.n_images,
            "n_stars": scene.n_fluxes,
            "star_blocks": self._stars.n_blocks,
            "star_columns": self._stars.n_columns,
            "cross_blocks": self._cross.n_blocks,
            "cross_columns": self._cross.n_columns,
            "mu": scene.mu,
            "smoothing": scene.smoothing,
            "edge": scene.edge,
            "iteration": 0,
            "alpha": 0.0,
            "share": 0.0,
            "image": 0,
            "first": 0,
            "image_blocks": self._observed_blocks,
        }
        return self._launcher.bind(name, {**self._memory.buffers, **numbers}, **others)

    def _bind_iteration(self) -> None:
        """Bind the kernels of an iteration, in its order."""
        self._convolve: Callable[[], object] = self._bind("convolve_columns")
        self._correlate: Callable[[], object] = self._bind("correlate_columns")
        if self.scene.transmission is not None:
            seen = TransmittedSky(self._bind, self._memory, self.scene.n_images)
            self._convolve, self._correlate = seen.convolve, seen.correlate
        if self._turned:
            self._turned.bind(self._bind, self._memory, self._queue)
        else:
            self._ratio = self._bind("ratio_rows")
        if self.scene.is_smoothed:
            self._smooth = self._bind("smooth")
        self._collect = self._bind("collect_sums")
        self._scale = self._bind("scale_rows")

    def _upload_scene(self) -> None:
        scene, memory = self.scene, self._memory
        if self._turned:
            self._turned.upload(memory)
        memory.clear("star_sums")  # in images that do not show a star they stay 0
        self.take_images()
        if scene.weights is not None and scene.has_exposure_map:
            memory.upload_pixels("exposure", self._laid(scene.weights, 0.0))
        background = scene.background()
        if background.ndim == 3:
            memory.upload_pixels("background", self._laid(background, 1.0))
        else:
            memory.upload("background", background)
        if scene.smoothing_map is not None:
            memory.upload_pixels("smoothing_map", [scene.smoothing_map])
        if scene.transmission is not None:
            memory.upload_pixels("transmission", scene.transmission)
        self._make_otfs()
        memory.upload_integers("star_corners", self._stars.corners)
        memory.upload_integers("star_near", self._stars.near)
        self.move_stars()
        if scene.weights is not None:
            self._invert(self._total_weight(scene.weights))

    def _laid(self, images: Iterable[Array], beside: float) -> Iterable[Array]:
        """Return images as they lie on the device, with a value beside their pixels."""
        laid = (spread(image, self._spacing, beside) for image in images)
        return self._turned.laid(laid) if self._turned else laid

    def take_images(self) -> None:
        """Take the images that the scene has now, all else being as it was; forget the record."""
        beside = 0.0 if self.scene.has_exposure_map else UNSEEN
        self._memory.upload_pixels("images", self._laid(self._marked_images(), beside))
        self._forget_record()

    def _forget_record(self) -> None:
        self._n_objectives = self._n_restored = 0
        self._pending_objective: Transfer | None = None
        self._n_scaled = 0
        self._last_mark: cl.Event | None = None
        self._unchecked: Transfer | None = None
        self._fetched: list[float] = []

    def _marked_images(self) -> Iterator[Array]:
        """Yield the images; `UNSEEN` is not observed, unless a map of exposures marks that."""
        weights = None if self.scene.has_exposure_map else self.scene.weights
        for j, image in enumerate(self.scene.images()):
            if weights is not None:
                image[~weights[j]] = UNSEEN
            yield image

    def set_scaling(self, scaling: Scaling) -> None:
        """Measure steps with this from now on."""
        self.scaling = scaling
        self._cross = self._cross_windows()
        self._memory.allocate(**cross_sizes(self.scene, self.program, self._cross))
        self._upload_scaling(scaling)

    def _upload_scaling(self, scaling: Scaling) -> None:
        self._memory.upload_pixels("shift", [scaling.shift])
        self._memory.upload_pixels(
            "cross_information",
            (self._cross.cut(s, 0, each) for s, each in enumerate(scaling.cross_information)),
        )
        self._memory.upload_integers("cross_corners", self._cross.corners)
        self._memory.upload_integers("cross_near", self._cross.near)
        self._gradient = self._bind("gradient_rows")
        self._step = self._bind("step_rows")

    def move_stars(self) -> None:
        """Put the stars where the scene has them now."""
        scene = self.scene
        self._memory.upload_pixels(
            "star_images",
            (
                self._stars.cut(s, j, scene.star_cutout(j, s))
                for s in range(scene.n_fluxes)
                for j in range(scene.n_images)
            ),
        )
        self._memory.upload("star_weights", scene.star_weights)

    def _make_otfs(self) -> None:
        transform = self._bind("rfft_rows", pixels=self._memory.buffers["extended"])
        otf = self._bind("otf_columns")
        for j in range(self.scene.n_images):
            self._memory.upload_pixels("extended", [self.scene.psf(j)])
            transform()
            otf.set(image=j)
            otf()

    def _total_weight(self, weights: NDArray) -> Array:
        """Return sum_j A_j^T w_j."""
        scene = self.scene
        # rfft_rows takes no images of other pixels.
        if scene.oversample > 1 or self._turned or scene.transmission is not None:
            from lnocl.core.scene.forward_model import Model  # which loads scipy

            model = Model(scene)
            return model.adjoint(model.weights)
        spectra, size = self._memory.buffers["spectra"], self.layout.spectra_bytes
        transform = self._bind("rfft_rows", pixels=self._memory.buffers["extended"])
        for j in reversed(range(len(weights))):
            if j == len(weights) - 1 or weights.strides[0]:  # else all images share them
                self._memory.upload_pixels("extended", [weights[j]])
                transform()
            if j > 0:  # the first array is where transforms come out
                cl.enqueue_copy(self._queue, spectra, spectra, byte_count=size, dst_offset=j * size)
        self._bind("correlate_columns")()
        self._bind("irfft_rows", pixels=self._memory.buffers["extended"])()
        return self.extended()

    def _invert(self, total: Array) -> None:
        """Make 1 / sum_j A_j^T w_j, 0 where nothing was observed."""
        self._observed = self.scene.observed(total)
        inverse = np.divide(1.0, total, out=np.zeros_like(total), where=self._observed)
        self._memory.upload_pixels("inverse_weight", [inverse])

    def start(self, extended: Array, star_fluxes: Array) -> None:
        """Begin from this estimate, on the grid and scaled; unobserved pixels are set to 0."""
        memory = self._memory
        if self._observed is not None:
            extended = np.where(self._observed, extended, 0.0)
        memory.upload_pixels("extended", [extended])
        self._transform_estimate()
        self.set_star_fluxes(star_fluxes)
        squares = np.zeros(memory.count("square_sums"))
        squares[0] = np.einsum("yx,yx->", extended, extended)
        memory.upload("square_sums", squares)
        if self.scaling is not None:
            memory.copy("extended", "previous")
            memory.clear("gradient")

    def ratio(self) -> None:
        """Make the ratios of the estimate; record its objective."""
        if self._turned:
            self._turned.make_ratios()
        else:
            self._ratio()
        if self.scene.is_smoothed:
            self._smooth_buffer("extended")
        self._collect.set(iteration=self._n_objectives)
        self._collect()
        self._n_objectives += 1
        # Steps are judged by it: it is sent for before the work that need not wait for it.
        self._pending_objective = None if self.scaling is None else self._fetch_objective()

    def _smooth_buffer(self, name: str) -> None:
        """Make the slope and the curvature of these pixels."""
        self._smooth.set(extended=self._memory.buffers[name])
        self._smooth()

    def correct(self) -> None:
        """Back-project the ratios to the correction."""
        self._correlate()

    def scale(self) -> None:
        """Scale the estimate by its correction; fetch the objectives of some iterations ago."""
        event = self._scale()
        self._convolve()
        self._star_fluxes = None
        self._n_scaled += 1
        if self._n_scaled % ITERATIONS_AHEAD == 0:
            if self._last_mark is not None:
                self._last_mark.wait()
            self._last_mark = event
        if self._n_scaled % FETCH_EVERY == 0:
            if self._unchecked is not None:
                self._fetched = self._unchecked.wait()[0].reshape(-1, 2).sum(axis=1).tolist()
            first = 2 * (self._n_objectives - FETCH_EVERY)
            self._unchecked = self._memory.fetch_ranges(("objectives", first, 2 * FETCH_EVERY))

    def gradient(self) -> tuple[float, float]:
        """Take the estimate for the base of steps; return ``<D y, s>`` and ``<D y, D y>``."""
        self._gradient()
        pairs = self._memory.download("change_sums", self._memory.count("change_sums"))
        change_step, change_change = pairs.reshape(-1, 2, 2).sum(axis=(0, 2))
        self._make_estimate_the_base()
        return float(change_step), float(change_change)

    def _make_estimate_the_base(self) -> None:
        """Exchange the estimate and the one before it, over which the next one is written."""
        buffers = self._memory.buffers
        self._memory.exchange("extended", "previous")
        for launch in (self._gradient, self._step):
            launch.set(extended=buffers["extended"], previous=buffers["previous"])

    def star_gradient(self) -> Array:
        """Return the gradient of the objective in the star fluxes."""
        if not self.scene.n_fluxes:
            return np.zeros(0)  # without waiting for the device
        return -self._wait_for_objective()[1]

    def step(self, alpha: float, share: float) -> tuple[float, Array]:
        """Step from the base; return ``<gradient, d>`` and ``<cross_information_s, d>``."""
        if self.scene.is_smoothed and share < 1:  # the curvature is that of a longer step by now
            self._smooth_buffer("previous")
        self._step.set(alpha=float(alpha), share=float(share))
        self._step()
        transfer = self._memory.fetch("step_sums", "coupling_sums")
        self._convolve()  # which the host need not wait for
        slope, couplings = transfer.wait()
        n = self.scene.n_fluxes
        return float(slope.sum()), couplings.reshape(n, -1).sum(axis=1) if n else np.zeros(0)

    def set_star_fluxes(self, star_fluxes: Array) -> None:
        """Make these the star fluxes."""
        self._star_fluxes = self._memory.upload("star_fluxes", star_fluxes)

    def objective(self) -> float:
        """Return the objective recorded last, scaled."""
        return self._wait_for_objective()[0]

    def _wait_for_objective(self) -> tuple[float, Array]:
        """Return the objective recorded last, and ``sum_j <P_js, r_j - w_j>``."""
        if self._pending_objective is None:
            self._pending_objective = self._fetch_objective()
        objective, stars = self._pending_objective.wait()
        star_sums = stars.reshape(-1, 2).sum(axis=1)[: self.scene.n_fluxes]
        return float(objective.sum()), star_sums

    def _fetch_objective(self) -> Transfer:
        return self._memory.fetch_ranges(
            ("objectives", 2 * (self._n_objectives - 1), 2),
            ("star_totals", 0, self._memory.count("star_totals")),
        )

    def forget_objective(self) -> None:
        """Take the objective recorded last off the record."""
        self._n_objectives -= 1
        self._pending_objective = None

    def extended(self) -> Array:
        """Return the extended source, on the grid and scaled."""
        return self._memory.download_pixels("extended")

    def star_fluxes(self) -> Array:
        """Return the star fluxes, scaled."""
        if self._star_fluxes is None:
            self._star_fluxes = self._memory.download("star_fluxes", self.scene.n_fluxes)
        return self._star_fluxes.copy()

    def data_term(self) -> float:
        """Return the data term of the objective recorded last, scaled."""
        return float(self._memory.download("data_term", 2).sum())

    def objectives(self) -> Array:
        """Return the objectives recorded so far, scaled."""
        pairs = self._memory.download("objectives", 2 * self._n_objectives)
        return pairs.reshape(-1, 2).sum(axis=1)

    def fetched_objectives(self) -> list[float]:
        """Return the objectives that `scale` has fetched since the last call, scaled."""
        fetched, self._fetched = self._fetched, []
        return fetched

    def state(self) -> State:
        """Return the arrays that `restore` needs, between iterations, as they lie on the device."""
        state = {name: self._memory.download_raw(name) for name in self._stateful}
        state["objectives"] = state["objectives"].reshape(-1, 2)[: self._n_objectives]
        state["star_fluxes"] = state["star_fluxes"][: self.scene.n_fluxes]
        return state

    @property
    def _stateful(self) -> tuple[str, ...]:
        estimate = "extended", "star_fluxes", "square_sums", "objectives"
        return estimate if self.scaling is None else (*estimate, "previous", "gradient")

    def restore(self, state: State) -> None:
        """Continue from this state."""
        self._star_fluxes = None
        for name in self._stateful:
            self._memory.upload_raw(name, state[name])
        self._transform_estimate()
        n_objectives = len(state["objectives"])
        if not self.is_proven:
            self._n_restored = n_objectives
        self._n_objectives = n_objectives

    def _transform_estimate(self) -> None:
        """Make the row spectrum of an estimate that came from the host, and convolve it."""
        self._bind("rfft_rows", pixels=self._memory.buffers["extended"])()
        self._convolve()
        self._pending_objective = None
