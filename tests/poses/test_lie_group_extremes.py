"""Maps of all groups at zero, tiny, large and the largest numbers, at NaN and infinity; both modes of derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, SE3, SO2, SO3, interpolate, wrap_angle

GROUPS = (SO2, SO3, SE2, SE3)
FINITE = ("zero", "tiny", "small", "large", "1e30", "largest", "-largest")
NOT_FINITE = ("nan", "inf", "-inf")


def number(name, dtype):
    largest = float(np.finfo(dtype).max)
    named = {"zero": 0.0, "tiny": 1e-30, "small": 1e-3, "large": 1e7, "largest": largest, "-largest": -largest}
    return named[name] if name in named else float(name)


def at_each(group, dtype, names):
    """Tangents of which one entry, the translation, the rotation, or all are some number."""
    dof, turn = group.dof, {1: 1, 3: 1 if group is SE2 else 3, 6: 3}[group.dof]
    masks = [*np.eye(dof), np.arange(dof) < dof - turn, np.arange(dof) >= dof - turn, np.ones(dof)]
    base = 0.1 * np.arange(1, dof + 1)
    return jnp.array([np.where(m > 0, number(n, dtype), base) for n in names for m in masks], dtype)


def both_modes(function):
    def all_of(x):
        return function(x), jax.jacrev(function)(x), jax.jacfwd(function)(x)

    return jax.jit(jax.vmap(all_of))


def leaves_of(pose):
    return jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(pose)])


def exp_of(group):
    return lambda xi: leaves_of(group.exp(xi))


def log_of(group):
    """The logarithm of a pose whose translation, or of a rotation whose matrix, is what is given."""
    base = group.exp(0.1 * jnp.arange(1.0, group.dof + 1.0))

    def function(x):
        if group in (SE2, SE3):
            start = x[: base.translation.shape[0]]
            pose = SE3(base.rotation, start) if group is SE3 else SE2.from_parts(base.rotation, start)
        elif group is SO3:
            pose = SO3(base.rotation_matrix.at[0].set(x))
        else:
            pose = SO2(x[0], base.sin)
        return pose.log()

    return function


@pytest.mark.parametrize("make", [exp_of, log_of])
@pytest.mark.parametrize("group", GROUPS)
def test_what_is_finite_stays_so_and_what_is_not_has_no_derivatives(group, make):
    x = at_each(group, np.float32, (*FINITE, *NOT_FINITE))
    used = {SO2: 1, SO3: 3, SE2: 2, SE3: 3}[group] if make is log_of else group.dof
    bad = ~np.isfinite(np.asarray(x)[:, :used]).all(axis=1)
    value, *slopes = (np.asarray(part) for part in both_modes(make(group))(x))
    assert value.dtype == np.float32
    assert bad.any() and np.isnan(value[bad]).all() and np.isfinite(value[~bad]).all()
    for slope in slopes:
        assert np.isfinite(slope).all() and not slope[bad].any()


@pytest.mark.parametrize("group", [SE2, SE3])
def test_interpolation(group):
    size = 2 if group is SE2 else 3
    turns = [group.exp(jnp.full(group.dof, angle)).rotation for angle in (0.1, 0.3)]
    make = SE3 if group is SE3 else SE2.from_parts

    def between(x):
        return leaves_of(interpolate(make(turns[0], x[:size]), make(turns[1], -x[:size]), x[size]))

    names = [(place, fraction) for place in (*FINITE, *NOT_FINITE) for fraction in ("small", "nan")]
    x = jnp.array([[number(place, np.float32)] * size + [number(part, np.float32)] for place, part in names])
    value, *slopes = both_modes(between)(x.astype(jnp.float32))
    np.testing.assert_array_equal(jnp.isfinite(value).all(axis=1), jnp.isfinite(x).all(axis=1))
    for slope in slopes:
        assert bool(jnp.all(jnp.isfinite(slope)))


def test_a_pose_between_is_as_before(x64):
    """Ordinary numbers are not changed by the care for others: on the geodesic, at its fraction."""
    a, b = SE3.exp(jnp.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3])), SE3.exp(jnp.array([-4.0, 1.0, 2.0, 0.5, 0.4, -0.7]))
    third = interpolate(a, b, jnp.array(1.0 / 3.0))
    np.testing.assert_allclose(a.local(third), a.local(b) / 3.0, atol=1e-12)


def test_angles():
    for name in (*FINITE, *NOT_FINITE):
        angle = jnp.array(number(name, np.float32), jnp.float32)
        for function in (wrap_angle, lambda x: SO2.from_angle(x).cos, lambda x: SO2.from_angle(x).angle()):
            value, slope = jax.value_and_grad(function)(angle)
            assert bool(jnp.isfinite(value)) == (name in FINITE) and bool(jnp.isfinite(slope))
