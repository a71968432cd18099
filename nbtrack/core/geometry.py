"""Rigid transforms and unit quaternions, differentiable. No learning, no files."""

import torch
from jaxtyping import Float
from torch import Tensor

from nbtrack.machinery.device import constant


def normalize_quaternion(q_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The quaternion divided by its norm, which describes the same rotation.

    Source: paper, implementation details ("we renormalize after every optimization step").
    """
    return q_wxyz / q_wxyz.norm(dim=-1, keepdim=True)


def quaternion_to_matrix(q_wxyz: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrix of a quaternion (order w, x, y, z): R = I + 2 [v]× (w I + [v]×).

    [v]× is the matrix for which [v]× x = v × x, where v holds x, y and z of the quaternion.
    The quaternion is normalised here, so that its gradient is tangential to the unit sphere. A
    radial part could dominate Adam's step, and the renormalisation after the step would undo it.

    >>> quaternion_to_matrix(torch.tensor([0.0, 0.0, 0.0, 2.0])).diagonal().tolist()
    [-1.0, -1.0, 1.0]
    """
    device, dtype = q_wxyz.device, q_wxyz.dtype
    w, v = normalize_quaternion(q_wxyz).split([1, 3], dim=-1)
    identity = constant(((1, 0, 0), (0, 1, 0), (0, 0, 1)), device, dtype)
    # The rows of [v]× are e × v for the axes e, which are the rows of the identity.
    cross = torch.linalg.cross(identity.expand(*v.shape[:-1], 3, 3), v[..., None, :])
    w_identity_plus_cross = torch.addcmul(cross, w[..., None], identity)
    return torch.add(identity, cross @ w_identity_plus_cross, alpha=2)


def matrix_to_quaternion(rotation: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternion (w, x, y, z) of a rotation matrix; w >= 0.

    Every row of 4 q qᵀ is a multiple of q. The row with the largest diagonal entry is normalised,
    so that no rotation leads to a division by a small number.
    """
    # The diagonal entries of the rotation matrix, and the other entries of 4 q qᵀ: `wx` is 4 w x.
    difference = rotation - rotation.mT
    total = rotation + rotation.mT
    xx, yy, zz = rotation.diagonal(dim1=-2, dim2=-1).unbind(-1)
    wx, wy, wz = difference[..., 2, 1], difference[..., 0, 2], difference[..., 1, 0]
    xy, xz, yz = total[..., 0, 1], total[..., 0, 2], total[..., 1, 2]
    entries = [
        1 + xx + yy + zz, wx, wy, wz,
        wx, 1 + xx - yy - zz, xy, xz,
        wy, xy, 1 - xx + yy - zz, yz,
        wz, xz, yz, 1 - xx - yy + zz,
    ]  # fmt: skip
    products = torch.stack(entries, dim=-1).unflatten(-1, (4, 4))
    best = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    q_wxyz = normalize_quaternion(products.take_along_dim(best[..., None, None], dim=-2)[..., 0, :])
    return torch.where(q_wxyz[..., :1] < 0, -q_wxyz, q_wxyz)


def make_transform(
    rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Homogeneous transform from a rotation matrix and a translation (m)."""
    top = torch.cat([rotation, translation.unsqueeze(-1)], dim=-1)
    bottom = constant(((0, 0, 0, 1),), rotation.device, rotation.dtype)
    return torch.cat([top, bottom.expand(*rotation.shape[:-2], 1, 4)], dim=-2)


def transform_points(
    T_a_b: Float[Tensor, "4 4"], points_b: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Points (m) of frame b expressed in frame a."""
    rotation, translation = T_a_b[:3].split([3, 1], dim=-1)
    return points_b @ rotation.T + translation.squeeze(-1)
