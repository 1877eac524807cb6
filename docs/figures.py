"""Make the figures of the pages again.

``python docs/figures.py`` lists them; ``python docs/figures.py NAME ...`` makes some, and ``all``
makes all. DATA, by ``--data``, is the folder of the real frames (examples/real/DATA.md).
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

DOCS = Path(__file__).parent
ROOT = DOCS.parent


class Recipe(NamedTuple):
    """How figures are made.

    Attributes
    ----------
    time : str
        About how long it takes on two cores.
    command : str
        For bash, in the root of the repository, $ROOT; it writes to $OUT, and reads $DATA.
    figures : dict of str to str
        The file in $OUT of each figure in docs/.
    """

    time: str
    command: str
    figures: dict[str, str]


def same(folder: str, names: str, prefix: str = "") -> dict[str, str]:
    """Return figures whose files have their names but for a prefix."""
    return {f"{folder}/{prefix}{name}.png": f"{name}.png" for name in names.split()}


RECIPES = {
    "demo": Recipe(
        "1 min",
        "lnocl demo -o $OUT/demo && python docs/demo.py $OUT/demo $OUT/demo.png",
        {"demo.png": "demo.png"},
    ),
    "first": Recipe("5 s", "python docs/first.py $OUT/first.png", same("start", "first")),
    "symptoms": Recipe(
        "30 s",
        "python docs/symptoms.py $OUT",
        same("guide/symptoms", "rings dipole hole spots halo level grain checkerboard"),
    ),
    "look": Recipe(
        "1 min",
        # By relative names, which the reports show.
        "ln -s $DATA $OUT/data && cd $OUT && sh $ROOT/examples/real/look.sh data .",
        same("start/look", "galactic_centre lensed_quasar quasar_host stars")
        | {
            f"start/look/{name}.html": f"{name}.html"
            for name in ("galactic_centre", "lensed_quasar", "quasar_host")
        },
    ),
    "experiment": Recipe(
        "2 h",
        "python benchmarks/hh34_table.py --mu 8e-8 1e-6 -o $OUT",
        same("validation", "objects errors", "hh34_"),
    ),
    "narrow_band": Recipe(
        "5 min",
        "python examples/real/narrow_band.py $DATA/not-nebula-ou5 "
        "--picture $OUT/real_narrow_band.png",
        same("validation", "real_narrow_band"),
    ),
    "psf_lbti": Recipe(
        "10 s",
        "python examples/real/psf_lbti.py $DATA/lbti-fizeau-altair/lm_180507_009030.fits "
        "-o $OUT/psf_lbti.png",
        same("validation", "psf_lbti"),
    ),
    "scales": Recipe(
        "3 min",
        "python examples/real/scales.py $DATA/hst-hsc-cosmos --field 1 --picture $OUT/scales.png",
        {"validation/scales.png": "scales.png"},
    ),
    "ranks": Recipe(
        "10 h",
        "python benchmarks/coverage.py --seeds 2000 2024 --output $OUT && "
        "python benchmarks/coverage.py --report --output $OUT",
        {"validation/ranks.png": "ranks.png"},
    ),
    "bands": Recipe(
        "20 min",
        "python benchmarks/bands.py --size 512 --output $OUT",
        {"validation/bands.png": "bands-512.png"},
    ),
    "edges": Recipe(
        "5 min",
        "python benchmarks/frames.py edges --output $OUT/frames --figure $OUT/edges.png",
        same("validation", "edges"),
    ),
    "positions": Recipe(
        "10 s",
        "python benchmarks/positions.py figure --output benchmarks/results/positions && "
        "cp docs/validation/positions.png $OUT",
        same("validation", "positions"),
    ),
    "trade": Recipe(
        "10 min",
        "python benchmarks/trade.py --output $OUT/trade",
        same("validation", "trade"),
    ),
    "psf_wrong": Recipe(
        "5 min",
        "python benchmarks/wrong.py images --output $OUT/psf_wrong",
        same("validation", "psf_wrong"),
    ),
    **{
        name: Recipe(
            "1 min", f"sh examples/real/{name}.sh $DATA $OUT", same("validation", name, "real_")
        )
        for name in ("lensed_quasar", "chandra_pair", "chandra_point", "quasar_host", "spitzer")
    },
    "studies": Recipe(
        "5 h",
        "bash benchmarks/studies.sh $OUT",
        {
            f"validation/study_{name}.png": f"study-{name}.png"
            for name in ("contrast", "position", "psf", "images")
        },
    ),
    "precision": Recipe(
        "2 h",
        "python benchmarks/precision.py --output $OUT/precision",
        {"../benchmarks/results/precision.png": "precision.png"},
    ),
    "speed": Recipe(
        "1 h",
        "python benchmarks/iteration.py --output $OUT/pocl-3.0",
        {"../benchmarks/results/pocl-3.0.png": "pocl-3.0.png"},
    ),
}


def make(recipe: Recipe, data: str) -> None:
    """Run a recipe, and put its figures where the pages have them."""
    with tempfile.TemporaryDirectory() as out:
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        environment = os.environ | {
            "OUT": out,
            "DATA": data,
            "ROOT": str(ROOT),
            "MPLBACKEND": "Agg",
            "PATH": path,
        }
        subprocess.run(["bash", "-euc", recipe.command], cwd=ROOT, env=environment, check=True)
        for figure, made in recipe.figures.items():
            shutil.copyfile(Path(out, made), DOCS / figure)


def main() -> None:
    """Read the command line, and make what it names."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--data", default="examples/real/data")
    given = parser.parse_args()
    if not given.names:
        for name, recipe in RECIPES.items():
            print(f"{name:14s} {recipe.time:8s} {recipe.command}")
    if unknown := set(given.names) - {"all", *RECIPES}:
        parser.error(
            f"there is no recipe {', '.join(sorted(unknown))}; without a name all are listed"
        )
    for name in RECIPES if "all" in given.names else given.names:
        make(RECIPES[name], os.path.abspath(given.data))


if __name__ == "__main__":
    main()
