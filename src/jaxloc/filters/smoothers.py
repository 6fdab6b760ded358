"""What was known too late: states given the measurements after them, for the whole Kalman family."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxloc.beliefs.square_root import product, triangularize, whiten
from jaxloc.filters.interface import GaussianState, History
from jaxloc.filters.kalman import GaussianFilter, finite_or_zero, recenter, select
from jaxloc.poses import carry, is_flat, local


class Step(eqx.Module):
    """A motion looked at backwards: how the state before it follows from the state after it.

    Attributes:
        mean: of the state after, predicted.
        gain: d "before" by d "after", both tangents at their means.
        rest: root of the covariance that remains when the state after is known.
    """

    mean: Any
    gain: Float[Array, "*t d d"]
    rest: Float[Array, "*t d d"]


@eqx.filter_jit
def smooth(
    filt: GaussianFilter, history: History, controls: Any, *, active: Bool[Array, " t"] | None = None
) -> GaussianState:
    """States of a run given all its measurements: the Rauch-Tung-Striebel recursion, in square-root form.

    With the joint root ``tria[[F S, Q^1/2], [S, 0]] = [[A, 0], [G, C]]`` of a step, ``x_s = x + G A^-1 (x_s' - x'-)``
    and ``S_s = tria[C, G A^-1 S_s']``: no covariance is subtracted, so none can turn negative. Filters spread through
    their motions by derivatives or by sigma points, so this is the linear, extended or sigma-point smoother.

    Args:
        filt: the filter of the run.
        history: of the run, with whole states (``keep`` left alone).
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
    states, there = history.states, _there(history.states, active)
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    after = jax.tree.map(lambda leaf: leaf[1:], (controls, there))

    def back(smoothed, inputs):
        state, (control, here) = inputs
        earlier = smooth_step(state, look_back(filt, state, control), smoothed)
        earlier = select(here, earlier, _at(smoothed, state))
        return earlier, earlier

    _, smoothed = lax.scan(back, last, (before, after), reverse=True)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), smoothed, last)


@eqx.filter_jit
def smooth_fixed_lag(
    filt: GaussianFilter, history: History, controls: Any, lag: int, *, active: Bool[Array, " t"] | None = None
) -> GaussianState:
    """States of a run given the measurements up to ``lag`` steps after each: what can be known with a fixed delay.

    All steps go back side by side, so that time costs ``lag`` steps of a batch instead of ``t`` in turn.

    Args:
        filt: the filter of the run.
        history: of the run, with whole states.
        controls: those of the run.
        lag: number of later steps that each state sees, at least 0; near the end there are fewer.
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
    states, there = history.states, _there(history.states, active)
    count = there.shape[0]
    index = jnp.arange(count)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    following = jax.tree.map(lambda leaf: leaf[1:], controls)
    steps = jax.vmap(lambda state, control: look_back(filt, state, control))(before, following)

    def pick(tree, where):
        return jax.tree.map(lambda leaf: leaf[where], tree)

    def back(smoothed, offset):
        # From the state at index + offset + 1 to the one at index + offset, for every index.
        at = jnp.minimum(index + offset, max(count - 2, 0))
        state = pick(states, at)
        earlier = jax.vmap(smooth_step)(state, pick(steps, at), smoothed)
        earlier = jax.vmap(select)(there[at + 1], earlier, jax.vmap(_at)(smoothed, state))
        return jax.vmap(select)(index + offset < count - 1, earlier, smoothed), None

    start = pick(states, jnp.minimum(index + lag, count - 1))
    smoothed = start if count < 2 else lax.scan(back, start, jnp.arange(lag)[::-1])[0]
    return jax.vmap(_at)(smoothed, states)


def look_back(filt: GaussianFilter, state: GaussianState, control: Any) -> Step:
    """How a state follows from the one that the filter's motion moves it to."""
    spread = filt.move(state, finite_or_zero(control))
    return Step(spread.mean, *regress(spread.root()))


def regress(root: Float[Array, "n n"]) -> tuple[Float[Array, "d d"], Float[Array, "d d"]]:
    """Of the joint root of (after, before): the gain by which before follows from after, and the root of the rest."""
    size = root.shape[0] // 2
    moved, across, rest = root[:size, :size], root[size:, :size], root[size:, size:]
    # Directions that the motion leaves without any uncertainty say nothing about the state before it.
    floor = 8.0 * float(jnp.finfo(root.dtype).eps) * jnp.sqrt(jnp.sum(lax.stop_gradient(moved) ** 2, axis=1))
    free = jnp.diagonal(moved) > floor
    safe = jnp.where(free[:, None], moved, jnp.eye(size, dtype=root.dtype))
    # G A^-1, by the transposed system, which is lower triangular again when both its axes run backwards.
    held = jnp.where(free[None, :], across, 0.0)
    return whiten(safe.T[::-1, ::-1], held.T[::-1])[::-1].T, rest


def smooth_step(state: GaussianState, step: Step, smoothed: GaussianState) -> GaussianState:
    """A filtered state given the smoothed one after it."""
    change, root = local(step.mean, smoothed.mean), smoothed.covariance_sqrt
    if not is_flat(smoothed.mean):
        root = product(carry(smoothed.mean, jnp.zeros_like(change), step.mean), root)
    spread = triangularize(jnp.concatenate([step.rest, product(step.gain, root)], axis=1))
    mean, spread = recenter(state.mean, product(step.gain, change), spread)
    return GaussianState(mean, spread, state.step)


def _there(states: GaussianState, active: Bool[Array, " t"] | None) -> Bool[Array, " t"]:
    return jnp.ones(states.step.shape[:1], bool) if active is None else active


def _at(smoothed: GaussianState, state: GaussianState) -> GaussianState:
    """A smoothed state, with the step number of another."""
    return GaussianState(smoothed.mean, smoothed.covariance_sqrt, state.step)
