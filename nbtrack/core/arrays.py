"""Types of arrays that many signatures share. Names of arguments tell frames and units."""

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from torch import Tensor

Pose = Float[np.ndarray, "4 4"]  # a rigid transform, in double precision
Poses = Float[np.ndarray, "_ 4 4"]
Position = Float[np.ndarray, "3"]  # m, in double precision
ColorImage = UInt8[np.ndarray, "height width 3"]  # RGB
DepthImage = UInt16[np.ndarray, "height width"]  # mm, 0 = no measurement
Transform = Float[Tensor, "4 4"]  # a rigid transform, through which gradients may flow
Transforms = Float[Tensor, "_ 4 4"]
Points = Float[Tensor, "n 3"]  # m
Colors = Float[Tensor, "n 3"]  # red, green, blue in [0, 1]
Values = Float[Tensor, "n"]
Indices = Int[Tensor, "n"]
Scalar = Float[Tensor, ""]
RaySamples = Float[Tensor, "rays samples"]  # a value for each sample of each ray
RayColors = Float[Tensor, "rays samples 3"]
WorldPoints = Float[np.ndarray, "_ 3"]  # m, in double precision
Frames = Int[np.ndarray, "_"]  # indices of a sequence's frames
