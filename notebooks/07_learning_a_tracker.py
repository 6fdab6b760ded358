# %% [markdown]
# # 7. Learning a tracker from its own measurements
#
# A tracker has parameters that are hard to know: how often a target is missed, how much clutter there is, how targets
# wander, how noisy the sensor is. The likelihood that a PHD filter predicts of each scan is differentiable, so that
# these numbers can be learned from measurements alone: without true positions, without knowing what is clutter.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70
np.set_printoptions(precision=3, suppress=True)

# %% [markdown]
# ## A model of four numbers
#
# Targets appear in the middle of a square, one a scan on average, and stay for a few scans. Numbers are free of
# bounds: the log-odds of a detection, and the logarithms of the clutter rate, of the noise of velocities (q) and of
# the deviation of a measured coordinate (r). Merging widens components, which would be taken for less noise: only
# those that are nearly the same merge.

# %%
NAMES = ("detection", "clutter rate", "q", "r")
SURVIVAL, BIRTHS, HALF, SLOTS, ROOM = 0.85, 1.0, 40.0, 16, 36
truth = jnp.array([0.95, 6.0, 1.0, 1.0])
guess = jnp.array([0.7, 12.0, 2.0, 0.5])
births = jl.beliefs.Mixture(jnp.array([BIRTHS]), jnp.zeros((1, 4)), jnp.diag(jnp.array([225.0, 225.0, 1.0, 1.0]))[None])


def to_free(values):
    return jnp.concatenate([jnp.log(values[:1] / (1.0 - values[:1])), jnp.log(values[1:])])


def from_free(free):
    return jnp.concatenate([jax.nn.sigmoid(free[:1]), jnp.exp(free[1:])])


def make_tracker(values):
    detection, rate, q, r = values
    filt = jl.filters.KalmanFilter(
        jl.filters.ConstantVelocity(q), jl.filters.LinearSensor(jnp.eye(2, 4), r**2 * jnp.eye(2))
    )
    model = jl.tracking.TargetModel(
        filt,
        detection=detection,
        survival=SURVIVAL,
        clutter=jl.tracking.UniformClutter(rate, 4.0 * HALF**2),
        birth=jl.tracking.StaticBirth(births),
    )
    return jl.tracking.GmPhd(model, capacity=30, candidates=60, closeness=jl.beliefs.MahalanobisDistance(0.5))


# %% [markdown]
# ## Drives by the true numbers


# %%
def simulate(key, scans):
    detection, rate, q, r = truth
    motion = jl.filters.ConstantVelocity(q)

    def scan(carried, key):
        states, alive = carried
        keys = jax.random.split(key, 8)
        move = jax.vmap(lambda state, key: motion.sample(state, jnp.array(1.0), key=key))
        states = move(states, jax.random.split(keys[0], SLOTS))
        alive = alive & (jax.random.uniform(keys[1], (SLOTS,)) < SURVIVAL)
        new = ~alive & (jnp.cumsum(~alive) <= jax.random.poisson(keys[2], BIRTHS))
        first = jax.random.normal(keys[3], (SLOTS, 4)) * jnp.sqrt(jnp.diagonal(births.covariances[0]))[None]
        states, alive = jnp.where(new[:, None], first, states), alive | new
        own = states[:, :2] + r * jax.random.normal(keys[4], (SLOTS, 2))
        seen = alive & (jax.random.uniform(keys[5], (SLOTS,)) < detection)
        false = jax.random.uniform(keys[6], (ROOM - SLOTS, 2), minval=-HALF, maxval=HALF)
        there = jnp.arange(ROOM - SLOTS) < jax.random.poisson(keys[7], rate)
        return (states, alive), (jnp.concatenate([own, false]), jnp.concatenate([seen, there]))

    empty = jnp.zeros((SLOTS, 4)), jnp.zeros(SLOTS, bool)
    return jax.lax.scan(scan, empty, jax.random.split(key, scans))[1]


drives, scans = (4, 8) if FAST else (24, 15)
measurements, valid = jax.vmap(lambda key: simulate(key, scans))(jax.random.split(jax.random.key(0), drives))
figure, axes = plt.subplots(1, 4, figsize=(9, 2.4), sharey=True)
for number, axis in enumerate(axes):
    axis.plot(*measurements[0, number + 4][valid[0, number + 4]].T, "k.")
    axis.set(title=f"scan {number + 4}", xlim=(-HALF, HALF), ylim=(-HALF, HALF))
    axis.set_aspect("equal")
plt.show()

# %% [markdown]
# Which of these are targets? It cannot be seen in the plot, and need not be given.
#
# ## The likelihood, and its gradient


# %%
def cost(free):
    tracker = make_tracker(from_free(free))
    state = tracker.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))

    def one(z, v):
        history = jl.filters.run(tracker, state, jnp.ones(scans), z, v, keep=lambda state: None)[1]
        return jnp.sum(history.infos.log_likelihood)

    return -jnp.sum(jax.vmap(one)(measurements, valid)) / jnp.sum(valid)


slope = jax.jit(jax.value_and_grad(cost))
value, gradient = slope(to_free(guess))
for name, part in zip(NAMES, np.asarray(gradient), strict=True):
    print(f"{name:<13} {part:+.3f}")

# %% [markdown]
# ## Climbing
#
# Adam, from numbers that are wrong by a factor of two.

# %%
steps = 4 if FAST else 30
free, first, second, path, costs = to_free(guess), jnp.zeros(4), jnp.zeros(4), [guess], []
for step in range(1, steps + 1):
    value, gradient = slope(free)
    first, second = 0.9 * first + 0.1 * gradient, 0.99 * second + 0.01 * gradient**2
    size = 0.125 * (1.0 + np.cos(np.pi * step / steps))
    free = free - size * (first / (1 - 0.9**step)) / (jnp.sqrt(second / (1 - 0.99**step)) + 1e-8)
    path.append(from_free(free))
    costs.append(float(value))

path = np.stack(path)
figure, axes = plt.subplots(figsize=(6, 3))
for k, name in enumerate(NAMES):
    axes.semilogy(path[:, k] / float(truth[k]), label=name)
axes.axhline(1.0, color="k", linewidth=0.5)
axes.set(xlabel="step", ylabel="learned / true")
axes.legend()
plt.show()
print("learned", path[-1])
print("true   ", np.asarray(truth))
print(f"cost {costs[0]:.3f} -> {costs[-1]:.3f}; at the truth {float(cost(to_free(truth))):.3f}")

# %% [markdown]
# ## What it is not
#
# The likelihood is that of the filter, not of the world. A PHD filter takes the number of targets for a Poisson
# variable, and nearly forgets a target that it misses once: where targets stay for long, it explains their return by
# too small a detection probability. Here they stay for a few scans and appear as a Poisson process, so that little of
# that bias is left.
#
# ## Takeaways
#
# - `run` returns a predictive log-likelihood for every scan, and it is differentiable in everything in the model.
# - Drives are a batch: one `vmap` over them, one compiled program for the gradient.
# - Learned numbers are those that explain the data best to this filter; compare them with the physics.
#
# ## Next steps
#
# Put a detection probability that depends on the place into `TargetModel` (a `Detection` with array fields), and learn
# it in the same way.
