import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, SE3
from jaxloc.solvers import FunctionProblem, GaussNewton, Status, align_points, align_scaled_points, solve


def umeyama(source, target, weights=None):
    """NumPy, by singular values."""
    w = np.ones(len(source)) if weights is None else weights
    w = w / w.sum()
    from_center, to_center = w @ source, w @ target
    s, t = source - from_center, target - to_center
    u, d, vt = np.linalg.svd((t * w[:, None]).T @ s)
    sign = np.ones(source.shape[1])
    sign[-1] = np.linalg.det(u @ vt)
    rotation = (u * sign) @ vt
    scale = np.sum(d * sign) / np.sum(w[:, None] * s**2)
    return rotation, to_center - rotation @ from_center, scale, to_center - scale * rotation @ from_center


def cloud(rng, size=3, count=9, noise=0.1):
    source = rng.normal(size=(count, size)) + 2.0
    group = SE3 if size == 3 else SE2
    truth = np.asarray(group.exp(jnp.asarray(rng.uniform(-2.0, 2.0, group.dof))).matrix())
    target = source @ truth[:size, :size].T + truth[:size, size] + noise * rng.normal(size=(count, size))
    return source, target


rigid, scaled = jax.jit(align_points), jax.jit(align_scaled_points)


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
def test_equals_singular_values(size, dtype, rng):  # K-48
    source, target = cloud(rng, size)
    weights = rng.uniform(0.2, 2.0, len(source))
    arrays = [jnp.asarray(x, dtype) for x in (source, target, weights)]
    tolerance = 1e-12 if dtype == np.float64 else 5e-6
    rotation, translation, scale, shifted = umeyama(source, target, weights)
    found = align_points(*arrays[:2], weights=arrays[2])
    assert bool(found.ok) and found.covariance.dtype == dtype
    assert np.abs(found.value.rotation.matrix() - rotation).max() < tolerance
    assert np.abs(found.value.translation - translation).max() < tolerance
    found = align_scaled_points(*arrays[:2], weights=arrays[2])
    assert bool(found.ok) and abs(float(found.value.scale) - scale) < tolerance
    assert np.abs(found.value.pose.translation - shifted).max() < 2 * tolerance
    assert np.abs(found.value.pose.rotation.matrix() - rotation).max() < tolerance


@pytest.mark.parametrize("size", [2, 3])
def test_exact_without_noise(size, x64, rng):
    source, target = cloud(rng, size, count=size, noise=0.0)
    found = rigid(jnp.asarray(source), jnp.asarray(target))
    assert bool(found.ok) and np.abs(found.value.apply(jnp.asarray(source)) - target).max() < 1e-13
    bigger = scaled(jnp.asarray(source), jnp.asarray(3.0 * target))
    assert bool(bigger.ok) and abs(float(bigger.value.scale) - 3.0) < 1e-12
    assert np.abs(bigger.value.apply(jnp.asarray(source)) - 3.0 * target).max() < 1e-12


def test_reflected_points_get_the_best_rotation(x64, rng):
    source, _ = cloud(rng)
    mirrored = source * np.array([-1.0, 1.0, 1.0])
    found = rigid(jnp.asarray(source), jnp.asarray(mirrored))
    rotation, *_ = umeyama(source, mirrored)
    np.testing.assert_allclose(found.value.rotation.matrix(), rotation, atol=1e-12)
    assert abs(np.linalg.det(found.value.rotation.matrix()) - 1.0) < 1e-12


def whitened(pose, data):
    return (pose.apply(data["source"]) - data["target"]).T * data["root"][None, :]


def test_covariance_and_cost_equal_those_of_the_solver(x64, rng):
    source, target = cloud(rng)
    weights = rng.uniform(0.2, 2.0, len(source))
    found = align_points(jnp.asarray(source), jnp.asarray(target), weights=jnp.asarray(weights), sigma=0.1)
    data = {"root": np.sqrt(weights) / 0.1, "source": source, "target": target}
    problem = FunctionProblem(whitened, jax.tree.map(jnp.asarray, data))
    iterated = solve(problem, found.value, solver=GaussNewton())
    np.testing.assert_allclose(found.covariance, iterated.covariance, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.cost, iterated.cost, rtol=1e-10)
    assert int(found.num_steps) == 0


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("with_scale", [False, True])
def test_gradient_equals_differences(size, with_scale, x64, rng):
    source, target = (jnp.asarray(x) for x in cloud(rng, size))
    directions = [jnp.asarray(rng.normal(size=source.shape)) for _ in range(2)]

    def summary(source, target):
        value = (align_scaled_points if with_scale else align_points)(source, target).value
        scale, pose = (value.scale, value.pose) if with_scale else (0.0, value)
        return scale + jnp.sum(jnp.sin(jnp.arange(1.0, pose.dof + 1)) * pose.log())

    @jax.jit
    def slopes(source, target):
        forward = jax.jvp(summary, (source, target), tuple(directions))[1]
        return forward, jax.grad(summary, argnums=(0, 1))(source, target)

    forward, gradient = slopes(source, target)
    backward = sum(jnp.sum(g * d) for g, d in zip(gradient, directions, strict=True))
    step = 1e-6
    value = jax.jit(lambda s: summary(source + s * directions[0], target + s * directions[1]))
    difference = (value(step) - value(-step)) / (2 * step)
    np.testing.assert_allclose(backward, forward, rtol=1e-11)
    np.testing.assert_allclose(forward, difference, rtol=1e-7)


def test_gradient_is_finite_where_singular_values_are_equal(x64):
    """The corners of a cube: a derivative through singular values would divide by zero."""
    corners = jnp.asarray(np.array(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0])).reshape(3, -1).T)

    def summary(target):
        return jnp.sum(align_points(corners, target).value.log() * jnp.arange(1.0, 7.0))

    gradient = jax.jit(jax.grad(summary))(corners)
    step = 1e-6 * jnp.eye(24)[5].reshape(8, 3)
    difference = (summary(corners + step) - summary(corners - step)) / 2e-6
    np.testing.assert_allclose(gradient.ravel()[5], difference, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("align", [align_points, align_scaled_points])
def test_degenerate_sets_are_flagged_and_finite(align, rng):
    source, target = cloud(rng)
    line = np.linspace(-1.0, 1.0, len(source))[:, None] * np.array([[1.0, 2.0, 3.0]]) + 50.0
    cases = {
        "one point": (np.tile(source[:1], (len(source), 1)), target, None),
        "line": (line, line + 1.0, None),
        "line onto cloud": (line, target, None),
        "empty": (source, target, np.zeros(len(source), bool)),
        "two points": (source, target, np.arange(len(source)) < 2),
        "good": (source, target, None),
    }
    batch = [jnp.asarray(np.stack([case[i] for case in cases.values()]), np.float32) for i in range(2)]
    valid = jnp.asarray([np.ones(len(source), bool) if case[2] is None else case[2] for case in cases.values()])

    def lane(source, target, valid):
        found = align(source, target, valid=valid)
        leaves = jax.tree.leaves(found.value)
        return sum(jnp.sum(leaf) for leaf in leaves) + jnp.trace(found.covariance), (found.ok, found.status)

    run = jax.jit(jax.vmap(jax.value_and_grad(lane, argnums=(0, 1), has_aux=True)))
    (values, (ok, status)), gradients = run(*batch, valid)
    if align is align_points:
        assert ok.tolist() == [name == "good" for name in cases]
    else:
        assert ok.tolist()[:5] == [False] * 5 and bool(ok[5])
    assert set(status.tolist()[:5]) == {int(Status.RANK_DEFICIENT)}
    assert np.all(np.isfinite(values))
    for gradient in gradients:
        assert np.all(np.isfinite(gradient)) and not np.any(gradient[:5]) and np.any(gradient[5])


def test_masked_equals_absent_and_nan_is_masked(x64, rng):
    source, target = cloud(rng)
    spoiled = target.copy()
    spoiled[6:] = np.nan
    valid = jnp.arange(len(source)) < 6
    masked = align_points(jnp.asarray(source), jnp.asarray(spoiled), valid=valid)
    absent = align_points(jnp.asarray(source[:6]), jnp.asarray(target[:6]))
    np.testing.assert_allclose(masked.value.matrix(), absent.value.matrix(), atol=1e-13)
    np.testing.assert_allclose(masked.covariance, absent.covariance, rtol=1e-9)

    def summary(target):
        return jnp.sum(align_points(jnp.asarray(source), target, valid=valid).value.matrix())

    gradient = jax.jit(jax.grad(summary))(jnp.asarray(spoiled))
    assert np.all(np.isfinite(gradient)) and not np.any(gradient[6:])


def test_vmap_equals_loop_and_float32_far_from_the_origin(rng):
    clouds = [cloud(rng, count=6, noise=0.0) for _ in range(4)]
    source, target = (jnp.asarray(np.stack(x), jnp.float32) for x in zip(*clouds, strict=True))
    batch = jax.jit(jax.vmap(lambda s, t: align_points(s, t).value.matrix()))(source, target)
    for i in range(4):
        np.testing.assert_allclose(batch[i], align_points(source[i], target[i]).value.matrix(), atol=1e-5)
    away = align_points(source[0] + 1000.0, target[0] - 500.0)
    assert bool(away.ok)
    np.testing.assert_allclose(away.value.rotation.matrix(), batch[0][:3, :3], atol=1e-3)


def test_points_of_four_coordinates_are_refused():
    with pytest.raises(ValueError, match="2 or 3 coordinates"):
        align_points(jnp.zeros((5, 4)), jnp.zeros((5, 4)))
