"""Result of bundle adjustment, with covariances of chosen poses and points."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxloc._arguments import checked
from jaxloc._jit import filter_jit
from jaxloc._linalg import matmul
from jaxloc.beliefs import Gaussian
from jaxloc.poses import SE3
from jaxloc.refinement.bundle.problem import Bundle, BundleProblem
from jaxloc.refinement.bundle.schur import Eliminated, Tangent, eliminate, normal_equations, score_products
from jaxloc.refinement.bundle.structure import Structure
from jaxloc.solvers import Estimate, Quadratic, Status
from jaxloc.solvers.cholesky import factor


class BundleEstimate(eqx.Module):
    """Result of bundle adjustment.

    It is no `jaxloc.solvers.Estimate`, since the covariance of all unknowns would take gigabytes. Covariances of chosen
    poses and points are computed on demand, and `pose_estimate` gives what filters and pose graphs accept. Under plain
    least squares they are inverses of the Gauss-Newton Hessian, correct for correct sigmas; under robust kernels the
    sandwich covariance of M-estimation, from the observed scatter.

    Attributes:
        value: poses and points.
        cost: the objective at the value, the sum of rho.
        ok: whether the value can be used. Gradients are zero where it is False.
        num_steps: steps taken, rejected ones included.
        status: a `jaxloc.solvers.Status`.
        point_ok: points that their rays determine; the others keep their initial value.
        problem: the minimized problem.
        structure: its index tables.
    """

    value: Bundle
    cost: Float[Array, ""]
    ok: Bool[Array, ""]
    num_steps: Int[Array, ""]
    status: Int[Array, ""]
    point_ok: Bool[Array, " n"]
    problem: BundleProblem
    structure: Structure

    @filter_jit
    @checked
    def pose_covariance(self, cameras: Int[Array, " q"]) -> Float[Array, "q 6 q 6"]:
        """Joint covariance of chosen poses in their tangents (right perturbation); zero for fixed ones.

        Args:
            cameras: "q", numbers of the cameras.

        Returns:
            Covariance of camera ``cameras[i]`` with ``cameras[j]`` at ``[i, :, j, :]``, m and rad. Where directions are
            undetermined it is finite and without meaning.
        """
        eliminated, (size, count) = self._factored(), (self.value.poses.batch_shape[0], cameras.shape[0])
        if isinstance(self.problem.loss, Quadratic):
            blocks = eliminated.system.inverse().reshape(size, 6, size, 6)[cameras][:, :, cameras]
        else:
            rows = 6 * cameras[:, None] + jnp.arange(6, dtype=cameras.dtype)[None, :]
            zeros, none = jnp.zeros(6 * size, self.cost.dtype), jnp.zeros_like(self.value.points)
            unit = lambda row: Tangent(zeros.at[row].set(1.0).reshape(size, 6), none)  # noqa: E731
            solved = jax.lax.map(lambda row: eliminated.solve(unit(row)), rows.reshape(-1))
            blocks = self._scatter(eliminated, solved).reshape(count, 6, count, 6)
        free = ~self.problem.gauge.fixed[cameras]
        return jnp.where((free[:, None] & free[None, :])[:, None, :, None], _finite(blocks), 0.0)

    @filter_jit
    @checked
    def point_covariance(self, points: Int[Array, " q"]) -> Float[Array, "q 3 3"]:
        """Covariance of each of chosen points, world frame, m^2.

        Args:
            points: "q", numbers of the points.

        Returns:
            Covariances; zero along directions that are undetermined (see ``point_ok``).
        """
        eliminated = self._factored()
        zeros = jnp.zeros((self.value.poses.batch_shape[0], 6), self.cost.dtype)
        none = jnp.zeros_like(self.value.points)

        def block(point: Int[Array, ""]) -> Float[Array, "3 3"]:
            unit = lambda axis: Tangent(zeros, none.at[point, axis].set(1.0))  # noqa: E731
            solved = jax.lax.map(lambda axis: eliminated.solve(unit(axis)), jnp.arange(3))
            if isinstance(self.problem.loss, Quadratic):
                return solved.points[:, point]
            return self._scatter(eliminated, solved)

        # One after the other, since each solution has the size of the whole bundle.
        return _finite(jax.lax.map(block, points))

    def _scatter(self, eliminated: Eliminated, solved: Tangent) -> Float[Array, "d d"]:
        """Covariance under a robust kernel between unknowns, given their columns of the inverse Hessian."""
        scores = score_products(self.problem, self.value, self.structure, eliminated)
        scattered = jax.lax.map(scores.product, solved)
        sides = ((scattered.cameras, solved.cameras), (scattered.points, solved.points))
        return sum(matmul(a.reshape(a.shape[0], -1), b.reshape(b.shape[0], -1).T) for a, b in sides)

    def pose_gaussian(self, camera: Any) -> Gaussian:
        """The pose of one camera as a Gaussian density."""
        return self.pose_estimate(camera).gaussian()

    def pose_estimate(self, camera: Any) -> Estimate:
        """The pose of one camera, the others and all points marginalized; value, covariance and status of an Estimate.

        Args:
            camera: its number.

        Returns:
            Estimate of ``T_world_camera``. Its cost is that of the whole bundle.
        """
        return self._pose_estimate(jnp.asarray(camera, jnp.int32))

    @filter_jit
    def _pose_estimate(self, index: Int[Array, ""]) -> Estimate:
        pose: SE3 = jax.tree.map(lambda leaf: leaf[index], self.value.poses)
        covariance = self.pose_covariance(index[None])[0, :, 0, :]
        information = factor(covariance).inverse()
        return Estimate(pose, covariance, self.cost, self.ok, self.num_steps, self.status, information)

    def describe(self) -> str:
        """One line of text with the status (host only)."""
        lost = int(jnp.sum(~self.point_ok))
        status = Status(int(self.status)).name.lower().replace("_", " ")
        return f"{status} ({int(self.num_steps)} steps, cost {float(self.cost):.6g}, {lost} points undetermined)"

    def check(self) -> "BundleEstimate":
        """Itself, when it is ok (host only).

        Raises:
            ValueError: it is not; the message says why.
        """
        if not bool(self.ok):
            raise ValueError(f"The bundle is not usable: {self.describe()}.")
        return self

    def _factored(self) -> Eliminated:
        _, _, arrow = normal_equations(self.problem, self.value, self.structure)
        return eliminate(arrow, self.structure)


def _finite(array: Array) -> Array:
    return jnp.where(jnp.isfinite(array), array, 0.0)
