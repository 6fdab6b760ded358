"""Triangulation from several views: midpoint, optimal correction of two views, and maximum likelihood."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs.validity import positive
from jaxloc.poses import SE3
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, LevenbergMarquardt, Linearization, Loss, Problem, Quadratic, solve
from jaxloc.solvers.cholesky import factor

# Residual of a point behind a camera, sigmas.
_UNSEEN = 1e3


@filter_jit
@checked
def midpoint(
    centers: Float[Array, "n 3"], rays: Float[Array, "n 3"], *, valid: Bool[Array, " n"] | None = None
) -> Float[Array, "3"]:
    """Midpoint method: the point nearest to all rays, ``sum (I - r r^T) (x - c) = 0``.

    Args:
        centers: of the cameras, world frame, m.
        rays: unit bearings, world frame.
        valid: entries that are used.

    Returns:
        The point, world frame, m; finite, but not unique for parallel rays.

    References:
        Hartley and Sturm, "Triangulation", CVIU 1997, section 5.3 [T-8].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> centers = jnp.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
        >>> rays = jnp.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
        >>> [round(float(x), 2) for x in jl.multiview.triangulation.midpoint(centers, rays)]
        [1.0, 0.0, 1.33]
    """
    counts = jnp.ones(rays.shape[:1], bool) if valid is None else valid
    safe_rays = jnp.where(counts[:, None], rays, 0.0)
    safe_centers = jnp.where(counts[:, None], centers, 0.0)
    eye = jnp.eye(3, dtype=rays.dtype)
    number = jnp.sum(counts).astype(rays.dtype)
    # Relative to the mean center, for accuracy far from the origin.
    middle = jnp.sum(safe_centers, axis=0) / jnp.maximum(number, 1.0)
    offsets = jnp.where(counts[:, None], safe_centers - middle[None, :], 0.0)
    across = offsets - safe_rays * jnp.sum(safe_rays * offsets, axis=1, keepdims=True)
    matrix = number * eye - matmul(safe_rays.T, safe_rays)
    return middle + factor(matrix).solve(jnp.sum(across, axis=0))


@filter_jit
@checked
def correct_pair(
    first: Float[Array, "2"], second: Float[Array, "2"], matrix: Float[Array, "3 3"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Optimal correction of two corresponding points: the least sum of squares that fulfills ``x1^T M x2 = 0``.

    Two fixed steps, the first of which solves a quadratic equation; the remaining error is rounding. `midpoint` of
    the corrected rays is the optimal point of two views.

    Args:
        first: in the first image: px, or coordinates normalized alike in both images.
        second: in the second image.
        matrix: fundamental (px) or essential matrix with ``x1^T M x2 = 0``.

    Returns:
        The corrected points; points on the epipoles are unchanged.

    References:
        Lindstrom, "Triangulation made easy", CVPR 2010, algorithm niter2.

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sideways = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        >>> moved = jl.multiview.triangulation.correct_pair(jnp.array([2.0, 1.0]), jnp.array([1.0, 3.0]), sideways)
        >>> [point.round(3).tolist() for point in moved]
        [[2.0, 2.0], [1.0, 2.0]]
    """
    one = jnp.ones((1,), first.dtype)
    x, y = jnp.concatenate([first, one]), jnp.concatenate([second, one])
    image, back = matmul(matrix, y), matmul(matrix.T, x)
    inner, n, m = matrix[:2, :2], image[:2], back[:2]
    a, b, c = jnp.sum(n * matmul(inner, m)), 0.5 * (jnp.sum(n * n) + jnp.sum(m * m)), jnp.sum(x * image)
    discriminant = b * b - a * c
    root = jnp.where(discriminant > 0, jnp.sqrt(jnp.where(discriminant > 0, discriminant, 1.0)), 0.0)
    step = _ratio(c, b + root)
    n, m = n - step * matmul(inner, m), m - step * matmul(inner.T, n)
    step = step * _ratio(2.0 * root, jnp.sum(n * n) + jnp.sum(m * m))
    return first - step * n, second - step * m


def _ratio(top: Float[Array, ""], bottom: Float[Array, ""]) -> Float[Array, ""]:
    """Quotient with a nonnegative denominator; zero where that is zero."""
    some = bottom > float(jnp.finfo(bottom.dtype).tiny)
    return jnp.where(some, top / jnp.where(some, bottom, 1.0), 0.0)


class TriangulationProblem(Problem):
    """Least-squares problem of one point in several images; the state is the point, world frame.

    Attributes:
        camera: of all images.
        poses: ``T_world_camera``, a stack.
        pixels: "2 n"; finite everywhere.
        sigma: standard deviation of a pixel coordinate, one an image, px.
        valid: entries that are used.
        loss: robust kernel over the two coordinates.
    """

    camera: Pinhole
    poses: SE3
    pixels: Float[Array, "2 n"]
    sigma: Float[Array, " n"]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: Float[Array, "3"]) -> Float[Array, "2 n"]:
        """Whitened pixel errors; a large constant where the point is behind the camera."""
        c, visible = self._in_camera(state)
        error = (jnp.stack(self.camera.project_components(*c)) - self.pixels) / self.sigma[None, :]
        unseen = jnp.where(self.valid & ~visible, _UNSEEN, 0.0).astype(error.dtype)
        return jnp.where(visible[None, :], error, unseen[None, :])

    def linearize(self, state: Float[Array, "3"]) -> Linearization:
        """Residual and Jacobian by one forward pass for each coordinate."""
        columns = jnp.eye(3, dtype=state.dtype)
        residual, push = jax.linearize(self.residual, state)
        return Linearization(residual, jax.vmap(push)(columns))

    def admissible(self, state: Float[Array, "3"]) -> Bool[Array, ""]:
        """Whether the point is in front of at least two cameras."""
        return jnp.sum(self._in_camera(state)[1]) >= 2

    def _in_camera(self, point: Array) -> tuple[tuple[Array, Array, Array], Bool[Array, " n"]]:
        offsets = (point[None, :] - self.poses.translation)[:, :, None]
        moved = jnp.sum(self.poses.rotation.rotation_matrix * offsets, axis=1)
        x, y, z = moved[:, 0], moved[:, 1], moved[:, 2]
        visible = self.valid & self.camera.in_front_components(x, y, z)
        return (jnp.where(visible, x, 0.0), jnp.where(visible, y, 0.0), jnp.where(visible, z, 1.0)), visible


@filter_jit
@checked
def triangulate(
    camera: Pinhole,
    poses: SE3,
    pixels: Float[Array, "n 2"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Loss = Quadratic(),
) -> Estimate:
    """Maximum-likelihood triangulation of a point from several views: minimum of the reprojection errors.

    Args:
        camera: of all images; for different ones give normalized coordinates, ``Pinhole(1, 1, 0, 0)``, and a sigma
            for each.
        poses: ``T_world_camera``, a stack of n.
        pixels: measurements of the point, px.
        sigma: standard deviation of a pixel coordinate, px: a number or one an image.
        valid: images that are used; non-finite pixels never are, nor those without a positive finite sigma.
        loss: robust kernel over the two coordinates of an image.

    Returns:
        Estimate of the point, world frame, m. ``ok`` is False with fewer than two images, no baseline, or when the
        point lies behind the cameras. With little parallax the covariance is large, and the density skewed in depth.

    References:
        Hartley and Zisserman, *Multiple View Geometry*, 2004, section 12.4; a moving camera makes its baseline
        itself [T-8].

    Example:
        >>> import jax, jax.numpy as jnp, jaxloc as jl
        >>> camera = jl.sensors.Pinhole(500.0, 500.0, 320.0, 240.0)
        >>> place = lambda x: jl.poses.SE3.from_euler(jnp.stack([x, 0.0 * x, 0.0 * x]), 0.0, 0.0, 0.0)
        >>> poses = jax.vmap(place)(jnp.array([0.0, 1.0, 2.0]))
        >>> pixels = jnp.array([[420.0, 240.0], [320.0, 240.0], [220.0, 240.0]])
        >>> found = jl.multiview.triangulation.triangulate(camera, poses, pixels, sigma=0.5)
        >>> bool(found.ok), found.value.round(3).tolist()
        (True, [1.0, 0.0, 5.0])
    """
    finite = jnp.all(jnp.isfinite(pixels), axis=1)
    valid = finite if valid is None else finite & valid
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, pixels.dtype), valid.shape)
    valid = valid & positive(sigmas)
    pixels, sigmas = jnp.where(valid[:, None], pixels, 0.0), jnp.where(valid, sigmas, 1.0)
    problem = TriangulationProblem(camera, poses, pixels.T, sigmas, valid, loss)
    return solve(problem, _initial(problem), solver=LevenbergMarquardt())


def _initial(problem: TriangulationProblem) -> Float[Array, "3"]:
    """The midpoint of the rays; a far point if that is behind a camera."""
    poses, valid = problem.poses, problem.valid
    bearings = problem.camera.bearing(problem.pixels.T)
    rays = jnp.sum(poses.rotation.rotation_matrix * bearings[:, None, :], axis=2)
    nearest = midpoint(poses.translation, rays, valid=valid)
    count = jnp.maximum(jnp.sum(valid), 1).astype(rays.dtype)
    middle, forward = (jnp.sum(jnp.where(valid[:, None], v, 0.0), axis=0) / count for v in (poses.translation, rays))
    extent = jnp.sqrt(jnp.sum(jnp.where(valid[:, None], (poses.translation - middle[None, :]) ** 2, 0.0)))
    visible = jnp.sum(problem._in_camera(nearest)[1]) == jnp.sum(valid)
    return jnp.where(visible & jnp.all(jnp.isfinite(nearest)), nearest, middle + 30.0 * extent * forward)
