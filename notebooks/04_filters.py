# %% [markdown]
# # 4. Filters
#
# A filter carries a belief through time: predict with a motion, update with a measurement. Here every filter is
# a pytree with pure steps, so that a whole recording is one `scan`, a batch of recordings one `vmap`, and the
# likelihood of the data can be differentiated by anything in the model.

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
# ## A robot among landmarks
#
# The state is a pose, the control what odometry says, the measurement a range and a bearing. Bearings are
# rotations, not numbers, so that nothing has to be wrapped; covariances live in the tangent space of the pose.

# %%
motion = jl.sensors.IncrementMotion(turn_drive=0.05, turn_turn=0.1)
deviations = jnp.array([0.1, 0.03])
simulate = jl.data.simulate.landmarks.simulate_landmarks
drive = simulate(motion, deviations, key=jax.random.key(0), num_steps=60 if FAST else 300)
sensor = jl.sensors.RangeBearingSensor(drive.landmarks, *deviations)
prior = jl.beliefs.Gaussian(jl.poses.SE2(0.0, 0.0, 0.0), 1e-2 * jnp.eye(3))


def localize(filt, drive, valid):
    _, history = jl.filters.run(filt, filt.init(prior), drive.increments, drive.readings, valid)
    return history


filt = jl.filters.ExtendedKalmanFilter(motion, sensor)
seen = localize(filt, drive, drive.valid)
blind = localize(filt, drive, jnp.zeros_like(drive.valid))
figure, axes = plt.subplots(figsize=(5, 4))
axes.plot(*drive.poses.translation.T, "k", label="truth")
axes.plot(*blind.states.mean.translation.T, "C1--", label="odometry alone")
axes.plot(*seen.states.mean.translation.T, "C0", label="filter")
axes.plot(*drive.landmarks.T, "k^")
axes.set_aspect("equal")
axes.legend()
plt.show()

# %% [markdown]
# Masks are part of every update: `valid` says which measurements there are, and non-finite numbers are masked too.
# Is the covariance consistent? The normalized error of a pose has three degrees of freedom.

# %%
distance = jax.vmap(lambda state, pose: state.gaussian().mahalanobis_squared(pose))
print("mean NEES (3 expected):", float(distance(seen.states, drive.poses).mean()))
print("mean NIS (2 expected): ", float(seen.infos.nis[drive.valid].mean()))

# %% [markdown]
# ## Learning a sensor's noise by gradient
#
# The log likelihood of all readings is a differentiable function of the model. Start with deviations that are
# wrong by a factor of three, and climb.


# %%
@jax.jit
def cost(log_deviations):
    sensor = jl.sensors.RangeBearingSensor(drive.landmarks, *jnp.exp(log_deviations))
    return -jnp.sum(localize(jl.filters.ExtendedKalmanFilter(motion, sensor), drive, drive.valid).infos.log_likelihood)


guess = jnp.log(3.0 * deviations)
slope = jax.jit(jax.value_and_grad(cost))
for _ in range(10 if FAST else 60):
    value, gradient = slope(guess)
    guess = guess - 0.05 * gradient / jnp.linalg.norm(gradient)
print("learned", np.exp(np.asarray(guess)), "true", np.asarray(deviations))

# %% [markdown]
# ## Looking back
#
# A smoother gives each state all measurements, also those after it; over a batch it is one `vmap` more.

# %%
smoothed = jl.filters.smooth(filt, seen, drive.increments)


def rmse(poses):
    gaps = poses.translation - drive.poses.translation
    return float(jnp.sqrt(jnp.mean(jnp.sum(gaps**2, axis=1))))


print(f"position error: filter {rmse(seen.states.mean):.3f} m, smoother {rmse(smoothed.mean):.3f} m")

# %% [markdown]
# ## Things that change how they move
#
# A bank of filters, one for each mode of motion, finds out when a target begins to accelerate.

# %%
dt, position = 0.1, jl.filters.LinearSensor(jnp.eye(2, 6), 0.1 * jnp.eye(2))
calm = jl.filters.KalmanFilter(jl.filters.ConstantVelocity(0.01, axes=2, padding=2), position)
wild = jl.filters.KalmanFilter(jl.filters.ConstantAcceleration(1.0, axes=2), position)
bank = jl.filters.InteractingMultipleModel((calm, wild), jnp.array([[0.98, 0.02], [0.02, 0.98]]))
rng = np.random.default_rng(3)
acceleration = np.zeros((200, 2))
acceleration[80:120] = [2.0, -1.5]
velocity = np.cumsum(acceleration * dt, axis=0) + [1.0, 0.0]
track = jnp.asarray(np.cumsum(velocity * dt, axis=0), jnp.float32)
noisy = track + np.sqrt(0.1) * jnp.asarray(rng.normal(size=track.shape), jnp.float32)
start = bank.init(jl.beliefs.Gaussian(jnp.zeros(6), jnp.eye(6)))
_, history = jl.filters.run(bank, start, jnp.full(200, dt), noisy, jnp.ones(200, bool))
figure, axes = plt.subplots(figsize=(5, 2))
axes.plot(history.infos.probabilities[:, 1])
axes.axvspan(80, 120, color="k", alpha=0.1)
axes.set(xlabel="step", ylabel="P(accelerating)")
plt.show()

# %% [markdown]
# ## Particles
#
# Where densities have several peaks, samples carry them. The textbook case: a growth model that is observed
# through a square, so that the sign is lost.


# %%
class Growth(jl.beliefs.Motion):
    def move(self, state, control):
        return 0.5 * state + 25.0 * state / (1.0 + state**2) + 8.0 * jnp.cos(1.2 * control)

    def covariance(self, state, control):
        return jnp.eye(1)


class Square(jl.beliefs.Sensor):
    def expect(self, state, measurement):
        return state**2 / 20.0

    def covariance(self, state, measurement):
        return jnp.eye(1)


def simulate_growth(key):
    def step(state, inputs):
        k, key = inputs
        moved = Growth().sample(state, k, key=key)
        return moved, (moved, moved**2 / 20.0 + jax.random.normal(jax.random.fold_in(key, 1), (1,)))

    times = jnp.arange(100.0)
    return times, *jax.lax.scan(step, jnp.array([0.1]), (times, jax.random.split(key, 100)))[1]


times, states, squares = simulate_growth(jax.random.key(0))
belief = jl.beliefs.Gaussian(jnp.zeros(1), 5.0 * jnp.eye(1))
cloud = jl.beliefs.Particles.from_gaussian(belief, 1000, key=jax.random.key(1))
everything = jnp.ones(100, bool)
particles = jl.filters.ParticleFilter(Growth(), Square())
unscented = jl.filters.SigmaPointFilter(Growth(), Square())
_, by_particles = jl.filters.run(
    particles,
    particles.init(cloud),
    times,
    squares,
    everything,
    keep=lambda state: state.particles.mean(),
    key=jax.random.key(2),
)
_, by_points = jl.filters.run(unscented, unscented.init(belief), times, squares, everything)
for name, mean in (("particles", by_particles.states), ("unscented", by_points.states.mean)):
    print(f"{name:<10} mean square error {float(jnp.mean((mean - states) ** 2)):.1f}")

# %% [markdown]
# Resampling is counting, without a search; a million particles are one array. (On several devices the particle
# axis may be sharded, with the same numbers.)

# %%
many = 10_000 if FAST else 1_000_000
cloud = jl.beliefs.Particles.from_gaussian(belief, many, key=jax.random.key(1))
_, history = jl.filters.run(
    particles,
    particles.init(cloud),
    times[:20],
    squares[:20],
    everything[:20],
    keep=lambda state: state.particles.mean(),
    key=jax.random.key(2),
)
print(f"{many:,} particles, effective at the end: {float(history.infos.ess[-1]):,.0f}")

# %% [markdown]
# ## Takeaways
#
# - One contract, `init`, `predict`, `update`, `run`: filters differ in how they carry a belief, not in how they are
#   called.
# - The Kalman family keeps square roots of covariances: they stay positive in single precision.
# - Likelihoods are differentiable, so that noise levels need not be guessed.
#
# ## Next steps
#
# Notebook 5 puts a robot into a map, and takes the map away.
