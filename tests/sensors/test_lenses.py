import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxloc.sensors import BrownConrady, KannalaBrandt

FIVE = (-0.28, 0.07, 0.0012, -0.0008, 0.01)
EIGHT = (0.21, -0.05, 0.0007, 0.0004, 0.006, 0.45, -0.02, 0.003)
FISHEYE = (0.018, -0.011, 0.004, -0.0012)
LENSES = {
    "four": (BrownConrady, FIVE[:4]),
    "five": (BrownConrady, FIVE),
    "eight": (BrownConrady, EIGHT),
    "fisheye": (KannalaBrandt, FISHEYE),
}


def make(name):
    kind, coefficients = LENSES[name]
    return kind(coefficients)


def grid(dtype, reach=0.7):
    side = np.linspace(-reach, reach, 9)
    x, y = np.meshgrid(side, side)
    return jnp.asarray(x, dtype), jnp.asarray(y, dtype)


@pytest.mark.parametrize("name", LENSES)
def test_distort_equals_opencv(x64, name):  # T-16, K-81
    x, y = grid(np.float64)
    points = np.stack([np.ravel(x), np.ravel(y), np.ones(x.size)], -1)[:, None]
    zero, eye, coefficients = np.zeros(3), np.eye(3), np.array(LENSES[name][1])
    if name == "fisheye":
        expected, _ = cv2.fisheye.projectPoints(points, zero, zero, eye, coefficients)
    else:
        expected, _ = cv2.projectPoints(points, zero, zero, eye, coefficients)
    got = np.stack([np.ravel(c) for c in make(name).distort(x, y)], -1)
    assert np.abs(got - expected[:, 0]).max() < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", LENSES)
def test_undistort_inverts_distort(dtype, name):  # T-16, K-81
    lens, (x, y) = make(name), grid(dtype)
    xd, yd = lens.distort(x, y)
    back_x, back_y = lens.undistort(xd, yd)
    tolerance = 3e-6 if dtype == np.float32 else 1e-13
    assert back_x.dtype == dtype
    assert np.abs(back_x - x).max() < tolerance and np.abs(back_y - y).max() < tolerance
    assert bool(lens.can_undistort(xd, yd).all()) and bool(lens.in_domain(x, y).all())


def test_undistort_equals_opencv(x64):  # T-16
    x, y = grid(np.float64, 0.5)
    points = np.stack([np.ravel(x), np.ravel(y)], -1)[:, None]
    criteria = (cv2.TERM_CRITERIA_MAX_ITER + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    expected = cv2.undistortPointsIter(points, np.eye(3), np.array(FIVE), None, None, criteria)[:, 0]
    assert np.abs(np.stack([np.ravel(c) for c in make("five").undistort(x, y)], -1) - expected).max() < 1e-9
    fisheye = cv2.fisheye.undistortPoints(points, np.eye(3), np.array(FISHEYE))[:, 0]
    assert np.abs(np.stack([np.ravel(c) for c in make("fisheye").undistort(x, y)], -1) - fisheye).max() < 1e-7


@settings(deadline=None, max_examples=25)
@given(angle=st.floats(0.0, np.deg2rad(85.0)), direction=st.floats(-3.1, 3.1))
def test_fisheye_round_trip_to_85_degrees(angle, direction):
    with jax.enable_x64(True):
        lens = make("fisheye")
        r = np.tan(angle)
        x, y = jnp.array([r * np.cos(direction)]), jnp.array([r * np.sin(direction)])
        xd, yd = lens.distort(x, y)
        k1, k2, k3, k4 = FISHEYE
        radius = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        assert np.isclose(float(jnp.hypot(xd, yd)[0]), radius, atol=1e-12)
        back_x, back_y = lens.undistort(xd, yd)
        assert np.allclose([back_x, back_y], [x, y], rtol=1e-9, atol=1e-12)
        assert bool(lens.can_undistort(xd, yd)[0])


def test_fisheye_on_the_axis(dtype):
    lens, zero = make("fisheye"), jnp.zeros(1, dtype)
    for function in (lens.distort, lens.undistort):
        value, jacobian = function(zero, zero), jax.jit(jax.jacfwd(function))(zero, zero)
        assert float(value[0][0]) == 0.0
        assert np.allclose(jacobian[0], 1.0) and np.allclose(jacobian[1], 0.0)
        assert np.allclose(jax.jit(jax.jacrev(function))(zero, zero)[0], 1.0)
    edge = float(np.finfo(dtype).eps) ** 0.25  # the series and the closed form meet here
    below, above = (lens.distort(jnp.array([f * edge], dtype), zero)[0][0] / (f * edge) for f in (0.999, 1.001))
    assert abs(float(below - above)) < 20 * np.finfo(dtype).eps + abs(2e-3 * edge**2)


@pytest.mark.parametrize("name", ["eight", "fisheye"])
def test_gradients_of_the_inverse(x64, name):
    lens = make(name)
    at = jnp.array([[0.31, -0.02], [-0.22, 0.5]])

    @jax.jit
    def ideal(coefficients, at):
        return jnp.stack(eqx.tree_at(lambda m: m.coefficients, lens, coefficients).undistort(at[0], at[1]))

    step = 1e-6
    both = [jax.jit(jac(ideal, (0, 1)))(lens.coefficients, at) for jac in (jax.jacfwd, jax.jacrev)]
    for argument, value in ((0, lens.coefficients), (1, at)):
        forward, reverse = (jacobians[argument].reshape(4, -1) for jacobians in both)
        for i in range(value.size):
            bump = np.zeros(value.size)
            bump[i] = step
            bump = bump.reshape(value.shape)
            moved = [
                ideal(*[lens.coefficients + s * bump, at] if argument == 0 else [lens.coefficients, at + s * bump])
                for s in (1, -1)
            ]
            difference = np.ravel(moved[0] - moved[1]) / (2 * step)
            assert np.allclose(forward[:, i], difference, atol=1e-7)
        assert np.allclose(forward, reverse, atol=1e-12)


@pytest.mark.parametrize("name", ["five", "fisheye"])
def test_points_outside_the_lens_are_flagged_and_finite(dtype, name):
    lens = BrownConrady((-0.3, 0.0, 0.0, 0.0)) if name == "five" else KannalaBrandt((-0.1, 0.0, 0.0, 0.0))
    # The five-term lens folds at r = 1/sqrt(0.9) = 1.05, where its image ends at 0.70; the fisheye ends at 1.2.
    xd, yd = jnp.array([0.2, 1.3, 40.0, 1e8], dtype), jnp.array([0.1, 0.3, 3.0, 1e8], dtype)
    assert lens.can_undistort(xd, yd).tolist() == [True, False, False, False]
    for function in (lens.undistort, lens.distort):
        value, pull = jax.vjp(function, xd, yd)
        assert all(np.isfinite(leaf).all() for leaf in (*value, *pull(value)))
    if name == "five":
        inside = lens.in_domain(jnp.array([1.0, 1.1, 3.0, 1e6], dtype), jnp.zeros(4, dtype))
        assert inside.tolist() == [True, False, False, False]


@pytest.mark.slow
def test_vmap_equals_loop_and_jit_equals_eager(dtype):
    lens, (x, y) = make("five"), grid(dtype)
    together = lens.undistort(x, y)[0]
    alone = jax.vmap(jax.vmap(lambda a, b: lens.undistort(a, b)[0]))(x, y)
    assert np.allclose(together, alone, atol=1e-6)
    with jax.disable_jit():
        assert np.allclose(lens.undistort(x[:2], y[:2])[0], together[:2], atol=1e-6)


def test_wrong_number_of_coefficients():
    with pytest.raises(ValueError, match="4, 5 or 8"):
        BrownConrady((0.1, 0.2))
    with pytest.raises(ValueError, match="k1, k2, k3, k4"):
        KannalaBrandt((0.1, 0.2))
