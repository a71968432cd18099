"""Processes that start at once, forked from one that has imported everything."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import dask
from distributed.utils import get_mp_context

IMPORTED = ["torch._dynamo", "trimesh", "pytest", "distributed", "nbtrack.experiments.bench"]


@contextmanager
def forking() -> Iterator[Any]:
    """The context of `multiprocessing` that starts them; Dask's workers are such ones too."""
    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        context = get_mp_context()
        context.set_forkserver_preload(IMPORTED)
        yield context
