"""Volume rendering as pure tensor functions that know nothing about networks.

Rays are z-depth rays: a direction has z = 1 in the camera frame and length `ray_lengths` >= 1, so
sample positions are z-depths and metric distances along the ray are z-depths times that length.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nbtrack.core.arrays import RayColors, RaySamples, Scalar

Weights = Float[Tensor, "rays parts"]
"""Probabilities that rays end at their samples, or in the sections between them."""


@dataclass(frozen=True)
class Rendering:
    """What a ray sees: expectations under its weights."""

    color: Float[Tensor, "rays 3"]  # in [0, 1]
    depth: Float[Tensor, "rays"]  # z-depth, m
    depth_variance: Float[Tensor, "rays"]  # m^2
    weights: RaySamples  # their sum is at most 1


def weights_from_density(
    density: RaySamples, depths: RaySamples, ray_lengths: Float[Tensor, "rays"]
) -> RaySamples:
    """Termination probabilities w_i = o_i prod_{j<i} (1 - o_j), o_i = 1 - exp(-density_i delta_i).

    Densities in 1/m, ascending z-depths in m, and the metres along a ray for one metre of z-depth.
    Source: Sucar et al. 2021 (iMAP), Sec. 3.2. The last sample has no successor; it gets the
    section length of the one before it (our choice: a wall stays opaque, and free space free).
    """
    z_steps = depths.diff(dim=1)
    sections = torch.cat([z_steps, z_steps[:, -1:]], dim=1) * ray_lengths[:, None]
    optical_depth = density * sections
    opacity = -torch.expm1(-optical_depth)
    # Transmittance in front of a sample: everything that lies before it, itself left out.
    transmittance = torch.exp(-(optical_depth.cumsum(dim=1) - optical_depth))
    return opacity * transmittance


def weights_from_sdf(sdf: RaySamples, inverse_std: Scalar) -> Float[Tensor, "rays sections"]:
    """NeuS's unbiased, occlusion-aware weights of the sections between neighbouring samples.

    alpha_i = max((Phi(f_i) - Phi(f_{i+1})) / Phi(f_i), 0) with Phi(f) = sigmoid(s f) and weights
    w_i = Phi(f_0) alpha_i prod_{j<i} (1 - alpha_j).

    The factor Phi(f_0) is ours: a camera stands in free space, so a ray whose first sample lies
    inside something is dark. NeuS lets such rays leave the solid unharmed, for it looks at
    objects from outside; in rooms seen from inside the camera's own surroundings then filled up.

    The signed distance f is in m, positive in free space, `inverse_std` s in 1/m. Source:
    Wang et al. 2021 (NeuS), Eq. 13; the published code extrapolates f from mid-points, where the
    paper's own formula spares second derivatives.
    """
    # 1 - alpha_i, which is Phi(f_{i+1}) / Phi(f_i) and at most 1, in logarithms: a plain quotient
    # is 0/0 deep inside objects.
    log_phi = torch.nn.functional.logsigmoid(inverse_std * sdf)
    log_ratio = log_phi.diff(dim=1).clamp_max(0)
    # Phi(f_0) times all (1 - alpha_j) before a section; its own is taken out of the sum again.
    log_passed = log_phi[:, :1] + log_ratio.cumsum(dim=1) - log_ratio
    return -torch.expm1(log_ratio) * torch.exp(log_passed)


def composite(weights: RaySamples, colors: RayColors, depths: RaySamples) -> Rendering:
    """Expected colour, z-depth and depth variance: sum w c, sum w d and sum w (D - d)^2.

    Source: Sucar et al. 2021 (iMAP), Sec. 3.2. Light that passes the last sample adds nothing.
    """
    depth = (weights * depths).sum(dim=1)
    color = (weights[..., None] * colors).sum(dim=1)
    depth_variance = (weights * (depth[:, None] - depths).square()).sum(dim=1)
    return Rendering(color, depth, depth_variance, weights)


def stratified_depths(
    near: float, far: Float[Tensor, "rays"], n_samples: int, generator: Generator | None = None
) -> RaySamples:
    """One uniformly random z-depth (m) in each of `n_samples` equal parts of [near, far].

    Without a generator the samples lie in the middle of their parts.
    """
    offsets = far.new_full((len(far), n_samples), 0.5)
    if generator is not None:
        torch.rand(offsets.shape, generator=generator, out=offsets)
    parts = (torch.arange(n_samples, device=far.device) + offsets) / n_samples
    return near + (far[:, None] - near) * parts


def importance_depths(
    depths: RaySamples, weights: RaySamples, n_samples: int, generator: Generator | None = None
) -> Float[Tensor, "rays new_samples"]:
    """Z-depths (m) drawn from the piecewise-constant density that `weights` describe.

    Inverse transform sampling over the cells whose borders are the mid-points between samples.
    Source: Mildenhall et al. 2020 (NeRF), Sec. 5.2, as used by iMAP. A small floor keeps rays
    without any weight, which see free space only, sampled evenly.
    """
    borders = (depths[:, 1:] + depths[:, :-1]) / 2
    borders = torch.cat([depths[:, :1], borders, depths[:, -1:]], dim=1)
    share = weights + 1e-4
    cdf = (share / share.sum(dim=1, keepdim=True)).cumsum(dim=1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], dim=1)
    # Stratified in probability: fewer clumps than independent draws.
    levels = stratified_depths(0.0, depths.new_ones(len(depths)), n_samples, generator)
    cell = torch.searchsorted(cdf, levels, right=True).clamp(1, cdf.shape[-1] - 1)
    cdf_low, cdf_high = cdf.gather(-1, cell - 1), cdf.gather(-1, cell)
    low, high = borders.gather(-1, cell - 1), borders.gather(-1, cell)
    return low + (high - low) * (levels - cdf_low) / (cdf_high - cdf_low)
