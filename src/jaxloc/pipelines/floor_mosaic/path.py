"""The path of a camera over a floor: images laid upon each other, loops closed by a pose graph."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float64

from jaxloc.beliefs.gates import gate
from jaxloc.poses import SE2
from jaxloc.poses.planar import compose_poses, relative_poses
from jaxloc.sensors import Increment, IncrementMotion
from jaxloc.slam.mosaic import Exposure, Overlap, Patch, Registration, balance, register, register_squares
from jaxloc.slam.pose_graph import Edges, PoseGraph, marginals, optimize
from jaxloc.solvers import GemanMcClure, Quadratic


class OdometryNoise(eqx.Module):
    """How the odometry errs; see `IncrementMotion`.

    Attributes:
        drive: m at 1 m of way, along it.
        side: m at 1 m of way, across it.
        idle: m an image.
        turn_drive: rad at 1 m of way.
        turn_turn: rad at a turn of 1 rad.
        turn_idle: rad an image.
    """

    drive: float = 0.003
    side: float = 0.002
    idle: float = 0.0005
    turn_drive: float = 0.02
    turn_turn: float = 0.01
    turn_idle: float = 0.004


class Config(eqx.Module):
    """Options of the mosaic.

    Attributes:
        odometry: its noise; only used where covariances are not given.
        neighbors: images before each that it is laid upon.
        closures: earlier places that each image is laid upon at most.
        rounds: how often loops are looked for with better and better poses.
        min_overlap: part of an image that must be predicted to lie on another.
        gate: probability that a right registration is taken, by the odometry's covariance.
        kernel: of the robust loss on registrations, in sigmas.
        resolution: edge of a pixel of the mosaic, m; 0 for that of the images.
        black: gray level of darkness.
        tracking: part of the image's edges that is used to track in the finished mosaic.
    """

    odometry: OdometryNoise = OdometryNoise()
    neighbors: int = 2
    closures: int = 2
    rounds: int = 2
    min_overlap: float = 0.3
    gate: float = 0.9999
    kernel: float = 6.0
    resolution: float = 0.0
    black: float = 0.0
    tracking: float = 0.5

    def __check_init__(self):
        for name, least in (("neighbors", 1), ("closures", 0), ("rounds", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}, must be at least {least}")
        for name in ("min_overlap", "gate", "tracking"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise ValueError(f"{name} is {getattr(self, name)}, must lie between 0 and 1")
        if self.kernel <= 0.0 or self.resolution < 0.0:
            raise ValueError("kernel must be positive and resolution not negative")


class Pair(eqx.Module):
    """One image laid upon another.

    Attributes:
        first: number of the earlier image.
        second: number of the later one.
        motion: ``T_first_second`` as (x, y, heading), m and rad.
        covariance: in its tangent.
        share: part of the second image that lies on the first.
        closes: whether it closes a loop.
        ok: whether it was taken.
        overlap: exposures of both.
    """

    first: int
    second: int
    motion: Float64[np.ndarray, "3"]
    covariance: Float64[np.ndarray, "3 3"]
    share: float
    closes: bool
    ok: bool
    overlap: Overlap


class PathBuilder:
    """Registrations so far and the poses that follow from them."""

    def __init__(self, patches: Patch, odometry: np.ndarray, noise: np.ndarray, start: np.ndarray, config: Config):
        self.patches, self.odometry, self.noise, self.config = patches, odometry, noise, config
        self.count = patches.values.shape[0]
        self.poses = np.tile(start, (self.count, 1))
        self.covariances = np.zeros((self.count, 3, 3))
        self.pairs: list[Pair] = []
        self.tried: set[tuple[int, int]] = set()
        self.ok = True
        self._corners = np.asarray(patches.raster.corners(), np.float64)

    def follow(self) -> None:
        """Each image upon those before it, the poses carried along."""
        for number in range(1, self.count):
            self.poses[number] = compose_poses(self.poses[number - 1 : number], self.odometry[number - 1 : number])[0]
            for back in range(1, self.config.neighbors + 1):
                other = number - back
                if other >= 0 and self._overlap(other, number) >= self.config.min_overlap:
                    pair = self._register(other, number, self._reckoned_noise(other, number), closes=False)
                    if pair.ok and back == 1 or pair.ok and not self._has_pair(number):
                        self.poses[number] = compose_poses(self.poses[other][None], pair.motion[None])[0]
        self.settle()

    def close_loops(self) -> None:
        """Images upon those taken long before at the same place, by where both are thought to be."""
        for number in range(self.count):
            far = range(number - self.config.neighbors)
            shares = {other: self._overlap(other, number) for other in far if (other, number) not in self.tried}
            best = sorted((o for o in shares if shares[o] >= self.config.min_overlap), key=lambda o: -shares[o])
            for other in best[: self.config.closures]:
                spread = self.covariances[number] + self.covariances[other] + self.noise[number - 1]
                self._register(other, number, spread, closes=True)

    def settle(self) -> None:
        """The pose graph of everything so far."""
        good = [pair for pair in self.pairs if pair.ok]
        capacity = -(-max(len(good), 1) // 64) * 64  # few sizes: each is compiled
        motions, spreads = np.zeros((capacity, 3)), np.tile(np.eye(3), (capacity, 1, 1))
        ends = np.zeros((2, capacity), np.int32)
        for slot, pair in enumerate(good):
            motions[slot], spreads[slot], ends[:, slot] = pair.motion, pair.covariance, (pair.first, pair.second)
        valid = jnp.asarray(np.arange(capacity) < len(good))
        found = Edges(jnp.asarray(ends[0]), jnp.asarray(ends[1]), planar(motions), _floats(spreads), valid)
        # Odometry ties images without any overlap to the rest.
        edges = Edges.chain(planar(self.odometry), _floats(self.noise)).join(found)
        rough = optimize(planar(self.poses), edges, loss=GemanMcClure(self.config.kernel)).value
        # A last plain fit of what agrees: the sandwich of a robust one calls a pose exact that one edge alone holds.
        left = PoseGraph.of(edges, rough, Quadratic()).residual(jax.tree.map(lambda leaf: leaf[1:], rough))
        agree = edges.valid & (jnp.sum(left**2, axis=0) < (2.0 * self.config.kernel) ** 2)
        fit = optimize(rough, eqx.tree_at(lambda e: e.valid, edges, agree))
        self.ok = bool(fit.ok)
        if self.ok:
            self.poses = np.column_stack([np.asarray(part, np.float64) for part in _rows(fit.value)])
            self.covariances = np.asarray(marginals(fit), np.float64)

    def connected(self) -> np.ndarray:
        """Images that registrations tie to the largest group."""
        group = np.arange(self.count)
        for pair in self.pairs:
            if pair.ok:
                group[group == group[pair.second]] = group[pair.first]
        names, sizes = np.unique(group, return_counts=True)
        largest = names[np.argmax(sizes)]
        return (group == largest) & (sizes.max() > 1)

    def exposures(self) -> Exposure:
        """Of all images, from the pairs."""
        good = [pair for pair in self.pairs if pair.ok]
        if not good:
            return Exposure.none(self.count, self.patches.values.dtype)
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(pair.overlap for pair in good))
        first, second = (jnp.asarray([getattr(pair, name) for pair in good]) for name in ("first", "second"))
        return balance(first, second, stacked, jnp.ones(len(good), bool), count=self.count)

    def _has_pair(self, number: int) -> bool:
        return any(pair.second == number and pair.ok for pair in self.pairs[:-1])

    def _reckoned_noise(self, first: int, second: int) -> np.ndarray:
        """Covariance of the motion between two images by odometry, heading carried to the end."""
        total = np.zeros((3, 3))
        for number in range(first, second):
            back = pose_of_row(relative_poses(self.odometry[number][None], np.zeros((1, 3)))[0])
            adjoint = np.asarray(back.adjoint(), np.float64)
            total = adjoint @ total @ adjoint.T + self.noise[number]
        return total

    def _overlap(self, first: int, second: int) -> float:
        """Part of an image's middle rows and columns that is predicted to lie on another."""
        if not (np.isfinite(self.poses[first]).all() and np.isfinite(self.poses[second]).all()):
            return 0.0
        motion = relative_poses(self.poses[first][None], self.poses[second][None])[0]
        low, high = self._corners.min(axis=0), self._corners.max(axis=0)
        if np.hypot(*motion[:2]) > np.hypot(*(high - low)):
            return 0.0
        share = (np.arange(12) + 0.5) / 12
        x, y = (axis.ravel() for axis in np.meshgrid(*(a + share * (b - a) for a, b in zip(low, high, strict=True))))
        cos, sin = np.cos(motion[2]), np.sin(motion[2])
        there = np.column_stack([motion[0] + cos * x - sin * y, motion[1] + sin * x + cos * y])
        return float(np.mean(((there >= low) & (there <= high)).all(axis=1)))

    def _register(self, first: int, second: int, spread: np.ndarray, *, closes: bool) -> Pair:
        """Lays an image upon another; by squares where that fails from the predicted pose."""
        self.tried.add((first, second))
        guess = pose_of_row(relative_poses(self.poses[first][None], self.poses[second][None])[0])
        one, other = self._patch(first), self._patch(second)
        found = register(one, other, guess)
        taken = bool(found.estimate.ok) and self._agrees(guess, found, spread)
        if not taken:
            squares = register_squares(one, other, guess)
            if bool(squares.ok):
                found = register(one, other, squares.value)
                taken = bool(found.estimate.ok) and self._agrees(guess, found, spread)
        covariance = np.asarray(found.estimate.covariance, np.float64)
        motion, share = row_of_pose(found.estimate.value), float(found.overlap.share)
        pair = Pair(first, second, motion, covariance, share, closes, taken, found.overlap)
        self.pairs.append(pair)
        return pair

    def _agrees(self, guess: SE2, found: Registration, spread: np.ndarray) -> bool:
        """Whether what was found is likely under the prediction."""
        error = np.asarray(guess.local(found.estimate.value), np.float64)
        total = spread + np.asarray(found.estimate.covariance, np.float64)
        return bool(gate(jnp.asarray(error @ np.linalg.solve(total, error)), 3, self.config.gate))

    def _patch(self, number: int) -> Patch:
        return Patch(self.patches.values[number], self.patches.weight[number], self.patches.raster)


def odometry_covariances(odometry: np.ndarray, config: Config) -> np.ndarray:
    """Of motions, by the noise of the odometry."""
    if not len(odometry):
        return np.zeros((0, 3, 3))
    noise = config.odometry
    names = [name for name in vars(OdometryNoise()) if not name.startswith("_")]
    motion = IncrementMotion(**{name: getattr(noise, name) for name in names})
    steps = planar(odometry)
    each = jax.vmap(lambda step: motion.covariance(step, Increment(jnp.ones(()), step)))(steps)
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
