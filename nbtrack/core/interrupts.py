"""Ctrl-C, put off while processes are started or ended that it would reach as well."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any

INTERRUPTED = "interrupted; run the same command again to go on"
STATUS = 130  # what shells say of a command that ended so


@contextlib.contextmanager
def interrupts_put_off() -> Iterator[None]:
    """Let Ctrl-C wait for the end of a block, and never reach what is started within.

    These are processes that this one ends by itself, and that would each end with a traceback.
    """
    came: list[bool] = []
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
