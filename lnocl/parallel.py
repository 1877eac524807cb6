"""Independent tasks, in this process one after the other or in processes of Dask."""

from __future__ import annotations

import logging
import multiprocessing
import os
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

from lnocl import process
from lnocl.errors import InputError, LnoclError, counted, installed

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster, as_completed

Task = TypeVar("Task")
Answer = TypeVar("Answer")
# Returns the function that does a task; each process calls it once, and holds what it returns.
Maker = Callable[[], Callable[[Task], Answer]]
Warned = list[tuple[type[Warning], str]]

CURRENT = "current-scheduler"
Parallel = bool | int | Literal["current-scheduler"]
# Times in a row that tasks are sent anew although none was done since the last time.
MAX_FRUITLESS = 5
# Seconds to wait for a scheduler that is gone, and for its workers.
PATIENCE = 60.0
# Seconds between two looks for what was done; the workers need not wait for that.
LOOK_EVERY = 0.02
# And for workers, where nothing is done.
LOOK_AFTER = 1.0
_WITHOUT_GUARD = (
    "worker processes cannot be started, as each of them reads the script first: it has to be a "
    "file, not standard input, with 'if __name__ == \"__main__\":' round what it does"
)


def check_parallel(parallel: object) -> None:
    """Raise unless `parallel` is a flag, a number of processes or a scheduler, and Dask is there.

    Parameters
    ----------
    parallel : bool, int or "current-scheduler"
        False: this process. True: as many processes of this machine as it has cores, or so many;
        they end with the work. "current-scheduler": the workers of the client of Dask that is
        current, or else of the scheduler that its setting ``scheduler-address`` names.

    Raises
    ------
    InputError
        It is something else.
    LnoclError
        Dask is not installed.
    """
    is_number = isinstance(parallel, int) and (isinstance(parallel, bool) or parallel >= 1)
    if not (is_number or (isinstance(parallel, str) and parallel == CURRENT)):
        raise InputError(
            f"`parallel` must be True, False, a number of processes or {CURRENT!r}; {parallel!r} "
            "was given"
        )
    if parallel is not False:
        installed("distributed", "`parallel` needs Dask; install it with")


def work(
    make: Maker[Task, Answer],
    tasks: Iterable[Task],
    parallel: Parallel = False,
    instead: Callable[[Task, str], Answer] | None = None,
) -> Generator[Answer]:
    """Yield the answer to each task, in the order of the tasks.

    Tasks whose worker or connection is lost are done again. Warnings of a worker are given here,
    each once. Where the iteration is ended early, the tasks that are left are cancelled.

    Parameters
    ----------
    make : callable
        Returns the function that does a task. Each process calls it once, so that programs and
        buffers last from task to task. It can be pickled, like the tasks and the answers.
    tasks : iterable
        What to do.
    parallel : bool, int or "current-scheduler", optional
        As for `check_parallel`. This process does one after the other.
    instead : callable, optional
        Returns the answer to a task that has ended one worker after the other, given why.

    Raises
    ------
    InputError, LnoclError
        As `check_parallel`; there is no current client; there is no worker, or they are lost again
        and again; a task ends them, and there is no other answer.
    """
    check_parallel(parallel)
    if parallel is False:
        do = make()
        yield from map(do, tasks)
        return
    early: dict[int, Answer] = {}
    n_given = 0
    with _client_of(parallel) as client, closing(_answers(client, make, tasks, instead)) as answers:
        for k, answer in answers:
            early[k] = answer
            while n_given in early:
                yield early.pop(n_given)
                n_given += 1


@contextmanager
def _client_of(parallel: Parallel) -> Iterator[Client]:
    import dask
    import distributed

    _refuse_inside_a_task()
    if parallel == CURRENT:
        try:
            client = distributed.get_client()
        except (ValueError, OSError) as error:
            raise LnoclError(
                f"`parallel` {CURRENT!r} finds no scheduler ({error}): make a client first, as by "
                "dask.distributed.Client(ADDRESS), or set DASK_SCHEDULER_ADDRESS"
            ) from None
        yield client
        return
    _refuse_a_script_without_guard()
    cores = process.n_cores()
    n = int(parallel) if parallel is not True else cores
    # PoCL starts a thread a core in each process, where they would share the cores.
    threads = {"POCL_MAX_PTHREAD_COUNT": str(max(cores // n, 1))}
    # A worker that ends twice within this time is given up, even where it was started again.
    with dask.config.set({"distributed.deploy.lost-worker-timeout": "1 day"}):
        cluster = distributed.LocalCluster(
            n_workers=n,
            threads_per_worker=1,
            processes=True,
            dashboard_address="127.0.0.1:0",
            memory_limit=None,
            env={**threads, **os.environ},
        )
        try:
            with distributed.Client(cluster, set_as_default=False) as client:
                yield client
        finally:
            close_cluster(cluster)


def close_cluster(cluster: LocalCluster) -> None:
    """Close a cluster of Dask, whose list of workers may lack one that was killed.

    A busy machine takes its time to end workers that have nothing to do: that is not warned of.
    """
    with process.ignored_notes("distributed.nanny", logging.ERROR), suppress(KeyError):
        cluster.close()


def _refuse_a_script_without_guard() -> None:
    """Start a process as Dask does, which waits for ever where none can be started."""
    trial = multiprocessing.get_context("spawn").Process(target=os.getpid)
    try:
        trial.start()
    except RuntimeError as error:
        raise LnoclError(_WITHOUT_GUARD) from error
    trial.join()
    if trial.exitcode != 0:
        raise LnoclError(_WITHOUT_GUARD)


def _refuse_inside_a_task() -> None:
    """Refuse work inside a task of Dask, which would wait for the worker that it keeps."""
    import distributed

    try:
        distributed.get_worker()
    except ValueError:
        return
    raise InputError("`parallel` inside a task of Dask would wait for itself; leave it out there")


class _Ended(NamedTuple):
    """Why a task has no answer: its workers ended."""

    why: str


def _answers(
    client: Client,
    make: Maker[Task, Answer],
    tasks: Iterable[Task],
    instead: Callable[[Task, str], Answer] | None,
) -> Generator[tuple[int, Answer]]:
    """Yield the place of each task and its answer, as they are done; send what was lost anew."""
    shown: set[tuple[type[Warning], str]] = set()
    rounds, n_fruitless = list(filter(None, [dict(enumerate(tasks))])), 0
    while rounds:
        waiting = rounds.pop(0)
        n_before, is_alone = len(waiting), len(waiting) == 1
        for k, found in _round(client, make, waiting):
            task = waiting.pop(k)
            if not isinstance(found, _Ended):
                yield k, _pass_on(found, shown)
            elif not is_alone:  # another task may have ended the workers that it waited for
                rounds.append({k: task})
            elif instead is None:
                raise LnoclError(f"{found.why}; see what their logs say")
            else:
                yield k, instead(task, found.why)
        if waiting:
            rounds.insert(0, waiting)
        n_fruitless = n_fruitless + 1 if len(waiting) == n_before else 0
        if n_fruitless > MAX_FRUITLESS:
            raise LnoclError(
                f"the workers were lost {n_fruitless} times in a row before any of "
                f"{counted(len(waiting), 'task')} was done; see what their logs say"
            )


def _pass_on(found: tuple[Answer, Warned], shown: set[tuple[type[Warning], str]]) -> Answer:
    """Return the answer of a worker; give its warnings but for those that were shown."""
    answer, warned = found
    for category, message in warned:
        if (category, message) not in shown:
            shown.add((category, message))
            warnings.warn(category(message), stacklevel=5)
    return answer


def _round(
    client: Client, make: Maker[Task, Answer], waiting: Mapping[int, Task]
) -> Iterator[tuple[int, tuple[Answer, Warned] | _Ended]]:
    """Yield what workers found for tasks that are waiting, but for those that are lost."""
    import dask
    from distributed import as_completed
    from distributed.client import FutureCancelledError
    from distributed.scheduler import KilledWorker

    token = uuid.uuid4().hex
    futures: dict[Future, int] = {}
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 TB"}):
            # Unlike what is scattered, this is made again where all its copies are lost.
            made = client.submit(_same, make, key=f"lnocl-{token}")
            client.replicate([made])
            for k, task in waiting.items():
                futures[client.submit(_do, token, made, task, key=f"lnocl-{token}-{k}")] = k
        # One that is done is let go, lest it is done again where its worker is lost.
        for future in _completed(client, as_completed(futures, loop=client.loop)):
            k = futures.pop(future)
            try:
                answer = future.result(timeout=PATIENCE)
            except FutureCancelledError:
                continue  # lost with a worker or a connection
            except TimeoutError:
                return  # lost with its worker after it was done
            except KilledWorker as error:
                n_ended = counted(error.allowed_failures + 1, "worker")
                answer = _Ended(f"{n_ended} ended at the same task, perhaps for lack of memory")
            del future
            yield k, answer
    except TimeoutError:
        raise LnoclError(f"the scheduler has had no worker for {PATIENCE:g} s") from None
    finally:
        if client.status == "running":
            client.cancel(list(futures))


# A worker with several threads does one task at a time: buffers are not to be shared.
_LOCK = threading.Lock()
# By the token of the work.
_held: dict[str, Callable[[Any], Any]] = {}


def _completed(client: Client, completed: as_completed) -> Iterator[Future]:
    """Yield futures as they are completed, or lost; hold none of those that were yielded.

    Raises
    ------
    TimeoutError
        There is no worker for `PATIENCE`.
    """
    alive = looked = time.monotonic()
    while not completed.is_empty():
        if completed.has_ready():
            yield next(completed)
            alive = time.monotonic()
            continue
        now = time.monotonic()
        if now - looked > LOOK_AFTER:
            looked = now
            if _has_workers(client):
                alive = now
        if now - alive > PATIENCE:
            raise TimeoutError
        time.sleep(LOOK_EVERY)


def _has_workers(client: Client) -> bool:
    try:
        return client.status == "running" and bool(client.nthreads())
    except OSError:  # the connection is being made again
        return False


def _same(make: Maker[Task, Answer]) -> Maker[Task, Answer]:
    return make


def _do(token: str, make: Maker[Task, Answer], task: Task) -> tuple[Answer, Warned]:
    """Do a task in a worker, which holds what `make` returned until other work comes."""
    with _LOCK, process.recorded_warnings() as recorded:
        process.is_worker = True
        if token not in _held:
            _held.clear()
            _held[token] = make()
        answer: Answer = _held[token](task)
    return answer, [
        (each.category, getattr(each.message, "message", str(each.message))) for each in recorded
    ]
