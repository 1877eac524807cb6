"""Runs that were cut off go on as if they had not been, from nothing but their own checkpoints."""

import os
import pkgutil
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from scenes import ENGINES, Recipe, make_smooth_psfs

import lnocl
from lnocl.commands import cli
from lnocl.commands.checkpoints import Interrupts
from lnocl.engines.numpy import ReferenceEngine
from lnocl.runs import checkpoint
from lnocl.runs.run import FIRST_REFINED, Run

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
}
# Those that CI alone tests: what is the same for both solvers, and the slowest.
RARE = [("sgm", kind) for kind in ("refined", "change", "discrepancy", "held-out")]
RARE += [("sgp", "held-out")]
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
    if engine.id == "numpy" or (kind in ("stars, penalties", "no star") and "single" in engine.id)
]


def assert_same(found, expected):
    for name in ("extended", "star_fluxes", "star_positions", "history", "held_out"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    assert found.stop_reason == expected.stop_reason
    assert (found.mu, found.smoothing) == (expected.mu, expected.smoothing)


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize(("solver", "kind", "engine"), RUNS)
def test_what_was_cut_off_ends_bit_for_bit_where_it_would_have(solver, kind, engine, tmp_path):
    recipe, more = KINDS[kind]
    made, path = recipe.make(), str(tmp_path / "run.fits")
    given = {"solver": solver, "n_iter": 30, **engine, **more}
    whole = made.deconvolve(**given)
    cuts = [k for k in (1, 3, 10) if k < whole.n_iter]
    assert len(cuts) >= 2
    for cut in cuts:
        made.deconvolve(
            **given, checkpoint=path, callback=lambda k, _, cut=cut: k == cut, checkpoint_every=1e9
        )
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
def test_checkpoints_do_not_change_the_run(solver, engine, tmp_path):
    made, path = STARS.make(), tmp_path / "run.fits"
    given = {"solver": solver, "n_iter": 9, "engine": engine}
    assert_same(
        made.deconvolve(**given, checkpoint=path, checkpoint_every=0), made.deconvolve(**given)
    )


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
    whole = lnocl.deconvolve(**given)
    early = [k for k in refined if k not in (FIRST_REFINED * 2**n for n in range(9))]
    assert early
    for cut in (early[0], early[-1]):
        lnocl.deconvolve(**given, checkpoint=path, callback=lambda k, _, cut=cut: k == cut)
        assert_same(lnocl.deconvolve(**given, resume=path), whole)
        os.remove(path)


def test_a_callback_that_ends_a_run_where_it_ends_anyway_is_not_heeded(tmp_path):
    made, path = STARS.make(), str(tmp_path / "run.fits")
    given = {"n_iter": 400, "stop": 1e-3, "engine": "numpy"}
    whole = made.deconvolve(**given)
    assert whole.stop_reason == "change"
    cut = made.deconvolve(**given, checkpoint=path, callback=lambda k, _: k == whole.n_iter)
    assert_same(cut, whole)
    assert_same(made.deconvolve(**given, resume=path), whole)


HELD_OUT = {"stop": "held-out", "smoothing": "auto", "solver": "sgp"}


@pytest.mark.filterwarnings("ignore::lnocl.LnoclWarning")
@pytest.mark.parametrize(
    ("more", "engine"),
    [
        pytest.param(HELD_OUT, "numpy", id="sgp-numpy", marks=pytest.mark.exhaustive),
        pytest.param(HELD_OUT, "opencl", id="sgp-opencl", marks=pytest.mark.exhaustive),
        pytest.param({"mu": "auto"}, "numpy", id="sgm-numpy"),
    ],
)
def test_held_out_counts_go_on_from_where_they_were_cut_off(more, engine, tmp_path, monkeypatch):
    made, path = STARS.make(), str(tmp_path / "run.fits")
    given = {"n_iter": 16, "mu": 0.0, "engine": engine, "checkpoint": path, "checkpoint_every": 0}
    given |= more
    written, corrected, cut = [], [], 0
    genuine, correct = checkpoint.write, ReferenceEngine.correct

    def write(path, described, ended, arrays, overwrite):
        written.append("choice" in arrays)
        if written[0] or len(written) in (1, cut):
            genuine(path, described, ended, arrays, overwrite)
        if len(written) == cut:
            raise KeyboardInterrupt

    def count_and_correct(run):
        corrected.append(run)
        correct(run)

    monkeypatch.setattr(checkpoint, "write", write)
    monkeypatch.setattr(ReferenceEngine, "correct", count_and_correct)
    whole = made.deconvolve(**given)
    selection, corrections = written.index(True), len(corrected)
    assert selection > 10
    for cut in (1, selection // 2, selection):  # noqa: B007
        os.remove(path)
        written.clear()
        corrected.clear()
        with pytest.raises(KeyboardInterrupt):
            made.deconvolve(**given)
        assert_same(made.deconvolve(**given, resume=path), whole)
        # What was done is not done again, but for what six halves begin with.
        assert written.index(True) == selection
        assert len(corrected) <= corrections + 6


@pytest.mark.parametrize(
    ("every", "times"), [(0.0, 6), (1e9, 2)], ids=["after each iteration and the end", "seldom"]
)
def test_they_are_written_first_then_when_it_is_time_and_at_the_end(
    every, times, tmp_path, monkeypatch
):
    written = []
    monkeypatch.setattr(checkpoint, "write", lambda *given: written.append(given))
    given = {"n_iter": 5, "engine": "numpy", "checkpoint": str(tmp_path / "run.fits")}
    STARS.make().deconvolve(**given, checkpoint_every=every)
    assert len(written) == times
    assert [ended for _, _, ended, *_ in written] == [""] * (times - 1) + ["n_iter"]


# --- What is refused

CHANGES = {
    "images": lambda made: {"observation": made.observation(images=made.images + 1.0)},
    "psfs": lambda made: {"observation": made.observation(psfs=made.psfs + 1e-3)},
    "background": lambda made: {"observation": made.observation(background=8.5)},
    "mask": lambda made: {"observation": made.observation(mask=None)},
    "exposure": lambda made: {"observation": made.observation(exposure=2.0)},
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


def test_another_device_or_version_is_refused(saved, tmp_path):
    found = checkpoint.read(saved)
    for name in ("device", "version"):
        path = str(tmp_path / f"{name}.fits")
        checkpoint.write(path, found.described | {name: "'other'"}, found.ended, found.arrays)
        with pytest.raises(lnocl.InputError, match=f"of another run: {name} differs; repeat"):
            STARS.make().deconvolve(n_iter=6, engine="numpy", resume=path)


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
        # A comment, or padding.
        assert (read.described, read.ended) == (sound.described, sound.ended)
        for name, array in sound.arrays.items():
            np.testing.assert_array_equal(read.arrays[name], array)
    assert refused > 50 / share


@pytest.mark.parametrize(
    "content", [b"", b"SIMPLE", b"\x80\x04pickle"], ids=["empty", "cut", "other"]
)
def test_what_is_no_checkpoint_is_refused(content, tmp_path):
    path = tmp_path / "other.fits"
    path.write_bytes(content)
    with pytest.raises(lnocl.FileError, match="is not a checkpoint, or a damaged one"):
        checkpoint.read(str(path))
    fits.writeto(path, np.ones((4, 4)), overwrite=True)
    with pytest.raises(lnocl.FileError):
        checkpoint.read(str(path))


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
    given = {"n_iter": 3, "engine": "numpy", "checkpoint": "run.fits", "checkpoint_every": 0}
    STARS.make().deconvolve(**given, callback=lambda *_: os.chdir(elsewhere))
    assert (elsewhere / "run.fits").read_text() == "of somebody else"
    assert checkpoint.read(str(there / "run.fits")).arrays["progress"][0] == 3


@pytest.mark.parametrize("solver", ["sgm", "sgp"])
def test_a_run_that_had_ended_is_kept_in_another_file_too(solver, tmp_path):
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


@pytest.mark.parametrize("every", [-1.0, np.nan, "often"])
def test_times_that_are_none_are_refused(every, tmp_path):
    with pytest.raises(lnocl.InputError, match="checkpoint_every must be seconds"):
        STARS.make().deconvolve(
            n_iter=1, engine="numpy", checkpoint=str(tmp_path / "c"), checkpoint_every=every
        )


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
    given = {"n_iter": 5, "engine": "numpy", "checkpoint": path, "checkpoint_every": 0.0}
    if written == 0:
        with pytest.raises(lnocl.FileError, match="No space left"):
            STARS.make().deconvolve(**given)
        return
    with pytest.warns(lnocl.LnoclWarning, match="No space left on device; the run continues"):
        found = STARS.make().deconvolve(**given)
    assert found.n_iter == 5
    assert checkpoint.read(path).arrays["progress"][0] == written


# --- The command line, killed and interrupted


@pytest.fixture
def command(tmp_path):
    """Return the beginning of a command; its iterations are short."""
    made = Recipe((64, 64), 2, 1, smoothing=1e-3, background="scalar").make()
    for name in ("images", "psfs"):
        fits.writeto(tmp_path / f"{name}.fits", getattr(made, name))
    (x, y) = made.stars[0]
    return [
        *(sys.executable, "-m", "lnocl", "deconvolve", "images.fits", "--psf", "psfs.fits"),
        *("--background", "8", "--star", f"{x},{y}", "--quiet", "--overwrite"),
    ]


def start(command, folder, *more):
    return subprocess.Popen(
        [*command, *more],
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
        # Which whoever runs the tests in the background may ignore.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def finish(process):
    _, complaint = process.communicate()
    assert process.returncode == 0, complaint


def results(path):
    with fits.open(path) as hdus:
        return [hdus[0].data, hdus["STARS"].data["flux"], hdus["HISTORY"].data["objective"]]


def wait_for_change(path, process, before=None):
    """Wait until there is a checkpoint newer than before, or the process has ended."""
    while process.poll() is None:
        if path.exists() and path.stat().st_mtime_ns != before:
            return
        time.sleep(0.001)


@pytest.mark.system
@pytest.mark.parametrize(
    ("solver", "kills", "more"),
    [
        ("sgm", 1, []),
        pytest.param("sgm", 15, [], marks=pytest.mark.exhaustive),
        pytest.param("sgp", 15, [], marks=pytest.mark.exhaustive),
        pytest.param("sgp", 8, ["--stop", "held-out"], marks=pytest.mark.exhaustive),
    ],
    ids=["sgm-once", "sgm", "sgp", "sgp-held-out"],
)
def test_killed_at_any_moment_it_ends_where_it_would_have(solver, kills, more, command, tmp_path):
    rng = random.Random(solver)
    command = [*command, "--solver", solver, "--n-iter", "400", *more]
    whole, found, saved = (tmp_path / f"{name}.fits" for name in ("whole", "found", "run"))
    finish(start(command, tmp_path, "-o", whole.name))
    command = [*command, "-o", found.name, "--checkpoint", saved.name, "--checkpoint-every", "0"]
    progress, killed = (0, 0), 0
    while killed < kills:
        resume = ["--resume", saved.name] if saved.exists() else []
        before = saved.stat().st_mtime_ns if resume else None
        process = start(command, tmp_path, *resume)
        wait_for_change(saved, process, before)
        time.sleep(rng.uniform(0.0, 0.03))
        process.kill()
        process.communicate()
        killed += process.returncode == -signal.SIGKILL
        read = checkpoint.read(str(saved))  # never a half-written one
        assert progress_of(read) >= progress
        progress = progress_of(read)
        if read.ended:  # it was too quick: begin anew
            saved.unlink()
            progress = (0, 0)
    finish(start(command, tmp_path, "--resume", saved.name))
    for one, other in zip(results(found), results(whole), strict=True):
        np.testing.assert_array_equal(one, other)


def progress_of(read):
    """Return how far a run has come, first in what held-out counts choose."""
    if "choice" in read.arrays:
        return 1, read.arrays["progress"][0]
    return 0, read.arrays["snapshot_iterations"][-1]


@pytest.mark.system
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_one_signal_ends_it_with_a_result_and_a_checkpoint(number, command, tmp_path):
    command = [*command, "--n-iter", "100000"]
    saved = tmp_path / "run.fits"
    process = start(command, tmp_path, "-o", "found.fits", "--checkpoint", saved.name)
    wait_for_change(saved, process)
    process.send_signal(number)
    _, complaint = process.communicate()
    assert process.returncode == 128 + number
    header = fits.getheader(tmp_path / "found.fits")
    assert header["STOPPED"] == "interrupt"
    assert complaint.splitlines()[-1] == (
        f"lnocl: error: interrupted after {header['NITER']} iterations; their result is in "
        "found.fits; continue with --resume run.fits"
    )
    assert checkpoint.read(str(saved)).arrays["progress"][0] == header["NITER"]


@pytest.mark.system
def test_more_than_one_signal_ends_it_at_once(command, tmp_path):
    fits.writeto(tmp_path / "large.fits", np.full((2, 2048, 2048), 50.0, np.float32))
    command = ["large.fits" if word == "images.fits" else word for word in command]
    command = [*command, "--engine", "numpy", "--n-iter", "100000", "-o", "found.fits"]
    saved = tmp_path / "run.fits"
    process = start(command, tmp_path, "--checkpoint", saved.name)
    wait_for_change(saved, process)
    while process.poll() is None:  # NumPy lets the interpreter hear of one in so many
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    process.communicate()
    # Shells call both 130; the second is a signal while the interpreter ended.
    assert process.returncode in (130, -signal.SIGINT)
    assert not (tmp_path / "found.fits").exists()
    assert checkpoint.read(str(saved)).arrays["progress"][0] == 1


@pytest.fixture
def interrupted(command, tmp_path, monkeypatch):
    """Return what runs the command in this process, and sends signals where it calls something."""
    monkeypatch.chdir(tmp_path)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # which may be ignored here
    words = [*command[3:], "--engine", "numpy", "--n-iter", "3", "--models", "--residuals"]

    def interrupt(called, numbers, *more):
        genuine, due = pkgutil.resolve_name(called), list(numbers)

        def stand_in(*given, **options):
            while due:
                signal.raise_signal(due.pop(0))
            return genuine(*given, **options)

        with monkeypatch.context() as patch:
            patch.setattr(called, stand_in)
            return cli.main([*words, *more])

    yield interrupt
    signal.signal(signal.SIGINT, before)


def assert_whole(path):
    with fits.open(path, checksum=True) as hdus:
        assert [hdu.name for hdu in hdus[1:]] == ["STARS", "HISTORY", "MODELS", "RESIDUALS"]
        assert (hdus[0].header["STOPPED"], hdus[0].header["NITER"]) == ("n_iter", 3)


IN_THE_END = [
    "lnocl.deconvolution.make_result",
    "lnocl.result.Result.models",
    "lnocl.result.Result.residuals",
    "lnocl.io.fitswrite.write_result",
    "lnocl.io.atomic.os.fsync",
]


@pytest.mark.parametrize("called", IN_THE_END)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_after_the_last_iteration_costs_nothing(called, number, interrupted, capsys):
    assert interrupted(called, [number], "-o", "found.fits") == 128 + number
    assert capsys.readouterr().err == (
        "lnocl: error: interrupted after the last iteration; the result is in found.fits\n"
    )
    assert_whole("found.fits")


def test_nor_does_it_where_no_iteration_was_left(interrupted, capsys):
    checkpoints = ("--checkpoint", "run.fits", "-o", "whole.fits")
    assert interrupted("lnocl.io.fitswrite.write_result", [], *checkpoints) == 0
    resume = ("--resume", "run.fits", "-o", "found.fits")
    assert interrupted("lnocl.io.fitswrite.write_result", [signal.SIGINT], *resume) == 130
    assert_whole("found.fits")


@pytest.mark.parametrize("called", ["lnocl.io.fitswrite.write_result", "lnocl.io.atomic.os.fsync"])
@pytest.mark.parametrize(
    ("second", "word"),
    [
        (signal.SIGINT, "interrupted"),
        (signal.SIGTERM, "terminated"),
        (signal.SIGHUP, "terminated"),
    ],
)
def test_a_second_one_ends_it_with_no_file(called, second, word, interrupted, capsys):
    before = os.listdir()
    assert interrupted(called, [signal.SIGINT, second], "-o", "found.fits") == 128 + second
    assert capsys.readouterr().err == f"lnocl: error: {word}\n"
    assert os.listdir() == before


def test_a_signal_that_was_ignored_stays_so():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Interrupts() as interrupts:
            interrupts.callback(1, None)
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_signals_do_again_what_they_did_once_the_run_is_over():
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with Interrupts() as interrupts:
        assert not interrupts.callback(1, None)
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.system
@pytest.mark.parametrize("name", ["found.fits", "images.fits"])
def test_a_checkpoint_in_the_place_of_other_files_is_refused(name, command, tmp_path):
    process = start(command, tmp_path, "-o", "found.fits", "--checkpoint", name)
    _, complaint = process.communicate()
    assert process.returncode == 2
    assert f"the checkpoint {name} is the output or an input" in complaint


@pytest.mark.system
def test_the_output_does_not_replace_the_checkpoint_gone_on_from(command, saved, tmp_path):
    process = start(command, tmp_path, "-o", saved, "--resume", saved)
    _, complaint = process.communicate()
    assert process.returncode == 2
    assert "is one of the inputs" in complaint
