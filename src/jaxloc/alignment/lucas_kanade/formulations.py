"""Four formulations of Lucas-Kanade: forwards or inverse, additive or compositional.

References:
    Baker and Matthews, "Lucas-Kanade 20 years on: a unifying framework", IJCV 56(3), 2004, section 3 [K-27, K-72].
"""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.alignment.lucas_kanade.pyramid_level import Level, derivatives
from jaxloc.images.interpolation import AbstractInterpolation, sample_components
from jaxloc.images.warps import Euclidean, Homography, Warp, tangent_matrix


class Linearized(eqx.Module):
    """The warped image, and the derivatives of one of both images by the warp.

    Attributes:
        values: the image at the template's pixels.
        known: where the image is known.
        slope: derivatives of the differentiated image, "2 n".
        right: derivative of the column by the warp's tangent, "d n".
        down: derivative of the row.
    """

    values: Float[Array, " n"]
    known: Bool[Array, " n"]
    slope: Float[Array, "2 n"]
    right: Float[Array, "d n"]
    down: Float[Array, "d n"]

    @property
    def steepest(self) -> Float[Array, "d n"]:
        """Steepest descent images: derivative of the differentiated image by the tangent."""
        return self.slope[0][None] * self.right + self.slope[1][None] * self.down


class Formulation(eqx.Module):
    """Choice of the differentiated image and of the update of the warp."""

    inverse: eqx.AbstractClassVar[bool]

    @abstractmethod
    def linearize(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Linearized:
        """Both images about a warp of normalized coordinates."""

    @abstractmethod
    def update(self, warp: Warp, step: Float[Array, " d"]) -> Warp:
        """The warp updated by a step."""

    @abstractmethod
    def warp_curvature(self, level: Level, warp: Warp, linear: Linearized) -> Float[Array, "d d n"]:
        """Second derivative of the warp along the differentiated image's slope: ``sum_c slope_c d2W_c / dp dp``."""

    @abstractmethod
    def second(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Float[Array, "3 n"]:
        """Second derivatives (uu, uv, vv) of the differentiated image at the template's pixels."""


class ForwardsAdditive(Formulation):
    """Lucas and Kanade: the image is differentiated at ``W(x; p)``, and parameters are added, ``p + dp``."""

    inverse: ClassVar[bool] = False

    def linearize(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Linearized:
        """The image's derivatives under the warp."""
        sampled = level.sample_with_slope(warp, method)
        right, down = warp.additive_jacobian_components(level.u, level.v)
        return Linearized(sampled.values, sampled.known, sampled.slope, right, down)

    def update(self, warp: Warp, step: Float[Array, " d"]) -> Warp:
        """Sum of parameters."""
        return warp.add(step)

    def warp_curvature(self, level: Level, warp: Warp, linear: Linearized) -> Float[Array, "d d n"]:
        """By differentiating the Jacobian."""

        def jacobian(step: Float[Array, " d"]) -> tuple[Array, Array]:
            return warp.add(step).additive_jacobian_components(level.u, level.v)

        zero = jnp.zeros(warp.dof, level.u.dtype)
        right, down = jax.vmap(lambda e: jax.jvp(jacobian, (zero,), (e,))[1])(jnp.eye(warp.dof, dtype=zero.dtype))
        return linear.slope[0][None, None] * right + linear.slope[1][None, None] * down

    def second(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Float[Array, "3 n"]:
        """Those of the image."""
        return _image_second(level, warp, method)


class ForwardsCompositional(Formulation):
    """The warped image is differentiated, and the update is composed, ``W @ exp(d)``."""

    inverse: ClassVar[bool] = False

    def linearize(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Linearized:
        """Derivatives of the warped image: those of the image, through the warp."""
        sampled = level.sample_with_slope(warp, method)
        slope = through(warp, level, sampled.slope)
        return Linearized(sampled.values, sampled.known, slope, *warp.jacobian_components(level.u, level.v))

    def update(self, warp: Warp, step: Float[Array, " d"]) -> Warp:
        """Composition."""
        return warp.retract(step)

    def warp_curvature(self, level: Level, warp: Warp, linear: Linearized) -> Float[Array, "d d n"]:
        """Of the exponential."""
        return _flow_curvature(type(warp), level, linear)

    def second(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Float[Array, "3 n"]:
        """Those of the image, through the warp's derivative."""
        uu, uv, vv = _image_second(level, warp, method)
        (a, b), (d, e) = _derivative(warp, level)
        along, across = a * uu + d * uv, a * uv + d * vv
        mixed = b * along + e * across
        return jnp.stack([a * along + d * across, mixed, b * b * uu + 2.0 * b * e * uv + e * e * vv])


class InverseAdditive(Formulation):
    """Hager and Belhumeur: the template is differentiated, and parameters are added.

    For shifts, rotations, similarities and affine warps: a homography's Jacobian has no constant factor.

    References:
        Hager and Belhumeur, "Efficient region tracking with parametric models of geometry and illumination", 1998.
    """

    inverse: ClassVar[bool] = True

    def linearize(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Linearized:
        """The template's derivatives; the factor that depends on the warp is applied in the update."""
        if isinstance(warp, Homography):
            raise ValueError(
                "InverseAdditive: the Jacobian of a Homography has no constant factor; use InverseCompositional()."
            )
        return _of_template(level, warp, method)

    def update(self, warp: Warp, step: Float[Array, " d"]) -> Warp:
        """Sum of the parameters and the step mapped by the warp's linear part."""
        linear = warp.matrix().at[:2, 2].set(0.0)
        moved = matmul(linear, tangent_matrix(step))
        if isinstance(warp, Euclidean):
            return warp.add(jnp.concatenate([moved[:2, 2], step[2:]]))
        return type(warp).from_matrix(warp.matrix() + moved)

    def warp_curvature(self, level: Level, warp: Warp, linear: Linearized) -> Float[Array, "d d n"]:
        """Of the exponential."""
        return _flow_curvature(type(warp), level, linear)

    def second(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Float[Array, "3 n"]:
        """Those of the template."""
        return _template_second(level)


class InverseCompositional(Formulation):
    """Baker and Matthews: the template is differentiated once, and the inverse of the step is composed."""

    inverse: ClassVar[bool] = True

    def linearize(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Linearized:
        """The template's derivatives, which do not depend on the warp."""
        return _of_template(level, warp, method)

    def update(self, warp: Warp, step: Float[Array, " d"]) -> Warp:
        """Composition."""
        return warp.retract(step)

    def warp_curvature(self, level: Level, warp: Warp, linear: Linearized) -> Float[Array, "d d n"]:
        """Of the exponential."""
        return _flow_curvature(type(warp), level, linear)

    def second(self, level: Level, warp: Warp, method: AbstractInterpolation) -> Float[Array, "3 n"]:
        """Those of the template."""
        return _template_second(level)


def _of_template(level: Level, warp: Warp, method: AbstractInterpolation) -> Linearized:
    sampled = level.sample(warp, method)
    return Linearized(sampled.values, sampled.known, level.slope, *warp.jacobian_components(level.u, level.v))


def _derivative(warp: Warp, level: Level) -> list[list[Array]]:
    """Derivative of the warped coordinates by the original ones, row by row."""
    right, down = warp.map_components(level.u, level.v)
    (a, b, _), (d, e, _), (g, h, i) = warp.matrix()
    depth = g * level.u + h * level.v + i
    inverse = 1.0 / jnp.where(depth > 1e-6, depth, 1.0)
    return [
        [(a - right * g) * inverse, (b - right * h) * inverse],
        [(d - down * g) * inverse, (e - down * h) * inverse],
    ]


def through(warp: Warp, level: Level, slope: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """Chain rule: derivatives of an image by warped coordinates as derivatives by the original ones."""
    (a, b), (d, e) = _derivative(warp, level)
    return jnp.stack([slope[0] * a + slope[1] * d, slope[0] * b + slope[1] * e])


def _flow_curvature(warp: type[Warp], level: Level, linear: Linearized) -> Float[Array, "d d n"]:
    """Second derivative of ``exp(d) x`` at zero along the slope: ``(dX_j X_i + dX_i X_j) / 2`` of its fields X."""
    one, zero = jnp.ones_like(level.u), jnp.zeros_like(level.u)
    total = 0.0
    for towards, field in (((one, zero), linear.right), ((zero, one), linear.down)):
        right, down = jax.jvp(warp.jacobian_components, (level.u, level.v), towards)[1]
        change = linear.slope[0][None] * right + linear.slope[1][None] * down
        total = total + change[:, None] * field[None]
    return 0.5 * (total + jnp.swapaxes(total, 0, 1))


def second_derivatives(image: Float[Array, "h w"], level: Level) -> Float[Array, "3 h w"]:
    """Second derivatives (uu, uv, vv) of an image at a level's scale, by normalized coordinates."""
    scale = level.frame.radius / level.factor
    along, across = derivatives(image) * scale
    (uu, uv), (_, vv) = derivatives(along) * scale, derivatives(across) * scale
    return jnp.stack([uu, uv, vv])


def _template_second(level: Level) -> Float[Array, "3 n"]:
    second = second_derivatives(level.template_image, level).reshape(3, -1)
    return jnp.where((level.weight > 0)[None] & jnp.isfinite(second), second, 0.0)


def _image_second(level: Level, warp: Warp, method: AbstractInterpolation) -> Float[Array, "3 n"]:
    stacked = jnp.moveaxis(second_derivatives(level.image, level), 0, -1)
    values, _ = sample_components(stacked, *level.pixels(warp), method=method)
    return jnp.where(jnp.isfinite(values), values, 0.0).T
