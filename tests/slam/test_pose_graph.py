"""Pose graphs: against GTSAM and SciPy, Jacobians, masks, robust losses, gradients, consistency."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from jaxloc.poses import SE2, SE3
from jaxloc.poses.trajectory import chain
from jaxloc.slam import pose_graph
from jaxloc.slam.pose_graph import Edges, PoseGraph
from jaxloc.solvers import GemanMcClure, Quadratic, Status

SIGMAS = np.array([0.05, 0.04, 0.02])


def planar(rows):
    return jax.vmap(SE2)(*jnp.asarray(rows, jnp.result_type(float)).T)


def ring(rng, count=8, closures=((7, 0), (5, 1)), scale=1.0):
    """True poses round a ring, odometry and closures with noise, and a guess by dead reckoning."""
    angle = 2 * np.pi * np.arange(count) / count
    truth = planar(np.column_stack([3 * np.cos(angle), 3 * np.sin(angle), angle + 0.5 * np.pi]))
    pairs = np.array([*((k, k + 1) for k in range(count - 1)), *closures], np.int32)
    noise = jnp.asarray(scale * SIGMAS * rng.normal(size=(len(pairs), 3)))
    take = lambda which: jax.tree.map(lambda leaf: leaf[which], truth)  # noqa: E731
    measure = jax.vmap(lambda a, b, d: (a.inverse() @ b).retract(d))
    measured = measure(take(pairs[:, 0]), take(pairs[:, 1]), noise)
    covariance = jnp.tile(jnp.diag(jnp.asarray(SIGMAS**2))[None], (len(pairs), 1, 1))
    edges = Edges(jnp.asarray(pairs[:, 0]), jnp.asarray(pairs[:, 1]), measured, covariance, jnp.ones(len(pairs), bool))
    poses = [take(0)]
    for k in range(count - 1):
        poses.append(poses[-1] @ jax.tree.map(lambda leaf, k=k: leaf[k], measured))
    return truth, edges, jax.tree.map(lambda *leaves: jnp.stack(leaves), *poses)


def rows_of(poses):
    heading = np.arctan2(poses.rotation.sin, poses.rotation.cos)
    return np.column_stack([np.asarray(poses.translation), heading])


def test_the_optimum_is_that_of_scipy(x64, rng):
    _, edges, guess = ring(rng)
    fit = pose_graph.optimize(guess, edges)
    assert bool(fit.ok)
    measured, ends = rows_of(edges.T_first_second), np.column_stack([edges.first, edges.second])

    def matrix(row):
        x, y, t = row
        return np.array([[np.cos(t), -np.sin(t), x], [np.sin(t), np.cos(t), y], [0, 0, 1]])

    def residual(flat):
        rows = np.vstack([rows_of(guess)[:1], flat.reshape(-1, 3)])
        parts = []
        for (i, j), z in zip(ends, measured, strict=True):
            error = np.linalg.inv(matrix(z)) @ np.linalg.inv(matrix(rows[i])) @ matrix(rows[j])
            t = np.arctan2(error[1, 0], error[0, 0])
            half = 0.5 * t / np.tan(0.5 * t) if abs(t) > 1e-9 else 1.0
            inverse = np.array([[half, 0.5 * t], [-0.5 * t, half]])
            parts.append(np.r_[inverse @ error[:2, 2], t] / SIGMAS)
        return np.concatenate(parts)

    peer = least_squares(residual, rows_of(guess)[1:].ravel(), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(rows_of(fit.value)[1:].ravel(), peer.x, atol=1e-6)
    assert float(fit.cost) == pytest.approx(peer.cost, rel=1e-9)


def test_poses_and_covariances_are_those_of_gtsam(x64, rng):
    gtsam = pytest.importorskip("gtsam")
    _, edges, guess = ring(rng)
    fit = pose_graph.optimize(guess, edges)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = rows_of(guess)
    model = gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    for i, j, z in zip(edges.first.tolist(), edges.second.tolist(), rows_of(edges.T_first_second), strict=True):
        graph.add(gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*z), model))
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-7))))
    for k, row in enumerate(start):
        values.insert(k, gtsam.Pose2(*row))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    peer = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    theirs = np.array([[pose.x(), pose.y(), pose.theta()] for pose in (peer.atPose2(k) for k in range(len(start)))])
    # GTSAM's residual is no exact logarithm unless built so: equal to the second order of small errors.
    np.testing.assert_allclose(rows_of(fit.value), theirs, atol=2e-3)
    blocks, marginal = pose_graph.marginals(fit), gtsam.Marginals(graph, peer)
    for k in range(1, len(start)):
        np.testing.assert_allclose(blocks[k], marginal.marginalCovariance(k), rtol=0.03, atol=1e-5)
    np.testing.assert_allclose(blocks[0], 0.0)


@eqx.filter_jit
def both_ways(problem, state):
    """Linearized in closed form and by autodiff."""
    return problem.linearize(state), super(type(problem), problem).linearize(state)


@pytest.mark.parametrize("group", [SE2, SE3])
def test_the_jacobian_is_that_of_autodiff(x64, rng, group):
    count, dof = 4, group.dof
    draw = lambda n: jax.vmap(group.exp)(jnp.asarray(0.4 * rng.normal(size=(n, dof))))  # noqa: E731
    poses, root = draw(count), jnp.asarray(rng.normal(size=(5, dof, dof)))
    covariance = jnp.einsum("nij,nkj->nik", root, root) + 0.1 * jnp.eye(dof)[None]
    ends = jnp.array([[0, 1, 2, 3, 1], [1, 2, 3, 0, 3]])
    edges = Edges(ends[0], ends[1], draw(5), covariance, jnp.array([True, True, False, True, True]))
    problem = PoseGraph.of(edges, poses, Quadratic())
    state = jax.tree.map(lambda leaf: leaf[1:], poses)
    closed, general = both_ways(problem, state)
    np.testing.assert_allclose(closed.residual, general.residual, atol=1e-12)
    np.testing.assert_allclose(closed.jacobian, general.jacobian, atol=1e-9)


@pytest.mark.slow
def test_masked_is_absent_and_bad_edges_do_no_harm(rng):
    _, edges, guess = ring(rng)
    fit = pose_graph.optimize(guess, edges)
    junk = Edges(
        jnp.array([0, -1, 3, 2], jnp.int32),
        jnp.array([4, 2, 99, 6], jnp.int32),
        jax.tree.map(lambda leaf: jnp.full((4, *leaf.shape[1:]), jnp.nan), edges.T_first_second),
        jnp.full((4, 3, 3), jnp.nan),
        jnp.array([False, True, True, True]),
    )
    padded = pose_graph.optimize(guess, edges.join(junk))
    assert bool(padded.ok)
    np.testing.assert_allclose(rows_of(padded.value), rows_of(fit.value), atol=2e-4)
    slope = jax.grad(lambda z: jnp.sum(pose_graph.optimize(guess, eqx_at(edges, z)).value.translation))(
        edges.T_first_second.translation
    )
    assert bool(jnp.all(jnp.isfinite(slope)))


def eqx_at(edges, translation):
    moved = jax.vmap(lambda pose, t: SE2.from_parts(pose.rotation, t))(edges.T_first_second, translation)
    return Edges(edges.first, edges.second, moved, edges.covariance, edges.valid)


@pytest.mark.slow
def test_gradient_by_a_measurement(x64, rng):
    _, edges, guess = ring(rng)

    def place(x):
        return pose_graph.optimize(
            guess, eqx_at(edges, edges.T_first_second.translation.at[3, 0].add(x))
        ).value.translation[6, 1]

    numeric = (float(place(jnp.array(1e-5))) - float(place(jnp.array(-1e-5)))) / 2e-5
    assert float(jax.grad(place)(jnp.zeros(()))) == pytest.approx(numeric, rel=1e-4)


def test_a_wrong_closure_is_outvoted(rng):
    truth, edges, guess = ring(rng, closures=((7, 0), (5, 1), (6, 2), (2, 6)))
    wrong = edges.T_first_second.translation.at[-1].add(jnp.array([2.0, -1.0], edges.covariance.dtype))
    spoiled = eqx_at(edges, wrong)
    error = lambda fit: float(jnp.max(jnp.abs(fit.value.translation - truth.translation)))  # noqa: E731
    plain = pose_graph.optimize(guess, spoiled)
    robust = pose_graph.optimize(guess, spoiled, loss=GemanMcClure(4.0))
    assert bool(robust.ok) and error(robust) < 0.3 < error(plain)


def test_loose_poses_are_reported(rng):
    _, edges, guess = ring(rng)
    valid = edges.valid.at[3].set(False).at[-2:].set(False)
    fit = pose_graph.optimize(guess, Edges(edges.first, edges.second, edges.T_first_second, edges.covariance, valid))
    assert not bool(fit.ok) and int(fit.status) == Status.RANK_DEFICIENT
    assert bool(jnp.all(jnp.isfinite(fit.covariance)))
    with pytest.raises(ValueError, match="at least two"):
        pose_graph.optimize(jax.tree.map(lambda leaf: leaf[:1], guess), edges)
    with pytest.raises(ValueError, match="of size 2"):
        pose_graph.optimize(
            guess, Edges(edges.first, edges.second, edges.T_first_second, edges.covariance[:, :2, :2], valid)
        )


def test_errors_are_as_large_as_their_covariance(rng):
    truth, exact, _ = ring(rng, scale=0.0)
    noise = jnp.asarray(SIGMAS * rng.normal(size=(200, len(exact), 3)), jnp.float32)

    def squared(draw):
        measured = jax.vmap(lambda z, d: z.retract(d))(exact.T_first_second, draw)
        edges = Edges(exact.first, exact.second, measured, exact.covariance, exact.valid)
        start = chain(jax.tree.map(lambda leaf: leaf[0], truth), jax.tree.map(lambda leaf: leaf[:7], measured))
        fit = pose_graph.optimize(start, edges)
        delta = jax.vmap(lambda a, b: a.local(b))(truth, fit.value)[1:].reshape(-1)
        return delta @ jnp.linalg.solve(fit.covariance[3:, 3:], delta), fit.ok

    # One after the other: large batches of dense products can hang XLA's threads on a CPU with few cores.
    values, ok = jax.jit(lambda noise: jax.lax.map(squared, noise))(noise)
    assert bool(jnp.all(ok))
    assert 21 - 3 * (42 / 200) ** 0.5 < float(jnp.mean(values)) < 21 + 4 * (42 / 200) ** 0.5
    assert float(squared(noise[7])[0]) == pytest.approx(float(values[7]), rel=2e-2)


def test_poses_in_space():
    rng = np.random.default_rng(5)
    draw = jax.jit(jax.vmap(SE3.exp))
    steps, count = draw(jnp.asarray(rng.normal(size=(3, 6)) * 0.3, jnp.float32)), 4
    edges = Edges.chain(steps, jnp.tile(0.01 * jnp.eye(6)[None], (3, 1, 1)))
    truth = jax.jit(chain)(SE3.identity(), steps)
    wrong = draw(jnp.asarray(0.05 * rng.normal(size=(count, 6)), jnp.float32).at[0].set(0.0))
    start = jax.jit(jax.vmap(lambda pose, d: pose @ d))(truth, wrong)
    fit = pose_graph.optimize(start, edges)
    assert bool(fit.ok) and fit.covariance.shape == (24, 24)
    np.testing.assert_allclose(fit.value.translation, truth.translation, atol=1e-3)


def test_dtype_is_kept(dtype):
    steps = jax.tree.map(lambda leaf: leaf[None].astype(dtype), SE2(1.0, 0.0, 0.3))
    edges = Edges.chain(steps, 0.01 * jnp.eye(3, dtype=dtype)[None])
    guess = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), SE2.identity(dtype), steps)
    fit = pose_graph.optimize(guess, edges)
    assert bool(fit.ok) and fit.covariance.dtype == dtype and fit.value.translation.dtype == dtype
