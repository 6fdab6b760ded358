"""Points where the rays of several cameras meet: closed forms, and the most likely point with its covariance."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxloc._linalg import matmul
from jaxloc.poses import SE3
from jaxloc.sensors import Pinhole
from jaxloc.solvers import Estimate, LevenbergMarquardt, Linearization, Loss, Problem, Quadratic, solve
from jaxloc.solvers.cholesky import factor

# Residual, in sigmas, of a point that a camera has behind it.
_UNSEEN = 1e3


@eqx.filter_jit
def midpoint(
    centers: Float[Array, "n 3"], rays: Float[Array, "n 3"], *, valid: Bool[Array, " n"] | None = None
) -> Float[Array, "3"]:
    """The point nearest to all rays: ``sum (I - r r^T) (x - c) = 0``.

    Args:
        centers: of the cameras, world frame, m.
        rays: unit bearings, world frame.
        valid: which count.

    Returns:
        The point, world frame, m; of parallel rays one of many, finite.

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
    # About the mean center: the sums then hold the baselines, not the distance from the origin.
    middle = jnp.sum(safe_centers, axis=0) / jnp.maximum(number, 1.0)
    offsets = jnp.where(counts[:, None], safe_centers - middle[None, :], 0.0)
    across = offsets - safe_rays * jnp.sum(safe_rays * offsets, axis=1, keepdims=True)
    matrix = number * eye - matmul(safe_rays.T, safe_rays)
    return middle + factor(matrix).solve(jnp.sum(across, axis=0))


@eqx.filter_jit
def correct_pair(
    first: Float[Array, "2"], second: Float[Array, "2"], matrix: Float[Array, "3 3"]
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Moves two corresponding points by the least sum of squares until their rays meet: ``x1^T M x2 = 0``.

    Two fixed steps, the first of which solves a quadratic equation; the rest is of the order of rounding. `midpoint` of
    the corrected rays is the optimal point of two views.

    Args:
        first: in the first image: px, or coordinates normalized alike in both images.
        second: in the second image.
        matrix: fundamental (px) or essential matrix with ``x1^T M x2 = 0``.

    Returns:
        The corrected points. On the epipoles, where nothing is constrained, they stay.

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
    """A quotient of what is not negative below; zero where that is zero."""
    some = bottom > float(jnp.finfo(bottom.dtype).tiny)
    return jnp.where(some, top / jnp.where(some, bottom, 1.0), 0.0)


class TriangulationProblem(Problem):
    """Pixels of one point in several cameras; the state is the point, world frame.

    Attributes:
        camera: of all images.
        poses: ``T_world_camera``, a stack.
        pixels: "2 n"; finite everywhere.
        sigma: standard deviation of a pixel coordinate, one an image, px.
        valid: which count.
        loss: robust kernel over the two coordinates.
    """

    camera: Pinhole
    poses: SE3
    pixels: Float[Array, "2 n"]
    sigma: Float[Array, " n"]
    valid: Bool[Array, " n"]
    loss: Any = Quadratic()

    def residual(self, state: Float[Array, "3"]) -> Float[Array, "2 n"]:
        """Whitened pixel errors; dear where the point lies behind the camera."""
        c, seen = self._seen(state)
        error = (jnp.stack(self.camera.project_components(*c)) - self.pixels) / self.sigma[None, :]
        unseen = jnp.where(self.valid & ~seen, _UNSEEN, 0.0).astype(error.dtype)
        return jnp.where(seen[None, :], error, unseen[None, :])

    def linearize(self, state: Float[Array, "3"]) -> Linearization:
        """Residual and Jacobian by one forward pass for each coordinate."""
        columns = jnp.eye(3, dtype=state.dtype)
        residual, push = jax.linearize(self.residual, state)
        return Linearization(residual, jax.vmap(push)(columns))

    def admissible(self, state: Float[Array, "3"]) -> Bool[Array, ""]:
        """Whether two cameras have the point before them."""
        return jnp.sum(self._seen(state)[1]) >= 2

    def _seen(self, point: Array) -> tuple[tuple[Array, Array, Array], Bool[Array, " n"]]:
        offsets = (point[None, :] - self.poses.translation)[:, :, None]
        moved = jnp.sum(self.poses.rotation.rotation_matrix * offsets, axis=1)
        x, y, z = moved[:, 0], moved[:, 1], moved[:, 2]
        seen = self.valid & self.camera.in_front_components(x, y, z)
        return (jnp.where(seen, x, 0.0), jnp.where(seen, y, 0.0), jnp.where(seen, z, 1.0)), seen


@eqx.filter_jit
def triangulate(
    camera: Pinhole,
    poses: SE3,
    pixels: Float[Array, "n 2"],
    *,
    sigma: Any = 1.0,
    valid: Bool[Array, " n"] | None = None,
    loss: Loss = Quadratic(),
) -> Estimate:
    """The point that a camera saw from several places: the minimum of the reprojection errors.

    Args:
        camera: of all images; for different ones give normalized coordinates, ``Pinhole(1, 1, 0, 0)``, and a sigma
            for each.
        poses: ``T_world_camera``, a stack of n.
        pixels: where the point was seen, px.
        sigma: standard deviation of a pixel coordinate, px: a number or one an image.
        valid: which images count; numbers that are not finite never do.
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
        >>> seen = jnp.array([[420.0, 240.0], [320.0, 240.0], [220.0, 240.0]])
        >>> found = jl.multiview.triangulation.triangulate(camera, poses, seen, sigma=0.5)
        >>> bool(found.ok), found.value.round(3).tolist()
        (True, [1.0, 0.0, 5.0])
    """
    finite = jnp.all(jnp.isfinite(pixels), axis=1)
    valid = finite if valid is None else finite & valid
    pixels = jnp.where(valid[:, None], pixels, 0.0)
    sigmas = jnp.broadcast_to(jnp.asarray(sigma, pixels.dtype), valid.shape)
    problem = TriangulationProblem(camera, poses, pixels.T, sigmas, valid, loss)
    return solve(problem, _start(problem), solver=LevenbergMarquardt())


def _start(problem: TriangulationProblem) -> Float[Array, "3"]:
    """Where the rays meet; far ahead if they meet behind a camera."""
    poses, valid = problem.poses, problem.valid
    bearings = problem.camera.bearing(problem.pixels.T)
    rays = jnp.sum(poses.rotation.rotation_matrix * bearings[:, None, :], axis=2)
    meeting = midpoint(poses.translation, rays, valid=valid)
    count = jnp.maximum(jnp.sum(valid), 1).astype(rays.dtype)
    middle, ahead = (jnp.sum(jnp.where(valid[:, None], v, 0.0), axis=0) / count for v in (poses.translation, rays))
    spread = jnp.sqrt(jnp.sum(jnp.where(valid[:, None], (poses.translation - middle[None, :]) ** 2, 0.0)))
    seen = jnp.sum(problem._seen(meeting)[1]) == jnp.sum(valid)
    return jnp.where(seen & jnp.all(jnp.isfinite(meeting)), meeting, middle + 30.0 * spread * ahead)
