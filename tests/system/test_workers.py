"""Batches on a cluster of Dask that loses a worker and a connection, on the real engine."""

import math
import os
import signal
import time

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

    def __init__(self, cluster, client, names):
        self.cluster, self.client, self.names = cluster, client, names
        self.killed, self.is_cut = [], False
        self.processes = {}  # of the results that have arrived before the cut, by their names

    def pass_on(self, found, shown, passed_on=parallel._pass_on):
        record = passed_on(found, shown)
        if self.is_cut:
            return record
        self.processes[record.name] = record.process
        n_done = len(self.processes)
        workers = [process_of(each) for each in self.processes.values() if each]
        alive = [each for each in workers if each not in self.killed]
        if alive and n_done >= (N_TARGETS // 3, N_TARGETS // 2, math.inf)[len(self.killed)]:
            self.await_forgetting()
            self.killed.append(alive[0])
            os.kill(alive[0], signal.SIGKILL)
        if n_done >= N_TARGETS * 2 // 3:
            self.is_cut = True
            self.client.loop.add_callback(self.client.scheduler_comm.comm.abort)
        return record

    def await_forgetting(self):
        """Wait until the scheduler has forgotten the tasks whose results have arrived."""
        arrived = tuple(f"-{self.names.index(name)}" for name in self.processes)
        deadline = time.monotonic() + 30
        while held := [each for each in self.cluster.scheduler.tasks if each.endswith(arrived)]:
            assert time.monotonic() < deadline, f"{held} would be done again"
            time.sleep(0.01)


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
        disturbance = Disturbance(cluster, client, targets)
        monkeypatch.setattr(parallel, "_pass_on", disturbance.pass_on)
        words = ["batch", "targets.csv", "-o", "two", "--parallel", "current-scheduler"]
        assert cli.main(words) == 1
    assert f"{N_TARGETS} targets: {N_TARGETS - 1} done, 1 failed" in capfd.readouterr().out
    one, two = (Table.read(f"{folder}/summary.ecsv") for folder in ("one", "two"))
    for name in ("name", "status", "message", "n_iter", "stopped", "warnings", "device"):
        assert one[name].tolist() == two[name].tolist(), name
    assert one["status"].tolist() == ["failed" if k == 4 else "done" for k in range(N_TARGETS)]
    assert len(disturbance.killed) == 2
    assert disturbance.is_cut
    processes = dict(two.iterrows("name", "process"))
    for name, process in disturbance.processes.items():
        assert processes[name] == process  # what has arrived is not done again
    for name in set(targets) - {"gone"}:
        np.testing.assert_equal(outcome(f"one/{name}.fits"), outcome(f"two/{name}.fits"))
