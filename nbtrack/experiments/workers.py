"""Where jobs run side by side: processes of this machine, or the workers of a Dask cluster."""

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing.connection import Connection
from types import ModuleType
from typing import NamedTuple

import torch

from nbtrack.machinery.errors import MissingError

_START = "spawn"  # how worker processes begin: forked ones would lack the threads of libraries
_SECONDS_TO_CONNECT = 10
DEATHS = ("BrokenProcessPool", "KilledWorker")
"""Names of the errors that are raised, here or by Dask, where the process of a call has died."""


class Workplace(NamedTuple):
    """Executors for one call at a time; one whose process died is not used again."""

    begin: Callable[[], Executor]
    n_calls: int  # at a time
    n_threads: int  # of each call
    idle: list[Executor]  # those begun that have no call


@contextlib.contextmanager
def processes(number: int) -> Iterator[Workplace]:
    """Processes of this machine, which end with the block, or with this process if it is killed.

    They share the threads of this one. Each watches a pipe whose other end, `ours`, is closed in
    both cases. At the block's end that comes first, so that nothing waits for jobs that still run.
    """
    context = multiprocessing.get_context(_START)
    theirs, ours = context.Pipe(duplex=False)
    with contextlib.ExitStack() as stack, ours:

        def begin() -> Executor:
            # One process each: where several share an executor, one that dies ends them all.
            executor = ProcessPoolExecutor(1, context, _end_with, (theirs,))
            stack.enter_context(executor)
            with _spared():
                executor.submit(int)  # a call that does nothing: the process is begun for it
            return executor

        yield Workplace(begin, number, max(1, torch.get_num_threads() // number), [])


def _end_with(pipe: Connection) -> None:
    """End this worker, whatever it does, as soon as the other end of a pipe is closed."""

    def watch() -> None:
        pipe.poll(None)  # waits without limit: nothing is ever sent
        os._exit(1)  # at once, in the middle of a job

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _spared() -> Iterator[None]:
    """Let processes that are started in a block ignore Ctrl-C, and not run the main script again.

    At Ctrl-C each would print a traceback. A main script without a `__main__` guard would start
    processes from within them: Python runs again what `sys.modules` holds as `__main__`.
    """
    script = sys.modules["__main__"]
    # Python lets only the main thread set a handler.
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        if handler is not None:
            signal.signal(signal.SIGINT, handler)


@contextlib.contextmanager
def cluster(address: str, n_calls: int) -> Iterator[Workplace]:
    """The workers of a Dask scheduler, among which it shares so many calls at a time.

    Raises MissingError where there are none.
    """
    from distributed import Client  # an extra

    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
        client.wait_for_workers(1, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError):
        advice = "start 'dask scheduler', and 'dask worker ADDRESS --nthreads 1'"
        raise MissingError(f"no Dask scheduler at {address!r} with a worker: {advice}") from None
    with client:
        # Not pure: Dask would answer an equal call with the result of the earlier one.
        executor = client.get_executor(pure=False)
        try:
            yield Workplace(lambda: executor, n_calls, 1, [])
        finally:
            executor.shutdown(wait=False)  # after an error nothing waits for jobs that still run
