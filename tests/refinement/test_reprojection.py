import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3, retract
from jaxloc.refinement import Reprojection, StereoReprojection
from jaxloc.refinement.reprojection import stereo_jacobian, whitener
from jaxloc.sensors import BrownConrady, KannalaBrandt, Pinhole, StereoRig
from jaxloc.solvers import Cauchy, Quadratic, solve
from jaxloc.solvers.problem import cost_along

LENSES = {
    "no lens": lambda: None,
    "brown": lambda: BrownConrady((-0.3, 0.1, 1e-3, -2e-3, 0.01)),
    "fisheye": lambda: KannalaBrandt((0.05, -0.01, 0.002, 0.0)),
}
POSE = np.array([0.3, -0.2, 0.5, 0.1, -0.15, 0.2])


def camera_problem(lens, loss, rng, noise=1.0, dtype=np.float64):
    camera = Pinhole(*(jnp.asarray(x, dtype) for x in (500.0, 480.0, 320.0, 240.0, 2.0)), LENSES[lens]())
    if camera.lens is not None:
        camera = jax.tree.map(lambda x: x.astype(dtype), camera)
    pose = SE3.exp(jnp.asarray(POSE, dtype))
    z = rng.uniform(3.0, 9.0, (12, 1))
    local = np.concatenate([rng.uniform(-0.6, 0.6, (12, 2)) * z, z], axis=1)
    pixels = np.asarray(camera.project(jnp.asarray(local, dtype))) + noise * rng.normal(size=(12, 2))
    valid = np.arange(12) != 4
    points = pose.apply(jnp.asarray(local, dtype))
    arrays = points.T, jnp.asarray(pixels.T, dtype), jnp.asarray(1.5, dtype), jnp.asarray(valid)
    return Reprojection(camera, *arrays, loss), pose


def stereo_problem(loss, rng, noise=1.0, dtype=np.float64):
    rig = StereoRig(Pinhole(*(jnp.asarray(x, dtype) for x in (700.0, 690.0, 600.0, 180.0, 1.0))), 0.5)
    pose = SE3.exp(jnp.asarray(POSE, dtype))
    z = rng.uniform(3.0, 9.0, (12, 1))
    local = jnp.asarray(np.concatenate([rng.uniform(-0.6, 0.6, (12, 2)) * z, z], axis=1), dtype)
    root = rng.normal(size=(12, 3, 3))
    covariances = root @ root.mT + np.eye(3)
    white = whitener(jnp.asarray(covariances, dtype))
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), noise * rng.normal(size=(12, 3)))
    measured = np.asarray(rig.project(local)) + errors
    valid = jnp.asarray(np.arange(12) != 4)
    return StereoReprojection(rig, pose.apply(local).T, jnp.asarray(measured.T, dtype), white, valid, loss), pose


CASES = [("no lens", Quadratic), ("brown", Cauchy), ("fisheye", Cauchy), ("stereo", Cauchy)]


def setting(name, loss, rng, **options):
    return stereo_problem(loss, rng, **options) if name == "stereo" else camera_problem(name, loss, rng, **options)


@eqx.filter_jit
def derivatives(problem, pose):
    zero = jnp.zeros(6, pose.translation.dtype)
    closed = problem.linearize(pose), problem.hessian(pose)
    by_rule = jax.jacfwd(lambda d: problem.residual(retract(pose, d)))(zero)
    return closed, by_rule, jax.hessian(lambda d: cost_along(problem, pose, d))(zero)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "loss"), CASES)
def test_closed_forms_equal_autodiff(name, loss, x64, rng):
    """The Jacobian anywhere, the Hessian at a minimum."""
    problem, pose = setting(name, loss(), rng)
    found = solve(problem, pose)
    assert bool(found.ok)
    for at, at_minimum in ((pose, False), (found.value, True)):
        (linear, hessian), by_rule, exact = derivatives(problem, at)
        np.testing.assert_allclose(np.moveaxis(linear.jacobian, 0, -1), by_rule, atol=1e-9)
        np.testing.assert_allclose(linear.residual, problem.residual(at), atol=1e-12)
        if at_minimum:
            np.testing.assert_allclose(hessian, exact, atol=1e-8 * float(jnp.abs(exact).max()))


def test_residual_equals_numpy(dtype, rng):  # K-56
    problem, pose = camera_problem("no lens", Quadratic(), rng, dtype=dtype)
    matrix = np.asarray(pose.matrix(), float)
    local = (np.asarray(problem.points.T, float) - matrix[:3, 3]) @ matrix[:3, :3]
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    predicted = np.stack([500.0 * x + 2.0 * y + 320.0, 480.0 * y + 240.0])
    expected = (predicted - np.asarray(problem.pixels, float)) / 1.5
    expected[:, 4] = 0.0
    found = problem.residual(pose)
    assert found.dtype == dtype
    np.testing.assert_allclose(found, expected, atol=1e-10 if dtype == np.float64 else 2e-3)


def test_stereo_residual_is_white(rng):
    with jax.enable_x64(True):
        squares = [np.asarray(p.residual(q)) ** 2 for p, q in (stereo_problem(Quadratic(), rng) for _ in range(60))]
    mean = np.mean(squares, axis=(0, 2)) * 12.0 / 11.0  # one slot of twelve is masked
    np.testing.assert_allclose(mean, 1.0, atol=0.25)


def test_points_behind_the_camera_are_dear_and_move_nothing(x64, rng):
    problem, pose = camera_problem("no lens", Quadratic(), rng)
    behind = eqx.tree_at(lambda p: p.points, problem, problem.points.at[:, 2].set(pose.translation))
    linear = behind.linearize(pose)
    assert float(jnp.min(linear.residual[:, 2])) >= 1e3 and not np.any(linear.jacobian[:, :, 2])
    assert not np.any(linear.residual[:, 4]) and not np.any(linear.jacobian[:, :, 4])
    gradient = jax.grad(lambda p: cost_along(p, pose, jnp.zeros(6)), allow_int=True)(behind)
    assert np.all(np.isfinite(gradient.points)) and not np.any(gradient.points[:, 2])


def test_whitener_equals_inverse_cholesky(dtype, rng):
    root = rng.normal(size=(7, 3, 3))
    covariances = root @ root.mT + 0.1 * np.eye(3)
    found = np.moveaxis(np.asarray(whitener(jnp.asarray(covariances, dtype))), -1, 0)
    assert found.dtype == dtype and not np.any(np.triu(found, 1))
    expected = np.linalg.inv(np.linalg.cholesky(covariances))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-10 if dtype == np.float64 else 1e-4)
    singular = whitener(jnp.zeros((2, 3, 3), dtype))
    assert np.all(np.isfinite(singular))


def test_stereo_jacobian_equals_autodiff(x64, rng):
    problem, _ = stereo_problem(Quadratic(), rng)
    points = jnp.asarray(rng.uniform([-2.0, -2.0, 3.0], [2.0, 2.0, 9.0], (5, 3)))
    found = stereo_jacobian(problem.rig, tuple(points.T))
    expected = jax.vmap(jax.jacfwd(lambda p: problem.rig.project(p[None])[0]))(points)
    np.testing.assert_allclose(np.moveaxis(found, -1, 0), expected.mT, atol=1e-10)
