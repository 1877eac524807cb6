"""Runs that were cut off go on as if they had not been, from nothing but their own checkpoints."""

import os
import random
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from scenes import ENGINES, FEWER_ENGINES, Recipe, make_smooth_psfs, paper

import lnocl
from lnocl import checkpoint
from lnocl.core.engines.numpy import ReferenceEngine
from lnocl.core.runs.run import FIRST_REFINED, Run

STARS = Recipe((16, 32), 2, 2, mu=1e-3, smoothing=0.01, masked=0.05)
NO_STAR = Recipe((16, 32), 1)
# Recipe and further arguments of each kind of run that remembers something else.
KINDS = {
    "stars, penalties": (STARS, {}),
    "no star": (NO_STAR, {}),
    "refined": (STARS, {"refine_positions": True}),
    "change": (STARS, {"stop": 3e-4}),
    "discrepancy": (STARS, {"stop": "discrepancy"}),
    "held-out": (STARS, {"stop": "held-out", "smoothing": "auto"}),
    "held-out, no star": (NO_STAR, {"stop": "held-out", "smoothing": "auto"}),
    "held-out, refined": (
        STARS,
        {"stop": "held-out", "smoothing": "auto", "refine_positions": True},
    ),
}
# Those that CI alone tests: what is the same for both solvers, and the slowest.
RARE = [("sgm", kind) for kind in ("refined", "change", "discrepancy", "held-out")]
RARE += [("sgm", "held-out, no star"), ("sgm", "held-out, refined"), ("sgp", "held-out, refined")]
RUNS = [
    pytest.param(
        solver,
        kind,
        *engine.values,
        id=f"{solver}-{kind}-{engine.id}",
        marks=[pytest.mark.exhaustive] if (solver, kind) in RARE else [],
    )
    for solver in ("sgm", "sgp")
    for kind in KINDS
    for engine in ENGINES
    if engine.id == "numpy" or (kind == "stars, penalties" and "single" in engine.id)
]


def assert_same(found, expected):
    for name in ("extended", "star_fluxes", "star_positions", "history", "held_out"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.stop_reason == expected.stop_reason
    assert (found.mu, found.smoothing) == (expected.mu, expected.smoothing)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize(("solver", "kind", "engine"), RUNS)
def test_resumed_run_is_bit_identical_to_an_uninterrupted_run(solver, kind, engine, tmp_path):
    recipe, more = KINDS[kind]
    made, path = recipe.make(), str(tmp_path / "run.fits")
    given = {"solver": solver, "n_iter": 30, **engine, **more}
    whole = made.deconvolve(**given)
    cuts = [k for k in (1, 3, 10) if k < whole.n_iter]
    assert len(cuts) >= 2
    for cut in cuts:
        made.deconvolve(**given, checkpoint=path, callback=lambda k, _, cut=cut: k == cut)
        assert_same(made.deconvolve(**given, resume=path), whole)
        os.remove(path)


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_a_run_that_had_ended_is_as_it_was(solver, tmp_path):
    made, path = STARS.make(), str(tmp_path / "run.fits")
    given = {"solver": solver, "n_iter": 400, "stop": 1e-3, "engine": "numpy"}
    whole = made.deconvolve(**given, checkpoint=path)
    assert whole.stop_reason == "change"
    again = made.deconvolve(**given, resume=path, callback=lambda *_: pytest.fail("iterated"))
    assert_same(again, whole)


@pytest.mark.parametrize("engine", ["numpy", "opencl"])
@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_checkpoints_do_not_change_the_run(solver, engine, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    made, path = STARS.make(), tmp_path / "run.fits"
    given = {"solver": solver, "n_iter": 9, "engine": engine}
    assert_same(made.deconvolve(**given, checkpoint=path), made.deconvolve(**given))


@pytest.mark.exhaustive
def test_a_run_cut_off_where_no_step_was_left_for_the_stars_as_they_were_goes_on(
    tmp_path, monkeypatch
):
    """They are moved, and steps are left again."""
    refined = []
    genuine = Run._refine

    def refine(run):
        refined.append(run.done)
        genuine(run)

    monkeypatch.setattr(Run, "_refine", refine)
    (psf,), path = make_smooth_psfs(1, (16, 16)), str(tmp_path / "run.fits")
    sky = 20.0 + 9000.0 * np.roll(psf / psf.sum(), (-1, 0), (0, 1))
    images = np.random.default_rng(1).poisson(sky, (2, 16, 16))
    observation = lnocl.Observation(images, psf, background=5.0)
    given = {"observation": observation, "stars": [(8.4, 7.3)], "n_iter": 400, "mu": 1e-2}
    given |= {"solver": "sgp", "refine_positions": True, "engine": "numpy"}
    whole = paper(**given)
    early = [k for k in refined if k not in (FIRST_REFINED * 2**n for n in range(9))]
    assert early
    for cut in (early[0], early[-1]):
        paper(**given, checkpoint=path, callback=lambda k, _, cut=cut: k == cut)
        assert_same(paper(**given, resume=path), whole)
        os.remove(path)


@pytest.mark.parametrize("engine", FEWER_ENGINES[:2])
def test_a_run_that_has_converged_is_resumed_as_it_is(engine, tmp_path):
    """No step was left: the device has taken its stars back to where they were before."""
    y, x = np.indices((16, 16))
    paths = [str(tmp_path / name) for name in ("a.fits", "b.fits")]
    stars, fluxes = [(5.2, 6.1), (10.2, 9.1)], (3000.0, 1000.0)

    def blurred(x, y):
        return np.exp(-(x**2 + y**2 + 0.3 * x * y) / 3.0)

    image = 30.0 + sum(f * blurred(x - a, y - b) for (a, b), f in zip(stars, fluxes, strict=True))
    psf = blurred(x[:7, :7] - 3, y[:7, :7] - 3)
    observation = lnocl.Observation(np.random.default_rng(2).poisson(image), psf, background=30.0)
    given = {"observation": observation, "stars": stars, "n_iter": 3000, "mu": 1e-2}
    given |= {"solver": "sgp", "pad": 4, **engine}
    whole = paper(**given, checkpoint=paths[0])
    assert whole.stop_reason == "converged"
    assert_same(paper(**given, resume=paths[0], checkpoint=paths[1]), whole)
    assert_same(paper(**given, resume=paths[1]), whole)


def test_a_callback_that_ends_a_run_where_it_ends_anyway_is_not_heeded(tmp_path):
    made, path = STARS.make(), str(tmp_path / "run.fits")
    given = {"n_iter": 400, "stop": 1e-3, "engine": "numpy"}
    whole = made.deconvolve(**given)
    assert whole.stop_reason == "change"
    cut = made.deconvolve(**given, checkpoint=path, callback=lambda k, _: k == whole.n_iter)
    assert_same(cut, whole)
    assert_same(made.deconvolve(**given, resume=path), whole)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.exhaustive
@pytest.mark.parametrize("engine", ["numpy", "opencl"])
def test_held_out_counts_go_on_from_their_last_checkpoint(engine, tmp_path, monkeypatch):
    """And those that had ended do not iterate again."""
    made, path = STARS.make(), str(tmp_path / "run.fits")
    given = {"n_iter": 40, "engine": engine, "solver": "sgp", "stop": "held-out", "mu": 0.0}
    given |= {"smoothing": "auto", "checkpoint": path}
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    written, iterated, cut = [], [], 0
    genuine = checkpoint.write

    def write(*arguments):
        genuine(*arguments)
        written.append(arguments[2])
        if len(written) == cut:
            raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint, "write", write)
    whole = made.deconvolve(**given, callback=lambda k, _: iterated.append(k))
    assert set(written[:-1]) == {""}
    assert written[-1] == "held-out"
    all_iterated, n_iter = iterated.copy(), len(iterated)
    for cut in (1, n_iter // 2, len(written) - 1):
        os.remove(path)
        written.clear()
        with pytest.raises(KeyboardInterrupt):
            made.deconvolve(**given, callback=lambda *_: None)
        iterated.clear()
        found = made.deconvolve(**given, resume=path, callback=lambda k, _: iterated.append(k))
        assert_same(found, whole)
        assert iterated == all_iterated[n_iter - len(iterated) :]
        assert len(iterated) <= n_iter - cut
    iterated.clear()
    assert_same(
        made.deconvolve(**given, resume=path, callback=lambda k, _: iterated.append(k)), whole
    )
    assert iterated == []


@pytest.mark.parametrize(
    ("every", "times"), [(0.0, 6), (1e9, 2)], ids=["after each iteration and the end", "seldom"]
)
def test_they_are_written_first_then_when_it_is_time_and_at_the_end(
    every, times, tmp_path, monkeypatch
):
    written = []
    monkeypatch.setattr(checkpoint, "write", lambda *given: written.append(given))
    monkeypatch.setattr(checkpoint, "EVERY", every)
    given = {"n_iter": 5, "engine": "numpy", "checkpoint": str(tmp_path / "run.fits")}
    STARS.make().deconvolve(**given, callback=lambda *_: None)
    assert len(written) == times
    assert [ended for _, _, ended, *_ in written] == [""] * (times - 1) + ["n_iter"]


# --- What is refused

CHANGES = {
    "images": lambda made: {"observation": made.observation(images=made.images + 1.0)},
    "psfs": lambda made: {"observation": made.observation(psfs=made.psfs + 1e-3)},
    "background": lambda made: {"observation": made.observation(background=8.5)},
    "mask": lambda made: {"observation": made.observation(mask=None)},
    "exposure": lambda made: {"observation": made.observation(exposure=2.0)},
    "psf_scatter": lambda made: {"observation": made.observation(psf_scatter=made.psfs)},
    "offsets": lambda made: {"observation": made.observation(offsets=[(0, 0), (1, 0)])},
    "stars": lambda made: {"stars": made.stars[::-1]},
    "mu": lambda made: {"mu": 1.0000001e-3},
    "smoothing": lambda made: {"smoothing": 0.02},
    "solver": lambda made: {"solver": "sgp"},
    "n_iter": lambda made: {"n_iter": 7},
    "stop": lambda made: {"stop": "discrepancy"},
    "pad": lambda made: {"pad": 1},
    "precision": lambda made: {"precision": "double"},
    "engine": lambda made: {"engine": "opencl"},
    "refine_positions": lambda made: {"refine_positions": True},
    "initial_extended": lambda made: {"initial_extended": None},
    "initial_star_fluxes": lambda made: {"initial_star_fluxes": None},
}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = str(tmp_path_factory.mktemp("saved") / "run.fits")
    STARS.make().deconvolve(n_iter=6, engine="numpy", checkpoint=path)
    return path


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize("name", CHANGES)
def test_a_checkpoint_of_another_run_is_refused(name, saved):
    made = STARS.make()
    changed = {"n_iter": 6, "engine": "numpy", "resume": saved} | CHANGES[name](made)
    with pytest.raises(lnocl.InputError, match=rf"is of another run: .*\b{name}\b.* differ"):
        made.deconvolve(**changed)


def test_another_device_version_or_tuning_is_refused(saved, tmp_path):
    found = checkpoint.read(saved)
    for name, words in {
        "device": "of another run: device differs; repeat",
        "version": "of another run: version differs; repeat",
        "tuning": "of a run before lnocl devices --tune, which has",
    }.items():
        path = str(tmp_path / f"{name}.fits")
        checkpoint.write(path, found.described | {name: "'other'"}, found.ended, found.arrays)
        if name == "version":
            fits.setval(path, "DIGEST", value="made otherwise")
        with pytest.raises(lnocl.InputError, match=words):
            STARS.make().deconvolve(n_iter=6, engine="numpy", resume=path)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize("share", [6, pytest.param(1, marks=pytest.mark.exhaustive)])
def test_nothing_truncated_or_altered_is_gone_on_from(share, saved, tmp_path):
    """At every place, or at one in so many."""
    whole = Path(saved).read_bytes()
    path = tmp_path / "damaged.fits"
    sound, refused, rng = checkpoint.read(saved), 0, random.Random(1)
    for length in range(0, len(whole) - 2880, 1441 * share):
        path.write_bytes(whole[:length])
        with pytest.raises(lnocl.FileError):
            checkpoint.read(str(path))
    for at in rng.sample(range(len(whole)), 300 // share):
        flipped = bytearray(whole)
        flipped[at] ^= 1 << rng.randrange(7)
        path.write_bytes(flipped)
        try:
            read = checkpoint.read(str(path))
        except lnocl.FileError:
            refused += 1
            continue
        if read.described["version"] != sound.described["version"]:
            refused += 1  # as that of another version
            continue
        # A comment, or padding.
        assert (read.described, read.ended) == (sound.described, sound.ended)
        for name, array in sound.arrays.items():
            np.testing.assert_array_equal(read.arrays[name], array)
    assert refused > 50 / share


@pytest.mark.parametrize(
    "content", [b"", b"SIMPLE", b"\x80\x04pickle"], ids=["empty", "cut", "other"]
)
def test_invalid_checkpoint_is_refused(content, tmp_path):
    path = tmp_path / "other.fits"
    path.write_bytes(content)
    with pytest.raises(lnocl.FileError, match="is not a checkpoint, or a damaged one"):
        checkpoint.read(str(path))
    fits.writeto(path, np.ones((4, 4)), overwrite=True)
    with pytest.raises(lnocl.FileError, match="is not a checkpoint, or a damaged one"):
        checkpoint.read(str(path))


@pytest.mark.parametrize(
    ("name", "array"),
    [("extended", np.ones((8, 8))), ("steps", np.ones(4, "f4")), ("objectives", None)],
)
def test_arrays_that_are_not_like_those_of_the_run_are_refused(name, array, saved, tmp_path):
    found, path = checkpoint.read(saved), str(tmp_path / "other.fits")
    arrays = {key: value for key, value in found.arrays.items() if key != name}
    arrays |= {} if array is None else {name: array}
    checkpoint.write(path, found.described, found.ended, arrays)
    with pytest.raises(lnocl.FileError, match=f"is of no such run, by its array {name}; start"):
        STARS.make().deconvolve(n_iter=6, engine="numpy", resume=path)


def test_the_checkpoint_of_another_run_is_not_replaced(saved):
    before = Path(saved).read_bytes()
    with pytest.raises(lnocl.FileError, match="exists; resume from it, or remove it"):
        STARS.make().deconvolve(n_iter=6, engine="numpy", checkpoint=saved)
    assert Path(saved).read_bytes() == before


def test_the_checkpoint_of_a_run_that_began_meanwhile_is_not_replaced(tmp_path):
    made, path = STARS.make(), tmp_path / "run.fits"
    given = {"engine": "numpy", "checkpoint": path}

    def other(iteration, estimate):
        made.deconvolve(n_iter=4, **given)

    with pytest.raises(lnocl.FileError, match=r"the checkpoint .* exists"):
        made.deconvolve(n_iter=7, callback=other, **given)
    assert checkpoint.read(str(path)).arrays["progress"][0] == 4


def test_a_checkpoint_stays_in_its_folder_wherever_the_process_goes(tmp_path, monkeypatch):
    there, elsewhere = tmp_path / "there", tmp_path / "elsewhere"
    for folder in (there, elsewhere):
        folder.mkdir()
    (elsewhere / "run.fits").write_text("of somebody else")
    monkeypatch.chdir(there)
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    given = {"n_iter": 3, "engine": "numpy", "checkpoint": "run.fits"}
    STARS.make().deconvolve(**given, callback=lambda *_: os.chdir(elsewhere))
    assert (elsewhere / "run.fits").read_text() == "of somebody else"
    assert checkpoint.read(str(there / "run.fits")).arrays["progress"][0] == 3


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_finished_run_is_copied_to_another_checkpoint(solver, tmp_path):
    made, first, second = STARS.make(), tmp_path / "first.fits", tmp_path / "second.fits"
    given = {"n_iter": 3, "engine": "numpy", "solver": solver}
    whole = made.deconvolve(**given, checkpoint=first)
    assert_same(made.deconvolve(**given, resume=first, checkpoint=second), whole)
    assert_same(made.deconvolve(**given, resume=second, checkpoint=second), whole)
    assert checkpoint.read(str(second)).ended == "n_iter"


@pytest.mark.parametrize("name", ["a\0b.fits", "\ud800.fits", "folder/run.fits", ""])
def test_names_that_files_cannot_have_are_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for keyword in ("checkpoint", "resume"):
        with pytest.raises(lnocl.FileError):
            STARS.make().deconvolve(n_iter=1, engine="numpy", **{keyword: name})


def test_a_link_to_nothing_takes_no_name(saved, tmp_path):
    link = tmp_path / "link.fits"
    link.symlink_to("nothing.fits")
    with pytest.raises(lnocl.FileError, match="exists; resume from it, or remove it"):
        STARS.make().deconvolve(n_iter=6, engine="numpy", resume=saved, checkpoint=link)


def test_any_letters_may_name_a_device(tmp_path, monkeypatch):
    monkeypatch.setattr(ReferenceEngine, "name", "Größe ®")
    made, path = STARS.make(), tmp_path / "run.fits"
    given = {"n_iter": 3, "engine": "numpy"}
    whole = made.deconvolve(**given, checkpoint=path)
    assert_same(made.deconvolve(**given, resume=path), whole)


def test_numbers_of_any_kind_are_the_same_parameters(tmp_path):
    made, path = STARS.make(), tmp_path / "run.fits"
    given = {"n_iter": 3, "engine": "numpy"}
    whole = made.deconvolve(**given, mu=np.float64(0.5), checkpoint=path)
    again = {"n_iter": np.int64(3), "engine": "numpy", "mu": np.float32(0.5)}
    assert_same(made.deconvolve(**again, resume=path), whole)


@pytest.mark.parametrize("written", [0, 2], ids=["first", "later"])
def test_a_full_disk_stops_no_run_that_has_come_far(written, tmp_path, monkeypatch):
    path = str(tmp_path / "run.fits")
    genuine, count = checkpoint.write, []

    def fills_up(*given):
        if len(count) == written:
            raise lnocl.FileError(f"{path} cannot be written: No space left on device")
        count.append(1)
        genuine(*given)

    monkeypatch.setattr(checkpoint, "write", fills_up)
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    given = {"n_iter": 5, "engine": "numpy", "checkpoint": path}
    if written == 0:
        with pytest.raises(lnocl.FileError, match="No space left"):
            STARS.make().deconvolve(**given)
        return
    with pytest.warns(lnocl.LnoclWarning, match="No space left on device; the run continues"):
        found = STARS.make().deconvolve(**given, callback=lambda *_: None)
    assert found.n_iter == 5
    assert checkpoint.read(path).arrays["progress"][0] == written
