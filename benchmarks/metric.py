"""A measured figure, and how to measure: compiling and running apart, after a warm-up, the quickest of several runs."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

REPOSITORY = Path(__file__).resolve().parent.parent

# How far a figure may fall behind the baseline: time varies between runs, accuracy hardly does.
TIME, RATIO, ACCURACY = 0.5, 0.35, 0.1

_BETTER = {"lower": -1.0, "higher": 1.0}


@dataclass(frozen=True)
class Metric:
    """A figure.

    Attributes:
        key: unique name, ``room.what``.
        value: the figure.
        unit: its unit; "x" for a ratio, a peer's time over ours.
        direction: which way is better: "lower", "higher" or "equal" (to the baseline).
        rel_tol: part of the baseline by which it may be worse; None where it is only reported.
    """

    key: str
    value: float
    unit: str
    direction: str = "lower"
    rel_tol: float | None = None

    def falls_behind(self, baseline: float) -> bool:
        """Whether the figure is worse than the baseline by more than the tolerance."""
        if self.rel_tol is None:
            return False
        if not np.isfinite(self.value):
            return True
        change = self.value - baseline
        worse = abs(change) if self.direction == "equal" else -_BETTER[self.direction] * change
        return bool(worse > self.rel_tol * abs(baseline))


class Timing(NamedTuple):
    """Seconds by the clock on the wall, and of the processor over all threads."""

    wall: float
    cpu: float


def timed(function: Callable[[], Any]) -> tuple[Any, Timing]:
    """Runs a function once, to the end of its last array."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = jax.block_until_ready(function())
    return result, Timing(time.perf_counter() - wall, time.process_time() - cpu)


def quickest(function: Callable[[], Any], repeats: int = 10) -> Timing:
    """The least time of several runs after a warm-up."""
    jax.block_until_ready(function())
    runs = [timed(function)[1] for _ in range(repeats)]
    return Timing(min(run.wall for run in runs), min(run.cpu for run in runs))


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], Timing]:
    """A function compiled ahead for its arguments, and the time that tracing and compiling took."""
    return timed(lambda: jax.jit(function).lower(*arguments).compile())


def versus(key: str, ours: Timing, peer: Timing) -> list[Metric]:
    """How many times as long a peer takes for the same work: by the clock (reported), in processor time (watched)."""
    return [
        Metric(f"{key}.wall", peer.wall / ours.wall, "x", "higher"),
        Metric(f"{key}.cpu", peer.cpu / max(ours.cpu, 1e-9), "x", "higher", RATIO),
    ]


def gradient_over_forward(
    key: str, total: Callable[..., jax.Array], arguments: tuple[Any, ...], forward: Timing, repeats: int
) -> Metric:
    """Processor time of a number with its derivatives by the first argument, over that of the estimate alone."""
    run, _ = compiled(jax.value_and_grad(total), *arguments)
    took = quickest(lambda: run(*arguments), repeats)
    return Metric(f"{key}.gradient_over_forward", took.cpu / forward.cpu, "x", "lower", RATIO)


def in_fresh_process(module: str, function: str, *arguments: str, environment: Mapping[str, str] | None = None) -> Any:
    """Result (of plain numbers) of ``module.function(*arguments)`` in a process of its own."""
    code = (
        "import importlib, json, sys; module, function, *arguments = sys.argv[1:]; "
        "print(json.dumps(getattr(importlib.import_module(module), function)(*arguments)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, module, function, *arguments],
        cwd=REPOSITORY,
        env={**os.environ, **(environment or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"{module}.{function} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def device() -> str:
    """Where the figures were measured."""
    first = jax.devices()[0]
    return f"{first.device_kind}, {os.cpu_count()} cores, jax {jax.__version__}"
