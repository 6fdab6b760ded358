"""A pallet's pose from four edges [K-74, K-76]: autodiff, compounding, SciPy and finite differences judge."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from jaxloc.poses import SE2, compound
from jaxloc.refinement.pallet import (
    PalletEdges,
    PalletType,
    block_narrow,
    cross_ratio,
    edge_bearings,
    euro_long,
    euro_short,
    hole_ratio,
    pose_from_edges,
    printed_jacobian,
    stack_types,
)
from jaxloc.solvers import Status
from jaxloc.solvers.problem import Problem

FOCAL, SIGMA = 800.0, 0.05
POSE = (2.0, 0.3, 0.25)


def kind_in(dtype):
    return jax.tree.map(lambda leaf: leaf.astype(dtype), euro_long())


def seen(pose=POSE, dtype=np.float64, noise=None):
    """Bearings by trigonometry, edge by edge."""
    x, y, theta = pose
    edges = np.asarray(kind_in(dtype).edges(), float)
    places = [(x - np.sin(theta) * e, y + np.cos(theta) * e) for e in edges]
    bearings = np.array([FOCAL * b / a for a, b in places])
    return jnp.asarray(bearings if noise is None else bearings + noise, dtype)


def test_printed_jacobian_equals_autodiff(x64):  # K-76
    edges, focal = kind_in(np.float64).edges(), jnp.asarray(FOCAL)
    for pose in (POSE, (1.2, -0.4, -0.6), (4.0, 0.0, 0.0)):
        by_state = jax.jacfwd(lambda p: edge_bearings(SE2(p[0], p[1], p[2]), edges, focal))(jnp.asarray(pose))
        printed = printed_jacobian(SE2(*pose), edges, focal)
        np.testing.assert_allclose(printed, by_state.T, rtol=1e-10, atol=1e-6)


def test_second_factor_is_the_compound_left_jacobian(x64):  # K-76
    edges, focal = kind_in(np.float64).edges(), jnp.asarray(FOCAL)
    model = SE2(0.0, edges[0], 0.0)
    place = np.asarray((SE2(*POSE) @ model).translation)
    lens = np.array([-FOCAL * place[1] / place[0] ** 2, FOCAL / place[0]])
    by_pose = np.asarray(compound.left_jacobian(SE2(*POSE), model))[:2]
    np.testing.assert_allclose(printed_jacobian(SE2(*POSE), edges, focal)[:, 0], lens @ by_pose, rtol=1e-10)


def test_linearization_equals_autodiff(dtype):
    kind = kind_in(dtype)
    problem = PalletEdges(kind.edges(), seen(dtype=dtype) + 0.3, jnp.asarray(FOCAL, dtype), jnp.full(4, 20.0, dtype))
    state = SE2(*(jnp.asarray(p, dtype) for p in POSE))
    mine, theirs = problem.linearize(state), Problem.linearize(problem, state)
    np.testing.assert_allclose(mine.residual, theirs.residual)
    np.testing.assert_allclose(mine.jacobian, theirs.jacobian, rtol=1e-3 if dtype == np.float32 else 1e-9, atol=0.1)


def test_pose_equals_scipy_from_the_assumed_start(x64, rng):
    noise = SIGMA * rng.normal(size=4)
    found = pose_from_edges(kind_in(np.float64), seen(noise=noise), FOCAL, sigma=SIGMA)
    best = least_squares(
        lambda p: (np.asarray(seen(p)) - np.asarray(seen(noise=noise))) / SIGMA, [3.0, 0.0, 0.0], xtol=1e-14, ftol=1e-14
    )
    assert bool(found.ok)
    np.testing.assert_allclose([found.value.x, found.value.y, found.value.theta], best.x, atol=1e-6)
    np.testing.assert_allclose(found.cost, best.cost, rtol=1e-6)


@eqx.filter_jit
def fits(bearings, starts):
    def lane(b, start):
        found = pose_from_edges(euro_long(), b, FOCAL, sigma=SIGMA, initial=SE2(start[0], start[1], start[2]))
        return found, found.gaussian().mahalanobis_squared(SE2(*POSE))

    return jax.vmap(lane)(bearings, starts)


def test_converges_from_far_starts_and_is_consistent(rng):
    noise = SIGMA * rng.normal(size=(400, 4))
    bearings = jnp.stack([seen(dtype=np.float32, noise=n) for n in noise])
    starts = rng.uniform([1.3, -0.4, -0.3], [3.5, 0.6, 0.5], (400, 3))
    found, squared = fits(bearings, jnp.asarray(starts, jnp.float32))
    assert float(jnp.mean(found.ok)) > 0.97
    count = int(found.ok.sum())
    low, high = chi2.ppf([0.005, 0.995], 3 * count) / count
    assert low < float(jnp.mean(squared[found.ok])) < high


def test_ratio_is_constant_over_range_and_cross_ratio_over_pose(x64):  # K-74
    for kind in (euro_long(), euro_short(), block_narrow()):
        facing = [
            float(hole_ratio(edge_bearings(SE2(x, 0.1, 0.0), kind.edges(), FOCAL))) for x in (0.7, 1.0, 2.0, 5.0, 20.0)
        ]
        np.testing.assert_allclose(facing, float(kind.ratio()), rtol=1e-6)
        turned = [
            float(cross_ratio(edge_bearings(SE2(x, 0.2, theta), kind.edges(), FOCAL)))
            for x in (1.0, 2.0, 5.0)
            for theta in (-0.7, -0.2, 0.4)
        ]
        np.testing.assert_allclose(turned, float(cross_ratio(kind.edges())), rtol=1e-5)


@eqx.filter_jit
def summary(sizes, bearings, focal):
    kind = PalletType(sizes[0], sizes[1])
    value = pose_from_edges(kind, bearings, focal, sigma=SIGMA).value
    return value.x + 0.7 * value.y - 0.3 * value.theta


def test_gradients_equal_finite_differences(x64, rng):
    arguments = [jnp.array([0.3825, 0.145]), seen(noise=SIGMA * rng.normal(size=4)), jnp.asarray(FOCAL)]
    gradient = jax.grad(summary, argnums=(0, 1, 2))(*arguments)
    for index, step in enumerate((1e-6, 1e-4, 1e-3)):
        direction = jnp.asarray(rng.normal(size=arguments[index].shape))
        high, low = (
            float(summary(*(a + s * direction if i == index else a for i, a in enumerate(arguments))))
            for s in (step, -step)
        )
        expected = float(jnp.sum(gradient[index] * direction))
        assert abs((high - low) / (2 * step) - expected) <= 1e-4 * abs(expected)


@pytest.mark.slow
def test_bad_edges_are_flagged_and_finite():
    good = seen(dtype=np.float32)
    cases = jnp.stack(
        [
            good,
            jnp.full(4, jnp.nan),
            good.at[jnp.array([0, 1])].set(jnp.nan),
            good.at[0].set(jnp.nan),
            -good,
            0.0 * good,
        ]
    )

    def lane(bearings):
        found = pose_from_edges(euro_long(), bearings, FOCAL, sigma=SIGMA)
        total = found.value.x + found.value.theta + 1e-12 * jnp.sum(found.covariance)
        return total, (found.ok, found.value.x)

    run = jax.jit(jax.vmap(jax.value_and_grad(lane, has_aux=True)))
    (values, (ok, x)), gradients = run(cases)
    assert np.all(np.isfinite(values)) and np.all(np.isfinite(gradients)) and not np.any(gradients[~ok])
    assert ok.tolist()[:4] == [True, False, False, True] and not bool(ok[5])
    np.testing.assert_allclose(x[jnp.array([0, 3])], POSE[0], atol=2e-3)
    assert int(pose_from_edges(euro_long(), good, FOCAL, initial=SE2(-3.0, 0.0, 0.0)).status) != Status.CONVERGED


def test_no_types_are_named():
    with pytest.raises(ValueError, match="at least one"):
        stack_types(())
