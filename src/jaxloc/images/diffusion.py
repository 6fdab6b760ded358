"""Nonlinear, edge-preserving diffusion by fast explicit and by additive implicit steps.

``dL/dt = div(g(|grad L_s|) grad L)`` with a conductivity g that decreases with the gradient of the slightly smoothed
image. In flat regions, time t smooths like a Gaussian of variance ``2 t``. It is the scale space of KAZE and A-KAZE.

References:
    Perona and Malik, T-PAMI 1990; Weickert, ter Haar Romeny, Viergever, "Efficient and reliable schemes for nonlinear
    diffusion filtering", IEEE TIP 1998; Alcantarilla, Bartoli, Davison, "KAZE features", ECCV 2012 [T-43].
"""

import math
from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc.images.gradients import scharr, smooth

# Largest stable explicit step of the five-point scheme, for conductivities up to one.
LARGEST_STEP = 0.25


class Conductivity(eqx.Module):
    """Conductivity function of the squared gradient over the squared contrast; one where flat."""

    @abstractmethod
    def of(self, ratio: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Between zero and one."""


class PeronaMalik(Conductivity):
    """``1 / (1 + r)``: favors wide regions over small ones."""

    def of(self, ratio: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Conductivity."""
        return 1.0 / (1.0 + ratio)


class Exponential(Conductivity):
    """``exp(-r)``: favors strong edges."""

    def of(self, ratio: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Conductivity."""
        return jnp.exp(-ratio)


class Weickert(Conductivity):
    """``1 - exp(-3.315 / r^4)``: smooths within regions, hardly across them."""

    def of(self, ratio: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Conductivity; one, smoothly, where there is no gradient."""
        steep = ratio > 0.1
        return jnp.where(steep, -jnp.expm1(-3.315 / jnp.where(steep, ratio, 1.0) ** 4), 1.0)


class Linear(Conductivity):
    """One everywhere: Gaussian smoothing."""

    def of(self, ratio: Float[Array, "h w"]) -> Float[Array, "h w"]:
        """Ones."""
        return jnp.ones_like(ratio)


_PERONA_MALIK = PeronaMalik()


@filter_jit
def contrast(
    image: Float[Array, "h w"], *, percentile: float | Float[Array, ""] = 70.0, sigma: float = 1.0
) -> Float[Array, ""]:
    """Contrast parameter between noise and edges: a percentile of the gradients of the smoothed image.

    Args:
        image: gray levels.
        percentile: of the gradients that are not zero.
        sigma: blur before the derivative, px; static.

    Returns:
        Gray levels a pixel; one for a flat image.

    References:
        Alcantarilla et al. 2012, section 2.1.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(3.0 * jnp.arange(20.0)[None, :], (20, 20))
        >>> round(float(contrast(ramp, percentile=50.0)), 2)
        3.0
    """
    squared = jnp.where(jnp.isfinite(image), image, 0.0)
    gradient = scharr(smooth(squared, sigma))
    squared = gradient.right**2 + gradient.down**2
    some = squared > 0
    length = jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), jnp.nan)
    found = jnp.nanpercentile(lax.stop_gradient(length), percentile)
    return jnp.where(jnp.isfinite(found), found, 1.0)


@filter_jit
def conductance(
    image: Float[Array, "h w"],
    contrast: Float[Array, ""],
    *,
    kind: Conductivity = _PERONA_MALIK,
    sigma: float = 1.0,
) -> Float[Array, "h w"]:
    """Conductivity of every pixel, ``g(|grad L_s|^2 / k^2)``.

    Args:
        image: gray levels.
        contrast: k, gray levels a pixel.
        kind: the function g.
        sigma: blur before the derivative, px; static.

    Example:
        >>> import jax.numpy as jnp
        >>> ramp = jnp.broadcast_to(3.0 * jnp.arange(20.0)[None, :], (20, 20))
        >>> round(float(conductance(ramp, jnp.array(3.0))[10, 10]), 3)
        0.5
    """
    gradient = scharr(smooth(image, sigma))
    return kind.of((gradient.right**2 + gradient.down**2) / contrast**2)


def fed_steps(time: float, *, largest: float = LARGEST_STEP, cycles: int = 1) -> tuple[float, ...]:
    """Time steps of fast explicit diffusion: stable as a cycle, with the time as their exact sum.

    ``n`` steps of a cycle sum to ``(n^2 + n) / 3`` times the largest stable step (a factorized box filter). They are
    ordered to limit rounding errors in between.

    Args:
        time: diffusion time of all cycles.
        largest: largest stable explicit step.
        cycles: equal parts; conductivities are recomputed at each.

    Returns:
        Steps of one cycle, whose sum is ``time / cycles``.

    Raises:
        ValueError: an argument is not positive.

    References:
        Grewenig, Weickert, Bruhn, "From box filtering to fast explicit diffusion", DAGM 2010, eq. 10 [T-49].

    Example:
        >>> steps = fed_steps(5.0)
        >>> len(steps), round(sum(steps), 12), max(steps) > 0.25
        (8, 5.0, True)
    """
    if time <= 0 or largest <= 0 or cycles < 1:
        raise ValueError(f"fed_steps: time {time}, largest step {largest} and cycles {cycles} must be positive.")
    part = time / cycles
    count = math.ceil(math.sqrt(3.0 * part / largest + 0.25) - 0.5 - 1e-12)
    scale = 3.0 * part / (largest * (count * count + count))
    steps = [0.5 * scale * largest / math.cos(math.pi * (2 * i + 1) / (4 * count + 2)) ** 2 for i in range(count)]
    # Every k-th modulo a prime, which approximates Leja ordering.
    prime = next(p for p in range(count + 1, 2 * count + 3) if all(p % q for q in range(2, int(p**0.5) + 1)))
    stride = max(count // 2, 1)
    order = [i for i in ((k * stride) % prime - 1 for k in range(1, prime + 1)) if 0 <= i < count]
    steps = [steps[i] for i in order]
    # Scaled so that the sum is exactly the time.
    steps[-1] += part - math.fsum(steps)
    return tuple(steps)


def _flow(image: Float[Array, "h w"], conductance: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """``div(g grad L)`` with no flow through the border."""
    right = 0.5 * (conductance[:, 1:] + conductance[:, :-1]) * (image[:, 1:] - image[:, :-1])
    down = 0.5 * (conductance[1:] + conductance[:-1]) * (image[1:] - image[:-1])
    across = jnp.pad(right, ((0, 0), (0, 1))) - jnp.pad(right, ((0, 0), (1, 0)))
    return across + jnp.pad(down, ((0, 1), (0, 0))) - jnp.pad(down, ((1, 0), (0, 0)))


@filter_jit
def diffuse_explicit(
    image: Float[Array, "h w"], conductance: Float[Array, "h w"], steps: Float[Array, " n"]
) -> Float[Array, "h w"]:
    """Explicit steps ``L <- L + tau div(g grad L)`` with fixed conductivities.

    Args:
        image: gray levels.
        conductance: of each pixel, at most one.
        steps: sizes; at most `LARGEST_STEP`, or those of `fed_steps`.

    Example:
        >>> import jax.numpy as jnp
        >>> spot = jnp.zeros((9, 9)).at[4, 4].set(1.0)
        >>> diffused = diffuse_explicit(spot, jnp.ones((9, 9)), jnp.asarray(fed_steps(1.0)))
        >>> round(float(diffused.sum()), 4), bool(diffused[4, 4] < 0.2)
        (1.0, True)
    """
    return lax.scan(lambda now, step: (now + step * _flow(now, conductance), None), image, steps)[0]


@filter_jit
def diffuse_implicit(
    image: Float[Array, "h w"], conductance: Float[Array, "h w"], step: Float[Array, ""]
) -> Float[Array, "h w"]:
    """One additive operator splitting step: ``L <- (1/2) sum over both axes of (I - 2 tau A)^-1 L``.

    Each axis is a tridiagonal system, solved for all lines at once. Steps of any size are stable.

    Args:
        image: gray levels.
        conductance: of each pixel, not negative.
        step: diffusion time.

    References:
        Weickert et al. 1998, eq. 31 [T-48].

    Example:
        >>> import jax.numpy as jnp
        >>> spot = jnp.zeros((9, 9)).at[4, 4].set(1.0)
        >>> round(float(diffuse_implicit(spot, jnp.ones((9, 9)), jnp.array(50.0)).sum()), 4)
        1.0
    """
    down = _solve_lines(image, conductance, step)
    right = _solve_lines(image.T, conductance.T, step).T
    return 0.5 * (down + right)


def _solve_lines(image: Float[Array, "h w"], conductance: Float[Array, "h w"], step: Array) -> Float[Array, "h w"]:
    """``(I - 2 tau A)^-1`` along columns, by Thomas's algorithm; diagonally dominant, so without pivoting."""
    between = step * (conductance[1:] + conductance[:-1])
    above, below = jnp.pad(between, ((1, 0), (0, 0))), jnp.pad(between, ((0, 1), (0, 0)))

    def eliminate(state: tuple[Array, Array], row: tuple[Array, Array, Array]) -> tuple[tuple, tuple]:
        ratio, value = state
        up, low, right = row
        pivot = 1.0 + up + low - up * ratio
        new = low / pivot, (right + up * value) / pivot
        return new, new

    zero = jnp.zeros_like(image[0])
    _, (ratios, values) = lax.scan(eliminate, (zero, zero), (above, below, image))

    def substitute(later: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        ratio, value = row
        now = value + ratio * later
        return now, now

    return lax.scan(substitute, zero, (ratios, values), reverse=True)[1]


@filter_jit
def diffuse(
    image: Float[Array, "h w"], *, sigma: float, kind: Conductivity = _PERONA_MALIK, cycles: int = 4
) -> Float[Array, "h w"]:
    """Edge-preserving smoothing by cycles of fast explicit diffusion, in flat regions like a Gaussian.

    Args:
        image: gray levels.
        sigma: standard deviation of that Gaussian, px; static.
        kind: conductivity.
        cycles: number of evaluations of the conductivity; static.

    Returns:
        The smoothed image. Differentiable through the steps, not through the contrast.

    References:
        Alcantarilla, Nuevo, Bartoli, "Fast explicit diffusion for accelerated features in nonlinear scale spaces",
        BMVC 2013 [T-49, T-50].

    Example:
        >>> import jax, jax.numpy as jnp
        >>> edge = jnp.where(jnp.arange(40) < 20, 50.0, 150.0)[None, :] + jax.random.normal(jax.random.key(0), (40, 40))
        >>> smoothed = diffuse(edge, sigma=3.0)
        >>> bool(smoothed[:, 5:15].std() < 0.3), bool(smoothed[20, 21] - smoothed[20, 18] > 90)
        (True, True)
    """
    image = jnp.where(jnp.isfinite(image), image, 0.0)
    edge = contrast(image)
    steps = jnp.asarray(fed_steps(0.5 * sigma**2, cycles=cycles), image.dtype)

    def cycle(now: Array, _: None) -> tuple[Array, None]:
        return diffuse_explicit(now, conductance(now, edge, kind=kind), steps), None

    return lax.scan(cycle, image, None, length=cycles)[0]
