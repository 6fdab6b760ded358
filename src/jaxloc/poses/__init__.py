"""Rotations and poses: Lie groups, retraction of any pytree along its tangent space, and trajectories."""

from jaxloc.poses import (
    compound,
    direction,
    lie_group,
    manifold,
    matrix_exponential,
    planar,
    se2,
    se3,
    series,
    so2,
    so3,
    trajectory,
)
from jaxloc.poses.direction import Direction
from jaxloc.poses.lie_group import Group
from jaxloc.poses.manifold import carry, is_flat, local, retract, tangent_dimension, tangent_labels
from jaxloc.poses.se2 import SE2
from jaxloc.poses.se3 import SE3
from jaxloc.poses.so2 import SO2, wrap_angle
from jaxloc.poses.so3 import SO3
from jaxloc.poses.trajectory import Trajectory, chain, interpolate

__all__ = [
    "Direction",
    "Group",
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "Trajectory",
    "carry",
    "chain",
    "compound",
    "direction",
    "interpolate",
    "is_flat",
    "lie_group",
    "local",
    "manifold",
    "matrix_exponential",
    "planar",
    "retract",
    "se2",
    "se3",
    "series",
    "so2",
    "so3",
    "tangent_dimension",
    "tangent_labels",
    "trajectory",
    "wrap_angle",
]
