"""A transmission of the sky before the PSF on the device: each image then has a sky of its own."""

from __future__ import annotations

from collections.abc import Callable

from lnocl.core.opencl.launch import Launch


class TransmittedSky:
    """The kernels that convolve, and correlate, the sky of each image by itself.

    Parameters
    ----------
    bind : callable
        Binds a kernel by its name, and arguments that are not shared.
    n_images : int
        Images.
    """

    def __init__(self, bind: Callable[..., Launch], n_images: int) -> None:
        self._n_images = n_images
        self._transmit, self._gather = bind("transmit_rows"), bind("gather_rows")
        self._convolve, self._correlate = (
            bind(f"{name}_columns", n_images=1) for name in ("convolve", "correlate")
        )

    def convolve(self) -> None:
        """Make the row spectra of the ``A_j t_j f`` from the estimate."""
        self._transmit()
        self._each(self._convolve)

    def correlate(self) -> None:
        """Make the row spectrum of ``sum_j t_j A_j^T x_j`` from those of the x_j."""
        self._each(self._correlate)
        self._gather()

    def _each(self, launch: Launch) -> None:
        for j in range(self._n_images):
            launch.set(first=j)
            launch()
