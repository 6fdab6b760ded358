"""Simulated camera poses from points (PnP), shared by the benchmarks of solvers and refinement."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl

FOCAL, CENTER, SIGMA = 700.0, (600.0, 180.0), 0.5


class Problems(NamedTuple):
    """A batch of problems in double precision, and the camera.

    Attributes:
        camera: shared by all.
        points: "b n 3", world frame, m.
        pixels: "b n 2", with noise of `SIGMA` and outliers.
        truth: "b 4 4", ``T_world_camera``.
        start: "b 4 4", guesses some 0.1 m and 0.1 rad off.
    """

    camera: jl.sensors.Pinhole
    points: np.ndarray
    pixels: np.ndarray
    truth: np.ndarray
    start: np.ndarray

    def arrays(self) -> tuple:
        """Points, pixels and starts as arrays of the default dtype."""
        dtype = jnp.zeros(()).dtype
        start = jax.vmap(jl.poses.SE3.from_matrix)(jnp.asarray(self.start, dtype))
        return jnp.asarray(self.points, dtype), jnp.asarray(self.pixels, dtype), start

    def truths(self) -> jl.poses.SE3:
        """The true poses, stacked."""
        return jax.vmap(jl.poses.SE3.from_matrix)(jnp.asarray(self.truth, jnp.zeros(()).dtype))

    def intrinsics(self) -> np.ndarray:
        """The intrinsic matrix in double precision."""
        return np.array([[FOCAL, 0.0, CENTER[0]], [0.0, FOCAL, CENTER[1]], [0.0, 0.0, 1.0]])


def simulate(count: int, num_points: int = 50, *, outliers: float = 0.0, seed: int = 0) -> Problems:
    """Simulates problems: points 4 to 20 m ahead of cameras with poses some 0.3 m and 0.3 rad from the origin."""
    rng = np.random.default_rng(seed)
    shape = (count, num_points)
    truth = np.stack([_pose(xi) for xi in 0.3 * rng.normal(size=(count, 6))])
    start = truth @ np.stack([_pose(xi) for xi in 0.05 * rng.normal(size=(count, 6))])
    seen = np.stack([rng.uniform(-4, 4, shape), rng.uniform(-2, 2, shape), rng.uniform(4, 20, shape)], axis=-1)
    points = np.einsum("bij,bnj->bni", truth[:, :3, :3], seen) + truth[:, None, :3, 3]
    pixels = FOCAL * seen[..., :2] / seen[..., 2:] + np.array(CENTER) + SIGMA * rng.normal(size=(*shape, 2))
    wrong = rng.uniform([0.0, 0.0], [1200.0, 360.0], (*shape, 2))
    pixels = np.where(rng.uniform(size=(*shape, 1)) < outliers, wrong, pixels)
    return Problems(jl.sensors.Pinhole(FOCAL, FOCAL, *CENTER), points, pixels, truth, start)


def _pose(xi: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = cv2.Rodrigues(xi[3:])[0], xi[:3]
    return matrix
