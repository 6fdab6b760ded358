"""``jaxloc localize``: run the filter, write a row a scan as they come, then metrics and report."""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import typer

from jaxloc.cli import configuration, results, session
from jaxloc.cli.localize import report
from jaxloc.data import DataError, LaserLog, carmen, ros_map, tum
from jaxloc.data.io.writing import RowWriter
from jaxloc.poses import SE2
from jaxloc.sensors import OccupancyMap

_SPREAD = "time,sigma_x,sigma_y,sigma_heading,mass,ess,particles,inject,updated,found"


def run_log(
    path: Path,
    map_path: Path,
    start: tuple[float, float, float] | None,
    reference: Path | None,
    out: Path,
    config_path: Path | None,
) -> int:
    """Localizes a robot by its log.

    Args:
        path: CARMEN log.
        map_path: YAML file of the map.
        start: (x, y, heading) at the first scan, m and rad; None for anywhere.
        reference: TUM file with poses of the robot in the map.
        out: folder for the results.
        config_path: YAML file with options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    results.prepare(out)
    if start is not None and not np.isfinite(start).all():
        raise DataError("--start", "must be three finite numbers")
    grid = _check_map(map_path)
    log = carmen.read_log(path)
    truth = _read_reference(reference, log)
    from jaxloc.pipelines import localization as pipeline

    default = pipeline.Config()
    config = default if config_path is None else configuration.read_config(config_path, default)
    inputs = {
        "command": "localize",
        "log": str(path),
        "map": str(map_path),
        "start": None if start is None else list(start),
        "reference": None if reference is None else str(reference),
    }
    record = report.Record(log, grid, truth)
    with session.Interruption() as interruption, session.output_folder(out):
        _stream(log, grid, start, config, out, record, interruption)
        record.interrupted = interruption.requested
        metrics = results.write(record, config, out, inputs)
    _announce(metrics, out)
    return 130 if record.interrupted else 0


def _check_map(path: Path) -> OccupancyMap:
    grid = ros_map.read_map(path)
    if not bool(np.asarray(grid.occupied).any()):
        raise DataError(path, "shows no obstacle: nothing to localize by")
    if not bool(np.asarray(grid.free).any()):
        raise DataError(path, "shows no free cell: nowhere to be")
    return grid


def _read_reference(path: Path | None, log: LaserLog) -> report.Reference | None:
    """Poses to compare with: those of the file, or those that the log itself holds."""
    if path is None:
        return None if log.corrected is None else report.Reference(log.times, log.corrected)
    stamped = tum.read_trajectory(path)
    matrices = np.asarray(stamped.trajectory.matrices(), dtype=np.float64)
    heading = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    times = np.asarray(stamped.trajectory.times, dtype=np.float64) + stamped.start
    reference = report.Reference(times, np.column_stack([matrices[:, :2, 3], heading]))
    if not len(reference.match(log.times)[0]):
        raise DataError(path, "has no pose at the time of any scan of the log")
    return reference


def _stream(
    log: LaserLog,
    grid: OccupancyMap,
    start: tuple[float, float, float] | None,
    config: Any,
    out: Path,
    record: report.Record,
    interruption: session.Interruption,
) -> None:
    """Writes a row of each file for each scan, until the end or an interrupt."""
    from jaxloc.pipelines import localization as pipeline

    with ExitStack() as stack:
        stamped = stack.enter_context(RowWriter(out / "trajectory.tum"))
        spread = stack.enter_context(RowWriter(out / "spread.csv", _SPREAD))
        progress = stack.enter_context(session.show_progress("localization", len(log)))
        pose = None if start is None else SE2(*start)
        for step in pipeline.steps(log, grid, pose, config):
            stamped.append(tum.format_pose(step.time, _matrix(step.pose)))
            spread.append(_spread_row(step))
            record.add(step)
            progress(step.index + 1)
            if interruption.requested:
                break
        if not record.steps:
            raise typer.Abort


def _matrix(pose: np.ndarray) -> np.ndarray:
    x, y, heading = pose
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    matrix[:2, 3] = x, y
    return matrix


def _spread_row(step: Any) -> str:
    rotation = _matrix(step.pose)[:2, :2]
    covariance = rotation @ step.covariance[:2, :2] @ rotation.T
    sigmas = np.sqrt(np.maximum([covariance[0, 0], covariance[1, 1], step.covariance[2, 2]], 0.0))
    numbers = [f"{step.time:.6f}", *(f"{sigma:.6g}" for sigma in sigmas), f"{step.mass:.4f}", f"{step.ess:.1f}"]
    return ",".join([*numbers, f"{step.num_particles}", f"{step.inject:.4f}", f"{step.updated:d}", f"{step.found:d}"])


def _announce(metrics: dict[str, Any], out: Path) -> None:
    words = [f"{metrics['scans']} scans"]
    found = metrics["found_after_s"]
    words.append("robot not found" if found is None else f"found after {found:.1f} s")
    if metrics.get("error_median_m") is not None:
        words.append(f"median error {metrics['error_median_m']:.3f} m")
    if metrics["interrupted"]:
        words.append("interrupted")
    typer.echo(f"{', '.join(words)}: {out / 'report.html'}")
