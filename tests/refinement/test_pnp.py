"""PnP against OpenCV, PoseLib and SciPy; derivatives, masks and degenerate sets."""

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import poselib
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxloc.poses import SE3
from jaxloc.refinement import refine_pose
from jaxloc.sensors import BrownConrady, Pinhole
from jaxloc.solvers import Cauchy, Dogleg, LevenbergMarquardt, Quadratic, Status

INTRINSICS = (500.0, 490.0, 320.0, 240.0)
LENS = (-0.25, 0.08, 1e-3, -5e-4, 0.0)
TRUTH = np.array([0.3, -0.2, 0.5, 0.1, -0.15, 0.2])
COUNT = 16


def camera_at(dtype, lens=None):
    camera = Pinhole(*(jnp.asarray(x, dtype) for x in INTRINSICS))
    if lens is None:
        return camera
    return eqx.tree_at(lambda c: c.lens, camera, BrownConrady(jnp.asarray(lens, dtype)), is_leaf=lambda x: x is None)


def view(rng, dtype=np.float64, lens=None, noise=0.5):
    camera, pose = camera_at(dtype, lens), SE3.exp(jnp.asarray(TRUTH, dtype))
    z = rng.uniform(3.0, 9.0, (COUNT, 1))
    local = np.concatenate([rng.uniform(-0.5, 0.5, (COUNT, 2)) * z, z], axis=1)
    pixels = np.asarray(camera.project(jnp.asarray(local, dtype))) + noise * rng.normal(size=(COUNT, 2))
    return camera, pose.apply(jnp.asarray(local, dtype)), jnp.asarray(pixels, dtype)


def start(dtype=np.float64):
    return SE3.exp(jnp.asarray(TRUTH + 0.04, dtype))


def as_opencv(pose):
    inverse = np.linalg.inv(np.asarray(pose.matrix(), float))
    return cv2.Rodrigues(inverse[:3, :3])[0], inverse[:3, 3:].copy()


def from_opencv(rvec, tvec):
    return np.linalg.inv(np.block([[cv2.Rodrigues(rvec)[0], tvec.reshape(3, 1)], [np.zeros((1, 3)), np.ones((1, 1))]]))


@pytest.mark.slow
@pytest.mark.parametrize("lens", [None, LENS], ids=["no lens", "Brown-Conrady"])
def test_refined_pose_equals_opencv(lens, x64, rng):  # K-56, K-73
    camera, points, pixels = view(rng, lens=lens)
    found = refine_pose(camera, points, pixels, start())
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-14)
    matrix, coefficients = np.asarray(camera.matrix()), np.asarray(lens if lens else np.zeros(5))
    refined = cv2.solvePnPRefineLM(
        np.array(points), np.array(pixels), matrix, coefficients, *as_opencv(start()), criteria=criteria
    )
    assert bool(found.ok)
    np.testing.assert_allclose(found.value.matrix(), from_opencv(*refined), atol=1e-6)


def test_refined_pose_equals_poselib(x64, rng):
    camera, points, pixels = view(rng)
    guess = np.linalg.inv(np.asarray(start().matrix()))
    model = {"height": 480, "model": "PINHOLE", "params": list(INTRINSICS), "width": 640}
    pose = poselib.CameraPose()
    pose.R, pose.t = guess[:3, :3], guess[:3, 3]
    options = {"gradient_tol": 1e-14, "loss_type": "TRIVIAL", "max_iterations": 100, "step_tol": 1e-14}
    refined, _ = poselib.refine_absolute_pose(np.asarray(pixels), np.asarray(points), pose, model, options)
    found = refine_pose(camera, points, pixels, start())
    expected = np.linalg.inv(np.vstack([np.asarray(refined.Rt), [0.0, 0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(found.value.matrix(), expected, atol=1e-6)


def test_robust_pose_equals_scipy(x64, rng):
    camera, points, pixels = view(rng)
    pixels = pixels.at[:3].add(jnp.asarray(rng.uniform(-50.0, 50.0, (3, 2))))
    found = refine_pose(camera, points, pixels, start(), loss=Cauchy(2.0), sigma=0.5)

    def weighted(x):
        """Residuals whose plain squares add up to the cost of the kernel."""
        local = Rotation.from_rotvec(x[:3]).apply(np.array(points)) + x[3:]
        uv = local[:, :2] / local[:, 2:] * np.array(INTRINSICS[:2]) + np.array(INTRINSICS[2:])
        squared = np.sum(((uv - np.asarray(pixels)) / 0.5) ** 2, axis=1)
        return np.sqrt(4.0 * np.log1p(squared / 4.0))

    rvec, tvec = as_opencv(start())
    best = least_squares(weighted, np.concatenate([rvec.ravel(), tvec.ravel()]), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found.cost, best.cost, rtol=1e-9)
    np.testing.assert_allclose(found.value.matrix(), from_opencv(best.x[:3], best.x[3:]), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [LevenbergMarquardt(), Dogleg()], ids=lambda s: type(s).__name__)
def test_damped_solvers_agree(solver, rng):
    camera, points, pixels = view(rng, np.float32)
    reference = refine_pose(camera, points, pixels, start(np.float32))
    found = refine_pose(camera, points, pixels, SE3.exp(jnp.asarray(TRUTH + 0.2, np.float32)), solver=solver)
    assert bool(found.ok) and found.value.translation.dtype == np.float32
    np.testing.assert_allclose(found.value.matrix(), reference.value.matrix(), atol=1e-5)


@eqx.filter_jit
def summary(camera, points, pixels):
    value = refine_pose(camera, points, pixels, start(points.dtype), loss=Cauchy(2.0)).value
    return jnp.sum(jnp.sin(jnp.arange(1.0, 7.0, dtype=points.dtype)) * value.log())


@pytest.mark.slow
def test_gradients_by_pixels_points_and_intrinsics(x64, rng):
    arguments = view(rng, lens=LENS)
    gradient = eqx.filter_jit(jax.grad(lambda a: summary(*a)))(arguments)
    steps = [("pixels", 1e-4), ("points", 1e-6), ("camera", 1e-5)]
    for (_, step), index in zip(steps, (2, 1, 0), strict=True):
        direction = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arguments[index])
        high, low = (
            summary(
                *arguments[:index],
                jax.tree.map(lambda x, d, s=s: x + s * d, arguments[index], direction),
                *arguments[index + 1 :],
            )
            for s in (step, -step)
        )
        pairs = zip(jax.tree.leaves(gradient[index]), jax.tree.leaves(direction), strict=True)
        expected = sum(float(jnp.sum(g * d)) for g, d in pairs)
        assert abs((float(high) - float(low)) / (2 * step) - expected) <= 1e-4 * abs(expected)


@pytest.mark.slow
def test_gradient_in_single_precision(rng):
    with jax.enable_x64(True):
        arguments = view(rng)
        expected = np.asarray(jax.grad(summary, argnums=2)(*arguments))
    single = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float32), arguments)
    gradient = jax.grad(summary, argnums=2)(*single)
    assert gradient.dtype == np.float32
    assert np.linalg.norm(gradient - expected) <= 1e-3 * np.linalg.norm(expected)


def test_masked_equals_absent(x64, rng):
    camera, points, pixels = view(rng)
    spoiled = pixels.at[12:].set(jnp.nan)
    masked = refine_pose(camera, points, spoiled, start(), valid=jnp.arange(COUNT) < 12)
    absent = refine_pose(camera, points[:12], pixels[:12], start())
    np.testing.assert_allclose(masked.value.matrix(), absent.value.matrix(), atol=1e-11)
    np.testing.assert_allclose(masked.covariance, absent.covariance, rtol=1e-8, atol=1e-15)


def degenerate(kind, rng, count):
    """Batches of problems that have no answer; every lane has its own numbers."""
    z = rng.uniform(3.0, 9.0, (count, COUNT, 1))
    points = np.concatenate([rng.uniform(-0.5, 0.5, (count, COUNT, 2)) * z, z], axis=2)
    pixels = points[..., :2] / points[..., 2:] * 500.0 + [320.0, 240.0] + rng.normal(size=(count, COUNT, 2))
    valid = np.ones((count, COUNT), bool)
    if kind == "collinear":
        points = points[:, :1] + np.linspace(0.0, 1.0, COUNT)[None, :, None] * rng.normal(size=(count, 1, 3))
    elif kind == "coincident":
        points = np.tile(points[:, :1], (1, COUNT, 1))
    elif kind == "behind":
        points = points * [1.0, 1.0, -1.0]
    elif kind == "empty":
        valid[:] = False
    elif kind == "two points":
        valid[:, 2:] = False
    elif kind == "masked nan":
        points[:, 3:6], pixels[:, 5:], valid[:, 2:] = np.nan, np.nan, False
    elif kind == "nan":
        points[:, ::2], pixels[:, 1::2] = np.nan, np.inf
    elif kind == "huge":
        pixels = pixels * 1e30
    return points, pixels, valid


KINDS = ("collinear", "coincident", "behind", "empty", "two points", "masked nan", "nan", "huge")


@pytest.mark.slow
def test_ten_thousand_degenerate_problems(rng):
    """Values and gradients are finite in every lane, and no lane without an answer says that it has one."""
    parts = [degenerate(kind, rng, 1250) for kind in KINDS]
    points, pixels = (jnp.asarray(np.concatenate([p[i] for p in parts]), jnp.float32) for i in range(2))
    valid = jnp.asarray(np.concatenate([p[2] for p in parts]))

    def lane(points, pixels, valid):
        found = refine_pose(camera_at(np.float32), points, pixels, SE3.identity(jnp.float32), valid=valid)
        total = jnp.sum(found.value.matrix()) + jnp.sum(found.covariance) * 1e-12 + found.cost * 1e-12
        return total, found.ok

    run = jax.jit(jax.vmap(jax.value_and_grad(lane, argnums=(0, 1), has_aux=True)))
    (values, ok), gradients = run(points, pixels, valid)
    assert np.all(np.isfinite(values))
    for gradient in gradients:
        assert np.all(np.isfinite(gradient)) and not np.any(gradient[~ok])
    share = {kind: float(np.mean(ok[1250 * i : 1250 * (i + 1)])) for i, kind in enumerate(KINDS)}
    assert all(share[kind] == 0.0 for kind in KINDS if kind not in ("collinear",)), share
    assert share["collinear"] < 0.01, share


def test_two_points_are_too_few(rng):
    camera, points, pixels = view(rng, np.float32)
    found = refine_pose(camera, points, pixels, start(np.float32), valid=jnp.arange(COUNT) < 2)
    assert not bool(found.ok) and int(found.status) in (Status.RANK_DEFICIENT, Status.MAX_STEPS, Status.INADMISSIBLE)


def test_new_numbers_compile_nothing(rng):
    camera, points, pixels = view(rng, np.float32)
    traces = []

    @jax.jit
    def fit(camera, points, pixels, loss):
        traces.append(1)
        return refine_pose(camera, points, pixels, start(np.float32), loss=loss).value.matrix()

    for scale in (1.0, 2.0, 3.0):
        fit(jax.tree.map(lambda x, s=scale: x * s, camera), scale * points, pixels + scale, Cauchy(scale))
    assert len(traces) == 1 and refine_pose(camera, points, pixels, start(np.float32), loss=Quadratic()).ok.shape == ()
