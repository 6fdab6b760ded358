"""Rauch-Tung-Striebel and fixed-lag smoothers of the whole Kalman family."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc._linalg import back_substitution
from jaxloc.beliefs import validity
from jaxloc.beliefs.square_root import product, triangularize
from jaxloc.filters.interface import GaussianState, History
from jaxloc.filters.kalman import GaussianFilter, retract_root
from jaxloc.poses import carry, is_flat, local


class ReverseStep(eqx.Module):
    """Backward conditional of a motion: the state before it given the state after it.

    Attributes:
        mean: of the state after, predicted.
        gain: smoother gain, d "before" by d "after", in the tangents at the means.
        rest: root of the covariance of the state before given the state after.
    """

    mean: Any
    gain: Float[Array, "*t d d"]
    rest: Float[Array, "*t d d"]


@filter_jit
def smooth(
    filt: GaussianFilter, history: History, controls: Any, *, active: Bool[Array, " t"] | None = None
) -> GaussianState:
    """States of a run given all its measurements: the Rauch-Tung-Striebel recursion, in square-root form.

    With the joint root ``tria[[F S, Q^1/2], [S, 0]] = [[A, 0], [G, C]]`` of a step, ``x_s = x + G A^-1 (x_s' - x'-)``
    and ``S_s = tria[C, G A^-1 S_s']``: no covariance is subtracted, so none can turn negative. It uses the
    filter's own joint covariances (by derivatives or by sigma points), so this is the linear, extended or sigma-point
    smoother.

    Args:
        filt: the filter of the run.
        history: of the run, with whole states (default ``keep``).
        controls: those of the run.
        active: that of the run.

    Returns:
        Smoothed states, stacked along the steps; the last is the filtered one.

    References:
        Rauch, Tung and Striebel, AIAA J. 1965; Särkkä, "Unscented Rauch-Tung-Striebel smoother", IEEE TAC 2008; Särkkä
        and Svensson, *Bayesian Filtering and Smoothing*, 2023, chapter 12 [T-56], [T-57].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.KalmanFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> start = filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye))
        >>> _, history = jl.filters.run(filt, start, None, jnp.array([[1.0], [2.0], [0.0]]), jnp.ones(3, bool))
        >>> smoothed = jl.filters.smooth(filt, history, None)
        >>> bool((smoothed.covariance_sqrt[:-1] < history.states.covariance_sqrt[:-1]).all())
        True
    """
    states, mask = history.states, _mask(history.states, active)
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    after = jax.tree.map(lambda leaf: leaf[1:], (controls, mask))

    def back(smoothed, inputs):
        state, (control, here) = inputs
        earlier = smooth_step(state, reverse_step(filt, state, control), smoothed)
        earlier = tree.where(here, earlier, _at(smoothed, state))
        return earlier, earlier

    _, smoothed = lax.scan(back, last, (before, after), reverse=True)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), smoothed, last)


@filter_jit
def smooth_fixed_lag(
    filt: GaussianFilter, history: History, controls: Any, lag: int, *, active: Bool[Array, " t"] | None = None
) -> GaussianState:
    """States of a run given the measurements up to ``lag`` steps after each: fixed-lag smoothing.

    All states are smoothed in one batch, in ``lag`` sequential steps instead of ``t``.

    Args:
        filt: the filter of the run.
        history: of the run, with whole states.
        controls: those of the run.
        lag: number of later steps whose measurements each state uses, at least 0; fewer near the end.
        active: that of the run.

    Returns:
        Smoothed states, stacked along the steps.

    Raises:
        ValueError: if the lag is negative.

    References:
        Moore, "Discrete-time fixed-lag smoothing algorithms", Automatica 1973 [T-56].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> eye = jnp.eye(1)
        >>> filt = jl.filters.KalmanFilter(jl.filters.LinearMotion(eye, eye), jl.filters.LinearSensor(eye, eye))
        >>> start = filt.init(jl.beliefs.Gaussian(jnp.zeros(1), eye))
        >>> _, history = jl.filters.run(filt, start, None, jnp.array([[1.0], [2.0], [0.0]]), jnp.ones(3, bool))
        >>> late = jl.filters.smooth_fixed_lag(filt, history, None, 2)
        >>> bool(jnp.allclose(late.mean[0], jl.filters.smooth(filt, history, None).mean[0], atol=1e-5))
        True
    """
    if lag < 0:
        raise ValueError(f"A lag is at least 0; got {lag}.")
    states, mask = history.states, _mask(history.states, active)
    count = mask.shape[0]
    index = jnp.arange(count)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    following = jax.tree.map(lambda leaf: leaf[1:], controls)
    steps = jax.vmap(lambda state, control: reverse_step(filt, state, control))(before, following)

    def pick(stack, where):
        return jax.tree.map(lambda leaf: leaf[where], stack)

    def back(smoothed, offset):
        # From the state at index + offset + 1 to the one at index + offset, for every index.
        at = jnp.minimum(index + offset, max(count - 2, 0))
        state = pick(states, at)
        earlier = jax.vmap(smooth_step)(state, pick(steps, at), smoothed)
        earlier = jax.vmap(tree.where)(mask[at + 1], earlier, jax.vmap(_at)(smoothed, state))
        return jax.vmap(tree.where)(index + offset < count - 1, earlier, smoothed), None

    initial = pick(states, jnp.minimum(index + lag, count - 1))
    smoothed = initial if count < 2 else lax.scan(back, initial, jnp.arange(lag)[::-1])[0]
    return jax.vmap(_at)(smoothed, states)


def reverse_step(filt: GaussianFilter, state: GaussianState, control: Any) -> ReverseStep:
    """Backward conditional of a state, from the filter's joint covariance of its prediction."""
    joint = filt.predict_joint(state, validity.finite_or_neutral(control))
    return ReverseStep(joint.mean, *regression(joint.root()))


def regression(root: Float[Array, "n n"]) -> tuple[Float[Array, "d d"], Float[Array, "d d"]]:
    """Linear regression of before on after, given their joint root: the gain, and the root of the remainder."""
    size = root.shape[0] // 2
    moved, across, rest = root[:size, :size], root[size:, :size], root[size:, size:]
    # Directions of zero variance after the motion carry no information about the state before it.
    floor = 8.0 * float(jnp.finfo(root.dtype).eps) * jnp.sqrt(jnp.sum(lax.stop_gradient(moved) ** 2, axis=1))
    free = jnp.diagonal(moved) > floor
    safe = jnp.where(free[:, None], moved, jnp.eye(size, dtype=root.dtype))
    # G A^-1 = (A^-T G^T)^T.
    held = jnp.where(free[None, :], across, 0.0)
    return back_substitution(safe, held.T).T, rest


def smooth_step(state: GaussianState, step: ReverseStep, smoothed: GaussianState) -> GaussianState:
    """A filtered state given the smoothed one after it."""
    change, root = local(step.mean, smoothed.mean), smoothed.covariance_sqrt
    if not is_flat(smoothed.mean):
        root = product(carry(smoothed.mean, jnp.zeros_like(change), step.mean), root)
    root = triangularize(jnp.concatenate([step.rest, product(step.gain, root)], axis=1))
    mean, root = retract_root(state.mean, product(step.gain, change), root)
    return GaussianState(mean, root, state.step)


def _mask(states: GaussianState, active: Bool[Array, " t"] | None) -> Bool[Array, " t"]:
    return jnp.ones(states.step.shape[:1], bool) if active is None else active


def _at(smoothed: GaussianState, state: GaussianState) -> GaussianState:
    """A smoothed state with the step number of another."""
    return GaussianState(smoothed.mean, smoothed.covariance_sqrt, state.step)
