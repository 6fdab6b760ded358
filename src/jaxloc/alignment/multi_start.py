"""Alignment from many starts at once: all of them on the coarsest scale, the best few to the end."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc.alignment.lucas_kanade.align import estimate, search, start_of, take
from jaxloc.alignment.lucas_kanade.covariance import Evidence
from jaxloc.alignment.lucas_kanade.iteration import Descended
from jaxloc.alignment.lucas_kanade.normal_equations import Prepared, equations, zero_brightness
from jaxloc.alignment.lucas_kanade.options import LucasKanade
from jaxloc.alignment.lucas_kanade.pyramid_level import Level
from jaxloc.images.warps import Translation, Warp
from jaxloc.solvers import Estimate


def translations_around(center: Float[Array, "2"], *, spacing: float, count: int) -> Translation:
    """A square grid of shifts, ``count`` by ``count``, stacked along a leading axis.

    Args:
        center: the shift in the middle (right, down), px.
        spacing: between neighbors, px.
        count: shifts along each side.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> jl.alignment.multi_start.translations_around(jnp.zeros(2), spacing=4.0, count=3).translation[0].tolist()
        [-4.0, -4.0]
    """
    along = spacing * (jnp.arange(count, dtype=center.dtype) - 0.5 * (count - 1))
    right, down = jnp.meshgrid(along, along)
    return jax.vmap(Translation)(center[None, :] + jnp.stack([right.reshape(-1), down.reshape(-1)], axis=1))


def align(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "p q"] | Any,
    warp: type[Warp],
    seeds: Warp,
    *,
    method: LucasKanade = LucasKanade(),
    keep: int = 4,
    weights: Num[Array, "p q"] | Bool[Array, "p q"] | None = None,
    sigma: Any = None,
) -> Estimate:
    """Finds the warp under which the image looks most like the template, starting from many.

    All seeds are aligned on the coarsest scale of `method`, which costs little; those that explain the template best
    there are aligned to the end, and the best of them is the answer.

    Args:
        image: gray levels.
        template: gray levels.
        warp: its class.
        seeds: starts, a stack of warps of any class along a leading axis.
        method: as in `lucas_kanade.align`.
        keep: seeds that are aligned to the end; static.
        weights: of the template's pixels.
        sigma: standard deviation of the image's noise, gray levels.

    Returns:
        Estimate of the warp, as of `lucas_kanade.align`.

    References:
        Search before refinement [K-24, K-26]; Baker and Matthews (2004) for the refinement.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> u, v = jnp.meshgrid(jnp.arange(90.0), jnp.arange(80.0))
        >>> scene = lambda u, v: 100 + 40 * jnp.exp(-((u - 60) ** 2 + (v - 50) ** 2) / 50) + 0.2 * u
        >>> image, template = scene(u, v), scene(u + 40, v + 32)[:40, :40]
        >>> seeds = jl.alignment.multi_start.translations_around(jnp.array([24.0, 24.0]), spacing=8.0, count=5)
        >>> fit = jl.alignment.multi_start.align(image, template, jl.images.Translation, seeds)
        >>> bool(fit.ok), [round(x, 1) for x in fit.value.translation.tolist()]
        (True, [40.0, 32.0])
    """
    starts = jax.vmap(lambda seed: start_of(warp, seed, template))(seeds)
    return _align(take(image, template, weights, sigma, method), starts, min(keep, *starts.batch_shape))


@eqx.filter_jit
def _align(evidence: Evidence, starts: Warp, keep: int) -> Estimate:
    detached = jax.lax.stop_gradient(evidence)
    coarsest, *finer = detached.levels()
    brightness = zero_brightness(coarsest)
    matrices = jax.vmap(lambda start: evidence.frame.normalize(start))(jax.lax.stop_gradient(starts))
    first = jax.vmap(lambda start: search(detached, [coarsest], start, brightness))(matrices)
    cost = jax.vmap(lambda found: _cost(detached, coarsest, found))(first)
    chosen = jnp.argsort(cost)[:keep]
    few = jax.tree.map(lambda leaf: leaf[chosen], first)
    if finer:
        then = jax.vmap(lambda found: search(detached, finer, found.warp, found.brightness))(few)
        few = eqx.tree_at(lambda found: found.num_steps, then, then.num_steps + few.num_steps)
    last = finer[-1] if finer else coarsest
    best = jnp.argmin(jax.vmap(lambda found: _cost(detached, last, found))(few))
    return estimate(evidence, jax.tree.map(lambda leaf: leaf[best], few), jnp.array(True))


def _cost(evidence: Evidence, level: Level, found: Descended) -> Float[Array, ""]:
    """Share of the template's variation that is not explained; infinite where too little of it is on the image."""
    matching = evidence.matching
    now = equations(level, Prepared.of(level, found.warp, matching), found.warp, found.brightness, matching)
    # Where the image shows little contrast, little is left to explain: compare with what is explained.
    explained = (now.gain * level.spread) ** 2
    part = now.mean_cost / jnp.where(explained > 0, explained, 1.0)
    seen = jnp.where(level.look(found.warp, evidence.method.interpolation).known, level.weight, 0.0)
    enough = jnp.sum(seen) >= evidence.method.min_coverage * jnp.sum(level.weight)
    possible = enough & (now.gain > 0.1) & jnp.isfinite(part) & (explained > 0)
    return jnp.where(possible, part, jnp.inf)
