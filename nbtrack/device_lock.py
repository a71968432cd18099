"""Runs by the clock have their device to themselves, whichever command started the others.

A neighbour would slow the clock's steps down, and the result would be one of the neighbourhood. So
every map and every run of this user holds its device together with others, and a run by the clock
holds it alone. The system frees the hold of a process that ends, however it ends.
"""

import getpass
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from filelock import ReadWriteLock, Timeout

Say = Callable[[str], None]


@contextmanager
def beside_others_on(device: torch.device, say: Say) -> Iterator[None]:
    """Hold a device together with other runs; waits while a run by the clock has it.

    Args:
        say: told why, if there is something to wait for.
    """
    lock = _lock_of(device)
    try:
        lock.acquire_read(timeout=0)
    except Timeout:
        say("waits for a run by the clock on this device")
        lock.acquire_read()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def alone_on(device: torch.device, say: Say) -> Iterator[None]:
    """Hold a device alone; waits until no other run has it."""
    lock = _lock_of(device)
    try:
        lock.acquire_write(timeout=0)
    except Timeout:
        say("by the clock: waits until no other run is on this device")
        lock.acquire_write()
    try:
        yield
    finally:
        lock.release()


def _lock_of(device: torch.device) -> ReadWriteLock:
    name = re.sub(r"\W", "_", f"nbtrack_{getpass.getuser()}_{device}")
    return ReadWriteLock(Path(tempfile.gettempdir()) / f"{name}.lock")
