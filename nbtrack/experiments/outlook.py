"""What can be said of runs before they are made: whether the camera outruns their search."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from functools import lru_cache

from nbtrack.core.errors import NbtrackError
from nbtrack.data.sequence import observed_bounds, parse_frames, read_frames, select_frames
from nbtrack.experiments.jobs import MapJob, TrackJob
from nbtrack.experiments.scenes import Scene
from nbtrack.tracking.reach import reach_metrics

_FRAMES_LOOKED_AT = 20  # that tell a map's unit before there is a map
# A user is told where even the best follower has a larger error (m), or the camera moves farther
# than a search reaches in a larger share of the frames: hands start and stop, and the search
# catches up (our choice).
_LEAST_ATE, _SHARE = 0.01, 0.5


def reach_warnings(runs: Sequence[TrackJob]) -> Iterator[str]:
    """A line for each kind of run whose search falls behind its camera, whatever the map is; it
    names the first scene where that is so."""
    told = set()
    for run in runs:
        kind = run.tracker, run.settings, run.steps
        if kind in told:
            continue
        found = expected_reach(run)
        least_m, share = found.get("least_ate_m", 0.0), found.get("beyond_reach_share", 0.0)
        if least_m <= _LEAST_ATE and share <= _SHARE:
            continue
        told.add(kind)
        bound = f", and the best that follows it has an ATE of {least_m:.3f} m there"
        velocity = f"--set tracking.{run.tracker}.motion_model=constant_velocity, "
        yield (
            f"{run.steps:g} steps of {run.tracker} move the camera by at most "
            f"{1e3 * found['reach_m']:.1f} mm along an axis and {found['reach_deg']:.2f} deg about "
            f"it; it moves farther in {share:.0%} of the frames of {run.scene.name}"
            f"{bound if least_m > _LEAST_ATE else ''}: take more steps, a lower rate, "
            f"{velocity if run.settings.motion_model == 'previous_pose' else ''}"
            "or --method corrected"
        )


def expected_reach(run: TrackJob) -> dict[str, float]:
    """What `reach_metrics` will say of a run; nothing where its steps are not known before."""
    if run.steps is None:
        return {}
    with contextlib.suppress(NbtrackError):  # the run itself will say what is wrong
        recording = run.scene.recording
        frame_ids = select_frames(recording, parse_frames(run.frames), needs_poses=False)
        reach = run.settings.reach(run.steps, _unit_of(run.needs))
        path = recording.T_world_camera[frame_ids]
        return reach_metrics(reach, path, run.settings.motion_model)
    return {}


def _unit_of(job: MapJob) -> float:
    """Metres a unit of a map; about those of one that is still to be made."""
    is_done = job.is_done
    return job.map().field.bounds.metres_per_unit if is_done else _rough_unit(job.scene, job.frames)


@lru_cache
def _rough_unit(scene: Scene, frames: str) -> float:
    ids = select_frames(scene.recording, parse_frames(frames))
    some = ids[:: math.ceil(len(ids) / _FRAMES_LOOKED_AT)]
    return observed_bounds(read_frames(scene.recording, some)).metres_per_unit
