"""Joint least-squares fit of offset, heading, curvature and pitch to a template, with covariance."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxloc._linalg import matmul
from jaxloc.lanes.ground_view import GroundView
from jaxloc.lanes.ralph.profile import LaneFit, normalize_rows, shift_rows
from jaxloc.lanes.ralph.template import Template
from jaxloc.solvers import Estimate, LevenbergMarquardt, solve
from jaxloc.solvers.cholesky import factor
from jaxloc.solvers.gauss_newton import Solver
from jaxloc.solvers.least_squares import minimize
from jaxloc.solvers.problem import Problem
from jaxloc.solvers.robust_kernels import Loss, Quadratic, Tukey

_LEVELS = 3  # resolutions: a mark is wider than the initial error at the coarsest
_ROUGH_STEPS = 20
_STEPS = 100
_STRETCHES = 4
_BANDS = 4
_SMALLEST_NOISE = 0.02  # of a normalized row


class TemplateResidual(Problem):
    """Least-squares problem: rows of a straightened view against a template, with gain and bias removed per row.

    ``r_kn = (V_k(n) - T(n)) / s``, both normalized over the positions that row k shows; and the pitch against what is
    known of it, ``pitch / sigma``.

    Args:
        view: the road from above.
        template: the expected cross profile.
        noise: s, standard deviation of the difference of normalized rows.
        pitch_sigma: how well the pitch of the view is known, rad.
        loss: robust kernel of a single position, since dashes, cars and shadows are not in the template; and those of
            what is not seen and of the pitch.
    """

    view: GroundView
    template: Template
    noise: Float[Array, ""]
    pitch_sigma: Float[Array, ""]
    loss: tuple[Loss, Loss, Loss]

    def residual(self, state: LaneFit) -> tuple[Array, Array, Array]:
        """Whitened gray-level differences, and the prior on the pitch; one component per item."""
        difference, weight = self.differences(state)
        # Looking away must not pay: a position that is not seen costs what one that fits costs.
        missing = 1.0 - weight
        pitch = state.pitch / self.pitch_sigma
        return (difference / self.noise).reshape(1, -1), missing.reshape(1, -1), pitch.reshape(1, 1)

    def differences(self, state: LaneFit) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
        """Weighted differences of normalized rows and template, and their weights: zero where either is unknown."""
        values, weight = shift_rows(self.view, state, self.template.left)
        rows = normalize_rows(values, jnp.where(self.template.known[None, :], weight, 0.0))
        model = normalize_rows(jnp.broadcast_to(self.template.values, values.shape), rows.weight)
        return model.weight * (rows.values - model.values), model.weight


class Refined(eqx.Module):
    """A lane fitted to a template.

    Attributes:
        estimate: its `LaneFit`, with covariance.
        noise: standard deviation of the residuals of normalized rows: 0 for a perfect match, 1.4 for none.
    """

    estimate: Estimate
    noise: Float[Array, ""]


def refine(
    view: GroundView,
    template: Template,
    initial: LaneFit,
    *,
    pitch_sigma: Float[Array, ""],
    kernel: Loss | None = None,
    solver: Solver = LevenbergMarquardt(rtol=1e-5),
) -> Refined:
    """Fits offset, heading, curvature and pitch at once.

    Args:
        view: the road from above.
        template: its cross profile.
        initial: initial value, close enough for the marks to overlap.
        pitch_sigma: how well the pitch of the view is known, rad.
        kernel: robust kernel; ``Tukey(10)`` by default, wide enough that a mark half beside its place still pulls.
        solver: of the last, finest fit. Its tolerance is by the cost, which ten thousand noisy positions make large: a
            step that it leaves out is far below the standard deviation.

    Returns:
        The fit; derivatives are those of the minimum, with the scale of the noise held.
    """
    kernel = Tukey(10.0) if kernel is None else kernel
    views, templates = [view], [template]
    for _ in range(_LEVELS - 1):
        views.append(views[-1].coarser())
        templates.append(templates[-1].coarser())
    for level in range(_LEVELS - 1, 0, -1):
        rough = _problem(views[level], templates[level], initial, pitch_sigma, kernel)
        initial = minimize(rough, lax.stop_gradient(initial), LevenbergMarquardt(rtol=1e-3), _ROUGH_STEPS)[0]
    initial = lax.stop_gradient(initial)
    problem = _problem(view, template, initial, pitch_sigma, kernel)
    found = solve(problem, initial, solver=solver, max_steps=_STEPS)
    covariance = jnp.where(found.ok, _jackknife(problem, found.value), found.covariance)
    estimate = eqx.tree_at(lambda e: e.covariance, found, covariance)
    return Refined(estimate, _noise_level(problem, found.value))


def _problem(
    view: GroundView, template: Template, initial: LaneFit, pitch_sigma: Float[Array, ""], kernel: Loss
) -> TemplateResidual:
    """The problem with the noise level at the initial value."""
    problem = TemplateResidual(
        view, template, jnp.ones_like(pitch_sigma), pitch_sigma, (kernel, Quadratic(), Quadratic())
    )
    return eqx.tree_at(lambda p: p.noise, problem, lax.stop_gradient(_noise_level(problem, initial)))


def _noise_level(problem: TemplateResidual, state: LaneFit) -> Float[Array, ""]:
    """Standard deviation of the differences from their mean absolute value, robust to a few large ones."""
    difference, _ = problem.differences(state)
    count = jnp.maximum(jnp.sum(difference != 0.0), 1).astype(difference.dtype)
    return jnp.maximum(1.2533 * jnp.sum(jnp.abs(difference)) / count, _SMALLEST_NOISE)


def _jackknife(problem: TemplateResidual, state: LaneFit) -> Float[Array, "4 4"]:
    """Covariance by leaving out one stretch of road after the other.

    What a template does not know (a dash, a patch, a bend of the wheel tracks) is wrong in many neighboring places in
    the same way, so that ten thousand positions are worth a few. Without the stretch ``b`` the answer would move by
    ``d_b = (A - A_b)^-1 s_b``, ``A_b`` its share of the Hessian and ``s_b`` of the gradient; the covariance is
    ``(B - 1) / B sum d_b d_b^T``. It asks only that different stretches err independently.

    References:
        J. G. MacKinnon, M. O. Nielsen and M. D. Webb, "Fast and reliable jackknife and bootstrap methods for
        cluster-robust inference", Journal of Applied Econometrics 2023.
    """
    linear = problem.linearize(state)
    residual, jacobian = linear.residual[0][0], linear.jacobian[0][:, 0]
    weight = problem.loss[0].weight(residual**2)
    weighted = jacobian * weight[None, :]
    prior = linear.jacobian[2].reshape(4, -1)
    whole = matmul(weighted, jacobian.T) + matmul(prior, prior.T)

    def move(member: Array) -> Array:
        """How far the answer goes without some positions."""
        left_out = jnp.where(member[None, :], weighted, 0.0)
        return matmul(factor(whole - matmul(left_out, jacobian.T)).inverse(), matmul(left_out, residual))

    rows, columns = problem.view.image.shape[0], problem.template.left.size
    place = jnp.arange(residual.size)
    total = jnp.zeros_like(whole)
    for number, part in (
        (_STRETCHES, place // columns * _STRETCHES // rows),
        (_BANDS, place % columns * _BANDS // columns),
    ):
        moves = jax.vmap(lambda b, part=part: move(part == b))(jnp.arange(number))
        total += (number - 1.0) / number * matmul(moves.T, moves)
    return total
