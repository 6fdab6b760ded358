import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, SE3, retract
from jaxloc.solvers import Cauchy, FunctionProblem, Huber, Quadratic
from jaxloc.solvers.problem import cost, cost_along, is_quadratic, normal_equations, sandwich


def residual(state, data):
    """Two blocks: points seen through a biased sensor (components by items), and what is known of the bias."""
    seen = state["pose"].apply(data["source"]) + state["bias"][None, :]
    return {"bias": state["bias"] / 0.5, "points": (seen - data["target"]).T / 0.1}


def state_and_data(rng, dtype=np.float64):
    source = rng.normal(size=(7, 3))
    pose = SE3.exp(jnp.asarray([0.1, -0.2, 0.3, 0.2, 0.1, -0.3], dtype))
    target = np.asarray(pose.apply(jnp.asarray(source, dtype))) + 0.1 * rng.normal(size=(7, 3))
    state = {"bias": jnp.asarray([0.02, -0.03, 0.01], dtype), "pose": pose}
    return state, {"source": jnp.asarray(source, dtype), "target": jnp.asarray(target, dtype)}


@pytest.fixture
def setting(x64, rng):
    state, data = state_and_data(rng)
    losses = {"bias": Quadratic(), "points": Cauchy(2.0)}
    return FunctionProblem(residual, data, losses), state


def flat(tree):
    return jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(tree)])


def test_linearize_equals_jacfwd(setting):
    problem, state = setting
    linear = eqx.filter_jit(problem.linearize)(state)
    assert linear.jacobian["points"].shape == (9, 3, 7) and linear.jacobian["bias"].shape == (9, 3)
    expected = jax.jit(jax.jacfwd(lambda d: flat(problem.residual(retract(state, d)))))(jnp.zeros(9))
    found = np.concatenate([np.asarray(j).reshape(9, -1) for j in jax.tree.leaves(linear.jacobian)], axis=1)
    np.testing.assert_allclose(found.T, expected, atol=1e-12)
    np.testing.assert_allclose(flat(linear.residual), flat(problem.residual(state)))


def test_cost_is_the_sum_of_rho(setting):
    problem, state = setting
    parts = problem.residual(state)
    squared = np.sum(np.asarray(parts["points"]) ** 2, axis=0)
    expected = np.sum(2.0 * np.log1p(squared / 4.0)) + 0.5 * np.sum(np.asarray(parts["bias"]) ** 2)
    np.testing.assert_allclose(cost(problem, state), expected, rtol=1e-12)


def test_hessian_equals_autodiff(setting):
    problem, state = setting
    expected = jax.jit(jax.hessian(lambda d: cost_along(problem, state, d)))(jnp.zeros(9))
    np.testing.assert_allclose(
        eqx.filter_jit(problem.hessian)(state), expected, atol=1e-9 * float(jnp.abs(expected).max())
    )


def test_normal_equations_equal_numpy(setting):
    problem, state = setting
    normal = jax.jit(normal_equations)(problem, state)
    linear = problem.linearize(state)
    r, j = np.asarray(linear.residual["points"]), np.asarray(linear.jacobian["points"])
    weight = 1.0 / (1.0 + np.sum(r**2, axis=0) / 4.0)
    hessian = np.einsum("akn,n,bkn->ab", j, weight, j)
    prior = np.asarray(linear.jacobian["bias"])
    np.testing.assert_allclose(normal.hessian, hessian + prior @ prior.T, rtol=1e-9, atol=1e-9)
    gradient = jax.jit(jax.grad(lambda d: cost_along(problem, state, d)))(jnp.zeros(9))
    np.testing.assert_allclose(normal.gradient, gradient, atol=1e-10)
    np.testing.assert_allclose(normal.cost, cost(problem, state), rtol=1e-12)
    assert np.linalg.eigvalsh(normal.hessian + normal.correction).min() > 0


def test_bend_completes_the_curvature_of_gentle_residuals(x64):
    """For residuals linear in the state and all well inside the kernel, nothing but the bend is missing."""
    problem = FunctionProblem(lambda x, data: (data - x[0])[None, :], jnp.array([-0.3, 0.1, 0.4]), Cauchy(2.0))
    normal = normal_equations(problem, jnp.array([0.0]))
    np.testing.assert_allclose(normal.hessian + normal.correction, problem.hessian(jnp.array([0.0])), rtol=1e-12)


def test_sandwich_of_a_mean(x64, rng):
    """Location of scalars: bread and meat are sums of psi' and psi squared."""
    data = jnp.asarray(rng.normal(size=50))
    problem = FunctionProblem(lambda x, data: (x[0] - data)[None, :], data, Huber(1.0))
    bread, meat = sandwich(problem, jnp.zeros(1))
    squared, inside = np.asarray(data) ** 2, np.abs(data) <= 1.0
    np.testing.assert_allclose(bread, [[inside.sum()]], rtol=1e-12)
    leverage = np.where(inside, 1.0, 1.0 / np.sqrt(squared)) / inside.sum()
    expected = np.sum(np.minimum(squared, 1.0) / (1.0 - leverage) ** 2)
    np.testing.assert_allclose(meat, [[expected]], rtol=1e-12)
    bread, meat = sandwich(FunctionProblem(problem.function, data), jnp.zeros(1))
    assert float(bread[0, 0]) == float(meat[0, 0]) == 50.0


def test_one_kernel_serves_a_whole_tree(x64, rng):
    state, data = state_and_data(rng)
    one = FunctionProblem(residual, data, Cauchy(2.0))
    two = FunctionProblem(residual, data, {"bias": Cauchy(2.0), "points": Cauchy(2.0)})
    np.testing.assert_allclose(cost(one, state), cost(two, state))
    assert is_quadratic(FunctionProblem(residual, data).loss) and not is_quadratic(
        {"bias": Quadratic(), "points": Cauchy(2.0)}
    )


def test_scalar_and_vector_residuals(x64):
    state = SE2(1.0, 2.0, 0.3)
    scalar = FunctionProblem(lambda pose, data: pose.x - data, jnp.array(0.5))
    np.testing.assert_allclose(cost(scalar, state), 0.125)
    normal = normal_equations(scalar, state)
    np.testing.assert_allclose(normal.gradient, 0.5 * np.array([np.cos(0.3), -np.sin(0.3), 0.0]), atol=1e-14)


def test_empty_residual_is_refused():
    with pytest.raises(ValueError, match="nothing to solve"):
        normal_equations(FunctionProblem(lambda state, data: (), jnp.array(0.0)), jnp.zeros(1))


def test_dtype_is_kept(dtype, rng):
    state, data = state_and_data(rng, dtype)
    normal = jax.jit(normal_equations)(FunctionProblem(residual, data), state)
    assert normal.cost.dtype == normal.gradient.dtype == normal.hessian.dtype == dtype and normal.correction is None
