"""Axioms of the rotation groups, by random tangents."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxloc.poses import SO2, SO3
from jaxloc.poses.lie_group import skew


def axioms(group):
    """Largest violations of the group's laws for three tangents."""

    def distance(a, b):
        return jnp.max(jnp.abs(a.matrix() - b.matrix()))

    @jax.jit
    def violations(xs):
        a, b, c = (group.exp(x) for x in xs)
        one = group.identity(xs.dtype)
        delta = 0.3 * xs[1]
        return jnp.stack(
            [
                distance((a @ b) @ c, a @ (b @ c)),
                distance(a @ one, a),
                distance(one @ a, a),
                distance(a @ a.inverse(), one),
                distance(a.inverse() @ a, one),
                distance((a @ b).inverse(), b.inverse() @ a.inverse()),
                distance(a @ group.exp(delta), group.exp(a.adjoint() @ delta) @ a),
                distance(a.retract(a.local(b)), b),
                distance(a.normalize(), a),
            ]
        )

    return violations


VIOLATIONS = {group: axioms(group) for group in (SO2, SO3)}


@pytest.mark.parametrize("group", VIOLATIONS)
@settings(max_examples=40, deadline=None)
@given(values=st.lists(st.floats(-3.0, 3.0, width=32), min_size=9, max_size=9))
def test_group_axioms(group, values):
    xs = jnp.asarray(values, jnp.float32).reshape(3, 3)[:, : group.dof]
    assert float(VIOLATIONS[group](xs).max()) < 5e-6


def test_skew_is_the_cross_product(dtype, rng):
    a, b = (jnp.asarray(rng.normal(size=3), dtype) for _ in range(2))
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-6)
