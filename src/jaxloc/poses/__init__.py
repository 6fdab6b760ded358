"""Where things are: rotations, poses, and moving any pytree along a tangent."""

from jaxloc.poses import compound, direction, manifold, planar, rotation, se2, se3, series, trajectory
from jaxloc.poses.direction import Direction
from jaxloc.poses.group import Group
from jaxloc.poses.manifold import carry, is_flat, local, retract, tangent_dimension, tangent_labels
from jaxloc.poses.rotation import SO2, SO3, wrap_angle
from jaxloc.poses.se2 import SE2
from jaxloc.poses.se3 import SE3
from jaxloc.poses.trajectory import Trajectory, chain, interpolate

__all__ = [
    "SE2",
    "SE3",
    "SO2",
    "SO3",
    "Direction",
    "Group",
    "Trajectory",
    "carry",
    "chain",
    "compound",
    "direction",
    "interpolate",
    "is_flat",
    "local",
    "manifold",
    "planar",
    "retract",
    "rotation",
    "se2",
    "se3",
    "series",
    "tangent_dimension",
    "tangent_labels",
    "trajectory",
    "wrap_angle",
]
