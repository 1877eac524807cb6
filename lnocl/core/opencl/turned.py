"""Images that are turned, or have larger pixels, on the device: buffers, and kernels in order."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from lnocl.core.opencl.launch import Launch
from lnocl.core.opencl.layout import Layout
from lnocl.core.opencl.memory import OWN, Memory
from lnocl.core.opencl.program import Program
from lnocl.core.opencl.shears import Shears
from lnocl.core.scene.arrays import Array
from lnocl.core.scene.line_weights import TAPS, whole_and_weights
from lnocl.core.scene.rotation import Rotation


class TurnedImages:
    """The shears of the images of a scene, and the kernels that make their ratios.

    Parameters
    ----------
    rotations : sequence of Rotation
        Of the images.
    program : Program
        With the kernels.
    layout : Layout
        Of its arrays.

    Attributes
    ----------
    shears : list of Shears
        Of the images.
    rolls : list of ndarray of int, shape (ny,)
        By how many columns each row of an image is rotated.
    """

    def __init__(self, rotations: Sequence[Rotation], program: Program, layout: Layout) -> None:
        self._rotations, self._program, self._layout = rotations, program, layout
        self.shears = [Shears(rotation) for rotation in rotations]
        self.rolls = [each.roll for each in self.shears]
        # Lines of the tables of images of larger pixels.
        self._n_lines = sum(len(each.line_firsts) for each in self.shears)
        self._runs = self._runs_of_images()

    def _runs_of_images(self) -> list[tuple[int, int]]:
        """Return first and number of images that are launched together.

        On a CPU and where pixels are larger it is one, so that what one kernel leaves lies in the
        cache for the next; else all in a row, which keep a GPU busy.
        """
        runs = list[tuple[int, int]]()
        was_whole = False
        for j, each in enumerate(self.shears):
            is_whole = self._program.tuning.group > 1 and not len(each.line_firsts)
            if is_whole and was_whole:
                runs[-1] = runs[-1][0], runs[-1][1] + 1
            else:
                runs.append((j, 1))
            was_whole = is_whole
        return runs

    def sizes(self) -> dict[str, int]:
        """Return the bytes of the buffers, by the names that kernels have for them."""
        (ny, nx), p = self._program.grid, len(self.shears)
        item, n_lines = self._program.dtype.itemsize, self._n_lines
        one = self._program.columns_size * item
        columns = max(count for _, count in self._runs) * one
        n_phases = ny // self._program.phase_rows + self._program.phase_rows
        sizes = {
            "row_phases": p * n_phases * nx * item,
            "columns": columns,
            "ratio_columns": columns,
            "column_shifts": p * nx * 4,
            "column_weights": p * nx * TAPS * item,
            "image_weights": p * ny * TAPS * item,
        }
        if not n_lines:
            return sizes
        either = max(columns, self._layout.spectra_bytes)  # they hold spectra too
        return sizes | {
            "columns": either,
            "sampled": max(one, self._layout.spectra_bytes),
            "firsts": n_lines * 4,
            "weights": n_lines * TAPS * item,
            "still_shifts": p * nx * 4,
            "still_weights": p * nx * TAPS * item,
        }

    def upload(self, memory: Memory) -> None:
        """Put there what the kernels need of the images."""
        shears, block = self.shears, self._program.tuning.block
        phases = [self._layout.pack_phases(each) for each in self._rotations]
        memory.upload_raw("row_phases", np.array(phases))
        memory.upload_raw("column_shifts", np.array([s.column_wholes for s in shears], np.int32))
        memory.upload("column_weights", np.array([each.column_weights for each in shears]))
        weights = [each.pack_image_weights(block) for each in shears]
        memory.upload("image_weights", np.array(weights))
        memory.clear("ratio_columns", of_all=True)  # so it stays in blocks without observed rows
        if self._n_lines:
            memory.upload_raw("firsts", np.concatenate([each.line_firsts for each in shears]))
            memory.upload("weights", np.concatenate([each.line_weights for each in shears]))
            shifts, still = whole_and_weights(np.zeros(len(shears) * self._program.grid[1]))
            memory.upload_raw("still_shifts", (shifts + 1 - TAPS // 2).astype(np.int32))
            memory.upload("still_weights", still)

    def laid(self, images: Iterable[Array]) -> Iterator[Array]:
        """Yield images as they lie on the device: each row rotated by whole pixels."""
        for shears, image in zip(self.shears, images, strict=True):
            yield shears.lay(image)

    def bind(self, bind: Callable[..., Launch], memory: Memory, n_skies: int) -> None:
        """Bind the kernels; `bind` does so by a kernel's name to what all images share."""
        self._memory, self._first = memory, n_skies - 1  # the spectra of image 0
        self._kernels = {
            name: bind(name, count=max(count for _, count in self._runs))
            for name in ("irfft_sheared", "ratio_sheared", "rfft_sheared")
        }
        if self._n_lines:
            self._kernels["unshear_columns"] = bind("unshear_columns")
            spectra, columns = self._layout.spectra_shape, self._layout.columns_shape
            ny, nx = self._program.grid
            self._rows, self._columns = self._lines(spectra, ny), self._lines(columns, nx)
            places = dict.fromkeys(("given_size", "table", "array", "to"), 0)
            given = memory.buffers["spectra"]
            self._kernels["sample_lines"] = bind(
                "sample_lines", given=given, **places, **self._columns
            )

    def _lines(self, shape: tuple[int, ...], n: int) -> dict[str, int]:
        """Return what `sample_lines` takes for n lines a part of arrays [parts][stride][2][..]."""
        parts, stride, *rest = shape
        length = math.prod(rest) // self._program.tuning.lanes
        return {"parts": parts, "lines": n, "stride": stride, "length": length}

    def make_ratios(self) -> None:
        """Make the ratios of all images."""
        table = 0
        for image, count in self._runs:
            if n_lines := len(self.shears[image].line_firsts):
                self._make_sampled(image, table)
                table += n_lines
                continue
            images, array = {"image": image, "count": count}, self._first + image
            self._launch("irfft_sheared", spectra="spectra", array=array, count=count)
            self._launch("ratio_sheared", columns="columns", **images)
            self._launch(
                "rfft_sheared",
                spectra="spectra",
                array=array,
                ratio_columns="ratio_columns",
                column_shifts="column_shifts",
                column_weights="column_weights",
                **images,
            )

    def _make_sampled(self, image: int, table: int) -> None:
        """Make the ratio of an image of larger pixels, whose tables begin at a line."""
        (ny, nx), rows, columns = self._program.grid, self._rows, self._columns
        back = table + ny + nx
        self._sample("spectra", table, rows, array=self._first + image)
        self._launch("irfft_sheared", spectra="sampled", array=0, count=1)
        self._sample("columns", table + ny, columns)
        self._launch("ratio_sheared", columns="sampled", image=image, count=1)
        self._launch("unshear_columns", image=image)
        self._sample("columns", back + ny, columns)
        self._launch(
            "rfft_sheared",
            spectra="columns",
            ratio_columns="sampled",
            column_shifts="still_shifts",
            column_weights="still_weights",
            image=0,
            array=0,
            count=1,
        )
        self._sample("columns", back, rows, sampled="spectra", to=self._first + image)

    def _sample(self, given: str, table: int, lines: dict[str, int], **other: str | int) -> None:
        """Take lines of an array in a buffer into another, by the table that begins at a line."""
        places = {"array": 0, "sampled": "sampled", "to": 0, **other}
        self._launch("sample_lines", given=given, table=table, **places, **lines)

    def _launch(self, name: str, **arguments: str | int) -> None:
        """Launch a kernel with other arguments, buffers by their names."""
        memory, kernel = self._memory, self._kernels[name]
        buffers = {k: v for k, v in arguments.items() if isinstance(v, str)}
        sizes = {f"{k}_size": memory.count(v) for k, v in buffers.items() if v in OWN}
        kernel.set(**arguments | {k: memory.buffers[v] for k, v in buffers.items()} | sizes)
        kernel()
