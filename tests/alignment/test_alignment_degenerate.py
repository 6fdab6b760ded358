"""Every estimator of the room with degenerate numbers in every input: finite values and gradients, `ok` shows it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import degenerate_estimates as estimates
import jaxloc as jl
from degenerate_estimates import Case
from jaxloc.images import Translation
from jaxloc.images.gradients import smooth
from jaxloc.images.spectrum import LogPolar
from jaxloc.poses import SE3, SO3
from jaxloc.sensors import Pinhole, TexturedPlane

A = jl.alignment
RNG = np.random.default_rng(0)


def scene(u, v):
    return 120.0 + 50.0 * np.sin(0.45 * u) * np.cos(0.35 * v) + 20.0 * np.sin(0.2 * u + 0.3 * v)


V, U = np.meshgrid(np.arange(40.0), np.arange(40.0), indexing="ij")
IMAGE, TEMPLATE = scene(U, V) + RNG.normal(size=U.shape), scene(U + 7.3, V + 5.6)[:24, :24]
IMAGES = {"image": IMAGE, "template": TEMPLATE}
START = {"initial": np.array([7.0, 6.0])}


def moved(p):
    return Translation(p["initial"])


def starts(p):
    return A.multi_start.translations_around(p["initial"], spacing=3.0, count=2)


PLANE = TexturedPlane(jnp.asarray(IMAGE, jnp.float32), 0.05, SE3.identity())
SEEN_FROM = np.array([0.95, 0.95, -2.0])
PHOTO = PLANE.predict(
    Pinhole(40.0, 40.0, 19.5, 19.5), SE3(SO3.identity(), jnp.asarray(SEEN_FROM, jnp.float32)), shape=(40, 40)
).image


def plane_pose(p):
    plane = TexturedPlane(p["texture"], 0.05, SE3.identity())
    camera = Pinhole(p["focal"], p["focal"], jnp.array(19.5), jnp.array(19.5))
    start = SE3(SO3.identity(), p["initial"])
    return A.plane_pose.refine_pose(p["image"], plane, camera, start, sigma=p["sigma"], levels=1)


def tracked(p):
    options = A.klt.Klt(levels=1)
    found = A.klt.track(p["previous"], p["current"], p["points"], valid=p["valid"], options=options)
    # Where not ok, points are those that were given.
    return eqx.tree_at(lambda t: t.points, found, jnp.where(found.ok[:, None], found.points, 0.0))


WIDE_V, WIDE_U = np.meshgrid(np.arange(64.0), np.arange(64.0), indexing="ij")
TEXTURE = 100.0 * np.asarray(smooth(jax.random.normal(jax.random.key(0), (64, 64)), 1.0))
HUGE = {".*(largest|1e30)": "spectra of huge numbers overflow"}
BRIEF = A.mutual_information.MutualInformation(blurs=(1.0,), max_steps=12)
CASES = {
    "lucas_kanade.align.align": Case(
        lambda p: A.lucas_kanade.align(
            p["image"], p["template"], Translation, moved(p), weights=p["valid"], sigma=p["sigma"]
        ),
        images=IMAGES,
        sigmas={"sigma": 1.0},
        numbers=START,
    ),
    "ecc.align": Case(
        lambda p: A.ecc.align(p["image"], p["template"], Translation, moved(p), weights=p["valid"], sigma=p["sigma"]),
        images=IMAGES,
        sigmas={"sigma": 1.0},
        numbers=START,
    ),
    "multi_start.align": Case(
        lambda p: A.multi_start.align(
            p["image"], p["template"], Translation, starts(p), keep=2, weights=p["valid"], sigma=p["sigma"]
        ),
        images=IMAGES,
        sigmas={"sigma": 1.0},
        numbers=START,
    ),
    "mutual_information.align.align": Case(
        lambda p: A.mutual_information.align(
            p["image"], p["template"], Translation, moved(p), method=BRIEF, mask=p["valid"]
        ),
        images=IMAGES,
        numbers=START,
        # The information with another image may have a maximum.
        free={"template stripes"},
    ),
    "correlation.search.search": Case(
        lambda p: A.correlation.search(
            p["image"], p["template"], A.correlation.Window(p["corner"], (32, 32)), mask=p["valid"], sigma=p["sigma"]
        ),
        images=IMAGES,
        sigmas={"sigma": 1.0},
        numbers={"corner": np.array([3.0, 2.0])},
    ),
    "correlation.classify.classify": Case(
        lambda p: A.correlation.classify(p["image"], jnp.stack([p["template"], p["template"][::-1].T])),
        images=IMAGES,
        masked=False,
    ),
    "plane_pose.refine_pose": Case(
        plane_pose,
        images={"image": np.asarray(PHOTO), "texture": IMAGE},
        sigmas={"sigma": 3.0},
        numbers={"initial": SEEN_FROM + 0.02, "focal": 40.0},
        masked=False,
        # The differences from another map may have a minimum.
        free={"texture stripes"},
    ),
    "phase_correlation.translation": Case(
        lambda p: A.phase_correlation.translation(p["image"], p["current"]),
        images={"image": TEXTURE[8:56, 8:56], "current": TEXTURE[5:53, 10:58]},
        masked=False,
        left_out=HUGE,
    ),
    "phase_correlation.similarity": Case(
        lambda p: A.phase_correlation.similarity(p["image"], p["template"], sampling=LogPolar(64, 64), rounds=1),
        images={"image": TEXTURE[8:56, 8:56], "template": TEXTURE[5:53, 10:58]},
        masked=False,
        left_out=HUGE,
    ),
    "klt.track.track": Case(
        tracked,
        sets={"points": np.array([[30.0, 30.0], [25.0, 34.0], [36.0, 28.0]])},
        images={"previous": scene(WIDE_U, WIDE_V), "current": scene(WIDE_U + 1.3, WIDE_V - 0.8)},
        free={"points equal"},
    ),
}
# By the program of `track`, over a stack of images.
OTHERS = {"klt.track.track_frames", "klt.track.track_sequence"}
QUICK = {"clean", "image=nan", "template equal", "image stripes", "clean again"}

test_every_estimator_is_here, test_some_lanes, test_estimators = estimates.make_tests(
    "alignment", CASES, quick="correlation.search.search", lanes=QUICK, others=OTHERS
)
