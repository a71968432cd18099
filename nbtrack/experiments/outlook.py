"""What can be said of runs before they are made: whether the camera outruns their search."""

import contextlib
from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np

from nbtrack.core.errors import NbtrackError
from nbtrack.data.sequence import observed_bounds
from nbtrack.experiments.map_jobs import GivenMap, MapJob
from nbtrack.experiments.scenes import Scene
from nbtrack.experiments.track_jobs import TrackJob
from nbtrack.recordings.reading import parse_frames, read_frames, select_frames
from nbtrack.tracking.reach import reach_metrics

_FRAMES_LOOKED_AT = 20  # that tell a map's unit before there is a map
# A user is told where even the best follower has a larger error (m), or the camera moves farther
# than a search reaches in a larger share of the frames: hands start and stop, and the search
# catches up (our choice).
_LEAST_ATE = 0.01
_SHARE = 0.5


def reach_warnings(runs: Sequence[TrackJob]) -> Iterator[str]:
    """A line for each kind of run whose search falls behind its camera, whatever the map is."""
    kinds: dict[tuple, list[TrackJob]] = {}
    for run in runs:
        kinds.setdefault((run.tracker, run.settings, run.steps), []).append(run)
    for (tracker, settings, steps), alike in kinds.items():
        seen = {run.scene.name: expected_reach(run) for run in alike}
        short = {name: r for name, r in seen.items() if _is_short(r)}
        if not short:
            continue
        scene, worst = max(short.items(), key=lambda pair: pair[1]["least_ate_m"])
        others = f" (of {len(short)} scenes)" if len(short) > 1 else ""
        bound = f", and the best that follows it has an ATE of {worst['least_ate_m']:.3f} m there"
        velocity = f"--set tracking.{tracker}.motion_model=constant_velocity, "
        yield (
            f"{steps:g} steps of {tracker} move the camera by at most {1e3 * worst['reach_m']:.1f} "
            f"mm along an axis and {worst['reach_deg']:.2f} deg about it; it moves farther in "
            f"{worst['beyond_reach_share']:.0%} of the frames of {scene}{others}"
            f"{bound if worst['least_ate_m'] > _LEAST_ATE else ''}: take more steps, a lower rate, "
            f"{velocity if settings.motion_model == 'previous_pose' else ''}or --method corrected"
        )


def _is_short(reach: dict[str, float]) -> bool:
    least_m = reach.get("least_ate_m", 0.0)
    share = reach.get("beyond_reach_share", 0.0)
    return least_m > _LEAST_ATE or share > _SHARE


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


def _unit_of(job: MapJob | GivenMap) -> float:
    """Metres a unit of a map; about those of one that is still to be made."""
    if job.is_done:
        return job.map().field.bounds.metres_per_unit
    return _rough_unit(job.scene, job.frames)


@lru_cache
def _rough_unit(scene: Scene, frames: str) -> float:
    ids = select_frames(scene.recording, parse_frames(frames))
    some = ids[np.linspace(0, len(ids) - 1, min(len(ids), _FRAMES_LOOKED_AT)).astype(int)]
    return observed_bounds(read_frames(scene.recording, some)).metres_per_unit
