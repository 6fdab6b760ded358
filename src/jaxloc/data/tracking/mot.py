"""Detections and tracks of the MOT challenge: boxes in images.

Columns: ``frame, id, left, top, width, height, score, x, y, z`` (or class and visibility).

Frames count from 1; commas or spaces separate. The detector's identities are -1 and are not read; true rows of score 0
are ignored.

References:
    Leal-Taixe et al., "MOTChallenge 2015: towards a benchmark for multi-target tracking", arXiv 1504.01942.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from jaxloc.data.io.errors import DataError
from jaxloc.data.io.text import is_whole, parse_any_numbers, read_text
from jaxloc.data.io.writing import write_file
from jaxloc.data.tracking.records import Detections, LabeledTracks, Rows, assemble, assemble_tracks, check_frame

_FEWEST, _MOST = 7, 10
_NOT_GIVEN = -1.0
_ROUNDING = 1e-3
_LEAST_PERCENT = 10.0  # a detector that is never as sure as this gives no percent


def read_mot_detections(
    path: Path | str, *, num_frames: int | None = None, capacity: int | None = None, rate: float = 25.0
) -> Detections:
    """Reads detections (``det.txt``).

    Detections with non-finite values, or boxes without area, are left out and counted. Scores are probabilities; -1 is
    the format's mark for a score that is not given, and such a detection counts as sure; scores in percent are divided
    by 100.

    Args:
        path: the file.
        num_frames: how many frames there are; up to the last line where not given.
        capacity: slots of a frame; the highest scores are kept.
        rate: frames a second.

    Returns:
        The detections.

    Raises:
        DataError: when the file is missing, a line is malformed, or scores are neither probabilities nor percent.
    """
    values, lines = _read(path)
    values[:, 6] = _confidences(path, values[:, 6])
    rows = _rows(values, lines)
    return assemble(path, rows, rate=rate, first=1, num_frames=num_frames, capacity=capacity)


def read_mot_tracks(path: Path | str, *, num_frames: int | None = None, rate: float = 25.0) -> LabeledTracks:
    """Reads true tracks (``gt.txt``), or those of a tracker.

    Args:
        path: the file.
        num_frames: how many frames there are; up to the last line where not given.
        rate: frames a second.

    Returns:
        The tracks.

    Raises:
        DataError: when the file is missing, a line is malformed, or an identity occurs twice in a frame.
    """
    values, lines = _read(path)
    for identity, line in zip(values[:, 1], lines, strict=True):
        if identity < 0 or not is_whole(identity):
            raise DataError(path, f"line {line}: {identity:g} is no identity (whole, from 0)")
    counted = values[:, 6] != 0.0
    rows = _rows(values[counted], lines[counted], values[counted, 1].astype(np.int64))
    return assemble_tracks(path, rows, rate=rate, first=1, num_frames=num_frames)


def write_mot(path: Path | str, tracks: LabeledTracks) -> None:
    r"""Writes tracks as a result file of the benchmark, in one step.

    Args:
        path: the file.
        tracks: boxes with identities.

    Raises:
        DataError: when it cannot be written.

    Example:
        >>> import jaxloc as jl, numpy as np, tempfile, pathlib
        >>> one = np.array([1])
        >>> rows = jl.data.tracking.records.Rows(one, one, np.array([[1.0, 2.0, 4.0, 8.0]]), np.ones(1), 7 * one)
        >>> tracks = jl.data.tracking.records.assemble_tracks("a", rows, rate=25.0, first=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = pathlib.Path(folder) / "a.txt"
        ...     jl.data.tracking.write_mot(path, tracks)
        ...     path.read_text()
        '1,7,1.00,2.00,3.00,6.00,1.0000,-1,-1,-1\n'
    """
    found, lines = tracks.detections, []
    for frame, slot in np.argwhere(found.valid):
        left, top, right, bottom = found.boxes[frame, slot]
        box = f"{left:.2f},{top:.2f},{right - left:.2f},{bottom - top:.2f},{found.scores[frame, slot]:.4f}"
        lines.append(f"{found.frames[frame]},{tracks.ids[frame, slot]},{box},-1,-1,-1\n")
    write_file(path, "".join(lines))


def _confidences(path: Path | str, scores: Float64[np.ndarray, " n"]) -> Float64[np.ndarray, " n"]:
    """Scores between 0 and 1."""
    given = np.isfinite(scores) & (scores != _NOT_GIVEN)
    least, most = scores[given].min(initial=np.inf), scores[given].max(initial=-np.inf)
    scale = 1.0
    if given.any() and not (least >= 0.0 and most <= 1.0 + _ROUNDING):
        if least == most:  # says nothing about any
            return np.where(given, 1.0, np.where(scores == _NOT_GIVEN, 1.0, scores))
        if not (least >= 0.0 and _LEAST_PERCENT <= most <= 100.0):
            ends = f"scores lie between {least:.6g} and {most:.6g}"
            raise DataError(path, f"{ends}, must lie in 0..1 (or all be -1, or be percent): convert them")
        scale = 100.0
    return np.where(scores == _NOT_GIVEN, 1.0, np.where(given, np.minimum(scores / scale, 1.0), scores))


def _rows(
    values: Float64[np.ndarray, "n 7"], lines: Int64[np.ndarray, " n"], ids: Int64[np.ndarray, " n"] | None = None
) -> Rows:
    boxes = np.column_stack([values[:, 2:4], values[:, 2:4] + values[:, 4:6]])
    return Rows(lines, values[:, 0].astype(np.int64), boxes, values[:, 6], ids)


def _read(path: Path | str) -> tuple[Float64[np.ndarray, "n 7"], Int64[np.ndarray, " n"]]:
    """The first seven numbers of each line, and its line number."""
    rows, lines = [], []
    for number, line in enumerate(read_text(path).split("\n"), start=1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        rows.append(_parse(path, number, words))
        lines.append(number)
    return np.array(rows, dtype=np.float64).reshape(len(rows), _FEWEST), np.array(lines, dtype=np.int64)


def _parse(path: Path | str, line: int, words: Sequence[str]) -> list[float]:
    if not _FEWEST <= len(words) <= _MOST:
        raise DataError(path, f"line {line} has {len(words)} numbers, needs {_FEWEST} to {_MOST}")
    values = parse_any_numbers(path, line, words)
    check_frame(path, line, values[0], first=1)
    return values[:_FEWEST]
