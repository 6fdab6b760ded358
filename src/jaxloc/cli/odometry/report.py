"""Metrics and report of stereo odometry."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxloc._jit import filter_jit
from jaxloc.cli import results
from jaxloc.data import StereoSequence
from jaxloc.evaluation import consistency, plots, report, trajectories
from jaxloc.evaluation.trajectories import kitti_drift
from jaxloc.evaluation.trajectories.alignment import NoAlignment
from jaxloc.poses import Trajectory

_PROBABILITIES = (0.5, 0.9, 0.95)


class Record:
    """Outputs of a run so far.

    Args:
        title: of the report.
        sequence: the recording.
    """

    def __init__(self, title: str, sequence: StereoSequence):
        self.title = title
        self.sequence = sequence
        self.interrupted = False
        self.matrices: list[np.ndarray] = []
        self.outputs: list[Any] = []
        self._shown: tuple[int, Any] | None = None

    def add(self, output: Any, matrix: np.ndarray) -> None:
        """Adds a frame.

        Args:
            output: of the pipeline.
            matrix: ``T_world_camera``.
        """
        index = len(self.matrices)
        self.matrices.append(matrix)
        self.outputs.append(_Numbers(output))
        # Matches of one frame are shown: that in the middle of the recording, or the last one before it.
        if output.num_matches > 0 and index <= max(len(self.sequence) // 2, 1):
            self._shown = (index, output)

    def estimate(self) -> Trajectory:
        """The estimated path."""
        times = np.array([output.time for output in self.outputs])
        return Trajectory.from_matrices(jnp.asarray(times), jnp.asarray(np.stack(self.matrices)))

    def truth(self) -> Trajectory | None:
        """The true path so far, in the frame of its first pose."""
        if self.sequence.truth is None:
            return None
        matrices = np.asarray(self.sequence.truth.matrices(), dtype=np.float64)[: len(self.matrices)]
        relative = np.linalg.inv(matrices[0]) @ matrices
        return Trajectory.from_matrices(self.sequence.truth.times[: len(matrices)], jnp.asarray(relative))

    def distance(self) -> float:
        """Length of the estimated path, m."""
        positions = np.stack(self.matrices)[:, :3, 3]
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    def covariances(self) -> np.ndarray:
        """Covariances of the poses."""
        return np.stack([output.covariance for output in self.outputs])

    def stages(self) -> dict[str, np.ndarray]:
        """Wall time by stage, s, without the first two frames, which compile, where there are more than four."""
        skip = 2 if len(self.outputs) > 4 else 0
        names = dict.fromkeys(name for output in self.outputs for name in output.timings)
        times = {
            name: [output.timings[name] for output in self.outputs[skip:] if name in output.timings] for name in names
        }
        return {name: np.array(values) for name, values in times.items() if values}

    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json: SI units, or the unit in the name."""
        matches = [output for output in self.outputs if output.num_matches > 0]
        stages = self.stages()
        numbers: dict[str, Any] = {
            "frames": len(self.outputs),
            "frames_of_sequence": len(self.sequence),
            "interrupted": self.interrupted,
            "frames_not_ok": sum(not output.ok for output in self.outputs),
            "distance_m": self.distance(),
            "median_matches": float(np.median([one.num_matches for one in matches])) if matches else 0.0,
            "median_inliers": float(np.median([one.num_inliers for one in matches])) if matches else 0.0,
            "median_stage_seconds": {name: float(np.median(times)) for name, times in stages.items()},
            "median_frame_seconds": float(sum(np.median(times) for times in stages.values())),
        }
        truth = self.truth()
        if truth is not None and len(truth) > 1:
            numbers |= self._accuracy(truth)
        return results.finite(numbers)

    def _accuracy(self, truth: Trajectory) -> dict[str, Any]:
        lengths = kitti_drift.fitting_lengths(float(np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum()))
        # On short paths every frame begins a segment, on long ones every tenth, as in the benchmark.
        step = 10 if lengths[:1] == kitti_drift.KITTI_LENGTHS[:1] else 1
        motions, covariances = (
            jnp.asarray(np.stack([getattr(output, name) for output in self.outputs[1:]]), truth.times.dtype)
            for name in ("relative", "relative_covariance")
        )
        values = _compare(self.estimate(), truth, motions, covariances, jnp.asarray(lengths or (1.0,)), step)
        numbers: dict[str, Any] = {name: float(value) for name, value in values.items() if value.ndim == 0}
        fractions = zip(_PROBABILITIES, values["motion_coverage"].tolist(), strict=True)
        numbers["motion_coverage"] = {f"{probability:g}": fraction for probability, fraction in fractions}
        if lengths:
            numbers["segment_lengths_m"] = [round(length, 3) for length in lengths]
        return numbers

    def page(self, metrics: dict[str, Any]) -> str:
        """The report as HTML."""
        estimate, truth = self.estimate(), self.truth()
        covariances = self.covariances()
        path = plots.draw_trajectory(estimate, truth, covariances)
        sections = [report.Section("Trajectory", "From above, in the frame of the first camera.", path)]
        sections += self._matches()
        if truth is not None and len(truth) > 1:
            distances = np.asarray(trajectories.path_distances(truth.positions))
            curve = plots.draw_drift(distances, np.asarray(kitti_drift.drift_curve_percent(estimate, truth)))
            text = "Distance between the estimated and the true position, as a fraction of the distance so far."
            sections.append(report.Section("Drift", text, curve))
        text = "Three standard deviations of the estimated position, in camera axes"
        text += ", and the actual error." if truth is not None else "."
        uncertainty = plots.draw_ellipses(estimate, covariances, truth)
        sections.append(report.Section("Uncertainty", text, uncertainty))
        if self.stages():
            text = "Time of each stage; the first two frames, which compile, are left out."
            sections.append(report.Section("Timings", text, plots.draw_timings(self.stages())))
        sections.append(report.Section("Numbers", table=results.table(metrics)))
        note = "Interrupted: the report covers the frames until then. " if self.interrupted else ""
        summary = f"{note}{metrics['frames']} frames, {metrics['distance_m']:.1f} m."
        return report.render_report(self.title, sections, summary=summary, highlights=_highlights(metrics))

    def _matches(self) -> list[report.Section]:
        if self._shown is None:
            return []
        index, output = self._shown
        image = self.sequence[index].left
        figure = plots.draw_matches(
            image,
            np.asarray(output.uv_previous, dtype=np.float64),
            np.asarray(output.uv_current, dtype=np.float64),
            np.asarray(output.inlier, dtype=bool),
        )
        text = f"Frame {index}: lines lead from a feature's position in the keyframe to its position in this frame."
        return [report.Section("Matches", text, figure, raster=True)]


class _Numbers:
    """The numbers of an output, without its matches."""

    def __init__(self, output: Any):
        self.time = float(output.time)
        self.covariance = np.asarray(output.covariance, dtype=np.float64)
        self.relative = np.asarray(output.relative.matrix(), dtype=np.float64)
        self.relative_covariance = np.asarray(output.relative_covariance, dtype=np.float64)
        self.ok = bool(output.ok)
        self.num_inliers = int(output.num_inliers)
        self.num_matches = int(output.num_matches)
        self.timings = {name: float(value) for name, value in output.timings.items()}


@filter_jit
def _compare(
    estimate: Trajectory,
    truth: Trajectory,
    motions: Float[Array, "m 4 4"],
    motion_covariances: Float[Array, "m 6 6"],
    lengths: Float[Array, " l"],
    step: int,
) -> dict[str, Float[Array, "..."]]:
    """All numbers that need the truth, in one compiled function."""
    relative = trajectories.rpe(estimate, truth)
    segments = kitti_drift.segment_errors(estimate, truth, lengths=lengths, step=step)
    estimated = Trajectory.from_matrices(truth.times[1:], motions)
    actual = Trajectory(truth.times[1:], truth.relative())
    squared = consistency.trajectory_nees(estimated, motion_covariances, actual)
    return {
        "true_distance_m": truth.length(),
        "end_drift_percent": kitti_drift.end_drift_percent(estimate, truth),
        "t_err_percent": segments.translation_percent(),
        "r_err_deg_per_m": segments.rotation_deg_per_meter(),
        "ate_rmse_m": trajectories.ate(estimate, truth, alignment=NoAlignment()).rmse(),
        "ate_rmse_aligned_m": trajectories.ate(estimate, truth).rmse(),
        "rpe_translation_rmse_m": relative.translation.rmse(),
        "rpe_rotation_median_deg": jnp.rad2deg(relative.rotation.median()),
        # The errors of the motions between frames against their covariances; 6 where these are right.
        "motion_nees_mean": trajectories.Errors(squared.values, squared.ok).mean(),
        "motion_coverage": consistency.coverage(squared, 6, probabilities=_PROBABILITIES),
    }


def _highlights(metrics: dict[str, Any]) -> tuple[report.Highlight, ...]:
    wanted = (
        ("end_drift_percent", "drift at the end", "{:.2f} %"),
        ("t_err_percent", "translation error, KITTI", "{:.2f} %"),
        ("r_err_deg_per_m", "rotation error, KITTI", "{:.4f} deg/m"),
        ("ate_rmse_m", "absolute error, RMSE", "{:.2f} m"),
        ("median_inliers", "inliers a frame", "{:.0f}"),
        ("median_frame_seconds", "time a frame", "{:.3f} s"),
    )
    return results.highlights(metrics, wanted)
