"""Closed-form geometry: P3P beside OpenCV and PoseLib, triangulated points with covariance, RANSAC."""

from collections.abc import Iterator

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import poselib

import jaxloc as jl
from benchmarks.metric import ACCURACY, RATIO, TIME, Metric, quickest, versus
from benchmarks.pnp import CENTER, FOCAL, SIGMA, simulate
from jaxloc.solvers import Candidates


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _p3p(50 if smoke else 2000, 1 if smoke else 10)
    yield from _stereo(500 if smoke else 50_000, 1 if smoke else 10)
    yield from _coverage(200 if smoke else 20_000)
    yield from _ransac(64 if smoke else 1024, 500, 1 if smoke else 10)


def _p3p(count: int, repeats: int) -> Iterator[Metric]:
    """Three exact rays each: how near the best candidate comes to the truth, and how long it takes."""
    problems = simulate(count, num_points=3, seed=5)
    seen = np.einsum("bji,bnj->bni", problems.truth[:, :3, :3], problems.points - problems.truth[:, None, :3, 3])
    rays = seen / np.linalg.norm(seen, axis=-1, keepdims=True)
    arguments = jnp.asarray(rays, jnp.float32), jnp.asarray(problems.points, jnp.float32)
    run = jax.jit(jax.vmap(jl.multiview.p3p))
    found = run(*arguments)
    error = np.linalg.norm(np.asarray(found.poses.translation) - problems.truth[:, None, :3, 3], axis=-1)
    best = np.where(np.asarray(found.valid), error, np.inf).min(axis=1)
    yield Metric("multiview.p3p.found", float(np.mean(best < 0.05)), "share", "higher", 0.01)
    yield Metric("multiview.p3p.error", float(np.median(best)), "m", "lower", 5 * ACCURACY)
    ours = quickest(lambda: run(*arguments), repeats)
    yield Metric("multiview.p3p", 1e6 * ours.wall / count, "us", "lower", TIME)
    pixels = FOCAL * seen[..., :2] / seen[..., 2:] + np.array(CENTER)
    matrix, points = problems.intrinsics(), problems.points

    def by_cv2() -> None:
        for index in range(count):
            cv2.solveP3P(points[index], pixels[index], matrix, None, cv2.SOLVEPNP_P3P)

    def by_poselib() -> None:
        for index in range(count):
            poselib.p3p(rays[index], points[index])

    for name, peer in {"cv2": by_cv2, "poselib": by_poselib}.items():
        yield from versus(f"multiview.p3p.vs_{name}", ours, quickest(peer, 3))


def _stereo(count: int, repeats: int) -> Iterator[Metric]:
    """Points with covariance; the peer gives points alone."""
    rig = jl.data.simulate.stereo_points.kitti_rig()
    rng = np.random.default_rng(6)
    depth = rng.uniform(4.0, 60.0, count)
    points = np.stack([rng.uniform(-0.5, 0.5, count) * depth, rng.uniform(-0.2, 0.2, count) * depth, depth], axis=1)
    measured = rig.project(jnp.asarray(points, jnp.float32))
    noise = 0.25 * jnp.eye(3, dtype=jnp.float32)
    plain = jax.jit(lambda measured: rig.triangulate(measured))
    dense = jax.jit(jax.vmap(lambda z: jl.multiview.stereo_triangulation.triangulate(rig, z, noise)))
    ours = quickest(lambda: plain(measured), repeats)
    yield Metric("multiview.triangulate", 1e9 * ours.wall / count, "ns", "lower", TIME)
    took = quickest(lambda: dense(measured), repeats)
    yield Metric("multiview.triangulate.with_covariance", 1e9 * took.wall / count, "ns", "lower", TIME)
    error = np.abs(np.asarray(plain(measured)) - points) / depth[:, None]
    yield Metric("multiview.triangulate.error", float(error.max()), "relative", "lower", RATIO)
    # OpenCV's closed form: a projective map of (u, v, disparity).
    matrix, baseline = np.asarray(rig.camera.matrix(), float), float(rig.baseline)
    to_space = np.array(
        [[1, 0, 0, -matrix[0, 2]], [0, 1, 0, -matrix[1, 2]], [0, 0, 0, matrix[0, 0]], [0, 0, 1 / baseline, 0]]
    )
    u_left, u_right, v = np.asarray(measured).T
    seen = np.stack([u_left, v, u_left - u_right], axis=-1)[None]
    peer = quickest(lambda: cv2.perspectiveTransform(seen, to_space), repeats)
    yield from versus("multiview.triangulate.vs_cv2", ours, peer)


def _coverage(num_trials: int) -> Iterator[Metric]:
    """How often the 95 % ellipsoid of a point 8 m and 40 m away holds the truth."""
    rig = jl.data.simulate.stereo_points.kitti_rig()
    noise = 0.25 * jnp.eye(3, dtype=jnp.float32)
    for depth in (8.0, 40.0):
        point = jnp.array([1.0, 0.5, depth], jnp.float32)
        held = jl.multiview.coverage(rig, point, noise, key=jax.random.key(0), num_trials=num_trials)
        yield Metric(f"multiview.coverage95.{depth:.0f}m", float(held), "share", "equal", 0.02)


def _ransac(hypotheses: int, num_points: int, repeats: int) -> Iterator[Metric]:
    """A camera pose among half outliers; PoseLib's consensus ends early, ours has a fixed size."""
    problems = simulate(1, num_points=num_points, outliers=0.5, seed=7)
    camera, (points, pixels, _) = problems.camera, jax.tree.map(lambda leaf: leaf[0], problems.arrays())
    data = {"rays": camera.bearing(pixels), "points": points, "pixels": pixels}
    options = {"sample_size": 3, "threshold": 4 * SIGMA, "hypotheses": hypotheses}
    distances = jax.tree_util.Partial(_distances, camera)
    run = jax.jit(lambda data, key: jl.solvers.ransac(data, _poses_of_three, distances, key=key, **options))
    found = run(data, jax.random.key(0))
    error = float(np.linalg.norm(np.asarray(found.model.translation) - problems.truth[0, :3, 3]))
    yield Metric("multiview.ransac.error", error, "m", "lower", 1.0)
    yield Metric("multiview.ransac.inliers", float(jnp.mean(found.inliers)), "share", "higher", ACCURACY)
    ours = quickest(lambda: run(data, jax.random.key(1)), repeats)
    yield Metric("multiview.ransac", 1e3 * ours.wall, "ms", "lower", TIME)
    matrix, image = problems.intrinsics(), {"model": "PINHOLE", "width": 1200, "height": 400}
    image["params"] = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]]
    limits = {"min_iterations": hypotheses, "max_iterations": hypotheses, "max_reproj_error": 4 * SIGMA}
    arguments = problems.pixels[0], problems.points[0], image, limits, {}
    peer = quickest(lambda: poselib.estimate_absolute_pose(*arguments) and None, 3)
    yield from versus("multiview.ransac.vs_poselib", ours, peer)


def _poses_of_three(sample: dict) -> Candidates:
    found = jl.multiview.p3p(sample["rays"], sample["points"])
    return Candidates(found.poses, found.valid)


def _distances(camera: jl.sensors.Pinhole, pose: jl.poses.SE3, data: dict) -> jax.Array:
    """Reprojection errors, px."""
    moved = pose.inverse().apply(data["points"])
    error = jnp.linalg.norm(camera.project(moved) - data["pixels"], axis=1)
    return jnp.where(camera.in_front(moved), error, 1e6)
