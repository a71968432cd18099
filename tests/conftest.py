"""Fixtures that several test modules ask for by name."""

import os
from collections.abc import Iterator

import pytest
import torch


@pytest.fixture(scope="module")
def one_thread() -> Iterator[None]:
    """For tests with images so small that threads would only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def settings_stay_inside() -> Iterator[None]:
    """What a command sets for its own process must not reach the next test."""
    environment, threads = dict(os.environ), torch.get_num_threads()
    yield
    for name in set(os.environ) - set(environment):
        if name.startswith("NBTRACK_"):
            del os.environ[name]
    if torch.get_num_threads() != threads:
        torch.set_num_threads(threads)
