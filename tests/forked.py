"""Processes that start at once, forked from one that has imported everything."""

import multiprocessing
from contextlib import contextmanager
from multiprocessing import forkserver
from unittest import mock

import dask

IMPORTED = ["torch._dynamo", "trimesh", "pytest", "distributed", "nbtrack.experiments.bench"]


@contextmanager
def forking():
    """The context of `multiprocessing` that starts them; workers, also Dask's, are such ones."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(IMPORTED)
    forkserver.ensure_running()  # before Dask, which would have it import less
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}),
        mock.patch("nbtrack.experiments.workers._START", "forkserver"),
    ):
        yield context
