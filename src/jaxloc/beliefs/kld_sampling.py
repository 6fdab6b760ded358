"""KLD-sampling: adaptive number of particles by a Kullback-Leibler bound, in fixed shapes."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from jaxloc.beliefs.particles import Particles
from jaxloc.poses.lie_group import Group

_GOLDEN = 0.6180339887498949


class KLDSize(eqx.Module):
    """Number of particles that keeps the Kullback-Leibler distance from the true density below a bound.

    If k bins of a grid hold particles, ``n = (k - 1) / (2 e) (1 - 2 / (9 (k - 1)) + z sqrt(2 / (9 (k - 1))))^3`` draws
    keep the Kullback-Leibler distance below ``e``, with the probability below the quantile z. Arrays keep their size:
    particles beyond the needed number are masked.

    Attributes:
        bin_size: edge of a bin in each coordinate (of a pose: position, then rotation vector or heading).
        error: bound e of the distance.
        quantile: z of the standard normal; 2.326 for 99 %.
        minimum: least number of particles.

    References:
        Fox, "KLD-sampling: adaptive particle filters", NIPS 2001, eq. 7; "Adapting the sample size in particle filters
        through KLD-sampling", IJRR 2003, table 2 [R-5].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> size = jl.beliefs.KLDSize(jnp.ones(1), minimum=10)
        >>> int(size.needed(jnp.array(1))), int(size.needed(jnp.array(100)))
        (10, 1347)
    """

    bin_size: Float[Array, " d"]
    error: float = eqx.field(static=True, default=0.05)
    quantile: float = eqx.field(static=True, default=2.326)
    minimum: int = eqx.field(static=True, default=100)

    def needed(self, bins: Int[Array, "*n"]) -> Int[Array, "*n"]:
        """Number of particles for a number of occupied bins."""
        spare = jnp.maximum(bins - 1, 1).astype(jnp.float32)
        ratio = 2.0 / (9.0 * spare)
        number = spare / (2.0 * self.error) * (1.0 - ratio + self.quantile * jnp.sqrt(ratio)) ** 3
        number = jnp.where(bins > 1, jnp.ceil(number), 0.0)
        return jnp.maximum(number.astype(jnp.int32), self.minimum)

    def count(self, particles: Particles) -> Int[Array, ""]:
        """Number of samples that suffices, for equal particles sampled in ascending order.

        Samples are visited in strides of the golden ratio, so that every prefix of the sequence is evenly distributed
        over all of them; a sample counts as a new bin when it is the first in its slot of a hash table of four slots
        per particle.

        Returns:
            At least the minimum, at most the size of the stack.
        """
        size = particles.size
        order = (np.arange(size) * _stride(size)) % size
        slots = 1 << (4 * size - 1).bit_length()
        slot = (_hashes(lax.stop_gradient(particles.values), self.bin_size)[order] % slots).astype(jnp.int32)
        visit = jnp.arange(size, dtype=jnp.int32)
        first = jnp.full(slots, size, jnp.int32).at[slot].min(visit, mode="promise_in_bounds")
        bins = jnp.cumsum(first[slot] == visit, dtype=jnp.int32)
        enough = visit + 1 >= self.needed(bins)
        return jnp.where(jnp.any(enough), jnp.argmax(enough).astype(jnp.int32) + 1, size)


def coordinates(values: Any) -> Float[Array, "n d"]:
    """Particles as rows of coordinates: arrays as they are, poses as position and rotation vector (or heading).

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> poses = jax.vmap(jl.poses.SE2)(jnp.ones(2), jnp.zeros(2), jnp.zeros(2))
        >>> jl.beliefs.kld_sampling.coordinates(poses).tolist()
        [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    columns = []
    for node in jax.tree.leaves(values, is_leaf=lambda node: isinstance(node, Group)):
        if isinstance(node, Group):
            position = getattr(node, "translation", None)
            rotation = getattr(node, "rotation", node)
            columns += [] if position is None else [position]
            columns.append(jax.vmap(lambda one: one.log())(rotation))
        elif eqx.is_inexact_array(node):
            columns.append(node.reshape(node.shape[0], -1))
    return jnp.concatenate(columns, axis=1)


def _stride(size: int) -> int:
    """A stride near the golden ratio of the size, coprime to it."""
    step = max(int(size * _GOLDEN), 1)
    while np.gcd(step, size) != 1:
        step += 1
    return step


def _hashes(values: Any, bin_size: Array) -> UInt32[Array, " n"]:
    """Hash of the bin of each particle (multiply and shift, as in MurmurHash)."""
    cells = jnp.floor(coordinates(values) / bin_size[None, :]).astype(jnp.int32).astype(jnp.uint32)
    mixed = jnp.zeros(cells.shape[0], jnp.uint32)
    for column in range(cells.shape[1]):
        mixed = (mixed ^ cells[:, column]) * np.uint32(0x85EBCA6B)
        mixed = (mixed ^ (mixed >> np.uint32(13))) * np.uint32(0xC2B2AE35)
        mixed = mixed ^ (mixed >> np.uint32(16))
    return mixed
