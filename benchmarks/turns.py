"""Trackers that take turns, so that a machine that slows down slows all of them alike."""

import time
from collections.abc import Hashable, Mapping
from itertools import product

import numpy as np
import pandas as pd

from nbtrack.data.sequence import RgbdSequence
from nbtrack.tracking.tracker import Tracker


def in_turns(runs: Mapping[Hashable, tuple[Tracker, RgbdSequence]]) -> pd.DataFrame:
    """Every frame but the first by each tracker in its turn, on sequences of equal length.

    A row a frame: of which run, milliseconds with everything but the reading of files, steps, and
    the error of the position (m).
    """
    rows = []
    n_frames = {len(sequence) for _, sequence in runs.values()}
    for index, (name, (tracker, sequence)) in product(range(1, min(n_frames)), runs.items()):
        frame, start = sequence[index], time.perf_counter()
        found = tracker.track(frame)
        milliseconds = 1000 * (time.perf_counter() - start)
        off = found.T_world_camera[:3, 3] - sequence.T_world_camera[index, :3, 3]
        rows.append((name, milliseconds, found.steps, float(np.linalg.norm(off))))
    return pd.DataFrame(rows, columns=["run", "milliseconds", "steps", "error_m"])
