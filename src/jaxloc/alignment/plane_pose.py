"""Direct pose estimation: a camera's image aligned with a map image of a textured plane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.images.interpolation import Bicubic, sample_components
from jaxloc.images.normalization import as_gray
from jaxloc.images.pyramid import gaussian_pyramid
from jaxloc.poses import SE3
from jaxloc.sensors import Pinhole, TexturedPlane
from jaxloc.solvers import Estimate, LevenbergMarquardt, Problem, Quadratic, solve
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.estimate import guarded


class Appearance(eqx.Module):
    """Unknowns of the alignment: a pose, gain and bias.

    Attributes:
        pose: ``T_world_camera``.
        gain: contrast of the image over that of the map.
        bias: in standard deviations of the map.
    """

    pose: SE3
    gain: Float[Array, ""]
    bias: Float[Array, ""]


class PlaneAppearance(Problem):
    """Least-squares problem of gray-level differences between an image and visible map points.

    Attributes:
        camera: of the image at this scale.
        image: gray levels, finite everywhere.
        known: pixels around which it was finite.
        points: of the map, world frame, "3 n".
        values: of the map there, zero mean and unit variance.
        contrast: standard deviation of the map's gray levels.
        mean: of the map's gray levels.
        sigma: standard deviation of a difference, gray levels.
        loss: robust kernel.
    """

    camera: Pinhole
    image: Float[Array, "h w"]
    known: Bool[Array, "h w"]
    points: Float[Array, "3 n"]
    values: Float[Array, " n"]
    contrast: Float[Array, ""]
    mean: Float[Array, ""]
    sigma: Float[Array, ""]
    loss: Any = Quadratic()

    def sample(self, pose: SE3) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
        """The image at the map's points, and where it is known."""
        rotation = pose.rotation.matrix()
        x, y, z = matmul(rotation.T, self.points - pose.translation[:, None])
        front = self.camera.in_front_components(x, y, z)
        u, v = self.camera.project_components(x, y, z)
        values, inside = sample_components(self.image, u, v, method=Bicubic())
        column, row = (jnp.where(inside, jax.lax.stop_gradient(c), 0.0).round().astype(jnp.int32) for c in (u, v))
        known = front & inside & self.known[row, column] & jnp.isfinite(values)
        return jnp.where(known, values, 0.0), known

    def residual(self, state: Appearance) -> Float[Array, " n"]:
        """Whitened differences; zero for invisible points."""
        values, known = self.sample(state.pose)
        expected = self.mean + self.contrast * (state.gain * self.values + state.bias)
        return jnp.where(known, (values - expected) / self.sigma, 0.0)


@filter_jit
def refine_pose(
    image: Num[Array, "h w"] | Any,
    plane: TexturedPlane,
    camera: Pinhole,
    initial: SE3,
    *,
    sigma: Any = 3.0,
    loss: Any = Quadratic(),
    levels: int = 3,
    stride: int = 2,
) -> Estimate:
    """Pose of a camera from its image of a textured plane and an initial pose.

    Minimizes ``sum rho((image(project(T^-1 X_i)) - gain Z_i - bias) / sigma)`` over the pose ``T = T_world_camera``,
    gain and bias, for the map's pixels X_i with gray levels Z_i, from coarse to fine.

    Args:
        image: the camera's image, gray levels.
        plane: the map.
        camera: intrinsics and lens.
        initial: ``T_world_camera``.
        sigma: standard deviation of a difference, gray levels: noise of the image and errors of the map.
        loss: robust kernel, in sigmas.
        levels: of the pyramid; static.
        stride: between the map's pixels that are used at the finest level; static.

    Returns:
        Estimate of ``T_world_camera`` with covariance in its tangent (right perturbation). ``ok`` is False when less
        than a tenth of the map is visible or the texture leaves directions undetermined.

    References:
        Kelly's image prediction as a map [K-11, K-12, K-45]; Lucas and Kanade, 1981.

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> texture = jax.image.resize(jax.random.uniform(jax.random.key(0), (12, 12)) * 200, (96, 96), "cubic")
        >>> plane = jl.sensors.TexturedPlane(texture, 0.02, jl.poses.SE3.identity())
        >>> camera = jl.sensors.Pinhole(100.0, 100.0, 47.5, 47.5)
        >>> truth = jl.poses.SE3.exp(jnp.array([0.95, 0.95, -1.5, 0.0, 0.0, 0.05]))
        >>> image = plane.predict(camera, truth, shape=(96, 96)).image
        >>> initial = truth @ jl.poses.SE3.exp(jnp.array([0.03, -0.02, 0.05, 0.01, 0.0, 0.01]))
        >>> fit = jl.alignment.plane_pose.refine_pose(image, plane, camera, initial)
        >>> bool(fit.ok), bool(jnp.linalg.norm(fit.value.translation - truth.translation) < 0.01)
        (True, True)
    """
    sigma = jnp.asarray(sigma, plane.texture.dtype)
    usable = positive(sigma)
    given = image, plane, camera, initial, jnp.where(usable, sigma, 1.0), loss
    return guarded(usable, lambda *given: _refine(*given, levels, stride), *given)


def _refine(
    image: Any, plane: TexturedPlane, camera: Pinhole, initial: SE3, sigma: Array, loss: Any, levels: int, stride: int
) -> Estimate:
    image = as_gray(image, plane.texture.dtype)
    images, maps = gaussian_pyramid(image, levels=levels), gaussian_pyramid(plane.texture, levels=levels)
    one = jnp.ones((), image.dtype)
    state = Appearance(initial, one, jnp.zeros_like(one))
    fit, problem = None, None
    for level in reversed(range(levels)):
        problem = _problem(images[level], maps[level], plane, camera, level, sigma, loss, stride if level == 0 else 1)
        # Interpolated gray levels are not quadratic, which limits the accuracy.
        solver = LevenbergMarquardt(rtol=1e-4 if image.dtype == jnp.float32 else 1e-7)
        fit = solve(problem, state, solver=solver)
        state = fit.value
    return _pose_of(fit, problem)


def _problem(
    image: Array,
    texture: Array,
    plane: TexturedPlane,
    camera: Pinhole,
    level: int,
    sigma: Array,
    loss: Any,
    stride: int,
) -> PlaneAppearance:
    shrink = 2.0**level
    u, v = jnp.meshgrid(*(jnp.arange(0, size, stride, dtype=texture.dtype) for size in texture.shape[::-1]))
    points = plane.points(shrink * jnp.stack([u.reshape(-1), v.reshape(-1)], axis=1))
    values = texture[::stride, ::stride].reshape(-1)
    mean, contrast = jnp.mean(values), jnp.std(values)
    contrast = jnp.where(contrast > 0, contrast, 1.0)
    focal = camera.fx / shrink, camera.fy / shrink
    scaled = Pinhole(*focal, camera.cx / shrink, camera.cy / shrink, camera.skew / shrink, camera.lens)
    # NaN would pass to the derivatives through any later mask; interpolation reaches two pixels.
    finite = jnp.isfinite(image)
    known = jax.lax.reduce_window(finite, True, jax.lax.bitwise_and, (5, 5), (1, 1), "SAME")
    image = jnp.where(finite, image, 0.0)
    return PlaneAppearance(scaled, image, known, points.T, (values - mean) / contrast, contrast, mean, sigma, loss)


def _pose_of(fit: Estimate, problem: PlaneAppearance) -> Estimate:
    """The estimate of the pose alone: brightness marginalized."""
    info = fit.information
    across = info[:6, 6:]
    solver = factor(info[6:, 6:])
    kept = info[:6, :6] - matmul(across, jnp.stack([solver.solve(row) for row in across], axis=1))
    _, known = problem.sample(fit.value.pose)
    ok = fit.ok & (jnp.mean(known) >= 0.1) & (fit.value.gain > 0)
    return Estimate(fit.value.pose, fit.covariance[:6, :6], fit.cost, ok, fit.num_steps, fit.status, kept)
