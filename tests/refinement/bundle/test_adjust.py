import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxloc.poses import SE3, local, retract
from jaxloc.refinement.bundle import Bundle, Gauge, Observations, Structure, adjust
from jaxloc.sensors import Pinhole, StereoRig
from jaxloc.solvers import Cauchy, FunctionProblem, LevenbergMarquardt, Quadratic, solve

CAMERAS, POINTS = 4, 14
INTRINSICS = (500.0, 490.0, 320.0, 240.0)
INDEX = [(c, p) for c in range(CAMERAS) for p in range(POINTS) if (c + p) % 5]  # each point misses a camera or none
CAMERA, POINT = np.array(INDEX, np.int32).T
TABLES = {"num_cameras": CAMERAS, "num_points": POINTS}


def rig_at(dtype=np.float64):
    return StereoRig(camera_at(dtype), jnp.asarray(0.5, dtype))


def camera_at(dtype=np.float64):
    return Pinhole(*(jnp.asarray(x, dtype) for x in INTRINSICS))


def poses_at(twists):
    return jax.vmap(SE3.exp)(twists)


def scene(model, rng, dtype=np.float64, noise=0.5, off=0.03):
    """True bundle, a start beside it whose first two poses are right, and what is seen."""
    z = rng.uniform(4.0, 9.0, (POINTS, 1))
    points = np.concatenate([rng.uniform(-0.4, 0.4, (POINTS, 2)) * z, z], axis=1)
    twists = np.linspace([0, 0, 0, 0, 0, 0], [1.2, 0.2, 0.6, 0.05, -0.1, 0.05], CAMERAS)
    truth = Bundle(poses_at(jnp.asarray(twists, dtype)), jnp.asarray(points, dtype))
    frames = jax.vmap(lambda pose: pose.inverse().apply(truth.points))(truth.poses)
    seen = model.project(frames[CAMERA, POINT])
    measured = seen + jnp.asarray(noise * rng.normal(size=seen.shape), dtype)
    moves = off * rng.normal(size=twists.shape) * (np.arange(CAMERAS) > 1)[:, None]
    shifts = off * rng.normal(size=points.shape)
    return truth, truth.moved(jnp.asarray(moves, dtype), jnp.asarray(shifts, dtype)), measured


def sights(measured, **options):
    return Observations.of(CAMERA, POINT, measured, **options)


def dense_residual(state, data):
    """All observations of the rig, the first camera held at the origin."""
    rig, first, measured = data
    poses = jax.tree.map(lambda head, rest: jnp.concatenate([head[None], rest]), first, state[0])
    frames = jax.vmap(lambda pose: pose.inverse().apply(state[1]))(poses)
    return (rig.project(frames[CAMERA, POINT]) - measured).T / 0.5


@pytest.mark.slow
def test_bundle_equals_dense_solution(x64, rng):
    rig = rig_at()
    _, start, measured = scene(rig, rng)
    first, rest = (jax.tree.map(lambda leaf, part=part: leaf[part], start.poses) for part in (0, slice(1, None)))
    problem = FunctionProblem(dense_residual, (rig, first, measured))
    dense = solve(problem, (rest, start.points), solver=LevenbergMarquardt(), max_steps=100)
    found = adjust(rig, start, sights(measured, sigma=0.5))
    assert bool(found.ok) and bool(dense.ok) and bool(jnp.all(found.point_ok))
    np.testing.assert_allclose(found.cost, dense.cost, rtol=1e-10)
    np.testing.assert_allclose(found.value.points, dense.value[1], atol=1e-6)
    np.testing.assert_allclose(found.value.poses.translation[1:], dense.value[0].translation, atol=1e-6)
    joint = found.pose_covariance(jnp.arange(CAMERAS)).reshape(6 * CAMERAS, -1)
    np.testing.assert_allclose(joint[6:, 6:], dense.covariance[:18, :18], rtol=1e-5, atol=1e-12)
    assert not np.any(joint[:6])
    spread = found.point_covariance(jnp.array([0, 9]))
    np.testing.assert_allclose(spread[1], dense.covariance[45:48, 45:48], rtol=1e-5, atol=1e-12)
    one = found.pose_estimate(2)
    np.testing.assert_allclose(one.covariance, joint[12:18, 12:18], rtol=1e-9)
    np.testing.assert_allclose(one.information @ one.covariance, np.eye(6), atol=1e-6)


@pytest.mark.slow
def test_robust_bundle_is_a_minimum_of_the_written_cost(x64, rng):
    rig = rig_at()
    _, start, measured = scene(rig, rng)
    found = adjust(rig, start, sights(measured.at[3].add(6.0), sigma=0.5), loss=Cauchy(2.0))
    first = jax.tree.map(lambda leaf: leaf[0], start.poses)

    @jax.jit
    @jax.value_and_grad
    def cost(delta, state):
        residual = dense_residual(retract(state, delta), (rig, first, measured.at[3].add(6.0)))
        return jnp.sum(2.0 * jnp.log1p(jnp.sum(residual**2, axis=0) / 4.0))

    rest = jax.tree.map(lambda leaf: leaf[1:], found.value.poses)
    zero = jnp.zeros(6 * (CAMERAS - 1) + 3 * POINTS)
    value, slope = cost(zero, (rest, found.value.points))
    assert bool(found.ok)
    np.testing.assert_allclose(found.cost, value, rtol=1e-10)
    np.testing.assert_allclose(slope, 0.0, atol=1e-2)
    assert float(value) < float(cost(zero + 1e-4, (rest, found.value.points))[0])


def test_single_camera_equals_scipy(x64, rng):
    camera = camera_at()
    _, start, measured = scene(camera, rng)
    found = adjust(camera, start, sights(measured), gauge=Gauge.fix(CAMERAS, 0, 1))
    fx, fy, cx, cy = INTRINSICS
    turns = Rotation.from_matrix(np.asarray(start.poses.rotation.rotation_matrix)).as_rotvec()
    places = np.asarray(start.poses.translation)

    def residual(x):
        moving = x[: 6 * (CAMERAS - 2)].reshape(-1, 6)
        rotations = Rotation.from_rotvec(np.concatenate([turns[:2], moving[:, :3]])).as_matrix()
        centers = np.concatenate([places[:2], moving[:, 3:]])
        points = x[6 * (CAMERAS - 2) :].reshape(-1, 3)
        c = np.einsum("mij,mi->mj", rotations[CAMERA], points[POINT] - centers[CAMERA])
        shown = np.stack([fx * c[:, 0] / c[:, 2] + cx, fy * c[:, 1] / c[:, 2] + cy], axis=1)
        return (shown - np.asarray(measured)).ravel()

    guess = np.concatenate([np.concatenate([turns, places], axis=1)[2:].ravel(), np.asarray(start.points).ravel()])
    other = least_squares(residual, guess, method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    assert bool(found.ok)
    np.testing.assert_allclose(found.cost, other.cost, rtol=1e-9)
    np.testing.assert_allclose(found.value.points.ravel(), other.x[6 * (CAMERAS - 2) :], atol=1e-5)


def total(bundle):
    return jnp.sum(jnp.sin(bundle.points)) + jnp.sum(bundle.poses.translation[2:] * 3.0)


@pytest.mark.slow
def test_gradients_equal_finite_differences(x64, rng):
    camera = camera_at()
    _, start, measured = scene(camera, rng)
    structure = Structure.of(CAMERA, POINT, **TABLES)

    def answer(measured, sigma, focal):
        fit = adjust(
            eqx.tree_at(lambda camera: camera.fx, camera, focal),
            start,
            sights(measured, sigma=sigma),
            gauge=Gauge.fix(CAMERAS, 0, 1),
            loss=Cauchy(2.0),
            structure=structure,
        )
        return jnp.where(fit.ok, total(fit.value), jnp.nan)

    sigma, focal = jnp.full(measured.shape[1], 0.5), jnp.asarray(INTRINSICS[0])
    point = (measured, sigma, focal)
    run = jax.jit(jax.value_and_grad(answer, argnums=(0, 1, 2)))
    slopes = run(*point)[1]
    for number, (value, slope, step) in enumerate(zip(point, slopes, (1e-3, 1e-4, 1e-2), strict=True)):
        way = slope / jnp.linalg.norm(slope)
        ends = [run(*point[:number], value + sign * step * way, *point[number + 1 :])[0] for sign in (1, -1)]
        np.testing.assert_allclose(jnp.linalg.norm(slope), (ends[0] - ends[1]) / (2 * step), rtol=1e-4)


@pytest.mark.slow
def test_same_under_jit_and_vmap_and_no_retrace(x64, rng):
    rig = rig_at()
    _, start, measured = scene(rig, rng)
    structure = Structure.of(CAMERA, POINT, **TABLES)
    traces = []

    def fit(m):
        traces.append(None)
        return adjust(rig, start, sights(m), structure=structure).value.points

    plain = fit(measured)
    many = jax.jit(jax.vmap(fit))(jnp.stack([measured, measured + 0.2]))
    once = jax.jit(fit)
    np.testing.assert_allclose(once(measured), plain, atol=1e-9)
    np.testing.assert_allclose(many[0], plain, atol=1e-9)
    np.testing.assert_allclose(many[1], once(measured + 0.2), atol=1e-9)
    assert len(traces) == 3


def test_masked_equals_absent(x64, rng):
    rig = rig_at()
    _, start, measured = scene(rig, rng)
    keep = np.arange(len(CAMERA)) % 7 != 0
    whole = adjust(rig, start, sights(jnp.where(keep[:, None], measured, jnp.nan), valid=jnp.asarray(keep)))
    parts = adjust(rig, start, Observations.of(CAMERA[keep], POINT[keep], measured[keep]))
    unmasked = adjust(rig, start, sights(jnp.where(keep[:, None], measured, jnp.inf)))
    np.testing.assert_allclose(whole.value.points, parts.value.points, atol=1e-8)
    np.testing.assert_allclose(unmasked.value.points, parts.value.points, atol=1e-8)


def test_order_of_observations_does_not_matter(x64, rng):
    rig = rig_at()
    _, start, measured = scene(rig, rng)
    order = rng.permutation(len(CAMERA))
    # A camera that saw a point twice is drawn twice.
    order = np.append(order, order[:3])
    shuffled = adjust(rig, start, Observations.of(CAMERA[order], POINT[order], measured[order]))
    double = np.where(np.isin(np.arange(len(CAMERA)), order[:3]), np.sqrt(0.5), 1.0)
    plain = adjust(rig, start, sights(measured, sigma=jnp.asarray(np.repeat(double[:, None], 3, axis=1))))
    np.testing.assert_allclose(shuffled.value.points, plain.value.points, atol=1e-8)
    np.testing.assert_allclose(shuffled.cost, plain.cost, rtol=1e-10)


@pytest.mark.slow
def test_dtype_is_kept(dtype, rng):
    rig = rig_at(dtype)
    truth, start, measured = scene(rig, rng, dtype, noise=0.0)
    found = adjust(rig, start, sights(measured))
    assert bool(found.ok) and found.value.points.dtype == found.cost.dtype == dtype
    assert found.pose_covariance(jnp.array([3])).dtype == dtype
    np.testing.assert_allclose(found.value.points, truth.points, atol=2e-3 if dtype == np.float32 else 1e-8)
    np.testing.assert_allclose(local(found.value.poses, truth.poses), 0.0, atol=1e-3)


def test_outliers_hardly_move_a_robust_bundle(x64, rng):
    rig = rig_at()
    truth, start, measured = scene(rig, rng, noise=0.1)
    far = measured.at[::9].add(40.0)
    clean, robust, plain = (
        adjust(rig, start, sights(m, sigma=0.1), loss=loss)
        for m, loss in ((measured, Quadratic()), (far, Cauchy(2.0)), (far, Quadratic()))
    )

    def miss(fit):
        return float(jnp.max(jnp.abs(fit.value.poses.translation - truth.poses.translation)))

    assert bool(robust.ok) and miss(robust) < 3 * miss(clean) < miss(plain)


def test_pose_errors_agree_with_their_covariance(x64, rng):
    rig = rig_at()
    truth, _, clean = scene(rig, rng, noise=0.0)
    structure = Structure.of(CAMERA, POINT, **TABLES)
    noise = jnp.asarray(0.5 * rng.normal(size=(200, *clean.shape)))

    def squared(noise):
        fit = adjust(rig, truth, sights(clean + noise, sigma=0.5), structure=structure)
        last = jax.tree.map(lambda leaf: leaf[-1], truth.poses)
        return jnp.where(fit.ok, fit.pose_gaussian(CAMERAS - 1).mahalanobis_squared(last), jnp.nan)

    mean = float(jnp.mean(jax.jit(lambda noise: jax.lax.map(squared, noise))(noise)))
    # 6 degrees of freedom over 200 runs: a standard deviation of 0.245.
    assert 5.2 < mean < 6.8


@pytest.mark.slow
def test_covariance_of_a_robust_bundle_equals_the_sandwich(x64, rng):
    """Dense, by autodiff of each observation's cost; leverage by the points alone, as documented."""
    rig, loss = rig_at(), Cauchy(2.0)
    _, start, measured = scene(rig, rng)
    found = adjust(rig, start, sights(measured.at[::7].add(3.0), sigma=0.5), loss=loss)
    first, rest = (jax.tree.map(lambda leaf, part=part: leaf[part], found.value.poses) for part in (0, slice(1, None)))
    state, data = (rest, found.value.points), (rig, first, measured.at[::7].add(3.0))
    zero = jnp.zeros(6 * (CAMERAS - 1) + 3 * POINTS)
    residual = np.asarray(dense_residual(state, data)).T
    jacobian = np.asarray(jax.jacfwd(lambda d: dense_residual(retract(state, d), data))(zero)).transpose(1, 0, 2)
    squared = np.sum(residual**2, axis=1)
    weight, fall = 1.0 / (1.0 + squared / 4.0), -0.25 / (1.0 + squared / 4.0) ** 2
    fall = np.maximum(2.0 * fall, -0.9 * weight / squared)
    score = np.einsum("mkd,mk->md", jacobian, residual)
    hessian = np.einsum("m,mkd,mke->de", weight, jacobian, jacobian) + np.einsum("m,md,me->de", fall, score, score)
    on_point = jacobian.reshape(*jacobian.shape[:2], -1, 3)[np.arange(len(POINT)), :, CAMERAS * 2 - 2 + POINT]
    blocks = np.stack([hessian[i : i + 3, i : i + 3] for i in 6 * CAMERAS - 6 + 3 * POINT])
    share = np.einsum("m,mki,mij,mkj->m", weight, on_point, np.linalg.inv(blocks), on_point) / 3.0
    score = score * (weight / (1.0 - share))[:, None]
    inverse = np.linalg.inv(hessian)
    expected = inverse @ (score.T @ score) @ inverse
    joint = np.asarray(found.pose_covariance(jnp.array([1, 3, 0]))).reshape(18, 18)
    chosen = np.r_[0:6, 12:18]
    np.testing.assert_allclose(joint[:12, :12], expected[np.ix_(chosen, chosen)], rtol=1e-6, atol=1e-12)
    assert not np.any(joint[12:])
    spread = found.point_covariance(jnp.array([9]))
    np.testing.assert_allclose(spread[0], expected[45:48, 45:48], rtol=1e-6, atol=1e-12)


def test_robust_pose_errors_agree_with_their_covariance(x64, rng):
    """A tenth of the observations is ten times as wrong as the sigma says."""
    rig = rig_at()
    truth, _, clean = scene(rig, rng, noise=0.0)
    structure = Structure.of(CAMERA, POINT, **TABLES)
    scale = np.where(rng.random((200, len(CAMERA), 1)) < 0.1, 5.0, 0.5)
    noise = jnp.asarray(scale * rng.normal(size=(200, *clean.shape)))

    def squared(noise):
        fit = adjust(rig, truth, sights(clean + noise, sigma=0.5), structure=structure, loss=Cauchy(2.0))
        last = jax.tree.map(lambda leaf: leaf[-1], truth.poses)
        return jnp.where(fit.ok, fit.pose_gaussian(CAMERAS - 1).mahalanobis_squared(last), jnp.nan)

    values = np.asarray(jax.jit(lambda noise: jax.lax.map(squared, noise))(noise))
    assert np.isfinite(values).sum() >= 198
    assert 5.0 < np.nanmean(values) < 7.0
