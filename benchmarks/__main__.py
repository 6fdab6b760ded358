"""``python -m benchmarks [room ...]``: measures, prints, writes JSON, compares with a baseline, fills the README."""

import argparse
import json
import re
import sys
import time
from importlib import import_module
from pathlib import Path

import jax

from benchmarks.metric import REPOSITORY, Metric, device

ROOMS = tuple(sorted(path.stem.removeprefix("bench_") for path in Path(__file__).parent.glob("bench_*.py")))
_SPOT = re.compile(r"<!-- figure: (?P<key>[\w.]+) -->.*?<!-- /figure -->")


def measure(room: str, smoke: bool) -> list[Metric]:
    """Runs the benchmark of a room."""
    started, metrics = (time.perf_counter(), time.process_time()), []
    for metric in import_module(f"benchmarks.bench_{room}").metrics(smoke):
        print(f"{metric.key:<52} {metric.value:>12.5g} {metric.unit}", flush=True)
        metrics.append(metric)
    wall, processor = time.perf_counter() - started[0], time.process_time() - started[1]
    print(f"# {room}: {wall:.0f} s, {processor:.0f} s of processors", flush=True)
    # Each program holds memory maps, of which a process may have 65530: all rooms together need more.
    jax.clear_caches()
    return metrics


def write(path: Path, metrics: list[Metric]) -> None:
    """Writes figures, and keeps those that are there of rooms that were not measured."""
    record = read(path) if path.exists() else {"metrics": {}}
    measured = {metric.key.split(".")[0] for metric in metrics}
    kept = {key: row for key, row in record["metrics"].items() if key.split(".")[0] not in measured}
    rows = {m.key: {"value": m.value, "unit": m.unit, "direction": m.direction, "rel_tol": m.rel_tol} for m in metrics}
    record = {"device": device(), "metrics": dict(sorted({**kept, **rows}.items()))}
    path.write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")


def read(path: Path) -> dict:
    """Figures of an earlier run."""
    return json.loads(path.read_text(encoding="utf-8"))


def compare(metrics: list[Metric], baseline: dict, rooms: tuple[str, ...]) -> list[str]:
    """What fell behind the baseline, a line for each."""
    found = {metric.key: metric for metric in metrics}
    lines = []
    for key, row in baseline["metrics"].items():
        if key.split(".")[0] not in rooms:
            continue
        if key not in found:
            lines.append(f"{key}: not measured any more")
        elif found[key].falls_behind(row["value"]):
            lines.append(f"{key}: {found[key].value:.4g} {row['unit']}, was {row['value']:.4g} ({row['direction']})")
    return lines


def show(value: float) -> str:
    """A figure for people: two significant digits, no exponent."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:.0f}" if abs(rounded) >= 10 else f"{rounded:g}"


def fill(text: str, figures: dict) -> str:
    """Puts figures into the spots ``<!-- figure: key --><!-- /figure -->`` of a page; others stay as they are."""

    def spot(match: re.Match) -> str:
        row = figures.get(match["key"])
        return match[0] if row is None else f"<!-- figure: {match['key']} -->{show(row['value'])}<!-- /figure -->"

    return _SPOT.sub(spot, text)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command.

    Returns:
        The exit code: 1 when ``--gate`` was given and a figure fell behind.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("rooms", nargs="*", metavar="room", help=f"any of {', '.join(ROOMS)}; all by default")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures; other rooms' there are kept")
    parser.add_argument("--baseline", type=Path, default=REPOSITORY / "benchmarks" / "baseline.json", metavar="FILE")
    parser.add_argument("--gate", action="store_true", help="fail when a figure is behind the baseline")
    parser.add_argument("--smoke", action="store_true", help="small sizes, one repetition: does everything run?")
    parser.add_argument("--list", action="store_true", help="measure nothing: print the names of the rooms")
    parser.add_argument("--readme", type=Path, metavar="FILE", help="measure nothing: fill a page from the baseline")
    options = parser.parse_args(arguments)
    if options.readme is not None:
        page = options.readme.read_text(encoding="utf-8")
        options.readme.write_text(fill(page, read(options.baseline)["metrics"]), encoding="utf-8")
        return 0
    if options.list:
        print("\n".join(ROOMS))
        return 0
    rooms = tuple(options.rooms) or ROOMS
    if unknown := sorted(set(rooms) - set(ROOMS)):
        parser.error(f"no benchmark of {', '.join(unknown)}; there are {', '.join(ROOMS)}")
    if options.smoke:  # programs run once: compiling them well costs more than running them badly
        jax.config.update("jax_disable_most_optimizations", True)
    print(f"# {device()}", flush=True)
    metrics = [metric for room in rooms for metric in measure(room, options.smoke)]
    if options.json is not None:
        write(options.json, metrics)
    if not options.gate:
        return 0
    behind = compare(metrics, read(options.baseline), rooms)
    print("\n".join(behind) or "# nothing fell behind the baseline")
    return 1 if behind else 0


if __name__ == "__main__":
    sys.exit(main())
