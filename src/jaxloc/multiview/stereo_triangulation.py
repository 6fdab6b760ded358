"""Triangulation of stereo measurements with covariance: linear, unscented or sampled."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian, gate, propagate_sampled, propagate_unscented
from jaxloc.beliefs.square_root import cholesky
from jaxloc.sensors import StereoRig


class TriangulationMethod(eqx.Module):
    """Propagation of pixel noise to the covariance of a point."""

    @abstractmethod
    def triangulate(self, rig: StereoRig, measured: Gaussian, key: Key[Array, ""] | None) -> Gaussian:
        """Density of the point in the left camera's frame for the density of (u_left, u_right, v)."""


class Linear(TriangulationMethod):
    """First-order propagation ``J R J^T``; accurate for sigma_d / d below about 0.1."""

    @checked
    def triangulate(self, rig: StereoRig, measured: Gaussian, key: Key[Array, ""] | None) -> Gaussian:
        """Point and ``J R J^T``."""
        point = rig.triangulate(measured.mean[None])[0]
        jacobian = stereo_jacobian(rig, measured.mean)
        return Gaussian(point, matmul(matmul(jacobian, measured.covariance), jacobian.T))


class Unscented(TriangulationMethod):
    """Seven sigma points; the default weights are those of `propagate_unscented`."""

    alpha: float = eqx.field(static=True, default=1.0)
    beta: float = eqx.field(static=True, default=0.0)
    kappa: float | None = eqx.field(static=True, default=None)

    @checked
    def triangulate(self, rig: StereoRig, measured: Gaussian, key: Key[Array, ""] | None) -> Gaussian:
        """Moments of the sigma points."""
        options = {"alpha": self.alpha, "beta": self.beta, "kappa": self.kappa}
        return propagate_unscented(_PointOf(rig), measured, **options)


class Sampled(TriangulationMethod):
    """Moments of random samples; `triangulate` then needs a key."""

    num_samples: int = eqx.field(static=True, default=256)

    @checked
    def triangulate(self, rig: StereoRig, measured: Gaussian, key: Key[Array, ""] | None) -> Gaussian:
        """Moments of the samples."""
        if key is None:
            raise ValueError("triangulation by Sampled() draws random numbers: give key=jax.random.key(...).")
        return propagate_sampled(_PointOf(rig), measured, key=key, num_samples=self.num_samples)


_LINEAR = Linear()


@filter_jit
@checked
def triangulate(
    rig: StereoRig,
    measurement: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    *,
    method: TriangulationMethod = _LINEAR,
    key: Key[Array, ""] | None = None,
) -> Gaussian:
    """Gaussian density of the point of a stereo measurement.

    The range is inversely proportional to the disparity: its error grows as ``sigma_z = sqrt(2) sigma z^2 / (f B)``,
    and its density is skewed far away, where `Unscented` has the right mean and size and `Linear` does not.

    Args:
        rig: the stereo rig.
        measurement: (u_left, u_right, v), px. Without disparity (`rig.has_depth`) the result is finite but meaningless.
        covariance: "3 3" of the measurement, px^2.
        method: `Linear()`, `Unscented()` or `Sampled()`.
        key: random key, for `Sampled` only.

    Returns:
        Density of the point (x, y, z), left camera frame, m.

    Raises:
        ValueError: if the method needs a key and there is none.

    References:
        Thesis section 4.3, Fig. 4.6-4.7 [T-72], [T-73]; section 1.3 [T-7].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(718.856, 718.856, 607.2, 185.2), 387.57 / 718.856)
        >>> measurement = rig.project(jnp.array([[1.0, 0.5, 20.0]]))[0]
        >>> point = jl.multiview.stereo_triangulation.triangulate(rig, measurement, 0.25 * jnp.eye(3))
        >>> round(float(jnp.sqrt(point.covariance[2, 2])), 2)
        0.73
    """
    return method.triangulate(rig, Gaussian(measurement, covariance), key)


@checked
def stereo_jacobian(rig: StereoRig, measurement: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Derivative of the point (x, y, z) by (u_left, u_right, v).

    With ``d = u_left - u_right`` the rows are ``[z / fx - x / d, x / d, -z skew / (fx fy)]``,
    ``[-y / d, y / d, z / fy]`` and ``[-z / d, z / d, 0]``.

    Args:
        rig: the stereo rig.
        measurement: (u_left, u_right, v), px.

    Returns:
        "3 3", m/px.

    References:
        Thesis section 4.3, for fx = fy and no skew [T-72].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
        >>> from jaxloc.multiview.stereo_triangulation import stereo_jacobian
        >>> stereo_jacobian(rig, jnp.array([600.0, 565.0, 180.0]))[2].round(2).tolist()
        [-0.28999999165534973, 0.28999999165534973, 0.0]
    """
    camera = rig.camera
    x, y, z = rig.triangulate(measurement[None])[0]
    disparity = camera.fx * rig.baseline / z
    zero = jnp.zeros_like(z)
    rows = [
        [z / camera.fx - x / disparity, x / disparity, -z * camera.skew / (camera.fx * camera.fy)],
        [-y / disparity, y / disparity, z / camera.fy],
        [-z / disparity, z / disparity, zero],
    ]
    return jnp.stack([jnp.stack(row) for row in rows])


@filter_jit
@checked
def coverage(
    rig: StereoRig,
    point: Float[Array, "3"],
    covariance: Float[Array, "3 3"],
    *,
    key: Key[Array, ""],
    method: TriangulationMethod = _LINEAR,
    probability: float = 0.95,
    num_trials: int = 1000,
) -> Float[Array, ""]:
    """Monte Carlo coverage: how often the ellipsoid of `triangulate` contains the true point.

    Args:
        rig: the stereo rig.
        point: true point, left camera frame, m.
        covariance: "3 3" of the measurements, px^2.
        key: random key.
        method: as for `triangulate`.
        probability: of the ellipsoid.
        num_trials: number of simulated measurements.

    Returns:
        Fraction of trials whose squared Mahalanobis distance lies inside the chi-square gate.

    References:
        Thesis Fig. 4.7 [T-73].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> rig = jl.sensors.StereoRig(jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0), baseline=0.5)
        >>> point, noise = jnp.array([1.0, 0.5, 8.0]), 0.25 * jnp.eye(3)
        >>> held = jl.multiview.coverage(rig, point, noise, key=jax.random.key(0))
        >>> bool(jnp.abs(held - 0.95) < 0.03)
        True
    """
    noise_key, method_key = jax.random.split(key)
    noise = jax.random.normal(noise_key, (num_trials, 3), point.dtype)
    measurements = rig.project(point[None]) + matmul(noise, cholesky(covariance).T)

    def distance(measurement, trial_key):
        return triangulate(rig, measurement, covariance, method=method, key=trial_key).mahalanobis_squared(point)

    distances = jax.vmap(distance)(measurements, jax.random.split(method_key, num_trials))
    held = gate(distances, 3, probability) & rig.has_depth(measurements)
    return jnp.mean(held.astype(point.dtype))


class _PointOf(eqx.Module):
    """Triangulation as a pytree with its rig as data, so that another rig does not compile anew."""

    rig: StereoRig

    def __call__(self, measurement: Float[Array, "3"]) -> Float[Array, "3"]:
        return self.rig.triangulate(measurement[None])[0]
