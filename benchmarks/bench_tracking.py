"""Trackers: OSPA on the scenarios of the PHD literature, speed beside Stone Soup, learning a tracker by gradient."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxloc as jl
from benchmarks import learning, stone_soup
from benchmarks.metric import ACCURACY, TIME, Metric, Timing, compiled, quickest, timed, versus
from jaxloc.beliefs import Mixture
from jaxloc.data.simulate.targets import LinearScenario, TargetScenario, TurningScenario, simulate_targets
from jaxloc.evaluation.targets.ospa import ospa
from jaxloc.filters import ExtendedKalmanFilter, Filter, KalmanFilter, SigmaPointFilter, Unscented, run
from jaxloc.tracking import GmCphd, GmPhd, PointBirth, StaticBirth, TargetModel, UniformClutter

_GATE = 0.999
_CASES = ("phd.clutter10", "phd.clutter50", "phd.clutter60", "phd.extended", "phd.unscented", "cphd.clutter50")


def metrics(smoke: bool) -> Iterator[Metric]:
    yield from _accuracy(*((2, 5, ("phd.clutter10",)) if smoke else (40, 100, _CASES)))
    yield from _speed(2 if smoke else 100, 1 if smoke else 5)
    yield from _crowd(1 if smoke else 5)
    yield from _conflict((25,) if smoke else (25, 50, 100, 200, 400, 800, 1600, 3200), 1 if smoke else 3)
    yield from _sets(10 if smoke else 1000, 1 if smoke else 5)
    yield from _learned(*((2, 3, 2) if smoke else (64, 15, 30)))


def model_of(scenario: TargetScenario, filt: Filter) -> TargetModel:
    """What a tracker may know of a scenario."""
    places = scenario.birth_means.shape[0]
    births = Mixture(
        scenario.birth_weights, scenario.birth_means, jnp.stack([scenario.birth_covariance] * places)
    )  # fmt: skip
    return TargetModel(
        filt,
        detection=scenario.detection,
        survival=scenario.survival,
        clutter=UniformClutter(scenario.clutter_rate, scenario.clutter_volume),
        birth=StaticBirth(births),
    )


def linear(rate: float, **room: int) -> tuple[LinearScenario, GmPhd]:
    """The linear scenario, and its filter as published: a component of weight w is ``round(w)`` targets."""
    scenario = LinearScenario(clutter_rate=rate)
    return scenario, GmPhd(
        model_of(scenario, KalmanFilter(scenario.motion, scenario.sensor)), gate=_GATE, copies=True, **room
    )


def nobody(scenario: TargetScenario) -> Mixture:
    """An empty intensity."""
    return Mixture.empty(1, scenario.starts[0])


def score(scenario: TargetScenario, tracker: Any, runs: int, scans: int) -> dict[str, np.ndarray]:
    """Means of each run."""

    def one(key):
        drive = jax.tree.map(lambda leaf: leaf[:scans], simulate_targets(scenario, key=key))
        state = tracker.init(nobody(scenario))
        found = run(tracker, state, None, drive.measurements, drive.valid, keep=tracker.extract)[1].states
        sets = (found.means[..., :2], found.valid, drive.truth[..., :2], drive.truth_valid)
        distances = jax.vmap(lambda x, v, y, w: ospa(x, v, y, w, cutoff=100.0))(*sets)
        errors = jnp.abs(jnp.sum(found.valid, axis=1) - jnp.sum(drive.truth_valid, axis=1))
        return distances.distance.mean(), distances.localization.mean(), errors.mean()

    keys = jax.random.split(jax.random.key(0), runs)
    values = jax.jit(jax.vmap(one))(keys)
    return dict(zip(("ospa", "localization", "count_error"), map(np.asarray, values), strict=True))


def _accuracy(runs: int, scans: int, chosen: tuple[str, ...]) -> Iterator[Metric]:
    turning = TurningScenario()
    filters = {
        "extended": ExtendedKalmanFilter(turning.motion, turning.sensor),
        "unscented": SigmaPointFilter(turning.motion, turning.sensor, Unscented(alpha=1.0, beta=2.0, kappa=2.0)),
    }
    crowded, phd = linear(50.0)
    cases = {f"phd.clutter{rate}": linear(float(rate)) for rate in (10, 50, 60)}
    cases |= {f"phd.{name}": (turning, GmPhd(model_of(turning, filt), copies=True)) for name, filt in filters.items()}
    cases["cphd.clutter50"] = (crowded, GmCphd(phd, max_targets=30))
    for name in chosen:
        scenario, tracker = cases[name]
        found = score(scenario, tracker, runs, scans)
        error = found["ospa"].std() / np.sqrt(runs)
        yield Metric(f"tracking.{name}.ospa", float(found["ospa"].mean()), "m", "lower", ACCURACY)
        yield Metric(f"tracking.{name}.ospa_standard_error", float(error), "m")
        yield Metric(f"tracking.{name}.localization", float(found["localization"].mean()), "m")
        yield Metric(f"tracking.{name}.count_error", float(found["count_error"].mean()), "targets", "lower", ACCURACY)


def _pass(tracker: Any, state: Any, measurements: Any, valid: Any) -> Any:
    return run(tracker, state, None, measurements, valid, keep=tracker.extract)


def _speed(peer_scans: int, repeats: int) -> Iterator[Metric]:
    scenario, phd = linear(60.0, capacity=64, candidates=100)
    drive = simulate_targets(scenario, key=jax.random.key(0))
    for name, tracker in (("phd", phd), ("cphd", GmCphd(phd))):
        arguments = (tracker, tracker.init(nobody(scenario)), drive.measurements, drive.valid)
        program, took = compiled(_pass, *arguments)
        spent = quickest(lambda: program(*arguments), repeats)  # noqa: B023
        yield Metric(f"tracking.{name}.scans_a_second", scenario.num_scans / spent.wall, "scans/s", "higher", TIME)
        yield Metric(f"tracking.{name}.compile", took.wall, "s", "lower", TIME)
        if name == "phd":
            lost = program(*arguments)[1].infos.crowded.sum()
            yield Metric("tracking.phd.crowded", int(lost), "components without room", "lower", ACCURACY)
            ours = Timing(spent.wall / scenario.num_scans, spent.cpu / scenario.num_scans)
    scans = [np.asarray(z[v], float) for z, v in zip(drive.measurements, drive.valid, strict=True)][:peer_scans]
    _, took = timed(lambda: stone_soup.run(scenario, scans))
    yield Metric("tracking.stone_soup.scans_a_second", peer_scans / took.wall, "scans/s", "higher")
    yield from versus("tracking.phd.stone_soup", ours, Timing(took.wall / peer_scans, took.cpu / peer_scans))

    drives = jax.vmap(lambda key: simulate_targets(scenario, key=key))(jax.random.split(jax.random.key(1), 16))
    state = phd.init(nobody(scenario))
    program, _ = compiled(jax.vmap(lambda z, v: _pass(phd, state, z, v)), drives.measurements, drives.valid)
    spent = quickest(lambda: program(drives.measurements, drives.valid), min(repeats, 3))
    total = 16 * scenario.num_scans / spent.wall
    yield Metric("tracking.phd.batch16.scans_a_second", total, "scans/s", "higher", TIME)


def _field(count: int, seen: int, capacity: int, scans: int) -> tuple[GmPhd, Any, Any, Any]:
    """Targets on a square lattice 60 m apart, that stay, among clutter; their intensity is known to begin with."""
    rng, side = np.random.default_rng(0), int(np.ceil(np.sqrt(count)))
    volume = (60.0 * side) ** 2
    where = 60.0 * (0.5 + np.stack(np.meshgrid(*[np.arange(side)] * 2), -1).reshape(-1, 2)[:count])
    own = where + rng.normal(scale=5.0, size=(scans, count, 2))
    false = rng.uniform(0.0, 60.0 * side, size=(scans, seen - count, 2))
    filt = KalmanFilter(
        LinearScenario(acceleration=1.0).motion, jl.filters.LinearSensor(jnp.eye(2, 4), 25.0 * jnp.eye(2))
    )
    model = TargetModel(
        filt,
        detection=0.98,
        survival=0.99,
        clutter=UniformClutter(float(max(seen - count, 1)), volume),
        birth=PointBirth(0.1, volume, 25.0 * jnp.eye(2), jnp.full(2, 25.0)),
    )
    phd = GmPhd(model, capacity=capacity, gate=_GATE)
    means = jnp.asarray(np.pad(where, ((0, 0), (0, 2))), jnp.float32)
    state = phd.init(Mixture(jnp.ones(count), means, jnp.stack([25.0 * jnp.eye(4)] * count)))
    measurements = jnp.asarray(np.concatenate([own, false], axis=1), jnp.float32)
    return phd, state, measurements, jnp.ones((scans, seen), bool)


def _crowd(repeats: int) -> Iterator[Metric]:
    arguments = _field(100, 116, 256, 20)
    program, _ = compiled(_pass, *arguments)
    spent = quickest(lambda: program(*arguments), repeats)
    yield Metric("tracking.phd.hundred.scans_a_second", 20 / spent.wall, "scans/s", "higher", TIME)
    count = program(*arguments)[1].infos.count[-1]
    yield Metric("tracking.phd.hundred.count", float(count), "of 100 targets", "equal", ACCURACY)


def _conflict(counts: tuple[int, ...], repeats: int, scans: int = 3) -> Iterator[Metric]:
    """Time of a scan against the number of features in it, half of them targets' (T-47)."""
    spent = []
    for count in counts:
        arguments = _field(count // 2, count, count, scans)
        program, _ = compiled(_pass, *arguments)
        took = quickest(lambda: program(*arguments), repeats)  # noqa: B023
        spent.append(took.wall / scans)
        yield Metric(f"tracking.phd.features{count}.scan", 1e3 * spent[-1], "ms", "lower", TIME)
    if spent[-1] > 0.1:
        limit = np.exp(np.interp(np.log(0.1), np.log(spent), np.log(counts)))
        yield Metric("tracking.phd.features_at_10_hz", float(limit), "features", "higher", TIME)


def _sets(pairs: int, repeats: int) -> Iterator[Metric]:
    rng = np.random.default_rng(0)
    costs = jnp.asarray(rng.uniform(size=(20, 20)), jnp.float32)
    everything = jnp.ones((20, 20), bool)
    spent = quickest(lambda: jl.solvers.assign(costs, everything), 20 * repeats)
    yield Metric("tracking.assign20", 1e6 * spent.wall, "us", "lower", TIME)
    x, y = (jnp.asarray(rng.normal(scale=50.0, size=(pairs, 20, 2)), jnp.float32) for _ in range(2))
    there = jnp.ones((pairs, 20), bool)
    many = eqx.filter_jit(jax.vmap(lambda x, v, y, w: ospa(x, v, y, w, cutoff=100.0).distance))
    spent = quickest(lambda: many(x, there, y, there), repeats)
    yield Metric(f"tracking.ospa{pairs}", 1e3 * spent.wall, "ms", "lower", TIME)


def _learned(drives: int, scans: int, steps: int) -> Iterator[Metric]:
    """Each parameter over the truth, from starts that are wrong by a factor of two."""
    data = jax.jit(jax.vmap(lambda key: learning.simulate(key, scans)))(jax.random.split(jax.random.key(0), drives))
    found = learning.Parameters.of(learning.learn(data, steps)[-1])
    for name in ("detection", "clutter_rate", "acceleration", "deviation"):
        ratio = float(getattr(found, name) / getattr(learning.truth(), name))
        yield Metric(f"tracking.learned.{name}", ratio, "of the truth", "equal", ACCURACY)
