"""Residuals of points, lines and segments [K-15, K-56, K-57, K-63, K-73]: SciPy, dense sampling and autodiff judge."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxloc.poses import SE2, SE3
from jaxloc.refinement.correspondences import (
    Correspondences,
    LineLine,
    Mixed,
    PointLine,
    PointPoint,
    PointSegment,
    SegmentSegment,
    nearest_on_segment,
    refine,
)
from jaxloc.solvers import GemanMcClure, Quadratic, Status
from jaxloc.solvers.least_squares import normal_equations

TRUTH = {2: np.array([0.4, -0.3, 0.25]), 3: np.array([0.4, -0.3, 0.2, 0.1, -0.2, 0.15])}
SIGMA, COUNT = 0.02, 12
KINDS = ("point_point", "point_line", "point_segment", "segment_segment", "line_line")


def pose_of(size, dtype=np.float64, shift=0.0):
    return (SE2 if size == 2 else SE3).exp(jnp.asarray(TRUTH[size] + shift, dtype))


def scene(rng, size, noise=SIGMA, count=COUNT):
    """Arrays of the target frame and what a source at the true pose measures of them, as NumPy arrays."""
    matrix = np.asarray(pose_of(size, np.float32).matrix(), float)
    rotation, shift = matrix[:size, :size], matrix[:size, size]
    into = lambda x: (x - shift) @ rotation  # noqa: E731
    first, second = rng.uniform(-4, 4, (2, count, size))
    inner = first + rng.uniform(0.1, 0.9, (count, 1)) * (second - first)
    other = first + rng.uniform(0.1, 0.9, (count, 1)) * (second - first)
    noisy = lambda x: x + noise * rng.normal(size=x.shape)  # noqa: E731
    directions = rng.normal(size=(count, size))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return {
        "point_point": (noisy(into(first)), first),
        "point_line": (noisy(into(inner)), first, second - first),
        "point_segment": (noisy(into(inner)), first, second),
        "segment_segment": (noisy(into(inner)), noisy(into(other)), first, second),
        "line_line": (noisy(directions @ rotation), directions),
    }


CLASSES = dict(zip(KINDS, (PointPoint, PointLine, PointSegment, SegmentSegment, LineLine), strict=True))


def pairs(arrays, dtype, kinds=KINDS, valid=None):
    sets = {k: CLASSES[k](*(jnp.asarray(a, dtype) for a in arrays[k]), sigma=SIGMA, valid=valid) for k in kinds}
    return Correspondences(**sets)


def reference(arrays, kinds, size, x):
    """Differences of all kinds by NumPy, written by angle and normal rather than by projection."""
    if size == 2:
        c, s = np.cos(x[2]), np.sin(x[2])
        rotation, shift = np.array([[c, -s], [s, c]]), x[:2]
    else:
        rotation, shift = Rotation.from_rotvec(x[3:]).as_matrix(), x[:3]
    out = []
    for kind in kinds:
        a = arrays[kind]
        to = lambda p, r=rotation, t=shift: p @ r.T + t  # noqa: E731
        cross = lambda d, v: np.cross(d / np.linalg.norm(d, axis=1, keepdims=True), v)  # noqa: E731
        if size == 2:
            cross = lambda d, v: (d[:, 0] * v[:, 1] - d[:, 1] * v[:, 0]) / np.linalg.norm(d, axis=1)  # noqa: E731
        if kind == "point_point":
            out.append(to(a[0]) - a[1])
        elif kind == "point_line":
            out.append(cross(a[2], to(a[0]) - a[1]))
        elif kind == "point_segment":
            out.append(cross(a[2] - a[1], to(a[0]) - a[1]))  # points lie well between the ends
        elif kind == "segment_segment":
            out += [cross(a[3] - a[2], to(end) - a[2]) for end in a[:2]]
        else:
            unit = a[0] / np.linalg.norm(a[0], axis=1, keepdims=True)
            out.append(cross(a[1], unit @ rotation.T))
    return np.concatenate([o.ravel() for o in out]) / SIGMA


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
def test_all_kinds_mixed_equal_scipy(size, x64, rng):
    arrays = scene(rng, size)
    found = refine(pairs(arrays, np.float64), pose_of(size, shift=0.1))
    start = np.concatenate([TRUTH[size][:size], TRUTH[size][size:]])
    best = least_squares(lambda x: reference(arrays, KINDS, size, x), start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert bool(found.ok)
    np.testing.assert_allclose(found.cost, best.cost, rtol=1e-8)
    np.testing.assert_allclose(found.value.translation, best.x[:size], atol=1e-6)


@eqx.filter_jit
def fit(arrays, counts, size, dtype=np.float32):
    """All kinds in one program; those that do not count are masked."""
    everything = {
        k: CLASSES[k](*arrays[k], sigma=SIGMA, valid=jnp.broadcast_to(c, (COUNT,)))
        for k, c in zip(KINDS, counts, strict=True)
    }
    return refine(Correspondences(**everything), pose_of(size, dtype, shift=0.05))


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
def test_each_kind_recovers_the_pose(size, rng):
    arrays = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), scene(rng, size, noise=0.0))
    for index, kind in enumerate(KINDS):
        # Angles alone leave the place open.
        used = jnp.arange(5) == index if kind != "line_line" else jnp.array([True, False, False, False, True])
        found = fit(arrays, used, size)
        assert bool(found.ok), (kind, found.describe())
        np.testing.assert_allclose(found.value.matrix(), pose_of(size, np.float32).matrix(), atol=2e-4)


@pytest.mark.parametrize(("size", "ranks"), [(2, (2, 1, 1, 2, 1)), (3, (3, 2, 2, 4, 2))])
def test_one_pair_has_the_stated_cost_dofs(size, ranks, x64, rng):
    arrays = {kind: [a[:1] for a in sets] for kind, sets in scene(rng, size).items()}
    found = [Mixed(pairs(arrays, np.float64, (kind,))).linearize(pose_of(size)).jacobian[0] for kind in KINDS]
    assert tuple(int(np.linalg.matrix_rank(np.asarray(j[:, :, 0]), tol=1e-6)) for j in found) == ranks
    # Beyond an end of the segment every direction counts.
    beyond = [np.full((1, size), 9.0), arrays["point_segment"][1], arrays["point_segment"][2]]
    jacobian = Mixed(pairs({"point_segment": beyond}, np.float64, ("point_segment",))).linearize(pose_of(size))
    assert np.linalg.matrix_rank(np.asarray(jacobian.jacobian[0][:, :, 0])) == size


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, 3])
def test_closed_jacobians_equal_autodiff(size, dtype, rng):
    problem = Mixed(pairs(scene(rng, size), dtype))
    mine = problem.linearize(pose_of(size, dtype))
    theirs = super(Mixed, problem).linearize(pose_of(size, dtype))
    for a, b in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, atol=2e-2 if dtype == np.float32 else 1e-9)


def test_step_is_that_of_the_pseudoinverse(x64, rng):  # K-73
    problem = Mixed(pairs(scene(rng, 2), np.float64, ("point_point",)))
    state = pose_of(2, shift=0.02)
    linear, normal = problem.linearize(state), normal_equations(problem, state)
    step = -np.linalg.solve(normal.hessian, normal.gradient)
    stacked = np.asarray(linear.jacobian[0]).reshape(3, -1).T
    np.testing.assert_allclose(step, -np.linalg.pinv(stacked) @ np.asarray(linear.residual[0]).ravel(), atol=1e-9)


def test_object_and_robot_change_places(x64, rng):  # K-15
    arrays = scene(rng, 2)
    source, target = arrays["point_point"]
    there = refine(Correspondences(PointPoint(jnp.asarray(source), jnp.asarray(target))), pose_of(2))
    back = refine(Correspondences(PointPoint(jnp.asarray(target), jnp.asarray(source))), pose_of(2).inverse())
    np.testing.assert_allclose((there.value @ back.value).matrix(), np.eye(3), atol=1e-9)


@pytest.mark.parametrize("size", [2, 3])
def test_nearest_point_of_a_segment_equals_dense_sampling(size, x64, rng):  # K-63
    points, first, second = rng.uniform(-2, 2, (3, 40, size))
    second[0] = first[0]
    found = nearest_on_segment(*(jnp.asarray(a) for a in (points, first, second)))
    dense = first[:, None] + np.linspace(0, 1, 4001)[None, :, None] * (second - first)[:, None]
    gaps = np.linalg.norm(dense - points[:, None], axis=2)
    np.testing.assert_allclose(np.linalg.norm(found - points, axis=1), gaps.min(axis=1), atol=1e-5)
    ends = (np.argmin(gaps, axis=1) == 0, np.argmin(gaps, axis=1) == 4000)
    assert ends[0].sum() > 3 and ends[1].sum() > 3  # clamped at both


@eqx.filter_jit
def nees(arrays, counts):
    def lane(arrays):
        found = fit(arrays, counts, 2)
        return found.gaussian().mahalanobis_squared(pose_of(2, np.float32)), found.ok

    return jax.vmap(lane)(arrays)


def test_covariance_is_consistent(rng):
    scenes = [scene(rng, 2) for _ in range(300)]
    arrays = jax.tree.map(lambda *a: jnp.asarray(np.stack(a), jnp.float32), *scenes)
    for used in (*np.eye(5, dtype=bool)[:4], np.ones(5, bool)):
        squared, ok = nees(arrays, jnp.asarray(used))
        assert np.all(ok)
        assert 2.6 < float(np.mean(squared)) < 3.45, used  # 3, its standard deviation 0.14


def test_outliers_under_one_kernel_for_each_kind(rng):
    arrays = scene(rng, 2)
    arrays["point_point"][0][:3] += rng.uniform(1.0, 3.0, (3, 2))
    losses = (GemanMcClure(3.0), Quadratic())
    found = refine(pairs(arrays, np.float32, ("point_point", "point_line")), pose_of(2, np.float32), loss=losses)
    assert bool(found.ok)
    np.testing.assert_allclose(found.value.matrix(), pose_of(2, np.float32).matrix(), atol=0.05)


def test_masked_equals_absent(x64, rng):
    arrays = scene(rng, 2)
    spoiled = {k: [np.where(np.arange(COUNT)[:, None] < 8, a, np.nan) for a in sets] for k, sets in arrays.items()}
    masked = refine(pairs(spoiled, np.float64, valid=jnp.arange(COUNT) < 8), pose_of(2))
    absent = refine(pairs({k: [a[:8] for a in s] for k, s in arrays.items()}, np.float64), pose_of(2))
    np.testing.assert_allclose(masked.value.matrix(), absent.value.matrix(), atol=1e-10)
    np.testing.assert_allclose(masked.covariance, absent.covariance, rtol=1e-8)


def degenerate(kind, arrays):
    """Pairs that cannot tell the pose, and which kinds count."""
    used = np.zeros(5, bool)
    used[{"parallel lines": 1, "angles alone": 4, "one point": 0, "no length": 3}.get(kind, slice(None))] = True
    arrays = dict(arrays)
    if kind == "parallel lines":
        arrays["point_line"] = (*arrays["point_line"][:2], np.tile([[1.0, 0.5]], (COUNT, 1)))
    if kind == "one point":
        arrays["point_point"] = tuple(np.tile(a[:1], (COUNT, 1)) for a in arrays["point_point"])
    if kind == "no length":
        arrays["segment_segment"] = (*arrays["segment_segment"][:3], arrays["segment_segment"][2])
    if kind == "nan":
        arrays = {k: tuple(np.full_like(a, np.nan) for a in s) for k, s in arrays.items()}
    return {k: tuple(arrays[k]) for k in KINDS}, used


@pytest.mark.slow
def test_gradients_and_degenerate_pairs(x64, rng):
    """One program for all: what is degenerate is flagged and finite; what is not has the gradient of differences."""
    kinds = ("parallel lines", "angles alone", "one point", "no length", "nan")
    cases = [degenerate(kind, scene(rng, 2)) for kind in kinds]
    good = jax.tree.map(np.asarray, scene(rng, 2))
    direction = jax.tree.map(lambda a: rng.normal(size=a.shape), good)
    for step in (0.0, 1e-6, -1e-6):
        cases.append((jax.tree.map(lambda a, d, s=step: a + s * d, good, direction), np.ones(5, bool)))
    batch = jax.tree.map(lambda *a: jnp.asarray(np.stack(a)), *(case[0] for case in cases))

    def total(arrays, used):
        found = fit(arrays, used, 2, np.float64)
        value = jnp.sum(jnp.array([1.0, 0.7, 0.4]) * found.value.log())
        return value, (jnp.sum(found.covariance), found.ok, found.status)

    run = eqx.filter_jit(jax.vmap(jax.value_and_grad(total, has_aux=True)))
    (values, (spread, ok, status)), gradient = run(batch, jnp.asarray(np.stack([case[1] for case in cases])))
    assert ok.tolist() == 5 * [False] + 3 * [True]
    assert set(status[:5].tolist()) <= {Status.RANK_DEFICIENT, Status.MAX_STEPS}
    assert np.all(np.isfinite(values)) and np.all(np.isfinite(spread))
    assert all(np.all(g[:5] == 0) and np.all(np.isfinite(g)) for g in jax.tree.leaves(gradient))
    expected = sum(jax.tree.leaves(jax.tree.map(lambda g, d: float(np.sum(g[5] * d)), gradient, direction)))
    assert abs(float(values[6] - values[7]) / 2e-6 - expected) <= 1e-4 * abs(expected)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="one shape"):
        PointPoint(jnp.zeros((3, 2)), jnp.zeros((4, 2)))
    with pytest.raises(ValueError, match="the pose has 3"):
        refine(Correspondences(PointPoint(jnp.zeros((3, 2)), jnp.zeros((3, 2)))), SE3.identity())
    with pytest.raises(ValueError, match="at least one kind"):
        refine(Correspondences(), SE2.identity())
