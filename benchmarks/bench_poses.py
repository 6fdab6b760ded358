"""Lie groups: rounding in float32 against double precision and jaxlie, and the time of exponentials and transforms."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation

import jaxloc as jl
from benchmarks.metric import ACCURACY, Metric, quickest, versus


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _dead_reckoning(200 if smoke else 2000)
    yield from _round_trip(500 if smoke else 5000)
    yield from _speed(1000 if smoke else 100_000, 1 if smoke else 20)


def _dead_reckoning(count: int) -> Iterator[Metric]:
    """How far rounding alone moves the end of a path of small motions, half a meter each."""
    rng = np.random.default_rng(0)
    twists = rng.normal(size=(count, 6)) * 1e-3 + np.array([0.0, 0.0, 0.5, 0.0, 2e-3, 0.0])
    twists = twists.astype(np.float32)
    exact = np.eye(4)
    for twist in twists.astype(float):
        exact = exact @ scipy.linalg.expm(_hat(twist))
    path = jax.jit(lambda xi: jl.poses.chain(jl.poses.SE3.identity(), jax.vmap(jl.poses.SE3.exp)(xi)))(twists)
    peer = jax.jit(_jaxlie_end)(twists)
    per_km = 1000.0 / (0.5 * count)
    ours = float(np.linalg.norm(np.asarray(path.translation[-1], float) - exact[:3, 3])) * per_km
    theirs = float(np.linalg.norm(np.asarray(peer, float) - exact[:3, 3])) * per_km
    yield Metric("poses.dead_reckoning", ours, "m/km", "lower", 5 * ACCURACY)
    yield Metric("poses.dead_reckoning.jaxlie", theirs, "m/km")


def _jaxlie_end(twists):
    def step(pose, twist):
        return pose @ jaxlie.SE3.exp(twist), None

    return jax.lax.scan(step, jaxlie.SE3.identity(), twists)[0].translation()


def _hat(twist: np.ndarray) -> np.ndarray:
    x, y, z = twist[3:]
    matrix = np.zeros((4, 4))
    matrix[:3] = [[0.0, -z, y, twist[0]], [z, 0.0, -x, twist[1]], [-y, x, 0.0, twist[2]]]
    return matrix


def _round_trip(count: int) -> Iterator[Metric]:
    """Errors of exponential and logarithm, for angles from 1e-7 rad to nearly half a turn."""
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.geomspace(1e-7, 3.1, count)
    twists = np.concatenate([rng.normal(size=(count, 3)), axes * angles[:, None]], axis=1).astype(np.float32)
    poses = jax.jit(jax.vmap(jl.poses.SE3.exp))(twists)
    matrices = np.asarray(poses.rotation.rotation_matrix, float)
    exact = Rotation.from_rotvec(twists[:, 3:].astype(float)).as_matrix()
    back = np.asarray(jax.jit(jax.vmap(lambda pose: pose.log()))(poses), float)
    yield Metric("poses.exp_error", float(np.abs(matrices - exact).max()), "1", "lower", 5 * ACCURACY)
    yield Metric("poses.log_exp_error", float(np.abs(back - twists).max()), "rad, m", "lower", 5 * ACCURACY)


def _speed(count: int, repeats: int) -> Iterator[Metric]:
    rng = np.random.default_rng(2)
    twists = jnp.asarray(0.3 * rng.normal(size=(count, 6)), jnp.float32)
    points = jnp.asarray(rng.normal(size=(count, 3)), jnp.float32)
    pose, peer_pose = jl.poses.SE3.exp(twists[0]), jaxlie.SE3.exp(twists[0])
    exp = jax.jit(jax.vmap(jl.poses.SE3.exp))
    peer_exp = jax.jit(jax.vmap(lambda xi: jaxlie.SE3.exp(xi).as_matrix()))
    ours = quickest(lambda: exp(twists), repeats)
    yield Metric("poses.exp", 1e9 * ours.wall / count, "ns")
    yield from versus("poses.exp.vs_jaxlie", ours, quickest(lambda: peer_exp(twists), repeats))
    apply = jax.jit(lambda pose, points: pose.apply(points))
    peer_apply = jax.jit(lambda pose, points: pose @ points)
    ours = quickest(lambda: apply(pose, points), repeats)
    yield Metric("poses.apply", 1e9 * ours.wall / count, "ns")
    yield from versus("poses.apply.vs_jaxlie", ours, quickest(lambda: peer_apply(peer_pose, points), repeats))
