"""Sound files of every kind that is read, and their readers, to be given damaged ones."""

import gzip
import resource
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from scenes import make_psfs
from wcs_headers import PHYSICAL, SIP

from lnocl import checkpoint
from lnocl.io import fitsread, fitswrite, saved_results, sky, star_files
from lnocl.io.calibration import Calibration
from lnocl.io.frames import read_frames
from lnocl.simulation import load_target
from lnocl.studies import figures

SHAPE = (32, 34)
# Seconds that one file may take.
PATIENCE = 10
# Memory that all files may take together beyond what is in use.
ROOM = 2 * 2**30
RNG = np.random.default_rng(8)
COUNTS = RNG.poisson(100.0, SHAPE)


def image(path):
    header = fits.Header(SIP | PHYSICAL | {"BUNIT": "electron", "EXPTIME": 30.0})
    fits.PrimaryHDU(COUNTS.astype("i2"), header).writeto(path, checksum=True)


def telescope(path):
    """Write what telescopes leave: an empty primary HDU, image, errors and flags as extensions."""
    header = fits.Header(SIP | {"BUNIT": "electron/s", "BSCALE": 0.5, "BZERO": 3.0, "BLANK": -1})
    primary = fits.PrimaryHDU(header=fits.Header({"EXPTIME": 30.0, "STARX": 5, "STARY": 6}))
    flags = fits.ImageHDU((COUNTS > 120).astype("i2"), name="DQ")
    hdus = [primary, fits.ImageHDU(COUNTS.astype("i4"), header, name="SCI"), flags]
    fits.HDUList(hdus).writeto(path)


def psfs(path):
    fits.writeto(path, make_psfs(2, (8, 10)).astype("f4"))


def mask(path):
    fits.writeto(path, (COUNTS > 130).astype("u1"))


def star_table(path):
    table = Table({"id": ["a", "b"], "x": [3.0, 7.5], "y": [4.0, 9.25], "n": [[1, 2], [3, 4]]})
    table.write(path, format="fits")


def sky_table(path):
    Table({"ra": [248.6211, 248.6212], "dec": [70.531, 70.5311]}).write(path, format="ascii.ecsv")


def text_table(path):
    Table({"x": [3.0, 7.5], "y": [4.0, 9.25]}).write(path, format="ascii.csv")


def votable(path):
    table = Table({"x": [3.0, 7.5], "y": [4.0, 9.25]})
    table.write(path, format="votable", tabledata_format="binary")


def tiles(path):
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(COUNTS.astype("i4"))]).writeto(path)


def truth(path):
    fitswrite.write_result(path, COUNTS, [(12.0, 13.0)], [1e5], cards=[("PIXSCALE", 2.5, "")])


def result(path):
    curve = np.array(
        [(i, 0.5 / i, 0.4 / i, 12.5) for i in range(1, 9)],
        dtype=[("iteration", int), ("rho", float), ("rho_star", float), ("magnitude", float)],
    )
    history = np.array(
        [(i, 9.0 / (i + 1)) for i in range(9)], dtype=[("iteration", int), ("objective", float)]
    )
    held_out = np.array(
        [(0.1, i, 1.0 / i) for i in (1, 2, 4)],
        dtype=[("smoothing", float), ("iteration", int), ("error", float)],
    )
    fitswrite.write_result(
        path, COUNTS, [(12.0, 13.0)], [1e5],
        {"HISTORY": history, "CURVE": curve, "HELDOUT": held_out, "MODELS": COUNTS[None]},
        cards=[("MU", 0.25, ""), ("PIXSCALE", 2.5, "")],
    )  # fmt: skip


MAKERS = [
    image, telescope, psfs, mask, star_table, sky_table, text_table, votable, tiles, truth, result
]  # fmt: skip


def read_observation(sound, damaged, name):
    """Read a damaged file in the role that it has, all others being sound."""
    files = {key: str(sound[f"{key}.dat"]) for key in ("image", "psfs", "mask")}
    files[name.partition(".")[0]] = damaged
    is_telescope = "telescope" in files
    frames = read_frames(
        [files["telescope"]] * 2 if is_telescope else [files["image"], str(sound["image.dat"])],
        [files["psfs"]],
        Calibration(
            background=[files.get("tiles", "auto")],
            exposure=["EXPTIME"],
            mask=["dq" if is_telescope else files["mask"]],
            align="wcs",
        ),
    )
    fitsread.wcs_cards(frames.header)
    if sky.has_celestial(frames.header):
        sky.to_sky(np.array([(3.0, 4.0)]), frames.header)


def read_stars(sound, damaged, name):
    star_files.read_stars(damaged, fits.Header(SIP), "a.fits")


def read_scene(sound, damaged, name):
    load_target(damaged)


def read_saved(sound, damaged, name):
    saved_results.read_result(damaged)


def draw(sound, damaged, name):
    files = {"truth": str(sound["truth.dat"]), "result": str(sound["result.dat"])}
    files[name.partition(".")[0]] = damaged
    # What matplotlib says of damaged numbers; that they are damaged is said by their DATASUM.
    warnings.filterwarnings("ignore", "Data has no positive values")
    list(figures.draw(f"{damaged}.figures", list(files.values()), overwrite=True))


def read_checkpoint(sound, damaged, name):
    checkpoint.read(damaged)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Return the paths of sound files by name, among them compressed ones."""
    folder = tmp_path_factory.mktemp("sound")
    paths = {}
    for make in MAKERS:
        path = folder / f"{make.__name__}.dat"
        make(str(path))
        packed = folder / f"{make.__name__}.gz"
        packed.write_bytes(gzip.compress(path.read_bytes()))
        paths |= {path.name: path, packed.name: packed}
    return paths


class TooSlowError(BaseException):
    """A file took too long."""


def wake(number, frame):
    raise TooSlowError


@pytest.fixture
def limits():
    """Let no file take long, nor much memory."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as stream:  # pages
        used = int(stream.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, before[1]))
    handler = signal.signal(signal.SIGALRM, wake)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, handler)
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.fixture
def quick_figures(monkeypatch):
    """Draw, but do not render, which is what takes the time and knows nothing of the files."""
    monkeypatch.setattr(
        "lnocl.studies.figures.save_figure", lambda figure, path, overwrite: Path(path).touch()
    )
