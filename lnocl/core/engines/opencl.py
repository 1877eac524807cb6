"""The iteration's verbs on an OpenCL device: the engine ``"opencl"``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from copy import copy
from dataclasses import replace

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from lnocl.core.engines import needs
from lnocl.core.engines.engine import State, has_weights
from lnocl.core.opencl.device import choose, context_of, describe, tell
from lnocl.core.opencl.faults import guarded
from lnocl.core.opencl.launch import Launch, Launcher
from lnocl.core.opencl.layout import Layout
from lnocl.core.opencl.memory import Memory, announce, of_all, refuse_if_too_large
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.tuning import Tuning, describe_tuning
from lnocl.core.opencl.turned import TurnedImages
from lnocl.core.opencl.windows import StarWindows
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.camera import spread
from lnocl.core.scene.scene import Scene
from lnocl.core.scene.stars import covered_box
from lnocl.core.scene.steps import STUCK, Steps
from lnocl.core.solvers.scaling import Scaling, inverse_weight

# What the images hold where a pixel was not observed.
UNSEEN = -1.0
# The prior of fluxes, and what steps leave for the next, by the names of buffers.
PRIOR = "prior_fluxes", "prior_precision"
CHANGES = "previous", "gradient", "change_sums"
# Share of the objective that single precision may round a step's fall by: 8e-7 and less were seen.
ROUNDING = 3e-7


@guarded
class OpenCLEngine:
    """A scene on a device, which takes or refuses each step by itself.

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
        For the scaled gradient projection method.
    n_members : int, optional
        Members of a batch, of which this is the first, and `member` returns the others.
    n_in_all : int, optional
        Members of all engines that the device is to hold, for which room is asked and announced; 0
        where that was done.

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
        n_members: int = 1,
        n_in_all: int = 1,
    ) -> None:
        self.name, self.bytes_needed = "the device", 0
        self._n_ticks = [0]  # which all members share
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
            has_turns=bool(scene.rotations),
        )
        self._first = Steps(rounding=ROUNDING) if precision == "single" else Steps()
        self.layout = Layout(self.program)
        turned = scene.rotations, self.program, self.layout
        self._turned = TurnedImages(*turned) if scene.rotations else None
        self._stars = StarWindows(
            self.layout.images,
            [[scene.star_box(j, s) for j in range(scene.n_images)] for s in range(scene.n_fluxes)],
            scene.n_images,
            self._turned.rolls if self._turned else [],
            scene.shown,
            self._spacing,
        )
        self._cross = self._cross_windows()
        sizes = needs.buffer_sizes(scene, self.program, self.layout, self._stars, n_iter)
        if self._turned:
            sizes |= self._turned.sizes()
        if scaling is not None:
            sizes |= needs.scaling_sizes(scene, self.program, self.layout, self._cross)
        with_launcher = of_all(sizes | Launcher.sizes(self.program), n_members)
        n_engines = n_in_all // n_members
        self.bytes_needed = refuse_if_too_large(chosen, with_launcher, n_engines)
        if n_engines:
            of_device = self.bytes_needed if chosen.type & cl.device_type.CPU else 0
            announce(
                chosen,
                n_engines * self.bytes_needed,
                needs.host_bytes(scene, scaling, of_device, self.program, n_in_all > 1),
                describe_tuning(chosen, self.program.dtype, self.program.tuning),
            )
        self._launcher = Launcher(self.program, n_members)
        self._queue = self._launcher.queue
        self._memory = Memory(self._queue, self.layout, scene.scale, n_members)
        self._observed: NDArray[np.bool_] | None = None
        self._memory.allocate(**sizes)
        # What was decided for each member, which all share; empty where that is not known.
        self._member, self._decided = 0, [Steps(going=0.0) for _ in range(n_members)]
        self._upload_scene()
        self._bind_iteration()
        if scaling is not None:
            self._upload_scaling(scaling)

    def member(self, k: int, scene: Scene) -> OpenCLEngine:
        """Return another member of the batch, whose scene differs in its images alone.

        It shares the device's ticks and all other arrays; a member that rests is left as it is.
        """
        other = copy(self)
        other.scene, other._member, other._memory = scene, k, self._memory.of(k)
        other.take_images()
        return other

    @property
    def is_proven(self) -> bool:
        """Whether every kernel of an iteration was launched before."""
        return self._n_ticks[0] > 1

    @property
    def _spacing(self) -> int:
        """Pixels of an image here to one of the scene's: turned images lie on pixels of the sky."""
        return self.program.image_grid[0] // self.scene.image_grid[0]

    def _cross_windows(self) -> StarWindows:
        cutouts = self.scaling.cross_information if self.scaling is not None else []
        boxes = [[covered_box(cutout, self.scene.grid)] for cutout in cutouts]
        return StarWindows(self.layout, boxes, 1)

    def _bind(self, name: str, **others: object) -> Launch:
        scene, rows = self.scene, self._spacing * self.scene.observation.shape[0]
        numbers = {
            "n_images": scene.n_images,
            "n_skies": scene.observation.n_skies,
            "n_stars": scene.n_fluxes,
            "star_blocks": self._stars.n_blocks,
            "star_columns": self._stars.n_columns,
            "cross_blocks": self._cross.n_blocks,
            "cross_columns": self._cross.n_columns,
            "has_transmission": int(scene.transmission is not None),
            "has_weights": int(has_weights(scene)),
            "has_background_map": int(needs.has_background_map(scene)),
            "has_exposure_map": int(scene.has_exposure_map),
            "mu": scene.mu,
            "is_smoothed": int(scene.is_smoothed),
            "has_smoothing_map": int(scene.smoothing_map is not None),
            "spectral": scene.spectral_smoothing,
            "image": 0,
            "array": 0,
            "image_blocks": -(-rows // (2 * self.program.tuning.block)),  # that hold some of these
        }
        sizes = {f"{each}_size": self._memory.count(each) for each in self._memory.buffers}
        return self._launcher.bind(name, {**self._memory.buffers, **sizes, **numbers}, **others)

    def _bind_all(self, *names: str) -> Callable[[], object]:
        """Return what launches several kernels, one after the other."""
        launches = list(map(self._bind, names))
        return lambda: [launch() for launch in launches]

    def _bind_iteration(self) -> None:
        """Bind the kernels of an iteration, in its order."""
        is_dimmed = self.scene.transmission is not None
        self._convolve = self._bind_all(*["transmit_rows"] * is_dimmed, "convolve_columns")
        self._correlate = self._bind_all("correlate_columns", *["gather_rows"] * is_dimmed)
        if self._turned:
            self._turned.bind(self._bind, self._memory, self.scene.observation.n_skies)
            self._compare: Callable[[], object] = self._turned.make_ratios
        else:
            self._compare = self._bind("ratio_rows")
        if self.scene.is_smoothed:
            self._smooth = self._bind("smooth")
        self._collect = self._bind("collect_sums")
        self._scale = self._bind("scale_rows")

    def _upload_scene(self) -> None:
        scene, memory = self.scene, self._memory
        # Members that were not started are summed up too, and images that do not show a star.
        for name in memory.buffers:
            if name == "steps" or name.endswith("_sums"):
                memory.clear(name, of_all=True)
        if self._turned:
            self._turned.upload(memory)
        self.take_images()
        has_map = scene.weights is not None and scene.has_exposure_map
        self._upload_map("exposure", np.asarray(scene.weights if has_map else [1.0]), 0.0)
        self._upload_map("background", scene.background(), 1.0)
        if scene.smoothing_map is not None:
            self._upload_skies("smoothing_map", scene.smoothing_map)
        if scene.transmission is not None:
            memory.upload_pixels("transmission", scene.transmission)
        self._set(Steps())
        self._make_otfs()
        self._set(Steps(going=0.0))
        memory.upload_raw("star_corners", self._stars.corners)
        memory.upload_raw("star_near", self._stars.near)
        self.move_stars()
        memory.upload("mixes", scene.mixes.ravel())
        for name in ("smoothing", "edge"):
            memory.upload(name, np.ravel(getattr(scene, name)))
        if has_weights(scene):
            inverse = inverse_weight(scene, self.scaling)
            self._observed = inverse > 0
            self._upload_skies("inverse_weight", inverse)
        else:
            memory.upload_points("inverse_weight", np.array([1.0 / scene.n_images]))

    def _upload_skies(self, name: str, values: Array) -> None:
        """Copy pixels of all skies to a buffer."""
        self._memory.upload_pixels(name, values.reshape(-1, *self.scene.grid))

    def _upload_map(self, name: str, values: Array, beside: float) -> None:
        """Copy images to a buffer, or a value for each."""
        if values.ndim == 3:
            self._memory.upload_pixels(name, self._laid(values, beside))
        else:
            self._memory.upload_points(name, values)

    def _laid(self, images: Iterable[Array], beside: float) -> Iterable[Array]:
        """Return images as they lie on the device, with a value beside their pixels."""
        laid = (spread(image, self._spacing, beside) for image in images)
        return self._turned.laid(laid) if self._turned else laid

    def take_images(self) -> None:
        """Take the images that the scene has now, all else being as it was."""
        self._memory.upload_pixels("images", self._laid(self._marked_images(), UNSEEN))

    def _marked_images(self) -> Iterator[Array]:
        """Yield the images, with `UNSEEN` where they were not observed."""
        weights = self.scene.weights
        for j, image in enumerate(self.scene.images()):
            if weights is not None:
                image[weights[j] == 0] = UNSEEN
            yield image

    def set_scaling(self, scaling: Scaling) -> None:
        """Measure steps with this from now on."""
        self.scaling = scaling
        self._cross = self._cross_windows()
        self._memory.allocate(**needs.cross_sizes(self.scene, self.program, self._cross))
        self._upload_scaling(scaling)

    def _upload_scaling(self, scaling: Scaling) -> None:
        self._upload_skies("shift", scaling.shift)
        self._memory.upload("flux_mixes", self.scene.flux_mixes.ravel())
        self._memory.upload_pixels(
            "cross_information",
            (self._cross.cut(s, 0, each) for s, each in enumerate(scaling.cross_information)),
        )
        self._memory.upload_raw("cross_corners", self._cross.corners)
        self._memory.upload_raw("cross_near", self._cross.near)
        inverse = scaling.star_information.solve(np.eye(self.scene.n_fluxes))
        self._memory.upload("star_inverse", inverse)
        self._gradient, self._step = self._bind("gradient_rows"), self._bind("step_rows")
        self._follow = self._bind("follow_stars")

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
        # Of the first sky of the first member, while others rest.
        transform = self._bind("rfft_rows", pixels=self._memory.buffers["extended"], n_skies=1)
        otf = self._bind("otf_columns")
        for j in range(self.scene.n_images):
            self._memory.upload_pixels("extended", [self.scene.psf(j)])
            transform()
            otf.set(image=j)
            otf()

    def start(self, extended: Array, star_fluxes: Array, recorded: int = 0) -> None:
        """Begin from this estimate, with so many objectives on the record; add its own; rest."""
        memory = self._memory
        self.finish()  # as what is launched here is launched for other members too
        if self._observed is not None:
            extended = np.where(self._observed, extended, 0.0)
        self._upload_skies("extended", extended)
        memory.upload("star_fluxes", star_fluxes)
        memory.clear("square_sums")
        rows = extended.reshape(-1, self.scene.grid[1])
        memory.upload("square_sums", np.einsum("yx,yx->", rows, rows))
        self._judge_estimate(replace(self._first, recorded=recorded))
        if self.scaling is not None:
            memory.copy("extended", "previous")
            memory.clear("gradient")
            self._correlate()
            self._gradient()
        memory.upload("steps", np.zeros(2))  # of which the first two are going and fresh

    def _judge_estimate(self, steps: Steps) -> None:
        """Make the ratios of an estimate that came from the host, and record its objective."""
        for name, values in zip(PRIOR, self.scene.prior_of_fluxes(), strict=True):
            self._memory.upload(name, values)
        self._set(steps)
        self._bind("rfft_rows", pixels=self._memory.buffers["extended"])()
        self._convolve()
        self._ratio()

    def _set(self, steps: Steps) -> None:
        if self._decided:  # else it is downloaded with those of the other members
            self._decided[self._member] = steps
        self._memory.upload_raw("steps", steps.numbers().astype(self.program.dtype))

    def _ratio(self) -> None:
        """Make the ratios of the estimate; judge its objective."""
        self._decided.clear()
        self._compare()
        if self.scene.is_smoothed:
            self._smooth()
        self._collect()

    def go_on(self, target: int, tolerance: float) -> None:
        """Let ticks go on until so many objectives are recorded, or have settled."""
        going = {"going": 1.0, "fresh": 1.0, "target": target, "tolerance": tolerance}
        self._set(replace(self.look(), **going))

    def finish(self) -> None:
        """Tick until all members of the batch rest."""
        while going := [steps for steps in self._decisions() if steps.going]:
            n_ticks = max(int(steps.target - steps.recorded) for steps in going)
            for _ in range(max(n_ticks, 1)):
                self.tick()

    def tick(self) -> None:
        """Iterate once: make a step, or one shorter than the last, which was refused."""
        self._n_ticks[0] += 1
        if self.scaling is None:
            self._correlate()
            self._scale()
            self._convolve()
            self._ratio()
            return
        self._step()
        self._follow()
        self._convolve()
        self._ratio()
        self._correlate()
        self._gradient()

    def look(self) -> Steps:
        """Return what was decided; this waits for all ticks."""
        return self._decisions()[self._member]

    def _decisions(self) -> list[Steps]:
        """Return what was decided for each member of the batch."""
        if self._decided:
            return self._decided
        n = self._memory.n_members
        numbers = self._memory.of(0).download("steps", n * needs.N_STEPS).reshape(n, -1)
        for k, each in enumerate(numbers.tolist()):
            self._decided.append(Steps(*each))
            if self._decided[k].reason == STUCK:
                self._memory.of(k).copy("previous", "extended")
                self._memory.of(k).copy("star_steps", "star_fluxes")
        return self._decided

    def extended(self) -> NDArray[np.floating]:
        """Return the extended source, on the grid and scaled, in the precision of the device."""
        pixels = self.layout.unpack_pixels(self._memory.download_raw("extended"))
        return pixels.reshape(self.scene.sky_grid)

    def star_fluxes(self) -> Array:
        """Return the star fluxes, scaled."""
        return self._memory.download("star_fluxes", self.scene.n_fluxes)

    def data_term(self) -> float:
        """Return the data term of the objective recorded last, scaled."""
        return float(self._memory.download("data_term", 2).sum())

    def objectives(self, first: int = 0) -> Array:
        """Return the objectives recorded, from one on, scaled."""
        pairs = self._memory.download("objectives", 2 * int(self.look().recorded))
        return pairs.reshape(-1, 2)[first:].sum(axis=1)

    def state(self) -> State:
        """Return the arrays that `restore` needs, between iterations, as they lie on the device."""
        recorded = int(self.look().recorded)
        state = {name: self._memory.download_raw(name) for name in self._stateful}
        state["objectives"] = state["objectives"].reshape(-1, 2)[:recorded]
        state["star_fluxes"] = state["star_fluxes"][: self.scene.n_fluxes]
        return state

    @property
    def _stateful(self) -> tuple[str, ...]:
        estimate = "extended", "star_fluxes", "square_sums", "objectives", "steps"
        return estimate if self.scaling is None else (*estimate, *CHANGES)

    def restore(self, state: State) -> None:
        """Continue from this state."""
        self.finish()
        for name in self._stateful:
            self._memory.upload_raw(name, state[name])
        if self.scaling is not None:  # where no step was left its stars are taken from there
            self._memory.upload_raw("star_steps", state["star_fluxes"])
        steps = Steps(*state["steps"].tolist())
        self._judge_estimate(Steps(recorded=steps.recorded - 1))
        # Where no step was left, the sums of the estimate are those of the step that was refused.
        self._memory.upload_raw("objectives", state["objectives"])
        self._set(steps)
