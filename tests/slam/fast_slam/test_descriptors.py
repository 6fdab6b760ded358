"""FastSLAM by descriptors: association against a loop in NumPy, worlds of look-alikes, bad numbers, gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxloc.beliefs import Gaussian
from jaxloc.filters import run
from jaxloc.poses import SE2, SO2
from jaxloc.sensors import DescribedReading, Increment, IncrementMotion, RangeBearing
from jaxloc.slam.fast_slam import (
    Appearance,
    Appearances,
    BlockProposal,
    Candidates,
    DescriptorFastSlam,
    FastSlam,
    Landmarks,
    MeasurementProposal,
    associate,
)

DEVIATIONS = (0.1, 0.03)
GATE = 13.815510557964274  # chi-square quantile of 0.999 with two degrees of freedom
CAPACITY, KINDS, LENGTH, STEPS = 40, 4, 6, 160


def motion():
    return IncrementMotion(drive=0.02, side=0.01, turn_drive=0.002, turn_turn=0.005)


def slam(num_particles=50, capacity=CAPACITY, proposal=MeasurementProposal()):
    return FastSlam(motion(), *DEVIATIONS, num_particles=num_particles, capacity=capacity, proposal=proposal)


def start():
    return Gaussian(SE2(0.0, 0.0, 0.0), 1e-12 * jnp.eye(3))


def reading(distance, bearing, descriptor, number=-1):
    where = RangeBearing(jnp.asarray(distance, float), SO2.from_angle(jnp.asarray(bearing, float)), jnp.array(number))
    return DescribedReading(where, jnp.asarray(descriptor, float))


def associate_in_numpy(seen, residuals, spreads, alike, log_ratios, log_new, free):
    """One particle: the row that maximizes the joint density, by a loop."""
    best, score = -1, -np.inf
    for j in range(len(seen)):
        squared = residuals[j] @ np.linalg.inv(spreads[j]) @ residuals[j]
        if seen[j] and alike[j] and squared <= GATE:
            log_density = -0.5 * squared - 0.5 * np.log(np.linalg.det(2.0 * np.pi * spreads[j])) + log_ratios[j]
            if log_density > score:
                best, score = j, log_density
    if best >= 0 and score >= log_new:
        return best, False
    unused = [j for j in range(len(seen)) if not seen[j]]
    return (free if free >= 0 else unused[0] if unused else len(seen)), True


def test_association_is_that_of_a_loop(x64, rng):
    """Particles with maps of their own, descriptors shared: rows and novelty as a plain loop finds them."""
    particles, k, trials = 12, 6, 60
    solve = jax.jit(jax.vmap(associate, in_axes=(0, 0, 0, None, None)))
    chosen = []
    for trial in range(trials):
        seen = rng.uniform(size=(particles, k)) < (1.0 if trial % 10 == 0 else 0.8)
        residuals = rng.normal(size=(particles, k, 2)) * rng.choice([0.05, 0.3], size=(particles, k, 1))
        roots = np.tril(0.1 * rng.normal(size=(particles, k, 2, 2))) + 0.1 * np.eye(2)
        spreads = roots @ roots.swapaxes(-1, -2) + 1e-4 * np.eye(2)
        descriptors, descriptor = rng.normal(size=(k, 3)), rng.normal(size=3)
        distances = np.linalg.norm(descriptors - descriptor, axis=1)
        alike, log_ratios = Appearance(0.7, reach=2.0).compare(jnp.asarray(descriptors), jnp.asarray(descriptor))
        np.testing.assert_array_equal(alike, distances <= 2.0)
        np.testing.assert_allclose(log_ratios, np.where(distances <= 2.0, -0.5 * (distances / 0.7) ** 2, 0.0))
        log_new, free = rng.uniform(-4.0, 3.0), int(rng.integers(-1, k + 1))
        maps = jax.vmap(Landmarks)(
            jnp.zeros((particles, k, 2)),
            jnp.zeros((particles, k, 2, 2)),
            jnp.asarray(seen),
            jnp.ones((particles, k), int),
        )
        candidates = Candidates(alike, log_ratios, jnp.asarray(log_new), jnp.asarray(free))
        found = solve(maps, jnp.asarray(residuals), jnp.asarray(spreads), jnp.array(-1), candidates)
        for i in range(particles):
            row, fresh = associate_in_numpy(
                seen[i], residuals[i], spreads[i], np.asarray(alike), np.asarray(log_ratios), log_new, free
            )
            assert (int(found.row[i]), bool(found.fresh[i])) == (row, fresh)
            chosen.append(fresh)
    assert 0.2 < np.mean(chosen) < 0.9  # both happen


class World:
    """A drive around pairs of landmarks that stand close to each other and look different, while pairs look alike."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        angles = 2.0 * np.pi * (np.arange(12) + 0.5) / 12
        offsets = rng.uniform(-3.0, 3.0, 12)
        middles = np.stack([(10.0 + offsets) * np.cos(angles), 10.0 + (10.0 + offsets) * np.sin(angles)], axis=1)
        apart = 0.2 * np.stack([np.cos(4.0 * angles), np.sin(4.0 * angles)], axis=1)
        self.landmarks = np.concatenate([middles + apart, middles - apart])
        kinds = np.concatenate([np.arange(12) % 2, 2 + np.arange(12) % 2])
        looks = np.eye(KINDS, LENGTH)[kinds] + 0.02 * rng.normal(size=(24, LENGTH))
        turn = 4.0 * np.pi / STEPS
        step = np.array([10.0 * turn, 0.0, turn])
        sigmas = np.sqrt([0.02**2 * step[0], 0.01**2 * step[0], 0.002**2 * step[0] + 0.005**2 * turn])
        pose, rows = np.zeros(3), []
        for _ in range(STEPS):
            pose = compose(compose(pose, arc(step)), sigmas * rng.normal(size=3))
            gaps = self.landmarks - pose[:2]
            near = np.flatnonzero(np.hypot(*gaps.T) < 8.0)
            number = rng.choice(near)
            distance = np.hypot(*gaps[number]) + DEVIATIONS[0] * rng.normal()
            bearing = np.arctan2(*gaps[number][::-1]) - pose[2] + DEVIATIONS[1] * rng.normal()
            rows.append((distance, bearing, number, *(looks[number] + 0.1 * rng.normal(size=LENGTH))))
        table = np.array(rows)
        self.numbers, self.kinds = table[:, 2].astype(np.int32), kinds[table[:, 2].astype(int)].astype(np.int32)
        self.range, self.bearing = jnp.asarray(table[:, 0]), jax.vmap(SO2.from_angle)(jnp.asarray(table[:, 1]))
        self.descriptors = jnp.asarray(table[:, 3:])
        ones = np.ones(STEPS)
        plan = jax.vmap(SE2)(*(jnp.asarray(ones * part) for part in arc(step)))
        self.increments = jax.vmap(Increment)(jnp.asarray(ones), plan)

    def readings(self, numbers):
        return jax.vmap(RangeBearing)(self.range, self.bearing, jnp.asarray(numbers))

    def error(self, known):
        """RMSE of the true landmarks' nearest rows, m, and how many rows there are."""
        points = np.asarray(known.means)[np.asarray(known.seen)]
        gaps = np.linalg.norm(self.landmarks[np.unique(self.numbers)][:, None] - points[None], axis=-1)
        return np.sqrt(np.mean(gaps.min(axis=1) ** 2)), len(points)


def arc(step):
    """A way and a turn, driven at once."""
    half = 0.5 * step[2]
    chord = step[0] * np.sinc(half / np.pi)
    return np.array([chord * np.cos(half), chord * np.sin(half), step[2]])


def compose(a, b):
    cos, sin = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + cos * b[0] - sin * b[1], a[1] + sin * b[0] + cos * b[1], a[2] + b[2]])


def stack(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


@pytest.fixture(scope="module")
def worlds():
    with jax.enable_x64(True):
        return [World(seed) for seed in range(16)]


@eqx.filter_jit
def follow(filt, increments, readings, keys):
    """Best maps, and the row that each particle took each reading for."""

    def one(increments, measured, key):
        valid = jnp.ones(STEPS, bool)
        end, history = run(filt, filt.init(start()), increments, measured, valid, keep=lambda s: None, key=key)
        particles = getattr(end, "slam", end)
        return jax.tree.map(lambda leaf: leaf[particles.best()], particles.maps), history.infos

    return jax.vmap(one)(increments, readings, keys)


def drive(filt, worlds, readings):
    """RMSE of the maps, m, the most rows that one has, and the row that most particles took each reading for."""
    keys = jax.random.split(jax.random.key(0), len(worlds))
    maps, infos = follow(filt, stack([world.increments for world in worlds]), stack(readings), keys)
    assert bool(infos.ok.all()) and bool(jnp.isfinite(infos.log_likelihood).all())
    found = [world.error(jax.tree.map(lambda leaf, i=i: leaf[i], maps)) for i, world in enumerate(worlds)]
    rows = np.median(np.asarray(infos.landmark), axis=-1).astype(int)
    return np.sqrt(np.mean([error**2 for error, _ in found])), max(count for _, count in found), rows


@pytest.mark.slow
def test_looks_and_places_together_do_what_neither_does_alone(worlds, x64):
    """Numbers hidden: a map nearly as good as with them, while looks alone or places alone mix landmarks up."""
    unknown = -np.ones(STEPS, np.int32)
    with_numbers, _, _ = drive(slam(), worlds, [world.readings(world.numbers) for world in worlds])
    by_place, _, _ = drive(slam(), worlds, [world.readings(unknown) for world in worlds])
    by_looks, _, _ = drive(slam(), worlds, [world.readings(world.kinds) for world in worlds])
    filt = DescriptorFastSlam(slam(), Appearance(0.35), length=LENGTH)
    described = [jax.vmap(DescribedReading)(world.readings(unknown), world.descriptors) for world in worlds]
    by_both, count, rows = drive(filt, worlds, described)
    assert by_both < 1.2 * with_numbers
    assert by_place > 1.3 * by_both and by_looks > 10.0 * by_both
    assert count <= 24 + 4  # few landmarks enter twice
    # Readings in a row of the map are of one landmark.
    pure = [
        np.bincount(world.numbers[taken == row]).max()
        for world, taken in zip(worlds, rows, strict=True)
        for row in np.unique(taken[taken >= 0])
    ]
    assert sum(pure) > 0.97 * rows.size


@pytest.mark.parametrize("proposal", [MeasurementProposal(), BlockProposal(5)])
def test_rows_are_shared_and_free_again(x64, proposal):
    """A row that no particle uses is free; descriptors are means over the readings that particles believed in."""
    filt = DescriptorFastSlam(slam(10, capacity=3, proposal=proposal), Appearance(0.5), length=2)
    state, key = filt.init(start()), jax.random.key(0)
    for looks in ([0.0, 1.0], [5.0, 0.0], [0.2, 1.2]):
        state, info = filt.update(state, reading(4.0, 0.1, looks), jnp.array(True), key=key)
        assert len(set(info.landmark.tolist())) == 1
    np.testing.assert_allclose(state.appearances.descriptors, [[0.1, 1.1], [5.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(state.appearances.readings, [2.0, 1.0, 0.0])
    # Suppose that all who believed in row 0 are gone.
    state = eqx.tree_at(lambda s: s.slam.maps.seen, state, state.slam.maps.seen.at[:, 0].set(False))
    state, info = filt.update(state, reading(4.0, 0.1, [-9.0, 9.0]), jnp.array(True), key=key)
    assert set(info.landmark.tolist()) == {0}
    np.testing.assert_allclose(state.appearances.descriptors[0], [-9.0, 9.0])


def test_a_full_map_takes_no_more(x64):
    filt = DescriptorFastSlam(slam(10, capacity=1), Appearance(0.5), length=2)
    state, key = filt.init(start()), jax.random.key(0)
    state, _ = filt.update(state, reading(4.0, 0.1, [0.0, 1.0]), jnp.array(True), key=key)
    after, info = filt.update(state, reading(4.0, 0.1, [5.0, 0.0]), jnp.array(True), key=key)
    assert set(info.landmark.tolist()) == {-1} and bool(info.ok)
    np.testing.assert_array_equal(after.appearances.descriptors, state.appearances.descriptors)


def test_new_landmarks_may_be_likelier_than_poor_matches(x64):
    """Two sigmas of place and looks from a known landmark: a new one where those are frequent."""
    for density, expected in ((1e-3, 0), (1e3, 1)):
        filt = DescriptorFastSlam(slam(10, capacity=2), Appearance(0.5, new_density=density), length=2)
        state, key = filt.init(start()), jax.random.key(0)
        state, _ = filt.update(state, reading(4.0, 0.1, [0.0, 0.0]), jnp.array(True), key=key)
        _, info = filt.update(state, reading(4.2, 0.1, [1.0, 0.0]), jnp.array(True), key=key)
        assert set(info.landmark.tolist()) == {expected}


def test_a_number_is_taken_at_its_word(x64):
    filt = DescriptorFastSlam(slam(10, capacity=3), Appearance(0.5), length=2)
    state, key = filt.init(start()), jax.random.key(0)
    state, info = filt.update(state, reading(4.0, 0.1, [0.0, 1.0], 2), jnp.array(True), key=key)
    assert set(info.landmark.tolist()) == {2}
    state, info = filt.update(state, reading(4.0, 0.1, [0.0, 1.0]), jnp.array(True), key=key)
    assert set(info.landmark.tolist()) == {2}


@pytest.mark.slow
def test_bad_numbers_change_nothing(dtype):
    filt = DescriptorFastSlam(slam(10, capacity=2), Appearance(0.5), length=2)
    state, key = filt.init(start()), jax.random.key(0)
    state, _ = filt.update(state, reading(4.0, 0.1, [0.0, 1.0]), jnp.array(True), key=key)
    huge = 2.0 * float(jnp.finfo(dtype).max) ** 0.5  # its square is none
    bad = [([jnp.nan, 0.0], 4.0, True), ([0.0, jnp.inf], 4.0, True), ([huge, 0.0], 4.0, True)]
    bad += [([0.0, 1.0], jnp.nan, True), ([0.0, 1.0], -1.0, True), ([0.0, 1.0], 4.0, False)]
    for looks, distance, valid in bad:
        after, info = filt.update(state, reading(distance, 0.1, looks), jnp.array(valid), key=key)
        assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), after, state)))
        assert float(info.log_likelihood) == 0.0 and bool(info.ok) and set(info.landmark.tolist()) == {-1}


@pytest.mark.slow
def test_the_likelihood_has_a_gradient(x64):
    """By noise, descriptors and their deviation; also where a reading is bad."""

    def log_likelihood(range_deviation, deviation, looks):
        inner = FastSlam(motion(), range_deviation, 0.03, num_particles=10, capacity=2, ess_threshold=0.0)
        filt = DescriptorFastSlam(inner, Appearance(deviation), length=2)
        first, _ = filt.update(
            filt.init(start()), reading(4.0, 0.1, [0.0, 1.0]), jnp.array(True), key=jax.random.key(0)
        )
        after, info = filt.update(first, reading(4.1, 0.1, looks), jnp.array(True), key=jax.random.key(1))
        return info.log_likelihood + 0.0 * jnp.sum(after.appearances.descriptors)

    at = (jnp.array(0.1), jnp.array(0.5), jnp.array([0.3, 0.8]))
    solve, step = jax.jit(jax.value_and_grad(log_likelihood, argnums=(0, 1, 2))), 1e-6
    found = solve(*at)[1]
    above, below = (solve(at[0], at[1] + sign * step, at[2])[0] for sign in (1.0, -1.0))
    np.testing.assert_allclose(found[1], (above - below) / (2.0 * step), rtol=1e-5)
    np.testing.assert_allclose(found[2], -(at[2] - jnp.array([0.0, 1.0])) / at[1] ** 2, rtol=1e-9)
    assert np.isfinite(found[0]) and float(found[0]) != 0.0
    bad = solve(*at[:2], jnp.array([jnp.nan, 0.0]))[1]
    assert all(bool(jnp.isfinite(part).all()) for part in bad)


def test_descriptors_blend_by_their_shares(x64):
    known = Appearances(jnp.array([[1.0], [4.0]]), jnp.array([1.0, 3.0]))
    after = known.include(jnp.array([8.0]), jnp.array([0.0, 1.0]))
    assert after.descriptors.tolist() == [[1.0], [5.0]] and after.readings.tolist() == [1.0, 4.0]


def test_a_wrong_length_is_said():
    filt = DescriptorFastSlam(slam(10, capacity=1), Appearance(0.5), length=2)
    with pytest.raises(ValueError, match="2 numbers"):
        filt.update(filt.init(start()), reading(4.0, 0.1, [1.0]), jnp.array(True), key=jax.random.key(0))
