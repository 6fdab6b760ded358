# %% [markdown]
# # 3. Stereo odometry
#
# A car with two cameras drives down a street. From what both cameras see we estimate its motion from frame to
# frame, and the path that the motions add up to. The street is rendered here, so that we know the truth.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70
np.set_printoptions(precision=2, suppress=True)

# %%
street = jl.data.simulate_street(num_frames=8 if FAST else 60, seed=1)
frame = street[0]
figure, rows = plt.subplots(2, 1, figsize=(6, 4.4), dpi=55)
for axes, image, name in zip(rows, (frame.left, frame.right), ("left", "right"), strict=True):
    axes.imshow(image, cmap="gray", vmin=0, vmax=255)
    axes.set_title(name)
    axes.set_axis_off()
plt.show()

# %% [markdown]
# ## Motion from matches
#
# Start with what images give in the end: points measured as `(u_left, u_right, v)` in two frames, some of
# them wrong. Both measurements are noisy, so depth is uncertain too: near points tell about translation, far
# ones about rotation only. `estimate_motion` samples motions from three points each, refines the best under a
# robust kernel, and fits the matches that agree once more, with the covariance of every match.

# %%
drive = jl.data.simulate_stereo_points(key=jax.random.key(0), num_frames=30 if FAST else 300)
rig = jl.data.simulate.stereo_points.kitti_rig()
noise = 0.25 * jnp.eye(3)


@jax.jit
def motions(pairs, keys):
    def advance(previous, item):
        pair, key = item
        matches = jl.refinement.StereoMatches.of(pair.previous, pair.current, noise, noise, None)
        found = jl.odometry.estimate_motion(rig, matches, previous, key=key)
        return found.estimate.value, found

    return jax.lax.scan(advance, jl.poses.SE3.identity(), (pairs, keys))[1]


found = motions(drive.pairs, jax.random.split(jax.random.key(1), len(drive.truth) - 1))
rejected = float(jnp.mean(~found.inliers[~drive.pairs.is_inlier]))
print(f"all ok: {bool(found.estimate.ok.all())}; {100 * rejected:.1f} % of the wrong matches rejected")

# %% [markdown]
# Do the covariances say how wrong the motions are? The share of true motions within their own 95 % ellipsoid
# should be 0.95.

# %%
gaps = jax.vmap(lambda a, b: a.local(b))(found.estimate.value, drive.pairs.motion)
squared = jax.vmap(jl.evaluation.consistency.nees)(gaps, found.estimate.covariance)
held = jl.evaluation.consistency.coverage(squared, 6, probabilities=(0.5, 0.95))
print("within the 50 % and 95 % ellipsoids:", held)

# %% [markdown]
# The path is the chain of motions; its error grows without bound, and the metric of the KITTI benchmark gives
# it as a part of the distance.

# %%
path = jl.poses.Trajectory(drive.truth.times, jl.poses.chain(drive.truth[0], found.estimate.value))
lengths = jl.evaluation.trajectories.kitti_drift.fitting_lengths(float(drive.truth.length()))
errors = jl.evaluation.segment_errors(path, drive.truth, lengths=lengths)
print(f"drift {float(errors.translation_percent()):.2f} % over {float(drive.truth.length()):.0f} m")
jl.evaluation.plots.trajectories.draw_trajectory(path, drive.truth)

# %% [markdown]
# ## From images
#
# The pipeline does the rest: corners spread over the image, binary descriptors, matches along the row in the
# right image and around the predicted place in the next frame, refined to a fraction of a pixel with a
# covariance each. It yields one step a frame, as frames come.

# %%
steps = list(jl.pipelines.odometry.run(street, jl.pipelines.odometry.Config(), street.rig))
estimate = jl.poses.Trajectory.from_matrices(
    street.truth.times, jnp.stack([step.pose.matrix() for step in steps]).astype(street.truth.times.dtype)
)
print("frames with a measured motion:", sum(step.ok for step in steps), "of", len(steps))
print(f"drift at the end: {float(jl.evaluation.end_drift_percent(estimate, street.truth)):.2f} %")

# %%
step = steps[len(steps) // 2]
image = street[len(steps) // 2].left
figure = jl.evaluation.plots.trajectories.draw_matches(image, step.uv_previous, step.uv_current, step.inlier)
figure.set_dpi(60)
figure

# %% [markdown]
# A box that moves by itself gives matches that are good and yet disagree with the motion of the camera: they
# are rejected together with the mismatches. Each pose carries a covariance; along the path it grows.

# %%
covariances = np.stack([np.asarray(step.covariance) for step in steps])
jl.evaluation.plots.trajectories.draw_ellipses(estimate, covariances, street.truth)

# %% [markdown]
# The same from the command line, with a report: `jaxloc demo`, or `jaxloc odometry SEQUENCE` for a recording
# in KITTI layout.
#
# ## Takeaways
#
# - Errors in both frames matter: weigh each match by its own covariance, and near and far points sort
#   themselves out.
# - Consensus finds the start, a robust kernel the inliers, plain least squares the value and the covariance.
# - Odometry drifts: only seeing a known place again bounds the error.
#
# ## Next steps
#
# Read the code of `jaxloc.pipelines.odometry`, which is short, and exchange a part: another detector in
# `Config`, another kernel in `MotionOptions`. Loop closing, filters and maps are the next rooms of the house.
