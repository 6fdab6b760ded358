"""Lens distortion models (Brown-Conrady, Kannala-Brandt) and their inverses.

Points are normalized image coordinates (x/z, y/z), given as two component arrays of any equal shape.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit

_FAR = 100.0  # polynomial lenses are clipped at 89.4 degrees off the axis, where their powers would overflow float32
_WIDEST = 1.5698  # largest angle off the axis of a fisheye lens, rad: its tangent is 1000
_NEWTON_STEPS = 12
_RAY_SAMPLES = 8


class Lens(eqx.Module):
    """Interface of lens distortions of normalized image coordinates; the optical axis is a fixed point."""

    @abstractmethod
    def distort(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Distorted points of ideal ones."""

    @abstractmethod
    def undistort(
        self, xd: Float[Array, "*n"], yd: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Ideal points of distorted ones; first derivatives are exact, in forward and reverse mode."""

    @abstractmethod
    def in_domain(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether the lens is one-to-one between the axis and these ideal points."""

    @checked
    def can_undistort(self, xd: Float[Array, "*n"], yd: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether `undistort` has converged: false outside the image of the one-to-one region of the lens."""
        x, y = self.undistort(xd, yd)
        return _converged(*_residual(self, x, y, xd, yd), xd, yd) & self.in_domain(x, y)


class BrownConrady(Lens):
    """Brown-Conrady model: radial (polynomial or rational) and decentering distortion, OpenCV's coefficients.

    ``x_d = x g + 2 p1 x y + p2 (r2 + 2 x^2)``, ``y_d = y g + p1 (r2 + 2 y^2) + 2 p2 x y`` with ``r2 = x^2 + y^2`` and
    ``g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3)``.

    Args:
        coefficients: (k1, k2, p1, p2), (k1, k2, p1, p2, k3) or (k1, k2, p1, p2, k3, k4, k5, k6).

    Raises:
        ValueError: if there are not 4, 5 or 8 coefficients.

    References:
        D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering 1966 [T-16], [K-81].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> lens = jl.sensors.BrownConrady((-0.3, 0.1, 0.0, 0.0, 0.0))
        >>> x, y = lens.undistort(*lens.distort(jnp.array([0.4]), jnp.array([-0.2])))
        >>> x.round(3).tolist(), y.round(3).tolist()
        ([0.4000000059604645], [-0.20000000298023224])
    """

    coefficients: Float[Array, " c"]

    def __init__(self, coefficients: Any):
        self.coefficients = _floats(coefficients)
        if self.coefficients.shape not in {(4,), (5,), (8,)}:
            raise ValueError(
                f"BrownConrady got coefficients of shape {self.coefficients.shape}; give 4, 5 or 8 in the order "
                "k1, k2, p1, p2, k3, k4, k5, k6."
            )

    @checked
    def distort(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Distorted points of ideal ones (clipped at 89.4 degrees off the axis)."""
        k = [self.coefficients[i] for i in range(self.coefficients.size)]
        k1, k2, p1, p2 = k[:4]
        x, y = jnp.clip(x, -_FAR, _FAR), jnp.clip(y, -_FAR, _FAR)
        r2 = x * x + y * y
        gain = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k[4] if len(k) > 4 else k2))
        if len(k) == 8:
            # A rational model has poles far outside its image: bounded there.
            gain = gain / jnp.maximum(1.0 + r2 * (k[5] + r2 * (k[6] + r2 * k[7])), 1e-3)
        cross = 2.0 * x * y
        return x * gain + p1 * cross + p2 * (r2 + 2.0 * x * x), y * gain + p1 * (r2 + 2.0 * y * y) + p2 * cross

    @filter_jit
    @checked
    def undistort(
        self, xd: Float[Array, "*n"], yd: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Ideal points of distorted ones: a fixed number of damped Newton steps, then one implicit step.

        Outside the invertible region (`can_undistort`) the last iterate, with zero gradient.
        """
        frozen, target_x, target_y = lax.stop_gradient((self, xd, yd))

        def improve(_, state):
            x, y, damping = state
            step_x, step_y = _newton_step(frozen, x, y, target_x, target_y)
            new_x, new_y = x + damping * step_x, y + damping * step_y
            before, after = (_norm(*_residual(frozen, *p, target_x, target_y)) for p in ((x, y), (new_x, new_y)))
            better = (after < before) & (_determinant(frozen, new_x, new_y) > 0)
            damping = jnp.where(better, jnp.minimum(1.0, 4.0 * damping), 0.25 * damping)
            return jnp.where(better, new_x, x), jnp.where(better, new_y, y), damping

        initial = jnp.clip(target_x, -_FAR, _FAR), jnp.clip(target_y, -_FAR, _FAR)
        fold = _determinant(frozen, *initial) <= 0
        initial = tuple(jnp.where(fold, 0.0, component) for component in initial)
        x, y, _ = lax.fori_loop(0, _NEWTON_STEPS, improve, (*initial, jnp.ones_like(xd)))
        return _implicit_step(self, x, y, xd, yd)

    @checked
    def in_domain(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether the lens is one-to-one between the axis and these ideal points (it may fold beyond its image)."""
        ok = (jnp.abs(x) < _FAR) & (jnp.abs(y) < _FAR)
        for i in range(1, _RAY_SAMPLES + 1):
            fraction = i / _RAY_SAMPLES
            ok &= _determinant(self, fraction * x, fraction * y) > 0
        return ok


class KannalaBrandt(Lens):
    """Kannala-Brandt fisheye model: the image radius is a polynomial of the angle off the axis (OpenCV's ``fisheye``).

    ``r_d = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)`` with ``t = atan(r)``; directions in the image are unchanged.

    Args:
        coefficients: (k1, k2, k3, k4).

    Raises:
        ValueError: if there are not 4 coefficients.

    References:
        J. Kannala and S. Brandt, "A generic camera model and calibration method for conventional, wide-angle, and
        fish-eye lenses", PAMI 2006, eq. 6 [K-81].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> lens = jl.sensors.KannalaBrandt((0.02, -0.01, 0.0, 0.0))
        >>> x, _ = lens.undistort(*lens.distort(jnp.array([0.0, 5.0]), jnp.array([0.0, 1.0])))
        >>> bool(jnp.allclose(x, jnp.array([0.0, 5.0]), atol=1e-4))
        True
    """

    coefficients: Float[Array, "4"]

    def __init__(self, coefficients: Any):
        self.coefficients = _floats(coefficients)
        if self.coefficients.shape != (4,):
            raise ValueError(f"KannalaBrandt got coefficients of shape {self.coefficients.shape}; give k1, k2, k3, k4.")

    @checked
    def distort(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Distorted points of ideal ones."""
        r2 = x * x + y * y
        near, r = _safe_root(r2)
        on_axis = 1.0 + r2 * (self.coefficients[0] - 1.0 / 3.0)
        gain = jnp.where(near, on_axis, self._radius(jnp.arctan(r)) / r)
        return x * gain, y * gain

    @filter_jit
    @checked
    def undistort(
        self, xd: Float[Array, "*n"], yd: Float[Array, "*n"]
    ) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
        """Ideal points of distorted ones: bracketed Newton steps on the angle, then one implicit step."""
        frozen, target_x, target_y = lax.stop_gradient((self, xd, yd))
        near, radius = _safe_root(target_x * target_x + target_y * target_y)

        def improve(_, state):
            angle, low, high = state
            value, slope = jax.jvp(frozen._radius, (angle,), (jnp.ones_like(angle),))
            low, high = jnp.where(value < radius, angle, low), jnp.where(value < radius, high, angle)
            newton = angle + (radius - value) / jnp.where(slope > 1e-3, slope, 1e-3)
            inside = (newton >= low) & (newton <= high)
            return jnp.where(inside, newton, 0.5 * (low + high)), low, high

        initial = jnp.minimum(radius, _WIDEST), jnp.zeros_like(radius), jnp.full_like(radius, _WIDEST)
        angle, _, _ = lax.fori_loop(0, _NEWTON_STEPS, improve, initial)
        gain = jnp.where(near, 1.0, jnp.tan(angle) / radius)
        return _implicit_step(self, target_x * gain, target_y * gain, xd, yd)

    @checked
    def in_domain(self, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Bool[Array, "*n"]:
        """Whether the image radius increases between the axis and these ideal points."""
        angle = jnp.arctan(_safe_root(x * x + y * y)[1])
        ok = angle <= _WIDEST
        for i in range(1, _RAY_SAMPLES + 1):
            _, slope = jax.jvp(self._radius, (angle * (i / _RAY_SAMPLES),), (jnp.ones_like(angle),))
            ok &= slope > 0
        return ok

    def _radius(self, angle: Float[Array, "*n"]) -> Float[Array, "*n"]:
        k1, k2, k3, k4 = (self.coefficients[i] for i in range(4))
        t = angle * angle
        return angle * (1.0 + t * (k1 + t * (k2 + t * (k3 + t * k4))))


def _floats(values: Any) -> Float[Array, " c"]:
    return jnp.asarray(values, jnp.result_type(float) if not hasattr(values, "dtype") else values.dtype)


def _safe_root(square: Float[Array, "*n"]) -> tuple[Bool[Array, "*n"], Float[Array, "*n"]]:
    """Mask of squares so small that a series of two terms is exact, and the root elsewhere (one there)."""
    near = square < float(jnp.finfo(square.dtype).eps) ** 0.5
    return near, jnp.sqrt(jnp.where(near, 1.0, square))


def _norm(x: Array, y: Array) -> Array:
    return x * x + y * y


def _residual(lens: Lens, x: Array, y: Array, xd: Array, yd: Array) -> tuple[Array, Array]:
    value_x, value_y = lens.distort(x, y)
    return xd - value_x, yd - value_y


def _jacobian(lens: Lens, x: Array, y: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """The two columns of the 2x2 Jacobian of the lens at each point."""
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    along_x = jax.jvp(lens.distort, (x, y), (one, zero))[1]
    along_y = jax.jvp(lens.distort, (x, y), (zero, one))[1]
    return along_x, along_y


def _determinant(lens: Lens, x: Array, y: Array) -> Array:
    (a, c), (b, d) = _jacobian(lens, x, y)
    return a * d - b * c


def _newton_step(lens: Lens, x: Array, y: Array, xd: Array, yd: Array) -> tuple[Array, Array]:
    ex, ey = _residual(lens, x, y, xd, yd)
    (a, c), (b, d) = _jacobian(lens, x, y)
    determinant = a * d - b * c
    inverse = 1.0 / jnp.where(jnp.abs(determinant) > 1e-6, determinant, 1e-6)
    return inverse * (d * ex - b * ey), inverse * (a * ey - c * ex)


def _converged(ex: Array, ey: Array, xd: Array, yd: Array) -> Array:
    eps = float(jnp.finfo(ex.dtype).eps)
    return _norm(ex, ey) < (100.0 * eps) ** 2 * (1.0 + _norm(xd, yd))


def _implicit_step(lens: Lens, x: Array, y: Array, xd: Array, yd: Array) -> tuple[Array, Array]:
    """A Newton step with its matrix held fixed: no change at the root, and the derivative of the implicit function."""
    frozen, x, y = lax.stop_gradient((lens, x, y))
    ex, ey = _residual(lens, x, y, xd, yd)
    (a, c), (b, d) = _jacobian(frozen, x, y)
    determinant = a * d - b * c
    # Wider than `_converged`: this step is one more iteration.
    close = (_norm(ex, ey) < 1e-6 * (1.0 + _norm(xd, yd))) & (determinant > 0)
    inverse = 1.0 / jnp.where(close, determinant, 1.0)
    step_x, step_y = inverse * (d * ex - b * ey), inverse * (a * ey - c * ex)
    return x + jnp.where(close, step_x, 0.0), y + jnp.where(close, step_y, 0.0)
