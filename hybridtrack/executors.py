"""Where blocks run: in this thread, or on this machine's cores.

The kernels let go of Python's lock, so threads use every core and share all memory. Results come
back in the order of the tasks, whatever finished first; only a few wait at a time.
"""

import collections
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")


def available_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def in_order(
    function: Callable[[Task, threading.Event], Result], tasks: Iterable[Task], workers: int
) -> Iterator[Result]:
    """function(task, stop) of every task, in the tasks' order.

    Leaving the iteration (an error, Ctrl-C) sets `stop`, for functions to look at, and waits for
    those under way.
    """
    stop = threading.Event()
    if workers == 1:
        for task in tasks:
            yield function(task, stop)
        return
    waiting: collections.deque[Future[Result]] = collections.deque()
    pool = ThreadPoolExecutor(workers, thread_name_prefix="block")
    try:
        for task in tasks:
            waiting.append(pool.submit(function, task, stop))
            if len(waiting) > workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)
