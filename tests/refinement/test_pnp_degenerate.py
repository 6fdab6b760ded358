"""Points near a line or a plane, seen frontally and from far: refused or accepted alike in both precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE3, SO3
from jaxloc.refinement import refine_pose
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Status

COUNT, SIGMA, DRAWS = 20, 0.3, 8


def points_of(rng, kind, width):
    """Points about the origin, half a meter wide: in a volume, near a plane (z = 0), near a line."""
    points = rng.uniform(-0.25, 0.25, (COUNT, 3))
    if kind == "plane":
        points[:, 2] *= width
    elif kind == "line":
        axis, start = rng.standard_normal((2, 3))
        along = np.linspace(-0.4, 0.4, COUNT)[:, None] * axis / np.linalg.norm(axis)
        points = 0.1 * start + along + width * rng.standard_normal((COUNT, 3))
    return points


@jax.jit
def fits_of(camera, pose, points, noise):
    """Estimates of all draws, and the errors of their poses: one program a precision."""

    def one(points, noise):
        pixels = camera.project(pose.inverse().apply(points)) + noise
        return refine_pose(camera, points, pixels, pose, sigma=SIGMA)

    found = jax.vmap(one)(points, noise)
    return found.ok, found.covariance, jax.vmap(lambda value: pose.local(value))(found.value)


def fits(kind, width, tilt, distance, wide):
    """Estimates of all draws, from the true pose, in one of the precisions; and the true poses."""
    rng = np.random.default_rng(5)
    points = np.stack([points_of(rng, kind, width) for _ in range(DRAWS)])
    noise = SIGMA * rng.standard_normal((DRAWS, COUNT, 2))
    with jax.enable_x64(wide):
        dtype = jnp.float64 if wide else jnp.float32
        camera = Pinhole(*(jnp.asarray(x, dtype) for x in (800.0, 800.0, 320.0, 240.0)))
        turn = SE3.exp(jnp.array([0.0, 0.0, 0.0, np.radians(tilt), 0.0, 0.0], dtype)).rotation
        pose = SE3(turn, jnp.array([0.05, 0.02, distance], dtype)).inverse()
        return jax.tree.map(np.asarray, fits_of(camera, pose, jnp.asarray(points, dtype), jnp.asarray(noise, dtype)))


CASES = [
    ("volume", 1.0, 0.0, 3.0, True),
    ("plane", 0.1, 0.0, 3.0, True),
    ("plane", 0.0, 30.0, 3.0, True),
    ("plane", 0.0, 0.0, 1.0, True),
    ("plane", 0.0, 0.0, 8.0, True),
    ("plane", 1e-3, 0.0, 20.0, True),
    ("line", 0.1, 20.0, 5.0, True),
    ("line", 1e-2, 20.0, 5.0, True),
    ("line", 1e-4, 20.0, 5.0, False),
    ("line", 0.0, 20.0, 5.0, False),
    ("line", 0.0, 0.0, 20.0, False),
]


@pytest.mark.parametrize("kind, width, tilt, distance, expected", CASES)
def test_both_precisions_agree(kind, width, tilt, distance, expected):
    (ok, covariance, errors), (ok_wide, covariance_wide, errors_wide) = (
        fits(kind, width, tilt, distance, wide) for wide in (False, True)
    )
    assert ok.tolist() == ok_wide.tolist() == [expected] * DRAWS
    assert np.isfinite(covariance).all() and np.isfinite(errors).all()
    if expected:
        sigma, sigma_wide = (np.sqrt(np.diagonal(c, axis1=1, axis2=2)) for c in (covariance, covariance_wide))
        np.testing.assert_allclose(sigma, sigma_wide, rtol=0.05)
        # Rounding moves the pose by far less than its noise.
        assert (np.abs(errors - errors_wide) < 0.2 * sigma_wide).all()


@pytest.mark.parametrize("far", [1e3, 1e5, 1e9])
def test_a_point_at_the_horizon_costs_no_precision(far):
    rng = np.random.default_rng(0)
    points = np.vstack([[*rng.uniform(-2.0, 2.0, (COUNT - 1, 3)) + [0.0, 0.0, 6.0]], [[0.1 * far, 0.05 * far, far]]])
    found = []
    for wide in (False, True):
        with jax.enable_x64(wide):
            dtype = jnp.float64 if wide else jnp.float32
            camera = Pinhole(*(jnp.asarray(x, dtype) for x in (800.0, 800.0, 320.0, 240.0)))
            pose = SE3.exp(jnp.array([0.1, 0.2, -0.1, 0.05, 0.02, 0.1], dtype))
            noise = jnp.asarray(SIGMA * np.random.default_rng(1).standard_normal((DRAWS, COUNT, 2)), dtype)
            many = jnp.broadcast_to(jnp.asarray(points, dtype), (DRAWS, COUNT, 3))
            found.append(jax.tree.map(np.asarray, fits_of(camera, pose, many, noise)))
    (ok, covariance, errors), (ok_wide, covariance_wide, errors_wide) = found
    assert ok.all() and ok_wide.all()
    sigma = np.sqrt(np.diagonal(covariance_wide, axis1=1, axis2=2))
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), sigma, rtol=0.01)
    assert (np.abs(errors - errors_wide) < 0.05 * sigma).all()


def test_a_refused_pose_has_no_gradient():
    rng = np.random.default_rng(0)
    camera, pose = Pinhole(800.0, 800.0, 320.0, 240.0), SE3.identity()
    points = jnp.asarray(points_of(rng, "line", 0.0) + [0.0, 0.0, 5.0], jnp.float32)
    pixels = camera.project(points)
    fit = refine_pose(camera, points, pixels, pose, sigma=SIGMA)
    slope = jax.grad(lambda z: jnp.sum(refine_pose(camera, points, z, pose, sigma=SIGMA).value.translation))(pixels)
    assert not bool(fit.ok) and not np.asarray(slope).any()


@pytest.mark.parametrize("offset, wide, expected", [(1e3, False, True), (5.4e6, False, False), (5.4e6, True, True)])
def test_coordinates_that_rounding_spoils_are_refused(offset, wide, expected):
    """Points in a national grid: in single precision they are rounded to half a meter, which is many pixels."""
    rng = np.random.default_rng(2)
    points = rng.uniform(-1.0, 1.0, (COUNT, 3))
    with jax.enable_x64(wide):
        dtype = jnp.float64 if wide else jnp.float32
        camera = Pinhole(*(jnp.asarray(x, dtype) for x in (800.0, 800.0, 320.0, 240.0)))
        place = np.array([0.1 * offset, offset, 300.0])
        seen = camera.project(jnp.asarray(points + [0.0, 0.0, 5.0], dtype))
        pixels = seen + jnp.asarray(SIGMA * rng.standard_normal(seen.shape), dtype)
        start = SE3(SO3.identity(), jnp.asarray(place - [0.0, 0.0, 5.0], dtype))
        fit = refine_pose(camera, jnp.asarray(points + place, dtype), pixels, start, sigma=SIGMA)
        assert bool(fit.ok) == expected
        assert expected or Status(int(fit.status)) is Status.IMPRECISE
        assert "rounding exceeds the stated noise" in fit.describe() or expected
