"""Batches on a cluster of Dask that loses a worker and a connection, on the real engine."""

import math
import os
import signal

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commandline import outcome
from scenes import Recipe

from lnocl import parallel
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


class Disturbance:
    """Kills two workers whose results have arrived, and cuts the connection a little later."""

    def __init__(self, client):
        self.client = client
        self.processes, self.killed, self.is_cut = [], [], False

    def pass_on(self, found, shown, passed_on=parallel._pass_on):
        record = passed_on(found, shown)
        if record.process:
            self.processes.append(process_of(record.process))
        n_done = len(self.processes)
        alive = [each for each in self.processes if each not in self.killed]
        if alive and n_done >= (N_TARGETS // 3, N_TARGETS // 2, math.inf)[len(self.killed)]:
            self.killed.append(alive[0])
            os.kill(alive[0], signal.SIGKILL)
        if n_done >= N_TARGETS * 2 // 3 and not self.is_cut:
            self.is_cut = True
            self.client.loop.add_callback(self.client.scheduler_comm.comm.abort)
        return record


def process_of(text):
    """Return the number of a process from the words host:process."""
    return int(text.split(":")[1])


def test_a_lost_worker_and_connection_change_no_result(targets, capfd, monkeypatch):
    assert cli.main(["batch", "targets.csv", "-o", "one", "--quiet"]) == 1
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        disturbance = Disturbance(client)
        monkeypatch.setattr(parallel, "_pass_on", disturbance.pass_on)
        words = ["batch", "targets.csv", "-o", "two", "--parallel", "current-scheduler"]
        assert cli.main(words) == 1
    assert f"{N_TARGETS} targets: {N_TARGETS - 1} done, 1 failed" in capfd.readouterr().out
    one, two = (Table.read(f"{folder}/summary.ecsv") for folder in ("one", "two"))
    for name in ("name", "status", "message", "n_iter", "stopped", "warnings", "device"):
        assert one[name].tolist() == two[name].tolist(), name
    assert one["status"].tolist() == ["failed" if k == 4 else "done" for k in range(N_TARGETS)]
    processes = {process_of(each) for each in two["process"]}
    assert len(disturbance.killed) == 2
    assert disturbance.is_cut
    assert processes & {*disturbance.killed}  # what lost workers had done is not done again
    assert processes - {*disturbance.killed}
    for name in set(targets) - {"gone"}:
        np.testing.assert_equal(outcome(f"one/{name}.fits"), outcome(f"two/{name}.fits"))
