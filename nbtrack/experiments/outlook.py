"""What is said of a finished run whose camera outran the search, whatever the map was."""

from typing import Any

# A user is told where even the best follower has a larger error (m), or the camera moves farther
# than a search reaches in a larger share of the frames: hands start and stop, and the search
# catches up (our choice).
_LEAST_ATE, _SHARE = 0.01, 0.5


def reach_warning(metrics: dict[str, Any]) -> str | None:
    """A line for a run whose search fell behind its camera; None of any other."""
    least_m = metrics.get("least_ate_m", 0.0)
    share = metrics.get("beyond_reach_share", 0.0)
    if not (least_m > _LEAST_ATE or share > _SHARE):
        return None
    bound = f", and the best that follows it has an ATE of {least_m:.3f} m"
    return (
        f"{metrics['steps_per_frame']:g} steps of {metrics['tracker']} move the camera by at most "
        f"{1e3 * metrics['reach_m']:.1f} mm along an axis and {metrics['reach_deg']:.2f} deg about "
        f"it; it moves farther in {share:.0%} of the frames of {metrics['scene']}"
        f"{bound if least_m > _LEAST_ATE else ''}: take more steps, a lower rate, constant "
        "velocity as motion_model, or --method corrected"
    )
