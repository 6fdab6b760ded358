"""Registration of floor images with each other, and the pose graph of a camera's path over the floor."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float64

from jaxloc.beliefs.gates import gate
from jaxloc.pipelines.floor_mosaic.options import Config, OdometryNoise
from jaxloc.poses import SE2
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.sensors import Increment, IncrementMotion
from jaxloc.slam.mosaic import Exposure, Overlap, Patch, Registration, balance, register, register_squares
from jaxloc.slam.pose_graph import Edges, PoseGraph, marginals, optimize
from jaxloc.solvers import GemanMcClure, Quadratic


class Pair(eqx.Module):
    """Registration of one image with another.

    Attributes:
        first: number of the earlier image.
        second: number of the later one.
        motion: ``T_first_second`` as (x, y, heading), m and rad.
        covariance: in its tangent.
        share: fraction of the second image that overlaps the first.
        closes: whether it closes a loop.
        ok: whether it was accepted.
        overlap: gray levels of both there.
    """

    first: int
    second: int
    motion: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"]
    share: float
    closes: bool
    ok: bool
    overlap: Overlap


class Path(eqx.Module):
    """Images along a path, with the registrations and poses so far.

    Attributes:
        patches: the rectified images.
        odometry: motion (x, y, heading) from each image to the next, m and rad.
        noise: covariance of each motion, in its tangent.
        poses: (x, y, heading) of each image.
        covariances: of the poses, in their tangents; zero before `optimize_poses`.
        pairs: all registrations that were tried.
        ok: whether the pose graph was solved.
    """

    patches: tuple[Patch, ...]
    odometry: Float64[np.ndarray, "m 3"]
    noise: Float64[np.ndarray, "m 3 3"]
    poses: Float64[np.ndarray, "n 3"]
    covariances: Float64[np.ndarray, "n 3 3"]
    pairs: tuple[Pair, ...]
    ok: bool

    @staticmethod
    def start() -> "Path":
        """A path without images."""
        return Path((), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), (), True)

    def __len__(self) -> int:
        return len(self.patches)


def extend(path: Path, patch: Patch, pose: np.ndarray, noise: np.ndarray, config: Config) -> Path:
    """Appends an image, and registers it with those before it.

    Args:
        path: so far.
        patch: the rectified image.
        pose: of the first image; later the motion from the image before, (x, y, heading).
        noise: covariance of the motion.
        config: options.
    """
    number, patches = len(path), (*path.patches, patch)
    covariances = np.concatenate([path.covariances, np.zeros((1, 3, 3))])
    if not number:
        return Path(patches, path.odometry, path.noise, pose[None], covariances, (), True)
    poses = np.concatenate([path.poses, compose_poses(path.poses[-1:], pose[None])])
    odometry, noises = np.concatenate([path.odometry, pose[None]]), np.concatenate([path.noise, noise[None]])
    pairs = path.pairs
    for back in range(1, config.neighbors + 1):
        other = number - back
        if other < 0 or _overlap(patch, poses[other], poses[number]) < config.min_overlap:
            continue
        between = _odometry_covariance(odometry, noises, other, number)
        pair = _register(patches, poses, (other, number), between, config, closes=False)
        if pair.ok and (back == 1 or not any(known.second == number and known.ok for known in pairs)):
            poses[number] = compose_poses(poses[other][None], pair.motion[None])[0]
        pairs = (*pairs, pair)
    return Path(patches, odometry, noises, poses, covariances, pairs, path.ok)


def close_loops(path: Path, config: Config) -> Path:
    """Registers images with much earlier ones at the same place, by their current poses."""
    tried = {(pair.first, pair.second) for pair in path.pairs}
    pairs = list(path.pairs)
    for number in range(len(path)):
        earlier = [other for other in range(number - config.neighbors) if (other, number) not in tried]
        shares = {o: _overlap(path.patches[number], path.poses[o], path.poses[number]) for o in earlier}
        best = sorted((o for o in shares if shares[o] >= config.min_overlap), key=lambda o: -shares[o])
        for other in best[: config.closures]:
            between = path.covariances[number] + path.covariances[other] + path.noise[number - 1]
            pairs.append(_register(path.patches, path.poses, (other, number), between, config, closes=True))
    return eqx.tree_at(lambda p: p.pairs, path, tuple(pairs))


def optimize_poses(path: Path, config: Config) -> Path:
    """Solves the pose graph of odometry and registrations."""
    odometry = Edges.chain(planar(path.odometry), _floats(path.noise))
    # Odometry ties images without any overlap to the rest.
    edges = odometry.join(_edges([pair for pair in path.pairs if pair.ok]))
    rough = optimize(planar(path.poses), edges, loss=GemanMcClure(config.kernel)).value
    # A last plain fit of the inliers: the covariance of a robust fit is zero for a pose that one edge alone determines.
    residual = PoseGraph.of(edges, rough, Quadratic()).residual(jax.tree.map(lambda leaf: leaf[1:], rough))
    agree = edges.valid & (jnp.sum(residual**2, axis=0) < (2.0 * config.kernel) ** 2)
    fit = optimize(rough, eqx.tree_at(lambda e: e.valid, edges, agree))
    if not bool(fit.ok):
        return eqx.tree_at(lambda p: p.ok, path, False)
    poses = np.column_stack([np.asarray(part, np.float64) for part in _rows(fit.value)])
    covariances = np.asarray(marginals(fit), np.float64)
    return Path(path.patches, path.odometry, path.noise, poses, covariances, path.pairs, True)


def find_connected(path: Path) -> Bool[np.ndarray, " n"]:
    """Images of the largest group that registrations connect."""
    group = np.arange(len(path))
    for pair in path.pairs:
        if pair.ok:
            group[group == group[pair.second]] = group[pair.first]
    names, sizes = np.unique(group, return_counts=True)
    return (group == names[np.argmax(sizes)]) & (sizes.max() > 1)


def estimate_exposures(path: Path) -> Exposure:
    """Exposures of all images, from the gray levels of registered pairs."""
    good = [pair for pair in path.pairs if pair.ok]
    if not good:
        return Exposure.none(len(path), path.patches[0].values.dtype)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(pair.overlap for pair in good))
    first, second = (jnp.asarray([getattr(pair, name) for pair in good]) for name in ("first", "second"))
    return balance(first, second, stacked, jnp.ones(len(good), bool), count=len(path))


def _edges(good: list[Pair]) -> Edges:
    """Registrations as edges of the graph."""
    capacity = -(-max(len(good), 1) // 64) * 64  # few sizes: each is compiled
    motions, covariances = np.zeros((capacity, 3)), np.tile(np.eye(3), (capacity, 1, 1))
    ends = np.zeros((2, capacity), np.int32)
    for slot, pair in enumerate(good):
        motions[slot], covariances[slot], ends[:, slot] = pair.motion, pair.covariance, (pair.first, pair.second)
    valid = jnp.asarray(np.arange(capacity) < len(good))
    return Edges(jnp.asarray(ends[0]), jnp.asarray(ends[1]), planar(motions), _floats(covariances), valid)


def _odometry_covariance(odometry: np.ndarray, noise: np.ndarray, first: int, second: int) -> np.ndarray:
    """Covariance of the motion between two images by odometry, in the tangent at its end."""
    total = np.zeros((3, 3))
    for number in range(first, second):
        inverse = pose_of_row(relative_poses(odometry[number][None], np.zeros((1, 3)))[0])
        adjoint = np.asarray(inverse.adjoint(), np.float64)
        total = adjoint @ total @ adjoint.T + noise[number]
    return total


def _overlap(patch: Patch, first: np.ndarray, second: np.ndarray) -> float:
    """Fraction of an image that is predicted to lie on another, by a grid of its points."""
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        return 0.0
    motion = relative_poses(first[None], second[None])[0]
    corners = np.asarray(patch.raster.corners(), np.float64)
    low, high = corners.min(axis=0), corners.max(axis=0)
    if np.hypot(*motion[:2]) > np.hypot(*(high - low)):
        return 0.0
    share = (np.arange(12) + 0.5) / 12
    x, y = (axis.ravel() for axis in np.meshgrid(*(a + share * (b - a) for a, b in zip(low, high, strict=True))))
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    moved = np.column_stack([motion[0] + cos * x - sin * y, motion[1] + sin * x + cos * y])
    return float(np.mean(((moved >= low) & (moved <= high)).all(axis=1)))


def _register(
    patches: tuple[Patch, ...],
    poses: np.ndarray,
    ends: tuple[int, int],
    covariance: np.ndarray,
    config: Config,
    *,
    closes: bool,
) -> Pair:
    """Registers an image with an earlier one; by feature squares where that fails from the predicted pose."""
    first, second = ends
    predicted = pose_of_row(relative_poses(poses[first][None], poses[second][None])[0])
    one, other = patches[first], patches[second]
    found = register(one, other, predicted)
    accepted = bool(found.estimate.ok) and _agrees(predicted, found, covariance, config)
    if not accepted:
        squares = register_squares(one, other, predicted)
        if bool(squares.ok):
            found = register(one, other, squares.value)
            accepted = bool(found.estimate.ok) and _agrees(predicted, found, covariance, config)
    own = np.asarray(found.estimate.covariance, np.float64)
    motion, share = row_of_pose(found.estimate.value), float(found.overlap.share)
    return Pair(first, second, motion, own, share, closes, accepted, found.overlap)


def _agrees(predicted: SE2, found: Registration, covariance: np.ndarray, config: Config) -> bool:
    """Whether a registration passes the gate of the prediction."""
    error = np.asarray(predicted.local(found.estimate.value), np.float64)
    total = covariance + np.asarray(found.estimate.covariance, np.float64)
    return bool(gate(jnp.asarray(error @ np.linalg.solve(total, error)), 3, config.gate))


def odometry_covariances(odometry: np.ndarray, config: Config) -> np.ndarray:
    """Covariances of motions (x, y, heading), by the noise of the odometry."""
    if not len(odometry):
        return np.zeros((0, 3, 3))
    noise = config.odometry
    names = [name for name in vars(OdometryNoise()) if not name.startswith("_")]
    motion = IncrementMotion(**{name: getattr(noise, name) for name in names})
    motions = planar(odometry)
    each = jax.vmap(lambda one: motion.covariance(one, Increment(jnp.ones(()), one)))(motions)
    return np.asarray(each, np.float64)


def _floats(values: np.ndarray) -> Any:
    return jnp.asarray(values, jnp.result_type(float))


def planar(rows: np.ndarray) -> SE2:
    """Stacked poses of rows (x, y, heading)."""
    return jax.vmap(SE2)(*(_floats(column) for column in np.asarray(rows, np.float64).T))


def pose_of_row(row: np.ndarray) -> SE2:
    """The pose of a row (x, y, heading)."""
    return SE2(*(_floats(np.asarray(number)) for number in row))


def _rows(poses: SE2) -> tuple[Any, Any, Any]:
    heading = jnp.arctan2(poses.rotation.sin, poses.rotation.cos)
    return poses.translation[:, 0], poses.translation[:, 1], heading


def row_of_pose(pose: SE2) -> np.ndarray:
    """The row (x, y, heading) of a pose."""
    return np.array([float(pose.x), float(pose.y), float(pose.theta)])
