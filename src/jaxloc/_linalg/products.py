"""Matrix products at full precision."""

import jax.numpy as jnp
from jaxtyping import Array


def matmul(a: Array, b: Array) -> Array:
    """Matrix product at full precision: accelerators otherwise round the factors of geometry to 10 bits."""
    return jnp.matmul(a, b, precision="highest")
