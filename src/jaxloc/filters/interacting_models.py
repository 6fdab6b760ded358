"""Interacting multiple model (IMM) filter and smoother: a bank of filters, one for each mode of motion."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Key

from jaxloc import _tree as tree
from jaxloc._jit import filter_jit
from jaxloc.beliefs import Gaussian, validity
from jaxloc.beliefs.square_root import cholesky, product, triangularize, whiten
from jaxloc.filters.interface import Filter, FilterState, GaussianInfo, GaussianState, History, Info, conclude
from jaxloc.filters.kalman import GaussianFilter, retract_root
from jaxloc.filters.smoothers import ReverseStep, regression, smooth_step
from jaxloc.filters.unscented import intrinsic_mean
from jaxloc.poses import carry, is_flat, local


class InteractingState(FilterState):
    """State of the IMM filter: a density for each mode, and the mode probabilities.

    Attributes:
        states: one `GaussianState` per mode, stacked along a leading axis.
        log_probabilities: of the modes.
        step: number of predictions so far.
    """

    states: GaussianState
    log_probabilities: Float[Array, " k"]
    step: Int[Array, ""]

    @property
    def probabilities(self) -> Float[Array, "*s k"]:
        """Mode probabilities; they sum to one."""
        return jnp.exp(self.log_probabilities)

    def combined(self) -> GaussianState:
        """The normal density with the moments of the mixture of all modes."""
        return mix(self.states, self.probabilities)

    def gaussian(self) -> Gaussian:
        """The combined density as a `Gaussian`."""
        return self.combined().gaussian()


class InteractingInfo(Info):
    """Diagnostics of an update of the IMM filter.

    Attributes:
        log_likelihood: of the measurement given all earlier ones; zero where there is none.
        ok: whether the state can be used.
        probabilities: of the modes, after the update.
        modes: info of the filter of each mode, stacked along a leading axis.
    """

    log_likelihood: Float[Array, ""]
    ok: Bool[Array, ""]
    probabilities: Float[Array, " k"]
    modes: GaussianInfo


class InteractingMultipleModel(Filter):
    """The interacting multiple model (IMM) filter: one filter of the Kalman family per mode, mixed before each step.

    The mode is a Markov chain, ``p(s' = j | s = i) = transition[i, j]``. A prediction mixes the states of all modes for
    each mode, by the probability of the transition, and predicts the mixture by the filter of that mode; an update
    weights modes by the likelihood of the measurement.

    Args:
        filters: one for each mode, all on the same state; of any kind (linear, extended, sigma-point).
        transition: mode transition matrix "k k", rows sum to one; may be learned.

    Raises:
        ValueError: if the transition matrix does not fit the number of filters.

    References:
        Blom and Bar-Shalom, "The interacting multiple model algorithm for systems with Markovian switching
        coefficients", IEEE TAC 1988; Thesis eq. 1.3 and Fig. 1.3 [T-6].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.eye(1, 2), 0.01 * jnp.eye(1))
        >>> modes = [jl.filters.KalmanFilter(jl.filters.ConstantVelocity(q, axes=1), sensor) for q in (1e-4, 10.0)]
        >>> filt = jl.filters.InteractingMultipleModel(tuple(modes), jnp.array([[0.9, 0.1], [0.1, 0.9]]))
        >>> state = filt.init(jl.beliefs.Gaussian(jnp.zeros(2), 0.01 * jnp.eye(2)))
        >>> state, history = jl.filters.run(filt, state, jnp.ones(1), jnp.array([[2.0]]), jnp.ones(1, bool))
        >>> bool(history.infos.probabilities[0, 1] > 0.9)
        True
    """

    filters: tuple[GaussianFilter, ...]
    transition: Float[Array, "k k"]

    def __check_init__(self):
        count = len(self.filters)
        if isinstance(self.transition, jax.Array) and self.transition.shape != (count, count):
            raise ValueError(
                f"{count} filters need a transition matrix of shape ({count}, {count}); got {self.transition.shape}."
            )

    def init(self, prior: Gaussian, probabilities: Float[Array, " k"] | None = None) -> InteractingState:
        """The state of a prior density.

        Args:
            prior: of the state, the same in every mode.
            probabilities: of the modes; None for equal ones.
        """
        count = len(self.filters)
        if probabilities is None:
            probabilities = jnp.full(count, 1.0 / count, self.transition.dtype)
        states = _stack([filt.init(prior) for filt in self.filters])
        return InteractingState(states, log_probability(probabilities), jnp.zeros((), jnp.int32))

    def predict(self, state: InteractingState, control: Any, *, key: Key[Array, ""] | None = None) -> InteractingState:
        """The state one step ahead: mixed for each mode, then predicted by its filter."""
        del key
        ok, moved = tree.protect(_moved, self, state, validity.finite_or_neutral(control))
        held = _renumber(state.states, state.step + 1)
        return tree.where(ok, moved, InteractingState(held, state.log_probabilities, state.step + 1))

    def move(self, state: InteractingState, control: Any) -> InteractingState:
        """`predict` without protection from non-finite mode probabilities, which `predict` adds."""
        joint = state.log_probabilities[:, None] + log_probability(self.transition)
        predicted = jax.nn.logsumexp(joint, axis=0)
        weights = jnp.exp(joint - predicted[None, :])
        mixed = jax.vmap(mix, in_axes=(None, 1))(state.states, weights)
        moved = [filt.predict(one, control) for filt, one in zip(self.filters, unstack(mixed), strict=True)]
        return InteractingState(_stack(moved), predicted, state.step + 1)

    def update(
        self, state: InteractingState, measurement: Any, valid: Bool[Array, "*m"], *, key: Key[Array, ""] | None = None
    ) -> tuple[InteractingState, InteractingInfo]:
        """The state updated by a measurement."""
        del key
        ok, (after, info) = tree.protect(_updated, self, state, measurement, valid)
        return conclude(ok, after, info, state)

    def correct_by(
        self, state: InteractingState, measurement: Any, valid: Bool[Array, "*m"]
    ) -> tuple[InteractingState, InteractingInfo]:
        """`update` without protection from non-finite mode probabilities, which `update` adds."""
        pairs = [
            filt.update(one, measurement, valid) for filt, one in zip(self.filters, unstack(state.states), strict=True)
        ]
        states, infos = _stack([pair[0] for pair in pairs]), _stack([pair[1] for pair in pairs])
        joint = state.log_probabilities + infos.log_likelihood
        likelihood = jax.nn.logsumexp(joint)
        ok = jnp.all(infos.ok)
        log_probabilities = jnp.where(ok, joint - likelihood, state.log_probabilities)
        after = InteractingState(states, log_probabilities, state.step)
        return after, InteractingInfo(jnp.where(ok, likelihood, 0.0), ok, after.probabilities, infos)


def _moved(
    filt: InteractingMultipleModel, state: InteractingState, control: Any
) -> tuple[Bool[Array, ""], InteractingState]:
    moved = filt.move(state, control)
    return tree.all_finite(moved), moved


def _updated(
    filt: InteractingMultipleModel, state: InteractingState, measurement: Any, valid: Bool[Array, "*m"]
) -> tuple[Bool[Array, ""], tuple[InteractingState, InteractingInfo]]:
    after, info = filt.correct_by(state, measurement, valid)
    return info.ok & tree.all_finite((after, info)), (after, info)


@filter_jit
def smooth_interacting(
    filt: InteractingMultipleModel, history: History, controls: Any, *, active: Bool[Array, " t"] | None = None
) -> InteractingState:
    """Modes and states of a run given all its measurements: the IMM smoother.

    In each backward step, the likelihood of later measurements is, for each mode, the ratio of the smoothed and the
    predicted density. Each pair of modes (before, after) is smoothed with it; pairs are weighted by the transition
    matrix and the likelihood of their prediction, and pairs with the same mode before are merged.

    Args:
        filt: the filter of the run.
        history: of the run, with whole states.
        controls: those of the run.
        active: that of the run.

    Returns:
        Smoothed states, stacked along the steps.

    References:
        Helmick, Blair and Hoffman, "Fixed-interval smoothing for Markovian switching systems", IEEE TIT 1995;
        Nadarajah, Tharmarasa, McDonald and Kirubarajan, "IMM forward filtering and backward smoothing for maneuvering
        target tracking", IEEE TAES 2012 [T-6].

    Example:
        >>> import jax.numpy as jnp, jaxloc as jl
        >>> sensor = jl.filters.LinearSensor(jnp.eye(1, 2), 0.01 * jnp.eye(1))
        >>> modes = [jl.filters.KalmanFilter(jl.filters.ConstantVelocity(q, axes=1), sensor) for q in (1e-4, 10.0)]
        >>> filt = jl.filters.InteractingMultipleModel(tuple(modes), jnp.array([[0.9, 0.1], [0.1, 0.9]]))
        >>> start = filt.init(jl.beliefs.Gaussian(jnp.zeros(2), 0.01 * jnp.eye(2)))
        >>> dt, z = jnp.ones(4), jnp.array([[0.0], [0.0], [2.0], [4.0]])
        >>> _, history = jl.filters.run(filt, start, dt, z, jnp.ones(4, bool))
        >>> jl.filters.smooth_interacting(filt, history, dt).probabilities.shape
        (4, 2)
    """
    states = history.states
    mask = jnp.ones(states.step.shape[:1], bool) if active is None else active
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    after = jax.tree.map(lambda leaf: leaf[1:], (validity.finite_or_neutral(controls), mask))

    def back(smoothed, inputs):
        state, (control, here) = inputs
        earlier = _smooth_back(filt, state, control, smoothed)
        held = InteractingState(_renumber(smoothed.states, state.step), smoothed.log_probabilities, state.step)
        earlier = tree.where(here, earlier, held)
        return earlier, earlier

    _, smoothed = lax.scan(back, last, (before, after), reverse=True)
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), smoothed, last)


def _smooth_back(
    filt: InteractingMultipleModel, state: InteractingState, control: Any, smoothed: InteractingState
) -> InteractingState:
    """One step back of the smoother, over all pairs (mode before, mode after)."""
    predicted, pairs, scores = filt.predict(state, control), [], []
    for mode, expected, after in zip(filt.filters, unstack(predicted.states), unstack(smoothed.states), strict=True):
        evidence = density_ratio(expected, after)

        def pair(before, mode=mode, evidence=evidence):
            joint = mode.predict_joint(before, control)
            root, size = joint.root(), joint.output.shape[0]
            moved = GaussianState(joint.mean, root[:size, :size], before.step)
            revised, score = multiply(moved, evidence)
            return smooth_step(before, ReverseStep(joint.mean, *regression(root)), revised), score

        earlier, score = jax.vmap(pair)(state.states)
        pairs.append(earlier)
        scores.append(score)
    # [after, before]
    joint = jnp.stack(scores) + (state.log_probabilities[:, None] + log_probability(filt.transition)).T
    joint = jax.nn.log_softmax(joint, axis=1) + smoothed.log_probabilities[:, None]
    total = jax.nn.logsumexp(joint, axis=0)
    weights = jnp.exp(joint - total[None, :])
    merged = jax.vmap(mix, in_axes=(1, 1))(_stack(pairs), weights)
    return InteractingState(_renumber(merged, state.step), total, state.step)


class Evidence(eqx.Module):
    """Likelihood of later measurements: ``log p = score y - |root^T y|^2 / 2`` in the whitened state y.

    Attributes:
        center: mean and root of the prediction, which define y.
        free: directions of nonzero predicted variance.
        score, root: of the log likelihood.
    """

    center: GaussianState
    free: Bool[Array, " d"]
    score: Float[Array, " d"]
    root: Float[Array, "d d"]


def density_ratio(predicted: GaussianState, smoothed: GaussianState) -> Evidence:
    """The ratio of the smoothed and the predicted density."""
    root = predicted.covariance_sqrt
    info, scale = jnp.finfo(root.dtype), jnp.sqrt(jnp.sum(lax.stop_gradient(root) ** 2, axis=1))
    # Directions of zero variance (an acceleration held at zero) carry no information.
    free = jnp.diagonal(root) > jnp.maximum(8.0 * float(info.eps) * scale, float(info.tiny) ** 0.25)
    center = GaussianState(predicted.mean, _regularized(root, free), predicted.step)
    shift, white = _whitened(center, free, smoothed)
    eye = jnp.eye(shift.shape[0], dtype=root.dtype)
    inverse = whiten(_regularized(triangularize(white), free), eye)
    gained = product(inverse.T, inverse)
    return Evidence(center, free, product(gained, shift), cholesky(gained - eye))


def multiply(state: GaussianState, evidence: Evidence) -> tuple[GaussianState, Float[Array, ""]]:
    """The product of a density and a likelihood, normalized, and the logarithm of its mass."""
    center, known = evidence.center, evidence.root
    shift, white = _whitened(center, evidence.free, state)
    size = shift.shape[0]
    seen = product(known.T, white)
    scale = triangularize(jnp.concatenate([seen.T, jnp.eye(size, dtype=shift.dtype)], axis=1))
    slope = evidence.score - product(known, product(known.T, shift))
    step = whiten(scale, product(white.T, slope))
    root = whiten(scale, white.T).T
    mass = jnp.sum(evidence.score * shift) - 0.5 * jnp.sum(product(known.T, shift) ** 2)
    mass = mass + 0.5 * jnp.sum(step**2) - jnp.sum(jnp.log(jnp.diagonal(scale)))
    delta = product(center.covariance_sqrt, jnp.where(evidence.free, shift + product(root, step), 0.0))
    mean, root = retract_root(center.mean, delta, triangularize(product(center.covariance_sqrt, root)))
    return GaussianState(mean, root, state.step), mass


def _whitened(
    center: GaussianState, free: Bool[Array, " d"], state: GaussianState
) -> tuple[Float[Array, " d"], Float[Array, "d d"]]:
    """Mean and root of a state, whitened by the covariance of another."""
    shift, root = local(center.mean, state.mean), state.covariance_sqrt
    if not is_flat(center.mean):
        root = product(carry(state.mean, jnp.zeros_like(shift), center.mean), root)
    white = whiten(center.covariance_sqrt, jnp.concatenate([shift[:, None], root], axis=1))
    white = jnp.where(free[:, None], white, 0.0)
    return white[:, 0], white[:, 1:]


def _regularized(root: Float[Array, "d d"], free: Bool[Array, " d"]) -> Float[Array, "d d"]:
    """A root with unit, uncorrelated entries in the directions that are not free, so that it can be inverted."""
    return jnp.where(free[:, None] & free[None, :], root, jnp.eye(free.shape[0], dtype=root.dtype))


def mix(states: GaussianState, weights: Float[Array, " k"]) -> GaussianState:
    """The normal density with the mean and covariance of a mixture.

    Args:
        states: stacked along a leading axis.
        weights: they sum to one.

    Returns:
        The state, with an intrinsic mean on manifolds.
    """
    mean, deviations = intrinsic_mean(states.mean, weights)
    roots = states.covariance_sqrt
    if not is_flat(mean):
        zero = jnp.zeros(deviations.shape[1], deviations.dtype)
        roots = jax.vmap(lambda center, root: product(carry(center, zero, mean), root))(states.mean, roots)
    # The square root of a weight that underflows to zero has no derivative there.
    positive = weights > 0.0
    scale = jnp.where(positive, jnp.sqrt(jnp.where(positive, weights, 1.0)), 0.0)
    columns = jnp.concatenate([jnp.moveaxis(roots, 0, 1), deviations.T[:, :, None]], axis=2) * scale[None, :, None]
    return GaussianState(mean, triangularize(columns.reshape(columns.shape[0], -1)), states.step[0])


def log_probability(probabilities: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """Logarithm of probabilities, finite at zero."""
    return jnp.log(jnp.maximum(probabilities, float(jnp.finfo(probabilities.dtype).tiny)))


def unstack(states: GaussianState) -> list[GaussianState]:
    """The states of a stack."""
    return [jax.tree.map(lambda leaf, i=i: leaf[i], states) for i in range(states.step.shape[0])]


def _stack(items: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


def _renumber(states: GaussianState, step: Int[Array, ""]) -> GaussianState:
    numbers = jnp.broadcast_to(step[None], states.step.shape)
    return jax.vmap(GaussianState)(states.mean, states.covariance_sqrt, numbers)
