"""Locks that keep other processes out of a folder."""

import contextlib
import errno
import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from filelock import FileLock

from nbtrack.core.progress import tell

_NO_LOCKS = errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP  # what their lack is called


@contextlib.contextmanager
def locked(path: Path, timeout: float = -1) -> Iterator[bool]:
    """Keep other processes out of a block by a lock file, and tell whether that was possible.

    The system frees the lock when this process ends, however it ends. Where the file system knows
    none, that is said once. Raises filelock's Timeout where others keep it for `timeout` s; less
    than 0 waits as long as they do.
    """
    lock = FileLock(path, timeout=timeout)
    try:
        # It warns before it takes another kind, which would wait for files that locks have left.
        with warnings.catch_warnings(action="error"):
            lock.acquire()
    except (OSError, UserWarning) as error:
        if getattr(error, "errno", errno.ENOSYS) not in _NO_LOCKS:
            raise
        _tell_of_no_locks()
    try:
        yield lock.is_locked
    finally:
        lock.release()


@cache
def _tell_of_no_locks() -> None:
    tell("nbtrack: warning: no locks on this file system: run one command at a time in a folder")
