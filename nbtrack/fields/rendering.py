"""Volume rendering as pure functions of tensors, without networks.

Ray directions have z = 1 in the camera frame. So positions of samples on a ray are z-depths, and a
distance along the ray is a z-depth times the length of the direction, which is at least 1.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nbtrack.core.arrays import RayColors, RaySamples, Scalar

Weights = Float[Tensor, "rays parts"]
"""Probabilities that rays end at their samples, or in the sections between two samples."""


@dataclass(frozen=True)
class Rendering:
    """What rays see: expected values under their weights."""

    color: Float[Tensor, "rays 3"]  # in [0, 1]
    depth: Float[Tensor, "rays"]  # z-depth, m
    depth_variance: Float[Tensor, "rays"]  # m^2
    weights: Weights  # the sum over a ray is at most 1
    depths: RaySamples  # z-depths (m) at which the field was asked


def weights_from_density(
    density: RaySamples, depths: RaySamples, ray_lengths: Float[Tensor, "rays"]
) -> RaySamples:
    """Termination probabilities w_i = o_i prod_{j<i} (1 - o_j), o_i = 1 - exp(-density_i delta_i).

    Densities are in 1/m, z-depths (ascending) in m. `ray_lengths` are the lengths of the ray
    directions, and delta_i is the distance (m) from sample i to the next one along the ray. The
    last sample has no next one, and takes the delta of the sample before it. So a wall there is
    opaque, and free space there is not (our choice). Source: Sucar et al. 2021 (iMAP), Sec. 3.2.
    """
    z_steps = depths.diff()
    sections = torch.cat([z_steps, z_steps[:, -1:]], dim=1) * ray_lengths[:, None]
    optical_depth = density * sections
    opacity = -torch.expm1(-optical_depth)
    # The transmittance from the camera to a sample, whose own section does not count.
    transmittance = torch.exp(-(optical_depth.cumsum(dim=1) - optical_depth))
    return opacity * transmittance


def weights_from_sdf(sdf: RaySamples, inverse_std: Scalar) -> Float[Tensor, "rays sections"]:
    """NeuS's unbiased, occlusion-aware weights of the sections between neighbouring samples.

    The weights are w_i = Phi(f_0) alpha_i prod_{j<i} (1 - alpha_j), with
    alpha_i = max((Phi(f_i) - Phi(f_{i+1})) / Phi(f_i), 0) and Phi(f) = sigmoid(s f). The signed
    distance f is in m and positive in free space; s, `inverse_std`, is in 1/m.

    The factor Phi(f_0) is our choice. NeuS lets a ray that starts inside a solid leave it, since it
    looks at objects from outside. In a room seen from inside, the space around the cameras then
    filled up. With the factor a ray whose first sample lies inside a solid sees nothing.

    Source: Wang et al. 2021 (NeuS), Eq. 13. NeuS's published code instead extrapolates f from the
    middles of sections; the formula of the paper, used here, needs no second derivatives.
    """
    # log_ratio is the logarithm of 1 - alpha_i = min(Phi(f_{i+1}) / Phi(f_i), 1). The quotient
    # itself would be 0/0 deep inside objects.
    log_phi = torch.nn.functional.logsigmoid(inverse_std * sdf)
    log_ratio = log_phi.diff().clamp_max(0)
    # The logarithm of Phi(f_0) times all (1 - alpha_j) before a section. The sum includes the
    # section's own term, which is subtracted again.
    log_passed = log_phi[:, :1] + log_ratio.cumsum(dim=1) - log_ratio
    return -torch.expm1(log_ratio) * torch.exp(log_passed)


def composite(weights: RaySamples, colors: RayColors, depths: RaySamples) -> Rendering:
    """Expected colour C = sum w c, z-depth D = sum w d and depth variance sum w (D - d)^2 of rays.

    Light that passes the last sample adds nothing. Source: Sucar et al. 2021 (iMAP), Sec. 3.2.
    """
    depth = (weights * depths).sum(dim=1)
    color = (weights[..., None] * colors).sum(dim=1)
    depth_variance = (weights * (depth[:, None] - depths).square()).sum(dim=1)
    return Rendering(color, depth, depth_variance, weights, depths)


def stratified_samples(
    near: float, far: Float[Tensor, "rays"], n_samples: int, generator: Generator | None = None
) -> RaySamples:
    """One uniformly random value in each of `n_samples` equal parts of [near, far], for each ray.

    The values are z-depths (m), or whatever else `near` and `far` are. Without a generator each
    value is the middle of its part.
    """
    offsets = far.new_full((len(far), n_samples), 0.5)
    if generator is not None:
        torch.rand(offsets.shape, generator=generator, out=offsets)
    parts = (torch.arange(n_samples, device=far.device) + offsets) / n_samples
    return near + (far[:, None] - near) * parts


def importance_depths(
    depths: RaySamples, weights: RaySamples, n_samples: int, generator: Generator | None = None
) -> Float[Tensor, "rays new_samples"]:
    """Z-depths (m) drawn from the piecewise-constant density that the weights of samples describe.

    Each sample of the first pass has a cell, whose borders are the mid-points to its neighbours;
    the first and the last cell end at their samples. A cell is drawn with a probability that is
    proportional to its weight plus a small constant. So on a ray without any weight, which sees
    free space only, all cells are equally likely. Source: inverse transform sampling, Mildenhall et
    al. 2020 (NeRF), Sec. 5.2, as used by iMAP.
    """
    borders = (depths[:, 1:] + depths[:, :-1]) / 2
    borders = torch.cat([depths[:, :1], borders, depths[:, -1:]], dim=1)
    share = weights + 1e-4
    cdf = torch.nn.functional.pad((share / share.sum(dim=1, keepdim=True)).cumsum(dim=1), (1, 0))
    # Values of the cumulative distribution, stratified in [0, 1]: they form fewer clusters than
    # independent draws.
    levels = stratified_samples(0.0, depths.new_ones(len(depths)), n_samples, generator)
    # For each level, the index of the upper border of its cell.
    cell = torch.searchsorted(cdf, levels, right=True).clamp(1, cdf.shape[-1] - 1)
    cdf_low, cdf_high = cdf.gather(-1, cell - 1), cdf.gather(-1, cell)
    low, high = borders.gather(-1, cell - 1), borders.gather(-1, cell)
    return low + (high - low) * (levels - cdf_low) / (cdf_high - cdf_low)
