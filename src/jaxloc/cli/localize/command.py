"""``jaxloc localize``: Monte Carlo localization of a laser log in an occupancy map."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxloc.cli import lifecycle
from jaxloc.cli.lifecycle import Arguments
from jaxloc.cli.localize import report
from jaxloc.data import DataError, LaserLog, carmen, ros_map, tum
from jaxloc.data.io.writing import RowWriter
from jaxloc.data.tum import planar_poses
from jaxloc.poses import SE2
from jaxloc.poses.planar import planar_matrix
from jaxloc.sensors import OccupancyMap

_FILES = {
    "trajectory.tum": None,
    "spread.csv": "time,sigma_x,sigma_y,sigma_heading,mass,ess,particles,inject,updated,found",
}


def default_config() -> Any:
    """The default options."""
    from jaxloc.pipelines import localization

    return localization.Config()


def run_log(
    path: Path,
    map_path: Path,
    initial: tuple[float, float, float] | None,
    reference: Path | None,
    arguments: Arguments,
) -> int:
    """Localizes a robot by its log.

    Args:
        path: CARMEN log.
        map_path: YAML file of the map.
        initial: (x, y, heading) at the first scan, m and rad; None for anywhere.
        reference: TUM file with poses of the robot in the map.
        arguments: output folder and options.

    Returns:
        The exit code.

    Raises:
        DataError: when any input is bad; nothing is written then.
    """
    lifecycle.prepare(arguments.out)
    if initial is not None and not np.isfinite(initial).all():
        raise DataError("--start", "must be three finite numbers")
    offset = np.array([*ros_map.read_offset(map_path), 0.0])
    grid = _read_map(map_path, offset[:2])
    log = carmen.read_log(path)
    record = report.Record(log, grid, _read_reference(reference, log, offset), offset[:2])
    config = arguments.read(default_config())
    inputs = {
        "command": "localize",
        "log": str(path),
        "map": str(map_path),
        "start": None if initial is None else list(initial),
        "reference": None if reference is None else str(reference),
    }
    from jaxloc.pipelines import localization

    def write(output: Any, rows: Mapping[str, RowWriter]) -> None:
        rows["trajectory.tum"].append(tum.format_pose(output.time, planar_matrix(output.pose + offset)))
        rows["spread.csv"].append(_sigma_row(output))
        record.add(output)

    with lifecycle.open_run(arguments.out) as run:
        start = None if initial is None else SE2(*(np.array(initial) - offset))
        outputs = localization.run(log, config, grid, initial=start)
        run.stream(outputs, write, title="localization", total=len(log), files=_FILES)
        return run.finish(record, config, inputs, _summary)


def _read_map(path: Path, offset: Float64[np.ndarray, "2"]) -> OccupancyMap:
    grid = ros_map.read_map(path, offset=offset)
    if not bool(np.asarray(grid.occupied).any()):
        raise DataError(path, "shows no obstacle: there is nothing to localize by")
    if not bool(np.asarray(grid.free).any()):
        raise DataError(path, "shows no free cell: there is no place for the robot")
    return grid


def _read_reference(path: Path | None, log: LaserLog, offset: Float64[np.ndarray, "3"]) -> report.Reference | None:
    """Poses to compare with, less the offset of the map: those of the file, or those that the log itself holds."""
    if path is None:
        reference = None if log.corrected is None else report.Reference(log.times, log.corrected - offset)
        return None if reference is None or reference.is_odometry(log) else reference
    times, poses = planar_poses(tum.read_trajectory(path))
    reference = report.Reference(times, poses - offset)
    if not len(reference.match(log.times)[0]):
        raise DataError(path, "has no pose at the time of any scan of the log")
    if reference.is_odometry(log):
        raise DataError(path, "holds the odometry of the log, which is no reference: it is an input of the estimate")
    return reference


def _sigma_row(output: Any) -> str:
    """Standard deviations along the axes of the map, and the state of the filter."""
    rotation = planar_matrix(output.pose)[:2, :2]
    covariance = rotation @ output.covariance[:2, :2] @ rotation.T
    sigmas = np.sqrt(np.maximum([covariance[0, 0], covariance[1, 1], output.covariance[2, 2]], 0.0))
    numbers = [f"{output.time:.6f}", *(f"{sigma:.6g}" for sigma in sigmas), f"{output.mass:.4f}", f"{output.ess:.1f}"]
    counts = [f"{output.num_particles}", f"{output.inject:.4f}", f"{output.updated:d}", f"{output.found:d}"]
    return ",".join([*numbers, *counts])


def _summary(metrics: dict[str, Any]) -> str:
    found, error = metrics["found_after_s"], metrics.get("error_median_m")
    text = f"{metrics['scans']} scans, " + ("robot not found" if found is None else f"found after {found:.1f} s")
    return text if error is None else f"{text}, median error {error:.3f} m"
