"""Two views among false correspondences beside OpenCV and PoseLib, minimal solvers, and sets that have no answer."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib
from scipy.spatial.transform import Rotation

from benchmarks.metric import ACCURACY, TIME, Metric, Timing, compiled, gradient_over_forward, quickest, timed, versus
from jaxloc.multiview import estimate_homography, estimate_relative_pose
from jaxloc.multiview.five_point import five_point
from jaxloc.solvers import Estimate

FOCAL, SIZE, SIGMA, FALSE = 700.0, np.array([1240.0, 376.0]), 0.5, 0.4
POINTS = 500
KINDS = ("planar", "rotation", "repeated", "collinear", "empty")


class View(NamedTuple):
    """Two images of random points: pixels about the center, rotation and direction of ``T_first_second``."""

    first: np.ndarray
    second: np.ndarray
    rotation: np.ndarray
    direction: np.ndarray


def metrics(smoke: bool) -> Iterator[Metric]:
    count, repeats = (10, 1) if smoke else (100, 10)
    yield from _relative_pose(count, repeats)
    yield from _degenerate(20 if smoke else 2000)
    yield from _five_point(50 if smoke else 2000)
    yield from _homography(count, repeats)


def simulate(seed: int, count: int = POINTS, false: float = FALSE, planar: bool = False, step: float = 1.0) -> View:
    """Two views of points 4 to 40 m away, a step of 1 m in any direction and a turn of up to 12 degrees apart."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.uniform(-0.15, 0.15, 3)).as_matrix()
    direction = rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    pictures = np.zeros((2, 0, 2))
    while pictures.shape[1] < count:
        u = rng.uniform(-0.5, 0.5, (count, 2)) * SIZE
        z = 10.0 + 0.004 * u[:, 0] if planar else rng.uniform(4.0, 40.0, count)
        seen = (np.column_stack([u / FOCAL * z[:, None], z]) - step * direction) @ rotation
        v = FOCAL * seen[:, :2] / np.maximum(seen[:, 2:], 0.1)
        good = (seen[:, 2] > 1.0) & np.all(np.abs(v) < 0.5 * SIZE, axis=1)
        pictures = np.concatenate([pictures, np.stack([u[good], v[good]])], axis=1)
    first, second = pictures[:, :count] + SIGMA * rng.normal(size=(2, count, 2))
    wrong = int(false * count)
    second[:wrong] = rng.uniform(-0.5, 0.5, (wrong, 2)) * SIZE
    return View(first, second, rotation, direction)


def _angle(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    cosine = np.sum(np.asarray(found, float) * truth, axis=-1)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _relative_pose(count: int, repeats: int) -> Iterator[Metric]:
    """How well the direction of the translation is found, and how soon; no motion is assumed."""
    views = [simulate(seed) for seed in range(count)]
    first, second = (jnp.asarray(np.stack(p) / FOCAL, jnp.float32) for p in zip(*(v[:2] for v in views), strict=True))
    keys = jax.random.split(jax.random.key(0), count)

    def one(a: jax.Array, b: jax.Array, key: jax.Array) -> Estimate:
        return estimate_relative_pose(a, b, sigma=SIGMA / FOCAL, key=key)

    run, building = compiled(jax.vmap(one), first, second, keys)
    found = run(first, second, keys)
    direction, turn = (np.stack([getattr(v, name) for v in views]) for name in ("direction", "rotation"))
    off = _angle(found.value.direction.vector, direction)
    yield Metric("two_views.pose.direction", float(np.median(off)), "deg", "lower", ACCURACY)
    yield Metric("two_views.pose.direction.worst", float(off.max()), "deg")
    apart = np.asarray(found.value.rotation.rotation_matrix, float).transpose(0, 2, 1) @ turn
    yield Metric("two_views.pose.rotation", _median_turn(apart), "deg", "lower", ACCURACY)
    yield Metric("two_views.pose.ok", float(jnp.mean(found.ok)), "share", "higher", 0.01)
    yield Metric("two_views.pose.compile", building.cpu, "s", "lower", TIME)
    took = quickest(lambda: run(first, second, keys), repeats)
    yield Metric("two_views.pose", 1e3 * took.wall / count, "ms", "lower", TIME)
    total = lambda *sets: jnp.sum(jax.vmap(one)(*sets).value.direction.vector)  # noqa: E731
    yield gradient_over_forward("two_views.pose", total, (first, second, keys), took, max(repeats // 3, 1))
    matrix = np.array([[FOCAL, 0, 0], [0, FOCAL, 0], [0, 0, 1]])
    for name, method in (("magsac", cv2.USAC_MAGSAC), ("ransac", cv2.RANSAC)):
        peer, took_peer = timed(lambda method=method: np.stack([_opencv(v, matrix, method) for v in views]))
        yield Metric(f"two_views.pose.{name}.direction", float(np.median(_angle(peer, direction))), "deg")
        yield from versus(f"two_views.pose.vs_{name}", took, took_peer)
    peer, took_peer = timed(lambda: np.stack([_poselib(v) for v in views]))
    yield Metric("two_views.pose.poselib.direction", float(np.median(_angle(peer, direction))), "deg")
    yield from versus("two_views.pose.vs_poselib", took, took_peer)


def _median_turn(rotations: np.ndarray) -> float:
    return float(np.degrees(np.median(Rotation.from_matrix(rotations).magnitude())))


def _opencv(view: View, matrix: np.ndarray, method: int) -> np.ndarray:
    essential, mask = cv2.findEssentialMat(view.second, view.first, matrix, method, 0.999, 2.58 * SIGMA)
    return cv2.recoverPose(essential[:3], view.second, view.first, matrix, mask=mask)[2][:, 0]


def _poselib(view: View) -> np.ndarray:
    camera = {"model": "SIMPLE_PINHOLE", "width": int(SIZE[0]), "height": int(SIZE[1]), "params": [FOCAL, 0.0, 0.0]}
    options = {"max_epipolar_error": 2.58 * SIGMA}
    pose, _ = poselib.estimate_relative_pose(view.second, view.first, camera, camera, options)
    return np.asarray(pose.t) / np.linalg.norm(pose.t)


def _degenerate(count: int) -> Iterator[Metric]:
    """Sets without an answer, or with an ambiguous one: finite in value and derivative, and told by ``ok``."""
    points = 100

    def total(a: jax.Array, b: jax.Array, valid: jax.Array, key: jax.Array) -> tuple[jax.Array, Estimate]:
        fit = estimate_relative_pose(a, b, sigma=SIGMA / FOCAL, valid=valid, key=key)
        return jnp.sum(fit.value.essential()), fit

    slope = jax.grad(total, argnums=(0, 1), has_aux=True)
    each = jax.jit(lambda *sets: jax.lax.map(lambda s: slope(*s), sets, batch_size=100))
    bad = 0
    for kind in KINDS:
        sets = [_degenerate_set(kind, seed, points) for seed in range(count)]
        first, second = (jnp.asarray(np.stack(p) / FOCAL, jnp.float32) for p in zip(*sets, strict=True))
        valid = jnp.full((count, points), kind != "empty")
        found = each(first, second, valid, jax.random.split(jax.random.key(1), count))
        finite = [np.isfinite(leaf).reshape(count, -1).all(axis=1) for leaf in jax.tree.leaves(found)]
        bad += int(np.sum(~np.all(finite, axis=0)))
        yield Metric(f"two_views.degenerate.{kind}.ok", float(jnp.mean(found[1].ok)), "share", "equal", None)
    yield Metric("two_views.degenerate.not_finite", float(bad), "sets", "lower", 0.0)


def _degenerate_set(kind: str, seed: int, points: int) -> tuple[np.ndarray, np.ndarray]:
    view = simulate(seed, points, 0.2, kind == "planar", 1e-9 if kind == "rotation" else 1.0)
    first, second = view.first, view.second
    if kind == "repeated":
        first[:], second[:] = first[:1], second[:1]
    if kind == "collinear":
        first[:, 1], second[:, 1] = 0.3 * first[:, 0], 0.3 * second[:, 0]
    return first, second


def _five_point(count: int) -> Iterator[Metric]:
    """How often the true pose is among the candidates of five exact pairs."""
    views = [simulate(seed, 5, 0.0) for seed in range(count)]
    for name, dtype in (("float32", jnp.float32), ("float64", jnp.float64)):
        with jax.enable_x64(dtype == jnp.float64):
            rng = np.random.default_rng(0)
            points = rng.uniform([-4.0, -4.0, 4.0], [4.0, 4.0, 12.0], (count, 5, 3))
            second = np.stack([(p - v.direction) @ v.rotation for p, v in zip(points, views, strict=True)])
            run = jax.jit(jax.vmap(five_point))
            rays = jnp.asarray(points, dtype), jnp.asarray(second, dtype)
            found = run(*rays)
            apart = np.asarray(found.poses.rotation.rotation_matrix) - np.stack([v.rotation for v in views])[:, None]
            best = np.where(np.asarray(found.valid), np.abs(apart).max((2, 3)), np.inf).min(axis=1)
            limit = 1e-6 if name == "float64" else 1e-3
            yield Metric(f"two_views.five_point.{name}", float(np.mean(best < limit)), "share", "higher", 0.01)
            if name == "float32":
                took = quickest(lambda run=run, rays=rays: run(*rays), 3)
                yield Metric("two_views.five_point", 1e6 * took.wall / count, "us", "lower", TIME)
    units = [
        [list(p / np.linalg.norm(p, axis=1, keepdims=True)) for p in pair] for pair in zip(points, second, strict=True)
    ]
    peer = quickest(lambda: [poselib.relpose_5pt(*pair) for pair in units] and None, 3)
    yield from versus("two_views.five_point.vs_poselib", took, peer)


def _homography(count: int, repeats: int) -> Iterator[Metric]:
    """A plane seen twice: corners moved by what was found against the truth."""
    rng = np.random.default_rng(0)
    truth = np.array([[0.9, 0.1, 20.0], [-0.05, 1.1, -10.0], [2e-4, -1e-4, 1.0]])
    move = lambda matrix, p: _transfer(np.asarray(matrix, float), p)  # noqa: E731
    first = rng.uniform(0.0, 600.0, (count, POINTS, 2))
    second = np.stack([move(truth, p) for p in first]) + SIGMA * rng.normal(size=first.shape)
    wrong = int(FALSE * POINTS)
    second[:, :wrong] = rng.uniform(0.0, 600.0, (count, wrong, 2))
    first = first + SIGMA * rng.normal(size=first.shape)
    arrays = jnp.asarray(first, jnp.float32), jnp.asarray(second, jnp.float32)
    keys = jax.random.split(jax.random.key(0), count)
    each = jax.vmap(lambda a, b, key: estimate_homography(a, b, key=key, sigma=SIGMA))
    run, _ = compiled(each, *arrays, keys)
    found = run(*arrays, keys)
    corners = np.array([[0.0, 0.0], [600.0, 0.0], [600.0, 600.0], [0.0, 600.0]])

    def error(transfer: Callable[[int], np.ndarray]) -> float:
        apart = [np.linalg.norm(transfer(i) - move(truth, corners), axis=1).mean() for i in range(count)]
        return float(np.median(apart))

    yield Metric(
        "two_views.homography.corners",
        error(lambda i: move(found.value.homogeneous[i], corners)),
        "px",
        "lower",
        ACCURACY,
    )
    yield Metric("two_views.homography.ok", float(jnp.mean(found.ok)), "share", "higher", 0.01)
    took = quickest(lambda: run(*arrays, keys), repeats)
    yield Metric("two_views.homography", 1e3 * took.wall / count, "ms", "lower", TIME)
    total = lambda *sets: jnp.sum(each(*sets).value.homogeneous)  # noqa: E731
    yield gradient_over_forward("two_views.homography", total, (*arrays, keys), took, max(repeats // 3, 1))
    peer: tuple[list[np.ndarray], Timing] = timed(
        lambda: [cv2.findHomography(a, b, cv2.USAC_MAGSAC, 2.58 * SIGMA)[0] for a, b in zip(first, second, strict=True)]
    )
    yield Metric("two_views.homography.magsac.corners", error(lambda i: move(peer[0][i], corners)), "px")
    yield from versus("two_views.homography.vs_magsac", took, peer[1])


def _transfer(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    moved = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    return moved[:, :2] / moved[:, 2:]
