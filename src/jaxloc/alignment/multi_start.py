"""Multi-start alignment: all initial warps at the coarsest scale, the best few at all scales."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc.alignment.lucas_kanade.align import finish, finite_warp, initial_warp, prepare, search
from jaxloc.alignment.lucas_kanade.covariance import AlignmentData
from jaxloc.alignment.lucas_kanade.iteration import SearchResult
from jaxloc.alignment.lucas_kanade.normal_equations import Prepared, equations, zero_brightness
from jaxloc.alignment.lucas_kanade.options import LucasKanade
from jaxloc.alignment.lucas_kanade.pyramid_level import Level
from jaxloc.images.warps import Translation, Warp
from jaxloc.solvers import Estimate


def translations_around(center: Float[Array, "2"], *, spacing: float, count: int) -> Translation:
    """Square grid of ``count`` by ``count`` translations, stacked along a leading axis.

    Args:
        center: translation at the center (right, down), px.
        spacing: between neighbors, px.
        count: translations along each side.

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
    initial: Warp,
    *,
    method: LucasKanade = LucasKanade(),
    keep: int = 4,
    weights: Num[Array, "p q"] | Bool[Array, "p q"] | None = None,
    sigma: Any = None,
) -> Estimate:
    """Finds the warp that aligns an image with a template, from many initial warps.

    All of them are refined at the coarsest scale of `method`, which costs little; those that explain the template best
    are refined at all scales, and the best result is returned.

    Args:
        image: gray levels.
        template: gray levels.
        warp: class of the warp.
        initial: a stack of warps of any class along a leading axis.
        method: as in `lucas_kanade.align`.
        keep: number of warps that are refined at all scales; static.
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
        >>> grid = jl.alignment.multi_start.translations_around(jnp.array([24.0, 24.0]), spacing=8.0, count=5)
        >>> fit = jl.alignment.multi_start.align(image, template, jl.images.Translation, grid)
        >>> bool(fit.ok), [round(x, 1) for x in fit.value.translation.tolist()]
        (True, [40.0, 32.0])
    """
    warps = jax.vmap(lambda one: initial_warp(warp, one, template))(initial)
    return _align(prepare(image, template, weights, sigma, method), warps, min(keep, *warps.batch_shape))


@filter_jit
def _align(data: AlignmentData, initial: Warp, keep: int) -> Estimate:
    detached = jax.lax.stop_gradient(data)
    coarsest, *finer = detached.levels()
    brightness = zero_brightness(coarsest)
    initial, finite = jax.vmap(finite_warp)(initial)
    matrices = jax.vmap(lambda one: data.frame.normalize(one))(initial)
    first = jax.vmap(lambda one: search(detached, [coarsest], one, brightness))(matrices)
    cost = jnp.where(finite, jax.vmap(lambda found: _cost(detached, coarsest, found))(first), jnp.inf)
    chosen = jnp.argsort(cost)[:keep]
    few = jax.tree.map(lambda leaf: leaf[chosen], first)
    if finer:
        then = jax.vmap(lambda found: search(detached, finer, found.warp, found.brightness))(few)
        few = eqx.tree_at(lambda found: found.num_steps, then, then.num_steps + few.num_steps)
    last = finer[-1] if finer else coarsest
    best = jnp.argmin(jax.vmap(lambda found: _cost(detached, last, found))(few))
    return finish(data, jax.tree.map(lambda leaf: leaf[best], few), jnp.any(finite))


def _cost(data: AlignmentData, level: Level, found: SearchResult) -> Float[Array, ""]:
    """Fraction of the template's variance that is not explained; infinite where too little is within the image."""
    matching = data.matching
    now = equations(level, Prepared.of(level, found.warp, matching), found.warp, found.brightness, matching)
    # Relative to the explained variance, since residuals are small where the image has little contrast.
    explained = (now.gain * level.contrast) ** 2
    part = now.mean_cost / jnp.where(explained > 0, explained, 1.0)
    visible = jnp.where(level.sample(found.warp, data.method.interpolation).known, level.weight, 0.0)
    enough = jnp.sum(visible) >= data.method.min_coverage * jnp.sum(level.weight)
    possible = enough & (now.gain > 0.1) & jnp.isfinite(part) & (explained > 0)
    return jnp.where(possible, part, jnp.inf)
