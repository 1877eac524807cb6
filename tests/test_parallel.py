"""Independent tasks: in this process, in processes of their own, and on a cluster of Dask."""

import os
import signal
import subprocess
import sys
import time
import warnings
from contextlib import closing, contextmanager
from functools import partial

import pytest

from lnocl import parallel
from lnocl.errors import InputError, LnoclError, LnoclWarning
from lnocl.parallel import CURRENT, check_parallel, work

distributed = pytest.importorskip("distributed", reason="Dask is not installed")

# Its sockets are closed by its own threads, when they come to it.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")


class Squares:
    """Squares numbers, and counts how many it has squared."""

    def __init__(self, seconds=0.0):
        self.seconds, self.n_done = seconds, 0

    def __call__(self, number):
        time.sleep(self.seconds)
        self.n_done += 1
        return number**2, os.getpid(), self.n_done


def warn_of(number):
    warnings.warn("numbers are odd" if number % 2 else "numbers are even", LnoclWarning, 2)
    return number


def make_warner():
    return warn_of


def refuse(number):
    raise InputError(f"{number} is no number of mine")


def make_refuser():
    return refuse


def end(number):
    os.kill(os.getpid(), signal.SIGKILL)


def make_ender():
    return end


def make_half_ender():
    return end_if_odd


def end_if_odd(number):
    if number % 2:
        end(number)
    return number


@contextmanager
def cluster_of_two():
    """Two workers, as a user would start them; the client is current."""
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50
    )
    try:
        with distributed.Client(cluster) as client:
            yield client
    finally:
        parallel.close_cluster(cluster)


@pytest.fixture(scope="module")
def client():
    with cluster_of_two() as client:
        client.wait_for_workers(2, timeout=60)
        yield client


def test_this_process_does_one_after_the_other():
    n_asked = []
    answers = work(Squares, (n_asked.append(k) or k for k in range(3)))
    assert next(answers) == (0, os.getpid(), 1)
    assert len(n_asked) == 1
    assert list(answers) == [(1, os.getpid(), 2), (4, os.getpid(), 3)]


@pytest.mark.parametrize("wrong", [0, -1, 2.0, "two", None, "current scheduler"])
def test_invalid_values_of_parallel_are_refused(wrong):
    with pytest.raises(InputError, match="parallel must be True, False, a number of processes or"):
        check_parallel(wrong)


@pytest.mark.parametrize("given", [True, 1, CURRENT])
def test_missing_dask_is_reported_with_its_install_command(monkeypatch, given):
    monkeypatch.setitem(sys.modules, "distributed", None)
    check_parallel(False)
    with pytest.raises(LnoclError, match=r"parallel needs Dask; install it with: pip install"):
        check_parallel(given)
    assert next(work(Squares, [3]))[0] == 9


def test_without_a_client_there_is_no_current_scheduler():
    with pytest.raises(LnoclError, match=r"finds no scheduler .*DASK_SCHEDULER_ADDRESS"):
        next(work(Squares, [1], CURRENT))


@pytest.mark.exhaustive
def test_processes_of_its_own_end_with_the_work(monkeypatch):
    close = distributed.LocalCluster.close

    def close_after_a_lost_worker(cluster):
        close(cluster)
        raise KeyError("tcp://127.0.0.1:1")

    monkeypatch.setattr(distributed.LocalCluster, "close", close_after_a_lost_worker)
    answers = list(work(Squares, range(6), 2))
    assert [each[0] for each in answers] == [0, 1, 4, 9, 16, 25]
    pids = {each[1] for each in answers}
    assert os.getpid() not in pids
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


@pytest.mark.exhaustive
def test_each_worker_creates_its_task_runner_once(client):
    answers = list(work(partial(Squares, 0.2), range(20), CURRENT))
    assert [each[0] for each in answers] == [k**2 for k in range(20)]
    pids = [each[1] for each in answers]
    assert len(set(pids)) == 2
    for pid in set(pids):
        counts = sorted(n for _, each, n in answers if each == pid)
        assert counts == list(range(1, pids.count(pid) + 1))


@pytest.mark.exhaustive
def test_a_worker_that_is_killed_and_a_connection_that_is_cut_cost_no_task(client):
    found = []
    for square, pid, _ in work(partial(Squares, 0.02), range(60), CURRENT):
        found.append(square)
        if len(found) == 10:
            os.kill(pid, signal.SIGKILL)
        if len(found) == 30:
            client.loop.add_callback(client.scheduler_comm.comm.abort)
    assert found == [k**2 for k in range(60)]


def test_warnings_of_workers_are_given_once(client):
    with pytest.warns(LnoclWarning) as given:
        assert list(work(make_warner, range(8), CURRENT)) == list(range(8))
    shown = [str(each.message) for each in given if each.category is LnoclWarning]
    assert sorted(shown) == ["numbers are even", "numbers are odd"]


def test_an_error_of_a_task_is_raised(client):
    with pytest.raises(InputError, match=r"\d is no number of mine"):
        list(work(make_refuser, range(4), CURRENT))
    assert len(list(work(Squares, range(4), CURRENT))) == 4  # the workers are none the worse


def count_tasks(dask_scheduler):
    return len(dask_scheduler.tasks)


@pytest.mark.exhaustive
def test_tasks_that_are_left_are_cancelled(client):
    with closing(work(partial(Squares, 0.3), range(1000), CURRENT)) as answers:
        next(answers)
        while client.run_on_scheduler(count_tasks) < 900:
            time.sleep(0.01)
    while client.run_on_scheduler(count_tasks) > 5:  # they would take minutes
        time.sleep(0.01)


def test_tasks_whose_workers_are_lost_again_and_again_are_given_up(client, monkeypatch):
    rounds = []

    def lose_all(client, make, waiting):
        rounds.append(len(waiting))
        return iter(())

    monkeypatch.setattr(parallel, "_round", lose_all)
    with pytest.raises(LnoclError, match="lost 6 times in a row before any of 3 tasks"):
        list(work(Squares, range(3), CURRENT))
    assert rounds == [3] * 6


@pytest.mark.exhaustive
def test_a_task_that_ends_its_workers_ends_the_work_or_has_another_answer():
    with pytest.raises(LnoclError, match="4 workers ended at the same task"):
        list(work(make_ender, [1], 2))
    answers = work(make_half_ender, range(3), 2, lambda number, why: (number, why))
    why = "4 workers ended at the same task, perhaps for lack of memory"
    assert list(answers) == [0, (1, why), 2]


def nested(parallel):
    return list(work(Squares, [3], parallel))


def make_nested():
    return nested


@pytest.mark.parametrize("inner", [CURRENT, 2])
def test_work_inside_a_task_is_refused(client, inner):
    with pytest.raises(InputError, match="parallel inside a task of Dask would wait for itself"):
        list(work(make_nested, [inner], CURRENT))


@pytest.mark.exhaustive
@pytest.mark.parametrize("is_file", [True, False])
def test_script_that_workers_cannot_import_is_reported(tmp_path, is_file):
    script = "from lnocl.parallel import work\ndef make():\n    return abs\n"
    if is_file:
        (tmp_path / "script.py").write_text(f"{script}print(list(work(make, [-1], 2)))\n")
        command, given = [sys.executable, tmp_path / "script.py"], ""
    else:
        command = [sys.executable, "-"]
        given = f"{script}if __name__ == '__main__':\n    print(list(work(make, [-1], 2)))\n"
    ended = subprocess.run(command, input=given, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    last = ended.stderr.splitlines()[-1]
    assert "it has to be a file, not standard input, with 'if __name__ == \"__main__\":'" in last


@pytest.mark.exhaustive
def test_where_all_workers_have_gone_it_says_so(monkeypatch):
    monkeypatch.setattr(parallel, "PATIENCE", 1.0)
    with cluster_of_two() as client:
        answers = work(partial(Squares, 0.2), range(200), CURRENT)
        next(answers)
        client.cluster.scale(0)
        with pytest.raises(LnoclError, match="the scheduler has had no worker for 1 s"):
            list(answers)
