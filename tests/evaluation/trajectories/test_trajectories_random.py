"""Trajectory errors of many short random paths, also straight, planar and at rest, against evo and brute force."""

import collections

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from evo.core import metrics
from evo.core.filters import FilterException
from evo.core.geometry import GeometryException
from evo.core.trajectory import PosePath3D
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxloc.evaluation import trajectories
from jaxloc.evaluation.trajectories import Frames, Meters, NoAlignment, RigidAlignment, SimilarityAlignment
from jaxloc.poses import SE3, Trajectory

LENGTHS = (1, 2, 3, 8)
COUNTS = pytest.mark.parametrize("count", [20, pytest.param(250, marks=pytest.mark.slow)])
SEGMENTS, STEP = (1.0, 3.0, 8.0), 2


def random_pair(rng, length, kind):
    """An estimated and a true path; the kinds are winding, straight, planar, turning on the spot, with stops."""
    truth = np.tile(np.eye(4), (length, 1, 1))
    for k in range(1, length):
        step = np.eye(4)
        turn, move = rng.choice([0.1, 1.0]) * rng.standard_normal(3), rng.standard_normal(3)
        if kind == "straight":
            turn, move = 0.0 * turn, move * [1, 0, 0]
        elif kind == "planar":
            turn, move = turn * [0, 0, 1], move * [1, 1, 0]
        elif kind == "turning":
            move = 0.0 * move
        elif kind == "stops" and rng.uniform() < 0.5:
            turn, move = 0.0 * turn, 0.0 * move
        step[:3, :3], step[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), move
        truth[k] = truth[k - 1] @ step
    estimate = truth.copy()
    for matrix in estimate:
        matrix[:3, :3] = matrix[:3, :3] @ Rotation.from_rotvec(0.2 * rng.standard_normal(3)).as_matrix()
        matrix[:3, 3] += 0.3 * rng.standard_normal(3)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = Rotation.from_rotvec(rng.standard_normal(3)).as_matrix(), rng.standard_normal(3)
    estimate = frame @ estimate
    estimate[:, :3, 3] *= rng.uniform(0.3, 3.0)
    return estimate, truth


def random_pairs(length, count):
    rng = np.random.default_rng(length)
    kinds = ("winding", "straight", "planar", "turning", "stops")
    return [random_pair(rng, length, kinds[k % len(kinds)]) for k in range(count)]


def over_all(function, pairs):
    """A metric of all pairs of paths, in one program."""

    def of_one(estimate, truth):
        times = jnp.arange(estimate.shape[0], dtype=estimate.dtype)
        return function(*(Trajectory(times, jax.vmap(SE3.from_matrix)(path)) for path in (estimate, truth)))

    return jax.jit(jax.vmap(of_one))(*(jnp.asarray(np.stack(side)) for side in zip(*pairs, strict=True)))


def picked(tree, k):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[k], tree)


@COUNTS
@pytest.mark.parametrize("length", LENGTHS)
def test_ate(length, count, x64):
    pairs, seen = random_pairs(length, count), collections.Counter()
    for alignment, scaled in ((NoAlignment(), None), (RigidAlignment(), False), (SimilarityAlignment(), True)):
        found = over_all(lambda *paths, by=alignment: trajectories.ate(*paths, alignment=by), pairs)
        for k, (estimate, truth) in enumerate(pairs):
            errors = picked(found, k)
            reference, moved = (PosePath3D(poses_se3=list(path)) for path in (truth, estimate))
            try:
                if scaled is not None:
                    moved.align(reference, correct_scale=scaled)
            except GeometryException:
                # evo refuses paths on a line, whose rotation is not unique; the sum of squares is.
                least = least_squares(estimate[:, :3, 3], truth[:, :3, 3], scaled)
                np.testing.assert_allclose(np.sqrt(np.mean(errors.values**2)), least, atol=1e-6)
                seen["refused"] += 1
                continue
            metric = metrics.APE(metrics.PoseRelation.translation_part)
            metric.process_data((reference, moved))
            np.testing.assert_allclose(errors.values, metric.error, atol=1e-7)
            numbers = metric.get_all_statistics()
            ours = trajectories.Errors(*(jnp.asarray(part) for part in (errors.values, errors.valid)))
            for name, other in (("rmse",) * 2, ("mean",) * 2, ("median",) * 2, ("largest", "max")):
                assert float(getattr(ours, name)()) == pytest.approx(numbers[other], abs=1e-7)
            seen["equal"] += 1
    assert seen["equal"] > 0


def least_squares(points, targets, scaled):
    """Root mean square of the best alignment, by its singular values (Kabsch) and the best scale."""
    a, b = points - points.mean(axis=0), targets - targets.mean(axis=0)
    u, spectrum, vt = np.linalg.svd(b.T @ a)
    spectrum[-1] *= np.sign(np.linalg.det(u @ vt))
    size_a, size_b = np.sum(a**2), np.sum(b**2)
    if scaled:
        total = size_b - (spectrum.sum() ** 2 / size_a if size_a > 0 else 0.0)
    else:
        total = size_a + size_b - 2.0 * spectrum.sum()
    return np.sqrt(max(total, 0.0) / len(points))


def test_the_least_sum_of_squares_is_that_of_a_search(rng):
    """The oracle of refused paths, against a numerical minimum."""
    points, targets = rng.standard_normal((2, 5, 3))

    def cost(x):
        moved = x[6] * Rotation.from_rotvec(x[:3]).apply(points) + x[3:6]
        return np.mean(np.sum((moved - targets) ** 2, axis=1))

    starts = [np.array([*turn, 0, 0, 0, 1]) for turn in rng.standard_normal((8, 3))]
    assert least_squares(points, targets, True) == pytest.approx(min(minimize(cost, x).fun for x in starts) ** 0.5)


SPACINGS = [
    (Frames(1), dict(delta=1, delta_unit=metrics.Unit.frames)),
    (Frames(3), dict(delta=3, delta_unit=metrics.Unit.frames, all_pairs=True)),
    (Frames(3, all_pairs=False), dict(delta=3, delta_unit=metrics.Unit.frames)),
    (Meters(2.0), dict(delta=2.0, delta_unit=metrics.Unit.meters)),
    (Meters(2.0, all_pairs=True), dict(delta=2.0, delta_unit=metrics.Unit.meters, all_pairs=True)),
]


@COUNTS
@pytest.mark.parametrize("length", LENGTHS)
def test_rpe(length, count, x64):
    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_rad
    pairs = random_pairs(length, count)
    for spacing, options in SPACINGS:
        found = over_all(lambda *paths, by=spacing: trajectories.rpe(*paths, spacing=by), pairs)
        for k, (estimate, truth) in enumerate(pairs):
            for ours, relation in zip((found.translation, found.rotation), relations, strict=True):
                metric = metrics.RPE(relation, pairs_from_reference=True, **options)
                try:
                    metric.process_data(tuple(PosePath3D(poses_se3=list(path)) for path in (truth, estimate)))
                    expected = metric.error
                except FilterException:  # no pairs
                    expected = []
                errors = picked(ours, k)
                np.testing.assert_allclose(errors.values[errors.valid], expected, atol=1e-7)
                assert not errors.values[~errors.valid].any()


@COUNTS
@pytest.mark.parametrize("length", LENGTHS)
def test_kitti_drift(length, count, x64):
    pairs = random_pairs(length, count)
    found = over_all(lambda *paths: trajectories.segment_errors(*paths, lengths=SEGMENTS, step=STEP), pairs)
    curves = over_all(trajectories.drift_curve_percent, pairs)
    for k, (estimate, truth) in enumerate(pairs):
        path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
        motions = np.linalg.inv(estimate[:1]) @ estimate, np.linalg.inv(truth[:1]) @ truth
        gaps = np.linalg.norm(motions[0][:, :3, 3] - motions[1][:, :3, 3], axis=1)
        percent = np.divide(100.0 * gaps, path, out=np.zeros_like(path), where=path > 0)
        np.testing.assert_allclose(curves[k], percent, atol=1e-6)
        for row, first in enumerate(range(0, length, STEP)):
            for column, wanted in enumerate(SEGMENTS):
                last = next((i for i in range(first, length) if path[i] > path[first] + wanted), None)
                assert bool(found.valid[k, row, column]) == (last is not None)
                if last is None:
                    assert found.translation[k, row, column] == found.rotation[k, row, column] == 0.0
                    continue
                motion = [np.linalg.inv(side[first]) @ side[last] for side in (estimate, truth)]
                error = np.linalg.inv(motion[0]) @ motion[1]
                angle = Rotation.from_matrix(error[:3, :3]).magnitude()
                assert float(found.translation[k, row, column]) == pytest.approx(np.linalg.norm(error[:3, 3]) / wanted)
                assert float(found.rotation[k, row, column]) == pytest.approx(angle / wanted, abs=1e-7)
