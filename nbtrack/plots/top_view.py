"""The world seen from above, not mirrored: which axes lie on the page, and which way up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

Direction = tuple[float | int, float | int, float | int]
Y_UP: Direction = (0, 1, 0)
_AXIS_NAMES = "xyz"


@dataclass(frozen=True)
class TopView:
    """Two world axes on the page, the third towards the reader; indices of x, y, z."""

    right: int
    ahead: int  # drawn vertically, growing upwards or downwards
    vertical: int
    ahead_is_upwards: bool
    up_sign: int  # of the vertical axis: +1 where up is its positive direction

    @classmethod
    def along(cls, up: Direction) -> "TopView":
        """The view against the world axis that is nearest to `up`."""
        vertical = int(np.abs(up).argmax())
        up_sign = 1 if up[vertical] > 0 else -1
        right, ahead = [axis for axis in range(3) if axis != vertical]
        # Right, page-up and up must be right-handed, or the reader sees a mirrored room.
        is_even_order = vertical != 1
        return cls(right, ahead, vertical, is_even_order == (up_sign > 0), up_sign)

    def on_page(self, points_world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """The points' two coordinates (m) on the page."""
        return points_world[:, [self.right, self.ahead]]

    def finish(self, axes: Axes) -> None:
        """Label the axes in metres, make them equal, and turn them the right way round."""
        axes.set(xlabel=f"{_AXIS_NAMES[self.right]} (m)", ylabel=f"{_AXIS_NAMES[self.ahead]} (m)")
        axes.set_aspect("equal")
        if not self.ahead_is_upwards:
            axes.invert_yaxis()
