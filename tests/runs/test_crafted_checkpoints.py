"""Checkpoints that someone has made up, their digest right: they are refused, or go on."""

import gzip
import random
import resource
from collections import Counter

import numpy as np
import pytest
from astropy.io import fits
from scenes import Recipe

import lnocl
from lnocl.runs import checkpoint

pytestmark = pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")

STARS = Recipe((8, 16), 2, 2, mu=1e-3, smoothing=0.01, masked=0.05, psf_shape=(3, 3))
ON_DEVICE = Recipe((16, 32), 2, 2, mu=1e-3, smoothing=0.01, masked=0.05)  # as other tests build
N_ITER = 8
# Runs that are cut off at an iteration.
KINDS = {
    "sgm": {},
    "sgp": {"solver": "sgp"},
    "refined": {"solver": "sgp", "refine_positions": True},
    "change": {"stop": 1e-9},
    "discrepancy": {"stop": "discrepancy"},
    "held-out": {"solver": "sgp", "stop": "held-out", "n_iter": 12},
    "smoothing": {"solver": "sgp", "stop": "held-out", "smoothing": "auto", "mu": 0.0},
}
NUMBERS = (
    -5, -1, 0, 1, 2, 3, 0.5, 7, 1000, 1e9, 2**31, -(2**31), 1e-300, 1e30, 1e38, 1e300, -1e300,
    np.nan, np.inf, -np.inf,
)  # fmt: skip
# Memory that all of them may take together beyond what is in use.
ROOM = 100 * 2**20
ENDED = ("", "callback", "n_iter", "converged", "change", "held-out", "interrupt", "x" * 99)


def make_saved(folder, kind, engine="numpy"):
    """Return the arguments of a run, and the checkpoint at which it was cut off."""
    recipe = STARS if engine == "numpy" else ON_DEVICE
    made, path = recipe.make(), str(folder / f"{kind}.fits")
    given = {"n_iter": N_ITER, "engine": engine} | KINDS[kind]
    made.deconvolve(**given, checkpoint=path, callback=lambda k, _: k == 4)
    return made, given, checkpoint.read(path)


@pytest.fixture(scope="module")
def all_saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved")
    return {kind: make_saved(folder, kind) for kind in KINDS}


def resume(made, given, saved, path, **changed):
    """Resume from a checkpoint with some arrays changed, or left out where they are None."""
    arrays = {name: array for name, array in (saved.arrays | changed).items() if array is not None}
    checkpoint.write(path, saved.described, saved.ended, arrays)
    return made.deconvolve(**given, resume=path)


WRONG = [
    ("progress", [-5, 8, 1], "progress holds -5, and must be from 0 to 8"),
    ("progress", [10**9, 8, 1], "progress holds 1e+09, and must be from 0 to 8"),
    ("progress", [4, 2, 1], "progress holds 2, and must be 8"),
    ("progress", None, "progress is missing"),
    ("progress", [4, 8], "progress is int64 of shape (2), and must be int64 of shape (3)"),
    ("objectives", None, "objectives is missing"),
    ("extended", np.ones((8, 8)), "extended is float64 of shape (8, 8), and must be float64 of "
     "shape (8, 16)"),
    ("extended", np.full((8, 16), np.nan), "extended holds nan, and must be from 0 to 3.40282e+38"),
    ("cross_windows", np.zeros((2, 4), np.int32), "cross_windows holds 0, and must be 2"),
    ("star_information", -np.ones((2, 2)), "star_information holds no Fisher information"),
    ("star_fluxes", np.ones(3), "star_fluxes is float64 of shape (3), and must be float64 of "
     "shape (2)"),
    ("more", np.ones(3), "more is not an array of such a run"),
]  # fmt: skip


WRONG_HALVES = [
    ("next_look", [10**9], "next_look holds 1e+09, and must be from 1 to 34"),
    ("halves_1_progress", [3, 12, 1], "halves_1_objectives is float64 of shape (5), "
     "and must be float64 of shape (3 to 4)"),
    ("snapshots_iteration", [1, 2, 4, 3], "snapshots_iteration does not lead to iteration 4"),
    ("snapshots_iteration", [1, 2], "snapshots_extended is float64 of shape (4, 2, 8, 16), and "
     "must be float64 of shape (2, 2, 8, 16)"),
    ("snapshots_extended", None, "snapshots_extended is missing"),
    ("more", np.ones(3), "more is not an array of such a run"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "name", "values", "words"),
    [*(("sgp", *each) for each in WRONG), *(("held-out", *each) for each in WRONG_HALVES)],
)
def test_the_message_says_what_is_wrong(kind, name, values, words, all_saved, tmp_path):
    path = str(tmp_path / "crafted.fits")
    values = None if values is None else np.array(values)
    with pytest.raises(lnocl.FileError) as caught:
        resume(*all_saved[kind], path, **{name: values})
    assert str(caught.value) == f"the checkpoint {path} is of no such run: {words}; start anew"


def test_nothing_is_written_on_the_device_beyond_its_buffers(tmp_path):
    run, path = make_saved(tmp_path, "sgm", "opencl"), str(tmp_path / "crafted.fits")
    assert run[2].arrays["objectives"].shape == (5, 2)
    for number in (-5, 10**9):
        with pytest.raises(lnocl.FileError, match="progress holds"):
            resume(*run, path, progress=np.array([number, 8, 1]))
    with pytest.raises(lnocl.FileError, match="objectives is float32 of shape"):
        resume(*run, path, objectives=np.ones((99, 2), np.float32))


def test_what_a_run_ended_by_is_checked(all_saved, tmp_path):
    made, given, saved = all_saved["sgp"]
    path = str(tmp_path / "crafted.fits")
    for ended in ("n_iter", "discrepancy", "lunch"):
        checkpoint.write(path, saved.described, ended, saved.arrays)
        with pytest.raises(lnocl.FileError, match=f"it ended by {ended} after 4 iterations"):
            made.deconvolve(**given, resume=path)


def large_array(hdus):
    hdus.append(fits.ImageHDU(np.zeros(2**11), name="MORE"))


def large_table(hdus):
    rows = np.array([(f"{k}", "") for k in range(200)], [("name", "U32"), ("value", "U256")])
    hdus["RUN"] = fits.BinTableHDU(rows, name="RUN")


def scaled_array(hdus):
    """One byte a number in the file, eight in memory."""
    hdus.append(fits.ImageHDU(np.zeros(4, "u1"), name="MORE"))
    hdus[-1].header["BSCALE"] = 2.5


def many_arrays(hdus):
    hdus.extend(fits.ImageHDU(np.zeros(1), name=f"MORE{k}") for k in range(200))


@pytest.mark.parametrize("pack", [bytes, gzip.compress])
@pytest.mark.parametrize("enlarge", [large_array, large_table, scaled_array, many_arrays])
def test_what_is_larger_than_the_state_of_a_run_is_not_read(
    enlarge, pack, all_saved, tmp_path, monkeypatch
):
    made, given, saved = all_saved["sgp"]
    path = tmp_path / "large.fits"
    checkpoint.write(str(path), saved.described, saved.ended, saved.arrays)
    with fits.open(path) as hdus:
        enlarge(hdus)
        hdus.writeto(path, overwrite=True)
    path.write_bytes(pack(path.read_bytes()))
    monkeypatch.setattr(checkpoint, "_digest", lambda *_: pytest.fail("read"))
    with pytest.raises(lnocl.FileError, match=r"with extension \d+, \w+, it is too large"):
        made.deconvolve(**given, resume=path)


# --- What is changed


def change_value(chance, arrays, name):
    array = arrays[name].copy()
    for _ in range(chance.choice([1, 1, 3])):
        at = chance.randrange(array.size)
        number = chance.choice([*NUMBERS, float(array.flat[at]) * chance.choice([-1, 0.9, 10])])
        array.flat[at] = np.array(number).astype(array.dtype)
    arrays[name] = array


def change_all(chance, arrays, name):
    number = np.array(chance.choice(NUMBERS)).astype(arrays[name].dtype)
    arrays[name] = chance.choice([np.full_like(arrays[name], number), arrays[name] * number])


def change_bytes(chance, arrays, name):
    content = bytearray(arrays[name].tobytes())
    for _ in range(chance.choice([1, 3, 10])):
        content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    arrays[name] = np.frombuffer(bytes(content), arrays[name].dtype).reshape(arrays[name].shape)


def change_shape(chance, arrays, name):
    array = arrays[name]
    arrays[name] = chance.choice(
        [array[:1], array[1:], array.ravel(), array[None], array[..., :1], np.array([array] * 3),
         np.concatenate([array, array]), array.T]
    )  # fmt: skip


def change_type(chance, arrays, name):
    arrays[name] = arrays[name].astype(chance.choice(["u1", "i2", "i4", "i8", "f4", "f8"]))


def leave_out(chance, arrays, name):
    del arrays[name]


def add(chance, arrays, name):
    other = chance.choice(["more", "rule", "next_look", "shift", "halves_7_x"])
    arrays[other] = arrays[name]


def exchange(chance, arrays, name):
    other = chance.choice(list(arrays))
    arrays[name], arrays[other] = arrays[other], arrays[name]


CHANGES = (
    change_value, change_value, change_all, change_bytes, change_shape, change_type, leave_out, add,
    exchange,
)  # fmt: skip


def craft(chance, saved):
    """Return what a checkpoint ended by, and its arrays, changed in one to three places."""
    arrays = dict(saved.arrays)
    with np.errstate(all="ignore"):
        for _ in range(chance.choice([1, 1, 2, 3])):
            arrays = {name: array for name, array in arrays.items() if array.size}
            small = [name for name in arrays if arrays[name].size < 20]
            chance.choice(CHANGES)(chance, arrays, chance.choice([*arrays, *small]))
    return chance.choice([saved.ended] * 9 + [chance.choice(ENDED)]), arrays


def go_on(made, given, path):
    """Resume a run; return "done", with a result of its shape, or "refused" where lnocl does."""
    try:
        result = made.deconvolve(**given, resume=path)
    except lnocl.LnoclError as error:
        return "refused" if "\n" not in str(error) else "in several lines"
    assert result.extended.shape == made.images.shape[1:]
    assert np.isfinite(result.extended).all()
    assert 0 <= result.n_iter <= given["n_iter"]
    assert len(result.history) == result.n_iter + 1
    return "done"


@pytest.fixture
def little_memory():
    with open("/proc/self/statm") as stream:  # pages
        used = int(stream.read().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + ROOM, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


@pytest.mark.usefixtures("little_memory")
@pytest.mark.parametrize("times", [1, pytest.param(10, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("kind", KINDS)
def test_crafted_checkpoints_are_refused_or_gone_on_from(kind, times, all_saved, monkeypatch):
    """Files take most of the time, and are left out."""
    made, given, saved = all_saved[kind]
    chance, outcomes = random.Random(times), Counter()
    for _ in range(times * (10 if kind == "held-out" else 40)):
        crafted = checkpoint.Checkpoint("run.fits", saved.described, *craft(chance, saved))
        monkeypatch.setattr(checkpoint, "read", lambda *_, crafted=crafted: crafted)
        outcomes[go_on(made, given, "run.fits")] += 1
    assert outcomes["refused"] > outcomes["done"]
