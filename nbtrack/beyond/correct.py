"""Correct a finished map at its surfaces, by the frames that it was made from."""

import time
from dataclasses import replace

from nbtrack.beyond.correction import corrected
from nbtrack.data.sequence import RgbdSequence
from nbtrack.mapping.files import Map
from nbtrack.mapping.holdout import split_holdout, usual_depth_residual


def correct_map(finished: Map, sequence: RgbdSequence, voxel: float) -> Map:
    """A map corrected in cells of `voxel` (m) by the frames it was made from; see `correction`.

    It says how long that took, and how much memory network and corrections take.
    """
    start = time.perf_counter()
    mapped, _ = split_holdout(len(sequence), finished.record["settings"]["holdout_every"])
    field = corrected(finished.field, sequence, mapped, voxel)
    seconds = time.perf_counter() - start
    record = {**finished.record, "correction": voxel, "correction_seconds": seconds}
    record["map_bytes"] = sum(tensor.nbytes for tensor in field.state_dict().values())
    record["seconds"] += seconds
    record["misfit_m"] = usual_depth_residual(field, sequence, mapped)
    return replace(finished, field=field, record=record)
