"""The work of ``lnocl devices --tune``: iterations timed with each tuning of a device."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from lnocl.core.engines.opencl import OpenCLEngine
from lnocl.core.opencl.device import choose, has_double
from lnocl.core.opencl.tuning import Tuning, candidates
from lnocl.core.scene.observation import Observation
from lnocl.core.scene.scene import Scene
from lnocl.errors import DeviceError

SIZE, N_IMAGES, TURNS, SECONDS_A_TURN = 1024, 4, 7, 0.1
MOST_A_TURN = 1000
MOST = (TURNS + 2) * MOST_A_TURN
PRECISIONS: dict[str, np.dtype[Any]] = {"single": np.dtype("f4"), "double": np.dtype("f8")}
# A tuning is taken in the place of the safe one if it takes less than this share of its time.
WORTH = 0.97


class Timed(NamedTuple):
    """A tuning, its milliseconds an iteration, and their ratio to those of the safe one."""

    tuning: Tuning
    ms: float
    ratio: float


def fastest(timed: list[Timed]) -> Tuning:
    """Return the fastest tuning, or the first where that gains less than 3 %."""
    best = min(timed, key=lambda each: each.ratio)
    return best.tuning if best.ratio < WORTH else timed[0].tuning


def measure(spec: str | None) -> Iterator[tuple[np.dtype, list[Timed]]]:
    """Yield each precision that a device has, and its tunings timed on 4 images of 1024 x 1024.

    All take turns; the ratio is the median of each turn's.
    """
    device, rng = choose(spec).device, np.random.default_rng(0)
    axis = np.arange(-32, 32) ** 2
    psf = np.exp(-(axis[:, None] + axis) / 20.0)
    observation = Observation(rng.poisson(100.0, (N_IMAGES, SIZE, SIZE)), psf, background=10.0)
    scene = Scene(observation, pad=0)
    for precision, dtype in PRECISIONS.items():
        if precision == "double" and not has_double(device):
            continue
        runs, tried = [], []
        for each in candidates(device, dtype):
            fitted = each.fit(device, dtype, scene.grid)
            try:
                runs.append(_Run(scene, precision, spec, fitted))
                tried.append(each)
            except DeviceError:  # such as too few registers for so large a group
                if not tried:
                    raise
        times = np.array([[run.time() for run in runs] for _ in range(TURNS)])
        ratios = np.median(times / times[:, :1], axis=0)
        yield dtype, list(map(Timed, tried, 1e3 * np.median(times, axis=0), ratios))


class _Run:
    def __init__(self, scene: Scene, precision: str, spec: str | None, tuning: Tuning) -> None:
        self._engine = OpenCLEngine(scene, precision, spec, MOST, tuning)
        self._engine.start(*scene.start(None, None))
        self._count = 1
        self.time()  # which compiles
        self._count = max(1, min(MOST_A_TURN, round(SECONDS_A_TURN / self.time())))

    def time(self) -> float:
        """Return the seconds of an iteration."""
        start = time.perf_counter()
        self._engine.go_on(MOST, 0.0)
        for _ in range(self._count):
            self._engine.tick()
        self._engine.look()  # which waits for them
        return (time.perf_counter() - start) / self._count
