"""Lucas-Kanade alignment of a template with an image under a parametric warp."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.alignment.lucas_kanade.covariance import AlignmentData, AlignmentEquations, conclude
from jaxloc.alignment.lucas_kanade.iteration import Limits, SearchResult, descend
from jaxloc.alignment.lucas_kanade.normal_equations import zero_brightness
from jaxloc.alignment.lucas_kanade.options import LucasKanade
from jaxloc.alignment.lucas_kanade.pyramid_level import Frame, Level
from jaxloc.images.normalization import as_gray
from jaxloc.images.warps import Warp
from jaxloc.solvers import Estimate
from jaxloc.solvers.implicit_gradient import attach_gradient


def align(
    image: Num[Array, "h w"] | Any,
    template: Num[Array, "p q"] | Any,
    warp: type[Warp],
    initial: Warp | None = None,
    *,
    method: LucasKanade = LucasKanade(),
    weights: Num[Array, "p q"] | Bool[Array, "p q"] | None = None,
    sigma: Any = None,
) -> Estimate:
    """Finds the warp W that aligns an image with a template: ``image(W(x)) ~ gain template(x) + bias``.

    Minimizes ``sum_x w(x) rho((image(W(x)) - gain template(x) - bias) / sigma)`` over the warp, gain and bias being
    eliminated in closed form, from coarse to fine. The value has the derivatives of the solution with respect to image,
    template and weights (implicit function theorem), in forward and reverse mode.

    Args:
        image: gray levels; nan where unknown.
        template: gray levels; nan where unknown.
        warp: class of the warp: `Translation`, `Euclidean`, `Similarity`, `Affine` or `Homography`.
        initial: a warp of any class from template pixels to image pixels; the identity by default.
        method: formulation, descent, brightness, scales, kernel and limits.
        weights: of the template's pixels, or a mask.
        sigma: standard deviation of the image's noise, gray levels; estimated from the residual if not given.

    Returns:
        Estimate of the warp, with the covariance of its tangent (``W @ exp(d)``, pixels). It accounts for the noise of
        both images after interpolation, but not for a warp that is too simple for the scene.
        ``ok`` is False when the texture leaves directions undetermined (a flat template, a single edge), when the
        search did not converge, or when the result contradicts the model: too little of the template in the image, too
        little correlation, a template folded over. The value is finite in any case.

    Raises:
        ValueError: an image has not two axes, weights have another shape than the template, or the formulation does
            not support the warp.

    References:
        Lucas and Kanade, 1981; Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 56(3), 2004 [K-12, K-20, K-21,
        K-27, K-72].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> u, v = jnp.meshgrid(jnp.arange(60.0), jnp.arange(50.0))
        >>> scene = lambda u, v: 100 + 40 * jnp.sin(0.3 * u) * jnp.cos(0.25 * v)
        >>> image, template = 0.7 * scene(u, v) + 20, scene(u + 12.3, v + 9.6)[:32, :32]
        >>> initial = jl.images.Translation(jnp.array([11.0, 11.0]))
        >>> fit = jl.alignment.lucas_kanade.align(image, template, jl.images.Translation, initial)
        >>> bool(fit.ok), [round(x, 1) for x in fit.value.translation.tolist()]
        (True, [12.3, 9.6])
    """
    # Numbers become arrays here, so that new values do not compile anew.
    arrays = (None if given is None else jnp.asarray(given) for given in (image, template, weights, sigma))
    return _align(*arrays, warp, initial, method)


def prepare(image: Any, template: Any, weights: Any, sigma: Any, method: LucasKanade) -> AlignmentData:
    """The images as arrays of one dtype, with their weights.

    Raises:
        ValueError: shapes that do not fit.
    """
    template = as_gray(template)
    if weights is not None and weights.shape != template.shape:
        raise ValueError(f"align: weights of shape {weights.shape} do not fit a template of shape {template.shape}.")
    given = jnp.ones_like(template) if weights is None else jnp.asarray(weights).astype(template.dtype)
    sigma = None if sigma is None else jnp.asarray(sigma, template.dtype)
    frame = Frame.of(template.shape, method.normalized)
    return AlignmentData(as_gray(image, template.dtype), template, given, sigma, frame, method)


def initial_warp(warp: type[Warp], initial: Warp | None, template: Any) -> Warp:
    """The initial value as a warp of the given class, in the template's dtype."""
    dtype = as_gray(template).dtype
    first = warp.identity(dtype) if initial is None else warp.of(initial)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), first)


@filter_jit
def _align(
    image: Any, template: Any, weights: Any, sigma: Any, warp: type[Warp], initial: Any, method: Any
) -> Estimate:
    data = prepare(image, template, weights, sigma, method)
    first, finite = finite_warp(initial_warp(warp, initial, template))
    detached = jax.lax.stop_gradient(data)
    levels = detached.levels()
    found = search(detached, levels, data.frame.normalize(first), zero_brightness(levels[0]))
    return finish(data, found, finite)


def finite_warp(warp: Warp) -> tuple[Warp, Bool[Array, ""]]:
    """The warp without gradient, the identity if it is not finite, and whether it is finite."""
    finite = jnp.all(jnp.isfinite(warp.matrix()))
    other = type(warp).identity(warp.matrix().dtype)
    safe = tree.where(finite, warp, other)
    return jax.lax.stop_gradient(safe), finite


def search(data: AlignmentData, levels: list[Level], warp: Warp, brightness: Float[Array, " k"]) -> SearchResult:
    """Iterations from coarse to fine over given levels."""
    method, count, moved = data.method, jnp.zeros((), jnp.int32), jnp.zeros((), warp.matrix().dtype)
    for number, level in enumerate(levels):
        last = number == len(levels) - 1
        limits = Limits(method.max_steps, method.tolerance * (1.0 if last else 10.0 * level.factor))
        found = descend(level, warp, brightness, data.matching, method.descent, limits=limits)
        warp, brightness, moved = found.warp, found.brightness, found.moved
        count = count + found.num_steps
    return SearchResult(warp, brightness, moved, count)


def finish(data: AlignmentData, found: SearchResult, finite: Bool[Array, ""]) -> Estimate:
    """Estimate from the result of a search, with covariance, status and the derivatives of the solution."""
    conclusion = conclude(jax.lax.stop_gradient(data), found.warp, found.brightness, found.moved, finite)
    attached = attach_gradient(found.warp, AlignmentEquations(data, found.brightness), conclusion.ok)
    value = data.frame.denormalize(attached)
    return Estimate(
        value,
        conclusion.covariance,
        conclusion.cost,
        conclusion.ok,
        found.num_steps,
        conclusion.status,
        conclusion.information,
    )
