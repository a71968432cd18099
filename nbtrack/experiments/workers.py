"""Workplaces, where jobs run side by side: processes of this machine, or a Dask cluster."""

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
"""Names of the errors that tell that the process of a call has died: Python's and Dask's."""


class Workplace(NamedTuple):
    """Executors of calls, each for one call at a time.

    An executor whose process has died must not be put back into `idle`.
    """

    begin: Callable[[], Executor]  # starts one more executor
    n_calls: int  # how many calls may run at a time
    n_threads: int  # how many CPU threads each call may use
    idle: list[Executor]  # executors that run no call now


@contextlib.contextmanager
def processes(number: int) -> Iterator[Workplace]:
    """A workplace of several processes of this machine, among which its threads are shared.

    The processes end at once when the block ends, and when this process is killed. For this each of
    them watches a pipe, whose other end, `ours`, is closed in both cases. It is closed before the
    executors, which would otherwise wait for calls that still run.
    """
    context = multiprocessing.get_context(_START)
    theirs, ours = context.Pipe(duplex=False)
    with contextlib.ExitStack() as stack, ours:

        def begin() -> Executor:
            # An executor with several processes would end all of them when one dies.
            executor = ProcessPoolExecutor(1, context, _end_with, (theirs,))
            stack.enter_context(executor)
            with _spared():
                executor.submit(int)  # starts the process, within `_spared`; the call does nothing
            return executor

        yield Workplace(begin, number, max(1, torch.get_num_threads() // number), [])


def _end_with(pipe: Connection) -> None:
    """End this worker process, whatever it does, when the other end of the pipe is closed."""

    def watch() -> None:
        pipe.poll(None)  # waits for the end of the pipe, since nothing is ever sent
        os._exit(1)  # ends the process at once, also in the middle of a job

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _spared() -> Iterator[None]:
    """Run a block whose new processes ignore Ctrl-C and do not run the main script again.

    At Ctrl-C each of them would print a traceback. In each new process Python runs the module again
    that is `__main__` here. A main script without a `__main__` guard would then start more
    processes from there, so an empty module takes its place during the block.
    """
    script = sys.modules["__main__"]
    # Only the main thread may set a handler of signals.
    is_main = threading.current_thread() is threading.main_thread()
    # None also stands for a handler that is not Python's, which could not be restored.
    handler = signal.getsignal(signal.SIGINT) if is_main else None
    if handler is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        if handler is not None:
            signal.signal(signal.SIGINT, handler)


@contextlib.contextmanager
def cluster(address: str, n_calls: int) -> Iterator[Workplace]:
    """A workplace of the workers of a Dask scheduler, which gets `n_calls` calls at a time.

    Raises MissingError if there is no scheduler at the address, or if it has no worker.
    """
    from distributed import Client  # an extra

    try:
        client = Client(address, timeout=_SECONDS_TO_CONNECT)
        client.wait_for_workers(1, timeout=_SECONDS_TO_CONNECT)
    except (OSError, ValueError):
        advice = "start 'dask scheduler', and 'dask worker ADDRESS --nthreads 1'"
        raise MissingError(f"no Dask scheduler at {address!r} with a worker: {advice}") from None
    with client:
        # With `pure` Dask would answer an equal call with the result of an earlier one.
        executor = client.get_executor(pure=False)
        try:
            # Dask's executor takes all calls, so each beginning gives the same one.
            yield Workplace(lambda: executor, n_calls, 1, [])
        finally:
            executor.shutdown(wait=False)  # after an error: does not wait for jobs that still run
