# %% [markdown]
# # 6. Many targets at once
#
# A PHD filter does not ask which measurement is of which target. It carries the expected number of targets
# anywhere, as a sum of weighted normals: each is moved, each is updated by each measurement, and the weights say
# what was likely. Pruning and merging keep the sum short.

# %%
import os
import time

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## The scene
#
# Twelve targets on straight lines, of which up to ten are there at a time, are measured with 98 % probability, with
# noise of 10 m, among 60 false measurements in each scan. This is the scenario on which such filters are compared.

# %%
scenario = jl.data.simulate.targets.LinearScenario(clutter_rate=60.0)
drive = jl.data.simulate.targets.simulate_targets(scenario, key=jax.random.key(0))
figure, axes = plt.subplots(figsize=(5, 5))
axes.plot(*drive.measurements[drive.valid].T, ".", color="0.8", markersize=2, rasterized=True)
for k in range(12):
    axes.plot(*drive.truth[drive.truth_valid[:, k], k, :2].T, "k", linewidth=1)
axes.set(xlabel="x [m]", ylabel="y [m]", title="all scans on top of each other")
axes.set_aspect("equal")
plt.show()

# %% [markdown]
# ## The filter
#
# What targets do and what a sensor sees of them is one record, shared by all trackers. Capacities are fixed and
# measurements padded, so that a whole recording is one compiled scan.


# %%
def make_tracker(scenario, **options):
    births = jl.beliefs.Mixture(
        scenario.birth_weights, scenario.birth_means, jnp.stack([scenario.birth_covariance] * 4)
    )
    model = jl.tracking.TargetModel(
        jl.filters.KalmanFilter(scenario.motion, scenario.sensor),
        detection=scenario.detection,
        survival=scenario.survival,
        clutter=jl.tracking.UniformClutter(scenario.clutter_rate, scenario.clutter_volume),
        birth=jl.tracking.StaticBirth(births),
    )
    return jl.tracking.GmPhd(model, capacity=100, gate=0.999, **options)


phd = make_tracker(scenario)
start = phd.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))


def track(tracker, state, measurements, valid):
    return jl.filters.run(tracker, state, None, measurements, valid, keep=tracker.extract)[1]


history = track(phd, start, drive.measurements, drive.valid)
begun = time.perf_counter()
jax.block_until_ready(track(phd, start, drive.measurements, drive.valid))
print(f"{100 / (time.perf_counter() - begun):,.0f} scans a second; crowded out: {int(history.infos.crowded.max())}")

# %% [markdown]
# Components carry the number of their track, so that targets have identities: a color is a number.

# %%
found = history.states
figure, axes = plt.subplots(figsize=(5, 5))
axes.scatter(*found.means[found.valid][:, :2].T, c=found.labels[found.valid] % 20, cmap="tab20", s=4, rasterized=True)
axes.set(xlabel="x [m]", ylabel="y [m]", title="extracted targets")
axes.set_aspect("equal")
plt.show()

# %% [markdown]
# ## How good is it?
#
# The OSPA distance of two sets is the error of a target on average, where a missing or a false one costs 100 m.


# %%
def score(found, drive):
    sets = (found.means[..., :2], found.valid, drive.truth[..., :2], drive.truth_valid)
    return jax.vmap(lambda x, v, y, w: jl.evaluation.targets.ospa(x, v, y, w, cutoff=100.0))(*sets)


ospa = score(found, drive)
figure, axes = plt.subplots(2, 1, figsize=(6, 4), sharex=True)
axes[0].plot(ospa.distance, label="OSPA")
axes[0].plot(ospa.localization, label="localization")
axes[0].set_ylabel("[m]")
axes[0].legend()
axes[1].plot(drive.truth_valid.sum(1), "k", label="truth")
axes[1].plot(history.infos.count, label="expected number")
axes[1].set(xlabel="scan", ylabel="targets")
axes[1].legend()
plt.show()
print(f"mean OSPA {float(ospa.distance.mean()):.1f} m (about 21 m over many runs)")

# %% [markdown]
# Many runs are one `vmap`: the reduction has no loop over components, so that it batches.

# %%
keys = jax.random.split(jax.random.key(1), 2 if FAST else 16)


@jax.jit
@jax.vmap
def mean_score(key):
    drive = jl.data.simulate.targets.simulate_targets(scenario, key=key)
    return score(track(phd, start, drive.measurements, drive.valid).states, drive).distance.mean()


scores = np.asarray(mean_score(keys))
print(f"{len(keys)} runs: {scores.mean():.1f} m, standard error {scores.std() / len(keys) ** 0.5:.1f} m")

# %% [markdown]
# ## A spooky effect
#
# Two targets a kilometer apart, and one is missed. The PHD filter nearly forgets it. The CPHD filter carries the
# distribution of the number of targets as well, and knows that there are two; but it gives the weight that is
# missing to both, however far away the other is.

# %%
far = jl.beliefs.Mixture(
    jnp.ones(2), jnp.array([[0.0, 0, 0, 0], [1000.0, 0, 0, 0]]), jnp.stack([100.0 * jnp.eye(4)] * 2)
)
seen, there = jnp.array([[5.0, 0.0]]), jnp.array([True])
after, _ = phd.update(phd.init(far), seen, there)
cphd = jl.tracking.GmCphd(phd)
state = cphd.init(far)
certain = jl.tracking.CphdState(state.mixture, jnp.zeros(31).at[2].set(1.0), state.step, state.num_labels)
spooky, _ = cphd.update(certain, seen, there)
for name, mixture in (("PHD", after.mixture), ("CPHD", spooky.mixture)):
    missed = mixture.means[:, 0] > 500.0
    here, away = (float(jnp.sum(jnp.where(mask, mixture.weights, 0.0))) for mask in (~missed, missed))
    print(f"{name:<5} measured one {here:.2f}, missed one {away:.2f}")

# %% [markdown]
# ## Where targets come from, and how much is clutter
#
# Without a map of births, targets are born with the measurements that no target explains; and a clutter rate that is
# not known can be followed.

# %%
model = phd.model
anywhere = jl.tracking.PointBirth(0.2, scenario.clutter_volume, 100.0 * jnp.eye(2), jnp.array([100.0, 100.0]))
blind = jl.tracking.TargetModel(
    model.filter,
    detection=model.detection,
    survival=model.survival,
    clutter=jl.tracking.UniformClutter(30.0, scenario.clutter_volume),  # half of what it is
    birth=anywhere,
)
adaptive = jl.tracking.GmPhd(blind, capacity=150, gate=0.999, clutter_memory=20.0)
begin = adaptive.init(jl.beliefs.Mixture.empty(1, jnp.zeros(4)))
end, learned = jl.filters.run(adaptive, begin, None, drive.measurements, drive.valid, keep=adaptive.extract)
print(f"clutter rate {30.0 * float(end.clutter_scale):.0f} (true: 60)")
print(f"mean OSPA without knowing where targets appear: {float(score(learned.states, drive).distance.mean()):.1f} m")

# %% [markdown]
# ## Takeaways
#
# - No association: every component meets every measurement, and weights decide.
# - Capacities are fixed, and what finds no room is counted: `info.crowded` is never silent.
# - A PHD filter forgets what it misses; a CPHD filter counts better, and misplaces what it misses.
#
# ## Next steps
#
# Notebook 7 learns the parameters of such a tracker from its own measurements.
