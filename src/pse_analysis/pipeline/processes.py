"""Tasks on several processes: paths in, paths out. Standard library only."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from pse_analysis.errors import OutOfMemory
from pse_analysis.pipeline.plan import THREADS

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
    # Each worker is one thread: several of them with BLAS threads of their own would fight for
    # the same cores. The setting is read when numpy is imported, hence from the environment that
    # the workers inherit, and hence spawn: a forked child would have numpy imported already.
    threads = dict.fromkeys(THREADS, "1")
    before = {name: os.environ.get(name) for name in threads}
    os.environ.update(threads)
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker
    )
    try:
        for future in as_completed([pool.submit(function, task) for task in tasks]):
            yield future.result()
        pool.shutdown()
    except BrokenProcessPool as error:
        raise OutOfMemory(
            "a process for the estimators ended suddenly, as when the system ends one because "
            f"memory runs out: run again with fewer of them (--workers 1, now {workers}), or with "
            "a shorter [study] or history_s, fewer trials, fewer methods"
        ) from error
    except BaseException:
        # Do not wait for estimates that nobody will read.
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin_worker() -> None:
    # Ctrl-C is for the runner, which ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Leave when the runner is gone, even if it was killed and could say nothing."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
