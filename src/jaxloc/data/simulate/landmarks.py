"""Simulated drives among point landmarks with known noise, for consistency tests of SLAM filters."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from jaxloc._jit import filter_jit
from jaxloc.beliefs import Motion
from jaxloc.poses import SE2, retract
from jaxloc.sensors import Increment, RangeBearing
from jaxloc.sensors.landmarks import observe


class LandmarkDrive(eqx.Module):
    """A simulated drive.

    Attributes:
        increments: odometry increments of all steps, stacked.
        readings: one at the end of each step, stacked.
        valid: whether a landmark was seen.
        poses: true T_world_robot after each step, stacked.
        landmarks: "k 2" true positions, m.
    """

    increments: Increment
    readings: RangeBearing
    valid: Bool[Array, " t"]
    poses: SE2
    landmarks: Float[Array, "k 2"]


@filter_jit
def simulate_landmarks(
    motion: Motion,
    deviations: Float[Array, "2"],
    *,
    key: Key[Array, ""],
    num_steps: int = 400,
    num_landmarks: int = 20,
    radius: float = 10.0,
    reach: float = 8.0,
    laps: float = 2.0,
) -> LandmarkDrive:
    """Simulates laps on a circle that starts at the origin, with landmarks scattered along it.

    Odometry reports the plan, and the robot does not quite follow it: true motion is a draw from the motion model. Each
    step ends in a reading of one random landmark within reach, if there is one.

    Args:
        motion: how the robot errs, a `Motion` of SE2 whose control is an `Increment`.
        deviations: standard deviations of range (m) and bearing (rad).
        key: random key.
        num_steps: steps of one second.
        num_landmarks: how many.
        radius: of the circle, m.
        reach: how far the sensor sees, m.
        laps: how often around.

    Returns:
        The drive.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> motion = jl.sensors.IncrementMotion()
        >>> drive = jl.data.simulate.landmarks.simulate_landmarks(
        ...     motion, jnp.array([0.1, 0.02]), key=jax.random.key(0), num_steps=20)
        >>> drive.poses.translation.shape
        (20, 2)
    """
    key_map, key_drive, key_choice, key_read = jax.random.split(key, 4)
    dtype = deviations.dtype
    landmarks = _scatter(num_landmarks, radius, reach, dtype, key_map)
    turn = 2.0 * jnp.pi * laps / num_steps
    plan = Increment(jnp.ones((), dtype), SE2.exp(jnp.array([turn * radius, 0.0, turn], dtype)))

    def advance(pose, keys):
        drive, choose, read = keys
        pose = motion.sample(pose, plan, key=drive)
        distances = jnp.sqrt(jnp.sum((landmarks - pose.translation[None]) ** 2, axis=1))
        near = distances < reach
        index = jnp.argmax(jnp.where(near, jax.random.uniform(choose, near.shape, dtype), -1.0)).astype(jnp.int32)
        exact = observe(pose, landmarks[index], index)
        noise = deviations * jax.random.normal(read, (2,), dtype)
        return pose, (pose, retract(exact, noise), jnp.any(near))

    keys = tuple(jax.random.split(one, num_steps) for one in (key_drive, key_choice, key_read))
    _, (poses, readings, valid) = jax.lax.scan(advance, SE2.identity(dtype), keys)
    increments = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_steps, *leaf.shape)), plan)
    return LandmarkDrive(increments, readings, valid, poses, landmarks)


def _scatter(count: int, radius: float, reach: float, dtype: Any, key: Key[Array, ""]) -> Float[Array, "k 2"]:
    """Positions evenly around the circle's center (0, radius), at random distances from the way."""
    angles = jnp.arange(count, dtype=dtype) * (2.0 * jnp.pi / count)
    offsets = jax.random.uniform(key, (count,), dtype, -0.5 * reach, 0.5 * reach)
    return jnp.stack([(radius + offsets) * jnp.cos(angles), radius + (radius + offsets) * jnp.sin(angles)], axis=1)
