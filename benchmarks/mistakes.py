"""Both kinds of mistakes of a tracker's verdicts, counted."""

import numpy as np
import pandas as pd


def mistakes(frames: pd.DataFrame, wrong_m: float) -> dict[str, int]:
    """Counts over the frames of a run, of which one is wrong if it is off by more than `wrong_m`.

    Wrong frames that are not called lost are missed; right ones that are called lost are lost in
    vain. The paper's methods do not judge themselves.
    """
    is_wrong = (frames["translation_error_m"] > wrong_m).to_numpy()
    is_lost = frames["lost"].to_numpy(bool) if "lost" in frames else np.zeros_like(is_wrong)
    stretches = np.split(is_wrong, np.flatnonzero(np.diff(is_wrong)) + 1)
    return {
        "wrong_frames": int(is_wrong.sum()),
        "longest_wrong": max(int(stretch.sum()) for stretch in stretches),
        "called_lost": int(is_lost.sum()),
        "missed_frames": int((is_wrong & ~is_lost).sum()),
        "frames_lost_in_vain": int((is_lost & ~is_wrong).sum()),
    }
