"""Image alignment by the enhanced correlation coefficient (ECC)."""

from dataclasses import replace
from typing import Any

from jaxtyping import Array, Bool, Num

from jaxloc.alignment.lucas_kanade import Correlation, ForwardsCompositional, LucasKanade
from jaxloc.alignment.lucas_kanade import align as lucas_kanade
from jaxloc.images.warps import Warp
from jaxloc.solvers import Estimate


def align(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "p q"] | Any,
    warp: type[Warp],
    initial: Warp | None = None,
    *,
    method: LucasKanade = LucasKanade(formulation=ForwardsCompositional()),
    weights: Num[Array, "p q"] | Bool[Array, "p q"] | None = None,
    sigma: Any = None,
) -> Estimate:
    """Finds the warp of the greatest correlation of image and template (ECC).

    Maximizes ``rho(W) = <i(W), t> / |i(W)| |t|`` of the zero-mean images. Unlike OpenCV's `findTransformECC` it does
    not throw, has a covariance, and can be differentiated and batched.

    Args:
        image: gray levels, nan where unknown.
        template: gray levels, nan where unknown.
        warp: class of the warp.
        initial: a warp from template pixels to image pixels; the identity by default.
        method: as in `lucas_kanade.align`; its brightness is replaced by `Correlation`.
        weights: of the template's pixels, or a mask.
        sigma: standard deviation of the image's noise, gray levels.

    Returns:
        Estimate of the warp, as of `lucas_kanade.align`.

    References:
        Evangelidis and Psarakis, "Parametric image alignment using enhanced correlation coefficient maximization",
        T-PAMI 30(10), 2008 [K-12, K-22].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> u, v = jnp.meshgrid(jnp.arange(60.0), jnp.arange(50.0))
        >>> scene = lambda u, v: 100 + 40 * jnp.sin(0.3 * u) * jnp.cos(0.25 * v)
        >>> image, template = 0.5 * scene(u, v) + 30, scene(u + 12.3, v + 9.6)[:32, :32]
        >>> initial = jl.images.Translation(jnp.array([11.0, 11.0]))
        >>> fit = jl.alignment.ecc.align(image, template, jl.images.Translation, initial)
        >>> bool(fit.ok), [round(x, 1) for x in fit.value.translation.tolist()]
        (True, [12.3, 9.6])
    """
    correlating = replace(method, brightness=Correlation())
    return lucas_kanade(image, template, warp, initial, method=correlating, weights=weights, sigma=sigma)
