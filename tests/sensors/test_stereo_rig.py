import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.sensors import BrownConrady, Pinhole, StereoRig


def make_rig(skew=0.0):
    return StereoRig(Pinhole(718.856, 716.0, 607.19, 185.2, skew), 0.5372)


def points_ahead(rng, dtype, n=30):
    z = rng.uniform(2.0, 60.0, n)
    return jnp.asarray(np.stack([z * rng.uniform(-0.6, 0.6, n), z * rng.uniform(-0.2, 0.2, n), z], -1), dtype)


@pytest.mark.parametrize("skew", [0.0, 4.0])
def test_projection_is_that_of_two_cameras(x64, rng, skew):  # T-22
    rig, points = make_rig(skew), points_ahead(rng, np.float64)
    left = rig.camera.project(points)
    right = rig.camera.project(points - jnp.array([[0.5372, 0.0, 0.0]]))
    measured = rig.project(points)
    assert np.allclose(measured, np.c_[left[:, 0], right[:, 0], left[:, 1]])
    assert np.allclose(right[:, 1], left[:, 1])
    assert np.allclose(rig.project_components(*points.T), measured.T)


@pytest.mark.parametrize("skew", [0.0, 4.0])
def test_triangulation_inverts_projection(dtype, rng, skew):  # T-23
    rig, points = make_rig(skew), points_ahead(rng, dtype)
    back = rig.triangulate(rig.project(points))
    assert back.dtype == dtype
    assert np.allclose(back, points, rtol=2e-3 if dtype == np.float32 else 1e-11)
    assert bool(rig.has_depth(rig.project(points)).all()) and bool(rig.in_front(points).all())


def test_printed_equations(x64):  # T-23, R-43
    rig = StereoRig(Pinhole(700.0, 700.0, 600.0, 180.0), 0.5)
    u_left, u_right, v = 640.0, 605.0, 200.0
    d, B, f = u_left - u_right, 0.5, 700.0
    expected = [B * (u_left - 600.0) / d, B * (v - 180.0) / d, f * B / d]
    assert np.allclose(rig.triangulate(jnp.array([[u_left, u_right, v]])), [expected])
    # (T - d) / (Z - f) = T / Z with disparity d in the units of f.
    Z = expected[2]
    assert np.isclose((B - d * 1e-3) / (Z - f * 1e-3), B / Z)


def test_measurements_without_depth(dtype):
    rig = make_rig()
    measured = jnp.array([[600, 590, 100], [600, 600, 100], [600, 610, 100], [np.nan, 1, 2]], dtype)
    assert rig.has_depth(measured).tolist() == [True, False, False, False]
    points, pull = jax.vjp(rig.triangulate, measured)
    (gradient,) = pull(jnp.ones_like(points))
    assert np.isfinite(points).all() and np.isfinite(gradient).all()
    assert np.allclose(gradient[1:], 0.0)
    behind = jnp.array([[1, 2, -3], [0, 0, 0]], dtype)
    measured, pull = jax.vjp(rig.project, behind)
    assert np.isfinite(measured).all() and np.allclose(pull(measured)[0], 0.0)


def test_gradients_of_baseline_and_points(x64, rng):
    rig, points = make_rig(), points_ahead(rng, np.float64, 4)
    measured = rig.project(points)
    slope = jax.jacfwd(lambda b: StereoRig(rig.camera, b).triangulate(measured))(rig.baseline)
    assert np.allclose(slope, points / rig.baseline)
    jacobian = jax.vmap(jax.jacrev(lambda m: rig.triangulate(m[None])[0]))(measured)
    inverse = jax.vmap(jax.jacfwd(lambda p: rig.project(p[None])[0]))(points)
    assert np.allclose(jacobian @ inverse, np.eye(3)[None], atol=1e-9)


def test_vmap_equals_loop_and_eager(dtype, rng):
    rig, points = make_rig(), points_ahead(rng, dtype)
    alone = jax.vmap(lambda p: rig.project(p[None])[0])(points)
    assert np.allclose(alone, rig.project(points), rtol=1e-6)
    with jax.disable_jit():
        assert np.allclose(rig.project(points), alone, rtol=1e-6)


def test_lens_is_refused():
    with pytest.raises(ValueError, match="rectify"):
        StereoRig(Pinhole(1.0, 1.0, 0.0, 0.0, lens=BrownConrady((0.0,) * 5)), 0.5)
