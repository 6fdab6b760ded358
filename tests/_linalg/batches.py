"""Batches of programs with linear algebra, run many times: does each end (docs/lapack_deadlock.md)?

python tests/_linalg/batches.py PROGRAM RUNS
"""

import os
import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxloc.beliefs import Gaussian
from jaxloc.features.opencv.chessboard import board_points
from jaxloc.filters import (
    Cubature,
    ExtendedKalmanFilter,
    InformationFilter,
    KalmanFilter,
    LinearMotion,
    LinearSensor,
    SigmaPointFilter,
)
from jaxloc.poses import SE2, SE3
from jaxloc.poses.trajectory import chain
from jaxloc.refinement.bundle import Bundle, Observations, adjust
from jaxloc.refinement.calibration import calibrate
from jaxloc.refinement.pnp import refine_pose
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.slam import pose_graph
from jaxloc.slam.pose_graph import Edges
from jaxloc.solvers import QR, GaussNewton

CAMERA = Pinhole(500.0, 500.0, 320.0, 240.0)


def normal(*shape, scale=1.0):
    return jnp.asarray(scale * np.random.default_rng(0).normal(size=shape), jnp.float32)


def pose_graphs():
    """200 graphs of 8 poses: 21 unknowns, 9 edges."""
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    rows = jnp.asarray(np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), angle + 0.5 * np.pi]), jnp.float32)
    truth = jax.vmap(SE2)(*rows.T)
    first, second = np.array([*((k, k + 1) for k in range(7)), (7, 0), (5, 1)], np.int32).T
    take = lambda index: jax.tree.map(lambda leaf: leaf[index], truth)  # noqa: E731
    exact = jax.vmap(lambda a, b: a.inverse() @ b)(take(first), take(second))
    sigmas = jnp.array([0.05, 0.04, 0.02])
    covariance = jnp.tile(jnp.diag(sigmas**2)[None], (9, 1, 1))

    def fit(noise):
        measured = jax.vmap(lambda pose, delta: pose.retract(delta))(exact, noise)
        edges = Edges(jnp.asarray(first), jnp.asarray(second), measured, covariance, jnp.ones(9, bool))
        initial = chain(take(0), jax.tree.map(lambda leaf: leaf[:7], measured))
        found = pose_graph.optimize(initial, edges)
        return found.value.translation, found.covariance

    return fit, normal(200, 9, 3) * sigmas


def calibrations():
    """24 cameras from 4 views of a board: 34 unknowns."""
    board = jnp.asarray(board_points((5, 4), 0.05), jnp.float32)
    tilts = jnp.array([[0.5, 0.1, 0.0], [-0.4, 0.3, 0.1], [0.1, -0.5, 0.2], [0.3, 0.4, -0.3]])

    def place(tilt):
        turned = SE3.from_euler(jnp.zeros(3), yaw=tilt[2], pitch=tilt[1], roll=tilt[0])
        return SE3(turned.rotation, jnp.array([0.0, 0.0, 0.4]) - turned.apply(board.mean(axis=0)[None])[0])

    corners = jax.vmap(lambda tilt: CAMERA.project(place(tilt).apply(board)))(tilts)

    def fit(noise):
        found = calibrate(board, corners + noise, shape=(480, 640), sigma=0.1)
        return found.value.T_camera_board.translation, found.covariance

    return fit, normal(24, 4, len(board), 2, scale=0.1)


def bundles():
    """24 stereo bundles of 5 poses and 8 points: a reduced system of 30 unknowns."""
    rng = np.random.default_rng(1)
    depth = rng.uniform(4.0, 9.0, (8, 1))
    points = jnp.asarray(np.hstack([rng.uniform(-0.4, 0.4, (8, 2)) * depth, depth]), jnp.float32)
    twists = jnp.asarray(np.linspace(np.zeros(6), [1.2, 0.2, 0.6, 0.05, -0.1, 0.05], 5), jnp.float32)
    truth, rig = Bundle(jax.vmap(SE3.exp)(twists), points), StereoRig(CAMERA, 0.5)
    camera, point = (jnp.asarray(index, jnp.int32) for index in np.divmod(np.arange(40), 8))
    frames = jax.vmap(lambda pose: pose.inverse().apply(points))(truth.poses)
    seen = rig.project(frames.reshape(-1, 3))
    tables = Observations.of(np.asarray(camera), np.asarray(point), seen, sigma=0.5)

    def fit(noise):
        initial = truth.moved(noise[:5] * (jnp.arange(5) > 1)[:, None], noise[5:, :3])
        found = adjust(rig, initial, tables)
        return found.value.points, found.pose_covariance(jnp.arange(5))

    return fit, normal(24, 13, 6, scale=0.02)


def camera_poses():
    """256 camera poses from 30 points by QR."""
    points = normal(30, 3) + jnp.array([0.0, 0.0, 6.0])
    seen = CAMERA.project(points)

    def fit(noise):
        found = refine_pose(CAMERA, points, seen + noise, SE3.identity(), solver=GaussNewton(linear_solver=QR()))
        return found.value.translation, found.covariance

    return fit, normal(256, 30, 2)


def kalman_filters():
    """64 runs of the linear, extended, cubature and information filters with 20 states, 12 of them measured."""
    eye = jnp.eye(20)
    motion, sensor = LinearMotion(eye + 0.1 * jnp.eye(20, k=10), 0.01 * eye), LinearSensor(eye[:12], jnp.eye(12))
    cubature = SigmaPointFilter(motion, sensor, Cubature())
    filters = (*(kind(motion, sensor) for kind in (KalmanFilter, ExtendedKalmanFilter, InformationFilter)), cubature)

    def fit(measurements):
        ends = []
        for filt in filters:
            state = filt.init(Gaussian(jnp.zeros(20), eye))
            for measurement in measurements:
                state, _ = filt.update(filt.predict(state, None), measurement, jnp.array(True))
            ends.append(state.mean)
        return ends

    return fit, normal(64, 2, 12)


PROGRAMS = {call.__name__: call for call in (pose_graphs, calibrations, bundles, camera_poses, kalman_filters)}


def main(name, runs):
    fit, noise = PROGRAMS[name]()
    batch = jax.jit(jax.vmap(fit))
    for _ in range(int(runs)):
        found = jax.block_until_ready(batch(noise))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
    os._exit(0)
