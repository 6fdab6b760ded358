"""Metrics and report of localization in a map."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float64, Int

from jaxloc.cli import results
from jaxloc.data import LaserLog
from jaxloc.evaluation import plots, report
from jaxloc.poses.planar import relative_poses
from jaxloc.sensors import OccupancyMap

_SAME_TIME = 0.02  # stamps of one instant, s
_SAME_POSE = 2e-3  # m and rad of rounding in files
_MOVED = 0.05  # m or rad; all paths of a robot that stands still are alike
_NUM_CLOUDS = 6


class Reference(eqx.Module):
    """Poses that the estimate is compared with.

    Args:
        times: increasing, s in the clock of the log.
        poses: "n 3" (x, y, heading) of the robot in the map, m and rad.
    """

    times: Float64[np.ndarray, " n"]
    poses: Float64[np.ndarray, "n 3"]

    def match(self, times: Float64[np.ndarray, " m"]) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """Indices of times with a reference pose at the same time, and of these poses."""
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self.times) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(self.times) - 1)
        nearest = np.where(times - self.times[before] <= self.times[after] - times, before, after)
        indices = np.flatnonzero(np.abs(self.times[nearest] - times) <= _SAME_TIME)
        return indices, nearest[indices]

    def is_odometry(self, log: LaserLog) -> bool:
        """Whether these poses are the odometry of the log, up to their frame: an input, no truth."""
        indices, partners = self.match(log.times)
        if len(indices) < 2:
            return False
        paths = log.odometry[indices], self.poses[partners]
        moved = [relative_poses(np.broadcast_to(path[:1], path.shape), path) for path in paths]
        difference = moved[1] - moved[0]
        difference[:, 2] = np.arctan2(np.sin(difference[:, 2]), np.cos(difference[:, 2]))
        return bool(np.abs(moved[0]).max() > _MOVED and np.abs(difference).max() < _SAME_POSE)


class Record:
    """Outputs of a run so far.

    Args:
        log: the recording.
        grid: the map.
        reference: poses to compare with.
        offset: (x, y) of the frame of the outputs, the map and the reference in the frame of their files, m.
    """

    def __init__(
        self,
        log: LaserLog,
        grid: OccupancyMap,
        reference: Reference | None,
        offset: Float64[np.ndarray, "2"],
    ):
        self.log = log
        self.grid = grid
        self.reference = reference
        self.offset = offset
        self.interrupted = False
        self.outputs: list[Any] = []

    def add(self, output: Any) -> None:
        """Adds a scan."""
        self.outputs.append(output)

    def poses(self) -> np.ndarray:
        """Estimated poses (x, y, heading)."""
        return np.stack([output.pose for output in self.outputs])

    def times(self) -> np.ndarray:
        """Stamps, s."""
        return np.array([output.time for output in self.outputs])

    def found(self) -> np.ndarray:
        """Scans at which the robot was localized."""
        return np.array([output.found for output in self.outputs])

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        found, times, poses = self.found(), self.times(), self.poses()
        used = [output for output in self.outputs if output.updated]
        numbers: dict[str, Any] = {
            "scans": len(self.outputs),
            "scans_of_log": len(self.log),
            "scans_dropped": self.log.dropped,
            "scans_used": len(used),
            "interrupted": self.interrupted,
            "found_after_s": float(times[np.argmax(found)] - times[0]) if found.any() else None,
            "found_fraction": float(found.mean()),
            "found_at_end": bool(found[-1]),
            "distance_m": float(np.linalg.norm(np.diff(poses[found, :2], axis=0), axis=1).sum()),
            "median_ess": float(np.median([output.ess for output in used])),
            "median_sigma_m": float(np.median([_sigma(output) for output in used])),
            "most_particles": max(output.num_particles for output in used),
            "least_particles": min(output.num_particles for output in used),
        }
        if self.reference is not None:
            numbers |= self._accuracy(found)
        return results.finite(numbers)

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of scans with a reference, and the error (x, y, heading): the reference relative to the estimate."""
        if self.reference is None:
            raise ValueError("There is no reference to compare with.")
        indices, partners = self.reference.match(self.times())
        return indices, relative_poses(self.poses()[indices], self.reference.poses[partners])

    def _accuracy(self, found: np.ndarray) -> dict[str, Any]:
        indices, errors = self.errors()
        numbers: dict[str, Any] = {"scans_compared": len(indices)}
        for suffix, chosen in (("", found[indices]), ("_all", np.ones(len(indices), bool))):
            if not chosen.any():
                continue
            distance = np.hypot(errors[chosen, 0], errors[chosen, 1])
            angle = np.degrees(np.abs(errors[chosen, 2]))
            numbers |= {
                f"error_median_m{suffix}": float(np.median(distance)),
                f"error_95_percent_m{suffix}": float(np.percentile(distance, 95)),
                f"error_max_m{suffix}": float(distance.max()),
                f"error_median_deg{suffix}": float(np.median(angle)),
                f"error_95_percent_deg{suffix}": float(np.percentile(angle, 95)),
            }
        return numbers

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        image, poses, found = self._image(), self.poses(), self.found()
        reference = None if self.reference is None else self.reference.poses
        path = plots.draw_map_path(image, poses, reference, found)
        text = "Estimated path over the map; poses before the robot was localized are dots."
        sections = [report.Section("Path", text, path, raster=True)]
        clouds = plots.draw_clouds(image, self._snapshots())
        text = "The particles at several times; the arrow is the estimate" + (
            ", the dark one the reference." if self.reference is not None else "."
        )
        sections.append(report.Section("Particles", text, clouds, raster=True))
        sections += self._error_section() + self._confidence_sections()
        sections.append(results.numbers_section(metrics))
        summary = f"{metrics['scans']} scans, {metrics['scans_used']} used. {self.log.mounting}".rstrip()
        if self.reference is None and self.log.corrected is not None:
            summary += " Poses in the log are its odometry: they are no reference to compare with."
        if self.offset.any():
            summary += " Figures count from x {:.0f} m, y {:.0f} m of the map.".format(*self.offset)
        if self.interrupted:
            summary += " Interrupted: the report ends with the last scan that was processed."
        title = f"Laser localization: {self.log.name}"
        return report.render_report(title, sections, summary=summary, highlights=_highlights(metrics))

    def _image(self) -> plots.MapImage:
        grid = self.grid
        origin = (float(grid.origin.x), float(grid.origin.y), float(grid.origin.theta))
        return plots.MapImage.of(np.asarray(grid.occupied), np.asarray(grid.free), origin, float(grid.resolution))

    def _snapshots(self) -> list[plots.Snapshot]:
        """Particles at the first scans, where they change most, and at some later ones."""
        used = [output for output in self.outputs if output.updated]
        late = np.linspace(0, len(used) - 1, _NUM_CLOUDS - 2).round().astype(int)[1:]
        chosen = sorted({0, min(1, len(used) - 1), min(3, len(used) - 1), *late.tolist()})
        truths: dict[int, np.ndarray] = {}
        if self.reference is not None:
            pairs = self.reference.match(np.array([used[number].time for number in chosen]))
            truths = {chosen[i]: self.reference.poses[j] for i, j in zip(*pairs, strict=True)}
        begin = self.outputs[0].time
        return [
            plots.Snapshot(
                f"after {used[number].time - begin:.1f} s, {used[number].num_particles} particles",
                used[number].cloud,
                used[number].pose,
                truths.get(number),
            )
            for number in chosen
        ]

    def _error_section(self) -> list[report.Section]:
        if self.reference is None:
            return []
        indices, errors = self.errors()
        if not len(indices):
            return []
        sigmas = np.array([_sigma(self.outputs[index]) for index in indices])
        curves = {"error": np.hypot(errors[:, 0], errors[:, 1]), "one standard deviation": sigmas}
        times = self.times()[indices] - self.outputs[0].time
        figure = plots.draw_curves(times, curves, "position (m)", logarithmic=True)
        return [report.Section("Error", "Distance to the reference, and its estimated standard deviation.", figure)]

    def _confidence_sections(self) -> list[report.Section]:
        used = [output for output in self.outputs if output.updated]
        times = np.array([output.time for output in used]) - self.outputs[0].time
        sizes = {
            "effective": np.array([output.ess for output in used]),
            "particles": np.array([float(output.num_particles) for output in used]),
        }
        shares = {
            "weight of the main cluster": np.array([output.mass for output in used]),
            "replaced by random poses": np.array([output.inject for output in used]),
        }
        return [
            report.Section(
                "Effective sample size",
                "Effective sample size, and number of particles.",
                plots.draw_curves(times, sizes, "particles", logarithmic=True),
            ),
            report.Section(
                "Confidence",
                "Fraction of the weight in the main cluster, and of the particles to be replaced by random ones.",
                plots.draw_curves(times, shares, "fraction"),
            ),
        ]


def _sigma(output: Any) -> float:
    """Standard deviation of the position, m."""
    return float(np.sqrt(max(output.covariance[0, 0] + output.covariance[1, 1], 1e-12)))


def _highlights(metrics: dict[str, Any]) -> tuple[report.Highlight, ...]:
    wanted = (
        ("error_median_m", "median error", "{:.3f} m"),
        ("error_95_percent_m", "95th percentile", "{:.3f} m"),
        ("error_median_deg", "median heading error", "{:.2f} deg"),
        ("found_after_s", "found after", "{:.1f} s"),
        ("distance_m", "distance", "{:.0f} m"),
    )
    return results.highlights(metrics, wanted)
