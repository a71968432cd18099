"""Ctrl-C: the end at once while a library is imported, which might swallow it; else as usual."""

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

INTERRUPTED = "interrupted; run the same command again to go on"
STATUS = 130  # what shells say of a command that ended so


def heed_interrupts() -> None:
    """Handle Ctrl-C in a command's main thread, unless somebody else does already."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        _handle_by(_end_or_raise)


@contextlib.contextmanager
def interrupts_put_off() -> Iterator[None]:
    """Ctrl-C waits for the end of a block, and never reaches what is started within: processes that
    this one ends by itself, and that would each end with a traceback."""
    if sys.platform == "win32":  # there is no mask that a process inherits
        yield
        return
    came = []
    usual = signal.getsignal(signal.SIGINT)
    resource_tracker.ensure_running()  # started within, it would let Ctrl-C through again
    _handle_by(lambda *_: came.append(True))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # which they inherit
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        _handle_by(usual)
    if came:
        raise KeyboardInterrupt


def _handle_by(handler: Callable[[int, FrameType | None], Any]) -> None:
    with contextlib.suppress(ValueError):  # of another thread, which Ctrl-C does not reach
        signal.signal(signal.SIGINT, handler)


def _end_or_raise(number: int, frame: FrameType | None) -> None:
    at = frame
    while at is not None:
        if at.f_code.co_filename.startswith("<frozen importlib"):
            os.write(2, f"nbtrack: {INTERRUPTED}\n".encode())
            os._exit(STATUS)
        at = at.f_back
    signal.default_int_handler(number, frame)
