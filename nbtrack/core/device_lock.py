"""Runs by the clock have their device to themselves, whichever command started the others.

A neighbour would slow the clock's steps down, and the result would be one of the neighbourhood. So
every map and every run of this user holds its device together with others, and a run by the clock
holds it alone. The system frees the hold of a process that ends, however it ends.
"""

import getpass
import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import ReadWriteLock, Timeout

_SLICE_SECONDS = 0.5

Say = Callable[[str], None]


@contextmanager
def beside_others_on(device: torch.device, say: Say) -> Iterator[None]:
    """Hold a device together with other runs; waits while a run by the clock has it.

    Args:
        say: told why, if there is something to wait for.
    """
    lock = _lock_of(device)
    _acquire(lock.acquire_read, lambda: say("waits for a run by the clock on this device"))
    try:
        yield
    finally:
        lock.release()


@contextmanager
def alone_on(device: torch.device, say: Say) -> Iterator[None]:
    """Hold a device alone; waits until no other run has it."""
    lock = _lock_of(device)
    _acquire(
        lock.acquire_write,
        lambda: say("by the clock: waits until no other run is on this device"),
    )
    try:
        yield
    finally:
        lock.release()


def _acquire(acquire: Callable[..., object], say: Callable[[], None]) -> None:
    """Wait in short slices: a longer wait of the lock's could not be interrupted."""
    try:
        acquire(timeout=0)
        return
    except Timeout:
        say()
    while True:
        try:
            acquire(timeout=_SLICE_SECONDS)
            return
        except Timeout:
            continue


def _lock_of(device: torch.device) -> ReadWriteLock:
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    user = os.getuid() if hasattr(os, "getuid") else getpass.getuser()
    name = re.sub(r"\W", "_", f"nbtrack_{user}_{device}")
    return ReadWriteLock(Path(tempfile.gettempdir()) / f"{name}.lock")
