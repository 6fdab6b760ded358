import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.poses import SE2, SE3, SO2, SO3, carry, is_flat, local, retract, tangent_dimension, tangent_labels


def nested(dtype):
    """Poses, stacked poses, arrays of several shapes, and leaves that do not move."""
    stack = jax.vmap(SE3.exp)(jnp.asarray(0.1 * np.arange(12.0).reshape(2, 6), dtype))
    return {
        "bias": jnp.asarray([[1.0, 2.0], [3.0, 4.0]], dtype),
        "count": jnp.arange(3),
        "flag": jnp.array(True),
        "name": "camera",
        "poses": stack,
        "robot": (SE2(jnp.asarray(1.0, dtype), 2.0, 0.3), SO3.identity(dtype), SO2.identity(dtype)),
        "scale": jnp.asarray(2.0, dtype),
    }


DIMENSION = 4 + 2 * 6 + 3 + 3 + 1 + 1


def test_local_undoes_retract_on_nested_pytrees(dtype, rng):
    value = nested(dtype)
    assert tangent_dimension(value) == DIMENSION
    delta = jnp.asarray(rng.uniform(-0.5, 0.5, DIMENSION), dtype)
    moved = eqx.filter_jit(retract)(value, delta)
    assert jax.tree.structure(moved) == jax.tree.structure(value)
    back = eqx.filter_jit(local)(value, moved)
    assert back.dtype == dtype
    np.testing.assert_allclose(back, delta, atol=1e-13 if dtype == np.float64 else 2e-6)
    assert moved["name"] == "camera" and bool(moved["flag"]) and np.array_equal(moved["count"], [0, 1, 2])
    assert moved["count"].dtype == value["count"].dtype


def test_parts_move_by_their_own_rules(x64, rng):
    value = nested(np.float64)
    delta = jnp.asarray(rng.uniform(-0.5, 0.5, DIMENSION))
    moved = retract(value, delta)
    np.testing.assert_allclose(moved["bias"].ravel(), value["bias"].ravel() + delta[:4])
    for i in range(2):
        pose = jax.tree.map(lambda x, i=i: x[i], value["poses"])
        expected = pose @ SE3.exp(delta[4 + 6 * i : 10 + 6 * i])
        np.testing.assert_allclose(moved["poses"].translation[i], expected.translation, atol=1e-14)
        np.testing.assert_allclose(moved["poses"].rotation.rotation_matrix[i], expected.rotation.matrix(), atol=1e-14)
    np.testing.assert_allclose(moved["robot"][0].matrix(), (value["robot"][0] @ SE2.exp(delta[16:19])).matrix())
    np.testing.assert_allclose(moved["scale"], 2.0 + delta[-1])


def test_jit_grad_and_vmap(x64, rng):
    value = {k: v for k, v in nested(np.float64).items() if k != "name"}
    delta = jnp.asarray(rng.uniform(-0.5, 0.5, (3, DIMENSION)))

    @jax.jit
    def trip(d):
        return local(value, retract(value, d))

    batch = jax.vmap(trip)(delta)
    np.testing.assert_allclose(batch, delta, atol=1e-13)
    np.testing.assert_allclose(trip(delta[1]), batch[1], atol=1e-14)
    jacobian = jax.jit(jax.jacrev(trip))(jnp.zeros(DIMENSION))
    np.testing.assert_allclose(jacobian, np.eye(DIMENSION), atol=1e-13)


def test_wrong_size_says_what_is_needed():
    with pytest.raises(ValueError, match="7 entries.*6 degrees"):
        retract(SE3.identity(), jnp.zeros(7))
    with pytest.raises(ValueError, match="no tangent"):
        local({"n": 3}, {"n": 3})


def test_labels_name_each_direction():
    value = {"pose": SE3.identity(), "bias": jnp.zeros(2), "scale": jnp.array(1.0)}
    assert tangent_labels(value) == (
        "bias[0]",
        "bias[1]",
        *(f"pose.{name}" for name in ("x", "y", "z", "rotation_x", "rotation_y", "rotation_z")),
        "scale",
    )
    stack = jax.vmap(SE2)(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
    assert tangent_labels(stack) == tuple(f"[{i}].{name}" for i in range(2) for name in ("x", "y", "rotation"))
    assert len(tangent_labels(nested(np.float32))) == DIMENSION


def test_carry_takes_tangents_from_place_to_place(x64):
    pose, delta = SE2(1.0, 2.0, 0.3), jnp.array([0.3, -0.2, 0.4])
    target = retract(pose, jnp.array([0.5, 0.1, -0.2]))
    found = carry(pose, delta, target)
    step = 1e-6
    for i, e in enumerate(step * np.eye(3)):
        there, back = (local(target, retract(pose, delta + jnp.array(sign * e))) for sign in (1.0, -1.0))
        np.testing.assert_allclose(found[:, i], (there - back) / (2 * step), atol=1e-8)
    assert is_flat({"x": jnp.zeros(2), "n": jnp.arange(3)}) and not is_flat({"pose": pose, "x": jnp.zeros(2)})
