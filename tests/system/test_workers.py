"""Batches on a cluster of Dask that loses a worker and a connection, on the real engine."""

import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commandline import outcome
from scenes import Recipe

from lnocl.commands import cli

distributed = pytest.importorskip("distributed", reason="Dask is not installed")

pytestmark = [
    pytest.mark.system,
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
]
N_TARGETS = 24


@pytest.fixture
def targets(tmp_path, monkeypatch):
    """Work in a folder with a table of targets, the fifth of which is bad."""
    monkeypatch.chdir(tmp_path)
    rows = []
    made = Recipe((64, 64), 2, 1).make()
    fits.writeto("psfs.fits", made.psfs)
    for k in range(N_TARGETS):
        fits.writeto(f"i{k}.fits", np.random.default_rng(k).poisson(made.images).astype(float))
        (x, y) = made.stars[0]
        rows.append((f"i{k}.fits", "psfs.fits", f"{x},{y}", "given", 400, "none", 0.01, 0))
    rows[4] = ("gone.fits", *rows[4][1:])
    names = ["images", "psf", "star", "psf_centre", "n_iter", "stop", "smoothing", "psf_error"]
    Table(rows=rows, names=names).write("targets.csv")
    return [row[0].removesuffix(".fits") for row in rows]


def disturb(client, lost):
    """Kill two workers that have done something, and cut the connection a little later."""
    for n_done in (N_TARGETS // 3, N_TARGETS // 2):
        await_results(n_done)
        lost.append(next(each for each in processes_of_results() if each not in lost))
        os.kill(lost[-1], signal.SIGKILL)
    await_results(N_TARGETS * 2 // 3)
    client.loop.add_callback(client.scheduler_comm.comm.abort)


def processes_of_results():
    """Return the processes that have done what is done, again and again until one is there."""
    while True:
        for record in Path("two").glob("*.json"):
            if ":" in (process := json.loads(record.read_text()).get("process") or ""):
                yield int(process.split(":")[1])
        time.sleep(0.01)


def await_results(number):
    while len(list(Path("two").glob("*.fits"))) < number:
        time.sleep(0.01)


def test_a_lost_worker_and_connection_change_no_result(targets, capfd):
    assert cli.main(["batch", "targets.csv", "-o", "one", "--quiet"]) == 1
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        lost = []
        thread = threading.Thread(target=disturb, args=(client, lost))
        thread.start()
        words = ["batch", "targets.csv", "-o", "two", "--parallel", "current-scheduler"]
        assert cli.main(words) == 1
        thread.join()
    assert f"{N_TARGETS} targets: {N_TARGETS - 1} done, 1 failed" in capfd.readouterr().out
    one, two = (Table.read(f"{folder}/summary.ecsv") for folder in ("one", "two"))
    for name in ("name", "status", "message", "n_iter", "stopped", "warnings", "device"):
        assert one[name].tolist() == two[name].tolist(), name
    assert one["status"].tolist() == ["failed" if k == 4 else "done" for k in range(N_TARGETS)]
    processes = {int(each.split(":")[1]) for each in two["process"]}
    assert processes & {*lost}  # what lost workers had done is not done again
    assert processes - {*lost}
    for name in set(targets) - {"gone"}:
        np.testing.assert_equal(outcome(f"one/{name}.fits"), outcome(f"two/{name}.fits"))
