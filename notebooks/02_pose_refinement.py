# %% [markdown]
# # 2. Pose refinement
#
# A camera sees points whose places are known. Where is it? That is the perspective-n-point problem, and the
# pattern of most of localization: **residual, solver, estimate**. We refine a pose, check that its covariance
# is consistent, survive outliers, and differentiate through the solution.

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl
from jaxloc.refinement import refine_pose

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70
np.set_printoptions(precision=2, suppress=True)

# %%
camera = jl.sensors.Pinhole(700.0, 700.0, 600.0, 180.0)
sigma = 0.5  # px
low, high = jnp.array([[-4.0, -2.0, 4.0]]), jnp.array([[4.0, 2.0, 20.0]])
points = jax.random.uniform(jax.random.key(0), (50, 3), minval=low, maxval=high)
truth = jl.poses.SE3.from_euler(jnp.array([0.3, -0.1, 0.2]), yaw=0.02, pitch=0.05, roll=-0.03)
pixels = camera.project(truth.inverse().apply(points)) + sigma * jax.random.normal(jax.random.key(6), (50, 2))

# %% [markdown]
# ## One pose
#
# We start at the identity and tell the solver how noisy a pixel is: residuals are in sigmas, so the
# covariance comes out in meters and radians without further scaling.

# %%
fit = refine_pose(camera, points, pixels, jl.poses.SE3.identity(), sigma=sigma)
print(fit.describe())
print("error (mm, mrad):", 1000 * fit.value.local(truth))
print("sigmas          :", 1000 * jnp.sqrt(jnp.diagonal(fit.covariance)))

# %% [markdown]
# `ok` says whether it is valid. Here is what happens when the data do not determine the pose: fifty points
# on one line leave the turn about it open. Nothing raises and nothing is NaN; on the host, `describe` names
# the open direction.

# %%
line = jnp.stack([jnp.zeros(50), jnp.linspace(-1.0, 1.0, 50), jnp.full(50, 6.0)], axis=1)
blind = refine_pose(camera, line, camera.project(line), jl.poses.SE3.identity(), sigma=sigma)
print(bool(blind.ok), "-", blind.describe())

# %% [markdown]
# ## A thousand poses, and a consistent covariance
#
# `jax.vmap` makes a batch of the same call. We repeat the experiment with fresh noise and look at the squared
# error in units of the covariance (NEES). If the covariance is consistent, it has a chi-square distribution with
# six degrees of freedom.


# %%
@jax.jit
def experiment(key):
    noisy = camera.project(truth.inverse().apply(points)) + sigma * jax.random.normal(key, (50, 2))
    fit = refine_pose(camera, points, noisy, jl.poses.SE3.identity(), sigma=sigma)
    return fit.gaussian().mahalanobis_squared(truth), fit.ok


trials = 200 if FAST else 2000
squared, ok = jax.vmap(experiment)(jax.random.split(jax.random.key(2), trials))
bounds = jl.evaluation.consistency.mean_bounds(6, trials)
print(f"all ok: {bool(ok.all())}; mean {float(squared.mean()):.2f}, should lie in", end=" ")
print(f"{float(bounds.lower):.2f} to {float(bounds.upper):.2f}")

axes = plt.figure(figsize=(6, 3)).add_subplot()
axes.hist(np.asarray(squared), bins=40, density=True, alpha=0.5, label="measured")
x = np.linspace(0.01, 25, 200)
axes.plot(x, x**2 * np.exp(-x / 2) / 16, label="chi-square, 6 degrees of freedom")
axes.set(xlabel="squared error over covariance", ylabel="density")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# ## Outliers
#
# Now a third of the pixels is wrong. Least squares gives them full weight; a robust kernel reduces it.
# Bounded kernels such as Geman-McClure need a start that is not too far off, so we first ask a convex one,
# Huber's.

# %%
wrong = jax.random.uniform(jax.random.key(3), (50,)) < 0.33
anywhere = jax.random.uniform(jax.random.key(4), (50, 2)) * jnp.array([[1200.0, 360.0]])
mixed = jnp.where(wrong[:, None], anywhere, pixels)
start, errors = jl.poses.SE3.identity(), {}
for name, loss in {
    "least squares": jl.solvers.Quadratic(),
    "Huber": jl.solvers.Huber(),
    "then Geman-McClure": jl.solvers.GemanMcClure(),
}.items():
    robust = refine_pose(camera, points, mixed, start, loss=loss, sigma=sigma)
    errors[name] = 1000 * float(jnp.linalg.norm(robust.value.translation - truth.translation))
    start = robust.value if name != "least squares" else start
    print(f"{name:>20}: {errors[name]:8.1f} mm, {int(robust.num_steps)} steps, ok {bool(robust.ok)}")

# %%
distances = jnp.linalg.norm(camera.project(robust.value.inverse().apply(points)) - mixed, axis=1) / sigma
weights = jl.solvers.GemanMcClure().weight(distances**2)
axes = plt.figure(figsize=(6, 3)).add_subplot()
axes.semilogx(distances[~wrong], weights[~wrong], "o", label="right")
axes.semilogx(distances[wrong], weights[wrong], "x", label="wrong")
axes.set(xlabel="residual (sigmas)", ylabel="weight at the solution")
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# With many outliers no start may be near enough. Then sample: three points give up to four poses (`p3p`), and
# the pose that most pixels agree with starts the refinement. `ransac` tries all samples at once. The
# functions that it calls are defined once, and what they need travels as data: a fresh closure in each call
# would be compiled in each call.


# %%
def poses_of_three(sample):
    found = jl.multiview.p3p(sample["rays"], sample["points"])
    return jl.solvers.Candidates(found.poses, found.valid)


def reprojection_error(camera, pose, data):
    return jnp.linalg.norm(camera.project(pose.inverse().apply(data["points"])) - data["pixels"], axis=1)


data = {"rays": camera.bearing(mixed), "points": points, "pixels": mixed}
distance = jax.tree_util.Partial(reprojection_error, camera)
options = {"sample_size": 3, "threshold": 4 * sigma, "hypotheses": 128, "key": jax.random.key(5)}
consensus = jl.solvers.ransac(data, poses_of_three, distance, **options)
final = refine_pose(camera, points, mixed, consensus.model, sigma=sigma, valid=consensus.inliers)
error = 1000 * float(jnp.linalg.norm(final.value.translation - truth.translation))
print(f"{int(consensus.inliers.sum())} of {int((~wrong).sum())} right pixels found; error {error:.1f} mm")

# %% [markdown]
# ## Through the solution
#
# What would the pose have been with another focal length? The implicit function theorem knows, from the exact
# Hessian at the solution, without unrolling the steps. We compare with really solving again.


# %%
@jax.jit
@jax.value_and_grad
def depth(focal):
    model = jl.sensors.Pinhole(focal, focal, camera.cx, camera.cy)
    return refine_pose(model, points, pixels, jl.poses.SE3.identity(), sigma=sigma).value.translation[2]


_, slope = depth(camera.fx)
again = (depth(camera.fx + 5.0)[0] - depth(camera.fx - 5.0)[0]) / 10.0
print(f"implicit function theorem: {1000 * float(slope):.3f} mm/px; solving again: {1000 * float(again):.3f} mm/px")

# %% [markdown]
# So an estimator can be a layer of something larger. Here we calibrate: we know where the camera stood, and seek the
# focal length with which the estimator says so, by Newton's method through it.

# %%
focal, curve = camera.fx - 50.0, []
for _ in range(5):
    curve.append(float(focal))
    value, slope = depth(focal)
    focal = focal - (value - truth.translation[2]) / slope
print("focal length (px):", np.array(curve))

# %% [markdown]
# ## Takeaways
#
# - A problem is a whitened residual; `refine_pose` and `solve` return an `Estimate` with covariance and `ok`.
# - Give the noise in its unit, and the covariance is consistent: check it with NEES, over many runs.
# - Robust kernels need a start nearby: a convex kernel or a consensus gives one.
# - Derivatives go through the solution, and cost one Hessian, whatever the number of steps.
#
# ## Next steps
#
# `03_stereo_odometry`: the same pieces, frame after frame, on images.
