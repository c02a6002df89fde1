"""Tasks on several processes: paths in, paths out. Standard library only."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from multiprocessing.process import BaseProcess
from typing import TypeVar

from pse_analysis.errors import OutOfMemory
from pse_analysis.pipeline.endings import CODES
from pse_analysis.pipeline.plan import THREADS

PATIENCE_S = 5.0
"""How long a process may take to end when it is asked to. [s]"""

Task = TypeVar("Task")
Done = TypeVar("Done")


def each(function: Callable[[Task], Done], tasks: Sequence[Task], workers: int) -> Iterator[Done]:
    """Results of a function over tasks, in the order in which they come.

    Parameters
    ----------
    function
        Of a module's top level, so that another process can find it.
    tasks
        What it is called with; paths and parameters rather than tables.
    workers
        Processes; with one, the tasks run in this process.

    Raises
    ------
    OutOfMemory
        If the system ended one of the processes.
    """
    workers = min(workers, len(tasks))
    if workers <= 1:
        yield from map(function, tasks)
        return
    others = multiprocessing.active_children()
    with _one_thread_each(), ExitStack() as stack:
        # Each in a block of its own: the first starts Python's tracker of resources, which opens
        # it.
        with _signals_waiting():
            pool = ProcessPoolExecutor(
                workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker
            )
            stack.callback(_end, pool, others)
        with _signals_waiting():
            futures = [pool.submit(function, task) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BrokenProcessPool as error:
            raise OutOfMemory(
                "a process for the estimators ended suddenly, as when the system ends one because "
                f"memory runs out: run again with fewer of them (--workers 1, now {workers}), or "
                "with a shorter [study] or history_s, fewer trials, fewer methods"
            ) from error
        pool.shutdown()


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that are started use one thread.

    Several with BLAS threads of their own would fight for the same cores. The setting is read when
    numpy is imported, hence from the environment that the workers inherit, and hence spawn: a
    forked child would have numpy imported already.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _signals_waiting() -> Iterator[None]:
    """Let signals wait while processes are started: cut short, a start leaves one astray.

    The processes inherit that, so that Ctrl-C does not meet them before they can tell it apart.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, CODES)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(pool: ProcessPoolExecutor, others: Sequence[BaseProcess]) -> None:
    """End the processes of a pool; those that were there before are others'."""
    # Do not wait for estimates that nobody will read.
    pool.shutdown(wait=False, cancel_futures=True)
    processes = [child for child in multiprocessing.active_children() if child not in others]
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(PATIENCE_S)
        if process.is_alive():
            process.kill()
            process.join()


def _begin_worker() -> None:
    # Ctrl-C is for the runner, which ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, CODES)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Leave when the runner is gone, even if it was killed and could say nothing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
