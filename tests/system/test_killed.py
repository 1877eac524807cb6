"""Commands that are killed or interrupted, and what their checkpoints and results hold then."""

import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from lnocl import checkpoint
from lnocl.commands.signals import ENDING

pytestmark = pytest.mark.system


def start(command, *more, every=checkpoint.EVERY):
    program = (
        "import sys\nfrom lnocl.commands import cli\nfrom lnocl import checkpoint\n"
        f"checkpoint.EVERY = {every}\nsys.exit(cli.main(sys.argv[1:]))"
    )
    return subprocess.Popen(
        [sys.executable, "-c", program, *command, *more],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_signals,
    )


def heed_signals():
    """Ignore no signal, though whoever runs the tests in the background may."""
    for number in (signal.SIGINT, *ENDING):
        signal.signal(number, signal.SIG_DFL)


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


@pytest.mark.parametrize(
    ("solver", "kills", "more"),
    [
        ("sgm", 1, []),
        pytest.param("sgm", 8, [], marks=pytest.mark.exhaustive),
        pytest.param("sgp", 8, [], marks=pytest.mark.exhaustive),
        pytest.param("sgp", 4, ["--stop", "held-out"], marks=pytest.mark.exhaustive),
    ],
    ids=["sgm-once", "sgm", "sgp", "sgp-held-out"],
)
def test_killed_at_any_moment_it_ends_where_it_would_have(solver, kills, more, small_command):
    rng = random.Random(solver)
    command = [*small_command, "--solver", solver, "--n-iter", "400", *more]
    whole, found, saved = (Path(f"{name}.fits") for name in ("whole", "found", "run"))
    finish(start(command, "-o", whole.name))
    command = [*command, "-o", found.name, "--checkpoint", saved.name]
    progress, killed = 0, 0
    while killed < kills:
        resume = ["--resume", saved.name] if saved.exists() else []
        before = saved.stat().st_mtime_ns if resume else None
        process = start(command, *resume, every=0.0)
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
            progress = 0
    finish(start(command, "--resume", saved.name))
    for one, other in zip(results(found), results(whole), strict=True):
        np.testing.assert_array_equal(one, other)


def progress_of(read):
    """Return the iterations done, of both halves where held-out counts choose."""
    name = "progress" if "progress" in read.arrays else "halves_0_progress"
    return read.arrays[name][0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_one_signal_ends_it_with_a_result_and_a_checkpoint(number, small_command):
    command = [*small_command, "--n-iter", "100000"]
    saved = Path("run.fits")
    process = start(command, "-o", "found.fits", "--checkpoint", saved.name)
    wait_for_change(saved, process)
    process.send_signal(number)
    _, complaint = process.communicate()
    assert process.returncode == 128 + number
    header = fits.getheader("found.fits")
    assert header["STOPPED"] == "interrupt"
    assert complaint.splitlines()[-1] == (
        f"lnocl: error: interrupted after {header['NITER']} iterations; their result is in "
        "found.fits; continue with --resume run.fits"
    )
    assert checkpoint.read(str(saved)).arrays["progress"][0] == header["NITER"]


def test_more_than_one_signal_ends_it_at_once(small_command):
    fits.writeto("large.fits", np.full((2, 2048, 2048), 50.0, np.float32))
    command = ["large.fits" if word == "images.fits" else word for word in small_command]
    command = [*command, "--engine", "numpy", "--n-iter", "100000", "-o", "found.fits"]
    saved = Path("run.fits")
    process = start(command, "--checkpoint", saved.name)
    wait_for_change(saved, process)
    while process.poll() is None:  # NumPy lets the interpreter hear of one in so many
        process.send_signal(signal.SIGINT)
        time.sleep(0.05)
    process.communicate()
    # Shells call both 130; the second is a signal while the interpreter ended.
    assert process.returncode in (130, -signal.SIGINT)
    assert not Path("found.fits").exists()
    assert checkpoint.read(str(saved)).arrays["progress"][0] == 1
