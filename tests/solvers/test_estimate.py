import equinox as eqx
import gtsam
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxloc.poses import SE2, SE3
from jaxloc.refinement import refine_pose
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Cauchy, Estimate, FunctionProblem, Status, solve

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2))


def graph(poses, data):
    """Prior on the first pose and relative poses between others, whitened by square roots of information."""

    def at(k):
        return jax.tree.map(lambda x: x[k], poses)

    def measured(k):
        return jax.tree.map(lambda x: x[k], data["motions"])

    prior = data["root_prior"] @ data["anchor"].local(at(0))
    edges = [data["root"] @ measured(k).local(at(i).inverse() @ at(j)) for k, (i, j) in enumerate(EDGES)]
    return {"edges": jnp.stack(edges, axis=1), "prior": prior[:, None]}


def graph_setting(group, rng):
    size = group.dof
    poses = jax.vmap(group.exp)(jnp.asarray(rng.uniform(-1.0, 1.0, (4, size))))

    def at(k):
        return jax.tree.map(lambda x: x[k], poses)

    motions = [at(i).inverse() @ at(j) for i, j in EDGES]
    covariance = (lambda a: a @ a.T / 50.0)(rng.normal(size=(size, size + 2)))
    prior = (lambda a: a @ a.T / 500.0)(rng.normal(size=(size, size + 2)))
    data = {
        "anchor": at(0),
        "motions": jax.tree.map(lambda *x: jnp.stack(x), *motions),
        "root": jnp.asarray(np.linalg.inv(np.linalg.cholesky(covariance))),
        "root_prior": jnp.asarray(np.linalg.inv(np.linalg.cholesky(prior))),
    }
    return poses, data, covariance, prior


@pytest.mark.slow
def test_covariance_equals_gtsam_in_the_plane(x64, rng):
    poses, data, covariance, prior = graph_setting(SE2, rng)
    found = solve(FunctionProblem(graph, data), jax.vmap(lambda p: p.retract(jnp.full(3, 0.02)))(poses))
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(4):
        values.insert(k, gtsam.Pose2(*map(float, poses.translation[k]), float(jax.vmap(lambda p: p.theta)(poses)[k])))
    factors.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Gaussian.Covariance(prior)))
    noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
    for i, j in EDGES:
        factors.add(gtsam.BetweenFactorPose2(i, j, values.atPose2(i).between(values.atPose2(j)), noise))
    expected = gtsam.Marginals(factors, values).jointMarginalCovariance([0, 1, 2, 3]).fullMatrix()
    assert bool(found.ok)
    assert np.abs(found.covariance - expected).max() < 1e-8


@pytest.mark.slow
def test_covariance_equals_gtsam_in_space(x64, rng):
    poses, data, covariance, prior = graph_setting(SE3, rng)
    found = solve(FunctionProblem(graph, data), jax.vmap(lambda p: p.retract(jnp.full(6, 0.02)))(poses))
    swap = np.array([3, 4, 5, 0, 1, 2])  # GTSAM puts rotation first
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k in range(4):
        values.insert(k, gtsam.Pose3(np.asarray(jax.vmap(lambda p: p.matrix())(poses)[k])))
    swapped = [c[np.ix_(swap, swap)] for c in (prior, covariance)]
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Gaussian.Covariance(swapped[0])))
    noise = gtsam.noiseModel.Gaussian.Covariance(swapped[1])
    for i, j in EDGES:
        factors.add(gtsam.BetweenFactorPose3(i, j, values.atPose3(i).between(values.atPose3(j)), noise))
    joint = gtsam.Marginals(factors, values).jointMarginalCovariance([0, 1, 2, 3]).fullMatrix()
    order = np.concatenate([6 * k + swap for k in range(4)])
    assert bool(found.ok) and found.covariance.shape == (24, 24)
    assert np.abs(found.covariance - joint[np.ix_(order, order)]).max() < 1e-8


CAMERA = (500.0, 500.0, 320.0, 240.0)


def views(seeds, count, outliers, rng):
    """Cameras that look at their own clouds of points from near a true pose; pixels have one sigma of noise."""
    pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (seeds, count, 2))
    depth = rng.uniform(4.0, 12.0, (seeds, count, 1))
    rays = np.concatenate([(pixels - [[320.0, 240.0]]) / 500.0, np.ones((seeds, count, 1))], axis=2)
    truth = jax.vmap(SE3.exp)(jnp.asarray(rng.uniform(-0.5, 0.5, (seeds, 6)), jnp.float32))
    points = jax.vmap(lambda pose, p: pose.apply(p))(truth, jnp.asarray(rays * depth, jnp.float32))
    noise = rng.normal(size=pixels.shape)
    count_outliers = int(outliers * count)
    noise[:, :count_outliers] += rng.uniform(-60.0, 60.0, (seeds, count_outliers, 2))
    initial = jax.vmap(lambda pose, d: pose.retract(d))(
        truth, jnp.asarray(0.05 * rng.normal(size=(seeds, 6)), jnp.float32)
    )
    return truth, points, jnp.asarray(pixels + noise, jnp.float32), initial


@eqx.filter_jit
def normalized_errors(truth, points, pixels, initial, loss):
    def lane(truth, points, pixels, initial):
        found = refine_pose(Pinhole(*CAMERA), points, pixels, initial, **loss)
        return found.gaussian().mahalanobis_squared(truth), found.ok, found.num_steps

    return jax.vmap(lane)(truth, points, pixels, initial)


def test_covariance_of_a_camera_pose_is_consistent(rng):
    """Also: at least 99 % of solvable problems in single precision are reported as solved."""
    nees, ok, steps = normalized_errors(*views(2000, 30, 0.0, rng), {})
    assert np.mean(ok) >= 0.99 and np.max(steps) <= 12
    count = int(np.sum(ok))
    low, high = stats.chi2.ppf([0.001, 0.999], 6 * count) / count
    assert low < np.mean(nees[ok]) < high


def test_covariance_under_a_robust_kernel_is_consistent(rng):
    nees, ok, _ = normalized_errors(*views(1000, 60, 0.25, rng), {"loss": Cauchy(2.385)})
    assert np.mean(ok) >= 0.99
    # The covariance is estimated from the scores of 60 items: Hotelling's T^2 with 60 - 6 degrees of freedom.
    dof, spare = 6, 60 - 6
    scale, law = dof * spare / (spare - dof + 1), stats.f(dof, spare - dof + 1)
    standard_error = scale * law.std() / np.sqrt(int(np.sum(ok)))
    assert abs(np.mean(nees[ok]) - scale * law.mean()) < 3.3 * standard_error


def made(information, status=Status.CONVERGED):
    information = jnp.asarray(information)
    size = information.shape[0]
    ok = jnp.array(status is Status.CONVERGED)
    return Estimate(
        jnp.zeros(size),
        jnp.eye(size),
        jnp.array(1.5),
        ok,
        jnp.array(4),
        jnp.array(int(status)),
        information.astype(jnp.float32),
    )


def test_observability_knows_no_units():
    """Scaling a direction's unit changes neither rank nor condition."""
    base = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.2], [0.0, 0.2, 3.0]])
    unit = np.diag([1e3, 1.0, 1e-3])
    a, b = made(base).observability(), made(unit @ base @ unit).observability()
    scale = 1.0 / np.sqrt(np.diagonal(base))
    eigenvalues = np.linalg.eigvalsh(base * np.outer(scale, scale))
    np.testing.assert_allclose(a.eigenvalues, eigenvalues, rtol=1e-5)
    np.testing.assert_allclose(a.condition, eigenvalues[-1] / eigenvalues[0], rtol=1e-5)
    np.testing.assert_allclose(b.condition, a.condition, rtol=1e-4)
    assert int(a.rank) == int(b.rank) == 3


def test_observability_finds_what_is_missing():  # K-13
    seen = made(np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 2.0]])).observability()
    assert int(seen.rank) == 2 and np.isinf(seen.condition)
    direction = np.asarray(seen.directions[:, 0])
    np.testing.assert_allclose(np.abs(direction), [np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-5)
    assert direction[0] * direction[1] > 0
    nothing = made(np.zeros((3, 3))).observability()
    assert int(nothing.rank) == 0 and np.all(np.isfinite(nothing.directions))


@pytest.mark.parametrize("status", list(Status))
def test_describe_and_check(status):
    estimate = made(np.diag([1.0, 0.0]), status)
    text = estimate.describe()
    assert "4 steps" in text and "1.5" in text
    if status is Status.CONVERGED:
        assert estimate.check() is estimate
        return
    with pytest.raises(ValueError, match="not usable"):
        estimate.check()
    assert ("unobservable: " in text) == (status is Status.RANK_DEFICIENT)


def test_gaussian_carries_value_and_covariance():
    estimate = made(np.eye(3))
    density = estimate.gaussian()
    assert density.mean is estimate.value and density.covariance is estimate.covariance
