"""Degenerate input of filters and trackers: many lanes of one program, with clean ones among them."""

import inspect

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

LARGEST = float(np.finfo(np.float32).max)
VALUES = (np.nan, np.inf, -np.inf, LARGEST, 1e30, 1e-30, 0.0, 1e7, -1.0)
UNUSABLE = (np.nan, np.inf, -np.inf, LARGEST, 1e30)


def concrete(room, kind):
    """Names of the public classes of a room that are of a kind and can be made: new ones enter by themselves."""
    found = ((name, getattr(room, name)) for name in room.__all__)
    return sorted(
        name
        for name, value in found
        if inspect.isclass(value) and issubclass(value, kind) and not inspect.isabstract(value)
    )


def replaced(value, number):
    """All numbers of an array replaced; of matrices, the diagonal scaled (or replaced, where that is not finite)."""
    if value.ndim < 2 or value.shape[-1] != value.shape[-2]:
        return jnp.full_like(value, number)
    return value * number if np.isfinite(number) else jnp.where(value > 0.0, number, value)


def lanes_of(base, matrices=()):
    """Name and parameters of each lane: every parameter with every value, and indefinite matrices."""
    lanes = [("clean", base)]
    for name, value in base.items():
        if value.dtype == bool:
            continue
        lanes += [(f"{name}={number:g}", base | {name: replaced(value, number)}) for number in VALUES]
    for name in matrices:
        value = base[name]
        wide = value.at[..., 0, 1].set(2.0 * value[..., 0, 0]).at[..., 1, 0].set(2.0 * value[..., 0, 0])
        lanes.append((f"{name} indefinite", base | {name: wide}))
    masked = {name: jnp.full_like(base[name], jnp.nan) for name in ("z",)}
    lanes.append(("masked", base | masked | {"valid": jnp.zeros_like(base["valid"])}))
    return [*lanes, ("clean", base)]


def unusable(*names):
    """Lanes whose answer cannot be supported: parameters that are not finite, or overflow."""
    return {f"{name}={number:g}" for name in names for number in UNUSABLE}


def check_lanes(step, base, *, unsupported, matrices=()):
    """Runs all lanes of a step in one program, and checks values, gradients, `ok` and the clean lanes.

    Args:
        step: of the parameters; its values, and whether they are usable.
        base: parameters of the clean lanes.
        unsupported: names of the lanes that must not be ``ok``.
        matrices: parameters that are covariances.
    """

    def one(parameters):
        floats = {name: value for name, value in parameters.items() if value.dtype != bool}

        def loss(floats):
            values, ok = step(floats | {"valid": parameters["valid"]})
            inexact = [leaf for leaf in jax.tree.leaves(values) if eqx.is_inexact_array(leaf)]
            # Log weights of empty slots are huge.
            total = sum(jnp.sum(jnp.where(jnp.abs(leaf) < 1e9, leaf, 0.0)) for leaf in inexact)
            return total, (inexact, ok)

        (_, (values, ok)), gradients = jax.value_and_grad(loss, has_aux=True)(floats)
        return values, ok, gradients

    lanes = lanes_of(base, matrices)
    program = jax.jit(jax.vmap(one))
    values, ok, gradients = program(stacked([parameters for _, parameters in lanes]))
    expected = program(stacked([base for _ in lanes]))
    problems = []
    for i, (name, _) in enumerate(lanes):
        if not all(np.isfinite(leaf[i]).all() for leaf in jax.tree.leaves(values)):
            problems.append(f"{name}: values")
        problems += [f"{name}: gradient by {key}" for key, leaf in gradients.items() if not np.isfinite(leaf[i]).all()]
        if name in unsupported and bool(ok[i]):
            problems.append(f"{name}: ok")
        if name in ("clean", "masked") and not bool(ok[i]):
            problems.append(f"{name}: not ok")
    assert not problems, problems
    missing = unsupported - {name for name, _ in lanes}
    assert not missing, missing
    for i in (0, len(lanes) - 1):
        for found, wanted in zip(jax.tree.leaves((values, gradients)), jax.tree.leaves(expected[::2]), strict=True):
            np.testing.assert_allclose(found[i], wanted[i], rtol=1e-5, atol=1e-6)


def stacked(parameters):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *parameters)


def marked(name, slow):
    """A test parameter, slow where its program takes long to compile."""
    return pytest.param(name, marks=[pytest.mark.slow] if name in slow else [])
