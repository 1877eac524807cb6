"""The demo: the paper's experiment is reconstructed by two methods, compared and drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from lnocl import metrics
from lnocl.errors import LnoclError
from lnocl.io.saved_results import read_result
from lnocl.plotting.beside import draw_beside
from lnocl.plotting.figure import check_matplotlib
from lnocl.studies.figures import save, view_of
from lnocl.studies.files import path_in

SCENE = "hh34"
# The paper's iteration. At 256 x 256 and seed 0, rho'' of MC-RL is 6.6 % at mu 0, 1e-8 and 3e-8,
# 8.3 % at 1e-7 and 14 % at 3e-7; its rho' is smallest after 2300 iterations.
N_ITER = 2000
PAPER = ("--solver", "sgm", "--stop", "none", "--smoothing", "0")
METHODS = {"RLM": "0", "MC-RL": "3e-8"}


def commands(folder: str, words: list[str]) -> Iterator[list[str]]:
    """Yield the commands of the two methods: the star in the image, and as a component.

    Parameters
    ----------
    folder : str
        Folder of the results.
    words : list of str
        Those of `lnocl.studies.files.write_simulation`, of a scene with one star.
    """
    at = words.index("--star")
    for method, mu in METHODS.items():
        star = [] if method == "RLM" else words[at : at + 2]
        more = ["--mu", mu, "--n-iter", str(N_ITER), *PAPER, "--residuals"]
        yield [*words[:at], *star, *words[at + 2 : -1], path_in(folder, method.lower()), *more]


def compare(folder: str, overwrite: bool) -> Iterator[str]:
    """Yield a table of the errors of both methods, and draw ``demo.png`` in the folder.

    Raises
    ------
    FileError
        A file of the folder cannot be read, or the picture written.
    """
    truth = read_result(path_in(folder, "truth"))
    found = {method: read_result(path_in(folder, method.lower())) for method in METHODS}
    ((x, y),) = truth.stars
    star = round(x), round(y)
    rows = metrics.star_rows(star, truth.extended.shape)
    near = {}
    yield f"{'method':<6} {'rho':>8}' {'rho':>7}'' {'star':>9}"
    for method, each in found.items():
        rho, near[method] = (
            metrics.restoration_error(
                each.extended, truth.extended, where, None if each.stars else star
            )
            for where in (None, rows)
        )
        flux = f"{each.star_fluxes[0] / truth.star_fluxes[0] - 1.0:+.2%}" if each.stars else ""
        yield f"{method:<6} {rho:>9.2%} {near[method]:>9.2%} {flux:>9}"
    yield (
        "rho' is the error of the whole jet, rho'' of the 24 rows around the star; star is the "
        "error of its flux"
    )
    rlm, mc_rl = near.values()
    yield f"near the star the error of MC-RL is {rlm / mc_rl:.1f} times smaller than that of RLM"
    try:
        check_matplotlib()
    except LnoclError as error:
        yield f"no picture: {error}"
        return
    view = view_of(found["MC-RL"])
    shown = {
        "truth": truth.extended,
        "one of the images, sky subtracted": view.images[0] - found["MC-RL"].number("BKG1"),
        **{f"{method}, error {near[method]:.0%}": each.extended for method, each in found.items()},
    }
    views = {name: replace(view, extended=each) for name, each in shown.items()}
    yield save(folder, "demo", draw_beside(views), overwrite)
