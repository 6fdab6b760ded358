"""A computation kept apart is the computation itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc._xla import compute_once


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.float32])
@pytest.mark.parametrize("first", [0.5, jnp.nan, -jnp.inf, 0.0])
def test_the_value_does_not_depend_on_what_decides_the_branch(dtype, first):
    numbers = jnp.array([first, 1.0, 2.0], dtype=dtype)
    found = jax.jit(lambda x: compute_once(jnp.add, x, x))(numbers)
    assert found.dtype == dtype
    np.testing.assert_array_equal(found, numbers + numbers)


def test_derivatives_and_batches(rng, x64):
    x, y = jnp.asarray(rng.normal(size=(2, 5, 4)))

    def plain(x, y):
        return jnp.sum((x * jnp.sin(y)) ** 2)

    def fenced(x, y):
        return jnp.sum(compute_once(lambda x, y: x * jnp.sin(y), x, y) ** 2)

    for of in (jax.grad, jax.hessian):
        want, got = (jax.jit(jax.vmap(of(function, argnums=(0, 1))))(x, y) for function in (plain, fenced))
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), want, got)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="others merge what is cheap to repeat, and do that well")
def test_nothing_is_merged_across(rng):
    compiled = jax.jit(lambda x: compute_once(jnp.cumsum, x)[::2] ** 2).lower(jnp.ones(8)).compile()
    assert "conditional(" in compiled.as_text()
