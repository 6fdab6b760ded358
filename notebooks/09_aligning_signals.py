# %% [markdown]
# # 9. Aligning signals
#
# There are two ways from images to a pose: match signals, or match features. This notebook takes the first: a
# template is laid upon an image until their gray levels agree. Lucas and Kanade did it with derivatives in 1981; Baker
# and Matthews sorted all the ways to do so in 2004, and measured them. We repeat their experiment, and go on from it.

# %%
import os
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jaxloc as jl
from jaxloc.alignment import klt, multi_start, mutual_information
from jaxloc.alignment import lucas_kanade as lk

sys.path.insert(0, str(next(p for p in (Path.cwd(), Path.cwd().parent) if (p / "benchmarks").is_dir())))
from benchmarks import baker_matthews as protocol

FAST = "JAXLOC_FAST" in os.environ
plt.rcParams["figure.dpi"] = 70

# %% [markdown]
# ## How far away may a start be?
#
# A template of 100 x 100 pixels is cut from an image under a random affine warp: three points are moved by noise of
# sigma pixels. The search starts at the unmoved place. It has converged when its points end within one pixel. The
# authors' image and random numbers are used where they are at hand, else an image made of noise.


# %%
def made_of_noise(seed=0, shape=(225, 150)):
    rng = np.random.default_rng(seed)
    v, u = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.fftfreq(shape[1]), indexing="ij")
    picture = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) / np.maximum(np.hypot(u, v), 0.02) ** 1.3).real
    return np.float32(120 + 45 * (picture - picture.mean()) / picture.std())


count = 30 if FAST else 300
if protocol.RECORDINGS.is_dir():
    scene, offsets, name = protocol.recorded("takeo"), protocol.offsets(count, 3), "Takeo, the authors' image"
else:
    scene = protocol.Scene(made_of_noise(), (30, 70), (100, 100))
    offsets, name = np.float32(np.random.default_rng(1).normal(size=(count, 3, 2))), "an image made of noise"

sigmas = (2, 6, 10) if FAST else (1, 2, 4, 6, 8, 10)
curves = {
    "inverse compositional": protocol.steps(14),
    "forwards additive": protocol.steps(14, formulation=lk.ForwardsAdditive()),
    "Newton": protocol.steps(14, descent=lk.NewtonStep()),
    "Newton, turned round": protocol.steps(14, descent=lk.NewtonStep(-1.0)),
    "diagonal, in pixels": protocol.steps(14, descent=lk.DiagonalStep(), normalized=False),
    "steepest, in pixels": protocol.steps(14, descent=lk.SteepestDescentStep(), normalized=False),
    "steepest, normalized": protocol.steps(14, descent=lk.SteepestDescentStep()),
    "blurred by 4, 2, 0 px": protocol.steps(14, scales=lk.Blurred((4.0, 2.0, 0.0))),
}
if FAST:  # each is a program of its own to compile
    curves = {label: curves[label] for label in ("inverse compositional", "blurred by 4, 2, 0 px")}
figure, axes = plt.subplots(figsize=(7, 4))
for label, method in curves.items():
    share = [100 * np.mean(protocol.errors(scene, offsets, method, s) <= 1) for s in sigmas]
    axes.plot(sigmas, share, "o-", label=label, markersize=3)
    print(f"{label:<24}", *(f"{x:6.1f}" for x in share))
axes.set(xlabel="sigma of the points [px]", ylabel="converged [%]", title=name)
axes.legend(fontsize=8)
plt.show()

# %% [markdown]
# The formulations of Gauss-Newton are one curve, as the paper proves. Newton's Hessian is right only next to the
# answer; the paper's curve for it, which is better, is met when its second-order part is turned round. Steepest descent
# fails in the paper's coordinates, pixels from the corner; in units of the template it does as well as Gauss-Newton.
# And smoothing, which the paper left out, does more than any choice between them.

# %% [markdown]
# ## Exposure
#
# A camera changes its gain when the scene changes. With gain and bias eliminated in closed form, the warp does not
# notice. What comes out is an `Estimate`: a warp with a covariance, and an `ok` that means what it says.

# %%
image = jnp.asarray(made_of_noise(2, (240, 320)))
truth = jl.images.Homography.exp(jnp.array([92.4, 61.3, 0.08, 0.05, -0.03, 0.02, 2e-4, -1e-4]))
u, v = jnp.meshgrid(jnp.arange(100.0), jnp.arange(100.0))
places = truth.apply(jnp.stack([u.reshape(-1), v.reshape(-1)], axis=1))
template = jl.images.interpolation.sample(image, places, method=jl.images.Bicubic()).values.reshape(100, 100)
start = jl.images.Translation(jnp.array([90.0, 63.0]))
corners = jnp.array([[0.0, 0.0], [99.0, 0.0], [99.0, 99.0], [0.0, 99.0]])
noise = 2.0 * jax.random.normal(jax.random.key(0), image.shape)

for label, brightness in {"unchanged": lk.Unchanged(), "gain and bias": lk.GainBias()}.items():
    fit = lk.align(
        0.6 * image + 30 + noise, template, jl.images.Homography, start, method=lk.LucasKanade(brightness=brightness)
    )
    apart = jnp.linalg.norm(fit.value.apply(corners) - truth.apply(corners), axis=1)
    sigma = jnp.sqrt(jnp.diagonal(fit.covariance)[:2])
    print(
        f"{label:<14} ok {bool(fit.ok)!s:<5} corners off by {float(apart.mean()):.3f} px, sigma of the shift {sigma} px"
    )

# %% [markdown]
# ## From anywhere
#
# Many starts are cheap on a small image: 49 of them are aligned at the coarsest level, in one batch, and the best
# four to the end.

# %%
seeds = multi_start.translations_around(jnp.array([110.0, 70.0]), spacing=14.0, count=7)
for label, run in {
    "one start, 20 px off": lambda: lk.align(
        image, template, jl.images.Homography, jl.images.Translation(jnp.array([110.0, 70.0]))
    ),
    "49 starts": lambda: multi_start.align(image, template, jl.images.Homography, seeds),
}.items():
    fit = jax.block_until_ready(run())
    began = time.perf_counter()
    jax.block_until_ready(run())
    spent = 1e3 * (time.perf_counter() - began)
    apart = jnp.linalg.norm(fit.value.apply(corners) - truth.apply(corners), axis=1)
    print(f"{label:<22} ok {bool(fit.ok)!s:<5} off by {float(apart.mean()):8.3f} px, {spent:.0f} ms")

# %% [markdown]
# ## Images of another kind
#
# Where dark has become bright, neither differences nor correlations help. Mutual information only asks that one image
# is informative about the other.

# %%
inverted = 255.0 * (1.0 - jnp.clip(image, 0, 255) / 255.0) ** 1.5
near = jl.images.Translation(jnp.array([91.0, 62.5]))
for label, align in {"gain and bias": lk.align, "mutual information": mutual_information.align}.items():
    fit = align(inverted, template, jl.images.Homography, near)
    apart = jnp.linalg.norm(fit.value.apply(corners) - truth.apply(corners), axis=1)
    print(f"{label:<20} ok {bool(fit.ok)!s:<5} corners off by {float(apart.mean()):.2f} px")

# %% [markdown]
# ## Thousands of small templates
#
# A tracker aligns a small patch around each of many points. Its gain is held near that of the whole image: a free
# gain would let a patch match anything flat.

# %%
current = 0.7 * jnp.asarray(jnp.roll(image, (2, 3), (0, 1))) + 20
points = jax.random.uniform(jax.random.key(1), (400, 2), minval=20.0, maxval=jnp.array([300.0, 220.0]))
found = klt.track(image, current, points)
off = jnp.linalg.norm(found.points - points - jnp.array([3.0, 2.0]), axis=1)
print(f"{float(found.ok.mean()):.0%} tracked, median error {float(jnp.median(off[found.ok])):.3f} px")

# %% [markdown]
# ## Derivatives
#
# The aligned warp has derivatives by every pixel of both images: those of the solution, not of the iterations.


# %%
def first_column(template):
    return lk.align(image, template, jl.images.Homography, start).value.apply(corners)[0, 0]


slope = jax.grad(first_column)(template)
figure, axes = plt.subplots(1, 2, figsize=(7, 3))
axes[0].imshow(template, cmap="gray")
axes[1].imshow(slope, cmap="seismic", vmin=-float(jnp.abs(slope).max()), vmax=float(jnp.abs(slope).max()))
for panel, title in zip(axes, ("template", "what moves its first corner right"), strict=True):
    panel.set_title(title)
    panel.axis("off")
plt.show()

# %% [markdown]
# ## Takeaways
#
# - All formulations of Gauss-Newton converge alike; the inverse ones cost least. Scales matter more than either.
# - Gain and bias belong into the model, not into a step before it.
# - A batch of coarse starts costs a few fine ones.
# - The covariance carries the noise of both images; it does not know about a warp that is too simple for its scene.
#
# ## Next steps
#
# `alignment.plane_pose` aligns a whole camera pose with a map image; `alignment.correlation` and `alignment.phase` find
# the start when there is none.
