"""Detections and labeled tracks by frame: one record for all file formats.

Every frame has the same number of slots; `valid` marks those that hold a detection, and the others hold zeros. Frames
without a row in the file are empty. Host code: arrays are NumPy's.
"""

from pathlib import Path

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float64, Int64

from jaxloc.data.io.errors import DataError

_MOST_FRAMES = 10**6  # a greater frame number is an error in the file
# Slots of all frames: a file may need this many, or so many for each of its rows.
_FREE_CELLS, _CELLS_PER_ROW = 500_000, 8
_MOST_PRESENCES = 10_000_000  # identities times frames
_LARGEST = 1e30  # beyond it single precision ends


class Detections(eqx.Module):
    """Detections by frame, "t m": sorted by score within each frame, the highest first.

    Attributes:
        frames: numbers of the frames.
        times: s since the first frame of the recording.
        valid: which slots hold a detection.
        boxes: (left, top, right, bottom) in the image, px.
        scores: of the detector, in its own units.
        types: rows of `names`; -1 where not valid.
        names: of the types.
        left_out: number of rows of a frame that were not used: non-finite values, boxes without area, no slot.
        camera: positions in the rectified frame of camera 0 (x right, y down, z forward), m; None for boxes in images.
        positions: in the world, the frame of the first camera pose, m.
        sizes: height, width, length, m.
        headings: direction of the length in the world, rad: from the world's x axis towards its -z axis.
    """

    frames: Int64[np.ndarray, " t"]
    times: Float64[np.ndarray, " t"]
    valid: Bool[np.ndarray, "t m"]
    boxes: Float64[np.ndarray, "t m 4"]
    scores: Float64[np.ndarray, "t m"]
    types: Int64[np.ndarray, "t m"]
    names: tuple[str, ...] = eqx.field(static=True)
    left_out: Int64[np.ndarray, " t"]
    camera: Float64[np.ndarray, "t m 3"] | None = None
    positions: Float64[np.ndarray, "t m 3"] | None = None
    sizes: Float64[np.ndarray, "t m 3"] | None = None
    headings: Float64[np.ndarray, "t m"] | None = None

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, kept: Bool[np.ndarray, "t m"]) -> "Detections":
        """A copy with fewer valid slots, such as those above a score; indices stay.

        Example:
            >>> import jaxloc as jl, numpy as np
            >>> boxes = np.array([[0.0, 0.0, 2.0, 2.0], [1.0, 1.0, 3.0, 3.0]])
            >>> rows = jl.data.tracking.records.Rows(np.array([1, 2]), np.array([0, 0]), boxes, np.array([0.2, 0.9]))
            >>> found = jl.data.tracking.records.assemble("file", rows, rate=10.0)
            >>> found.select(found.scores > 0.5).valid.tolist()
            [[True, False]]
        """
        return eqx.tree_at(lambda d: d.valid, self, self.valid & kept)


class Rows(eqx.Module):
    """Rows of a file.

    Attributes:
        lines: line numbers in the file, from 1.
        frames: numbers of the frames.
        boxes: left, top, right, bottom.
        scores: of the detector; 1 for true tracks.
        ids: identities, where they are known.
        types: rows of the names of the types.
        objects: height, width, length, x, y, z (camera), rotation about the camera's y axis.
    """

    lines: Int64[np.ndarray, " n"]
    frames: Int64[np.ndarray, " n"]
    boxes: Float64[np.ndarray, "n 4"]
    scores: Float64[np.ndarray, " n"]
    ids: Int64[np.ndarray, " n"] | None = None
    types: Int64[np.ndarray, " n"] | None = None
    objects: Float64[np.ndarray, "n 7"] | None = None

    def usable(self) -> Bool[np.ndarray, " n"]:
        """Rows with finite values; boxes without 3-D objects need a positive area."""
        good = (np.abs(self.boxes) < _LARGEST).all(axis=1) & (np.abs(self.scores) < _LARGEST)
        if self.objects is not None:
            return good & (np.abs(self.objects) < _LARGEST).all(axis=1)
        return good & (self.boxes[:, 2] > self.boxes[:, 0]) & (self.boxes[:, 3] > self.boxes[:, 1])


class LabeledTracks(eqx.Module):
    """Detections with identities: true tracks, or those of a tracker.

    Attributes:
        detections: by frame.
        ids: "t m" identities; -1 where not valid.
    """

    detections: Detections
    ids: Int64[np.ndarray, "t m"]

    def identities(self) -> Int64[np.ndarray, " n"]:
        """All identities, in ascending order."""
        return np.unique(self.ids[self.detections.valid])

    def slots(self) -> tuple[Int64[np.ndarray, "n t"], Bool[np.ndarray, "n t"]]:
        """Slot of each identity in each frame, and whether it is present."""
        present = self.detections.valid[None] & (self.ids[None] == self.identities()[:, None, None])
        if not present.size:
            return np.zeros(present.shape[:2], np.int64), np.zeros(present.shape[:2], bool)
        return present.argmax(axis=2), present.any(axis=2)

    def by_identity(self, values: Float64[np.ndarray, "t m *d"]) -> Float64[np.ndarray, "n t *d"]:
        """A field of the detections by identity, then by frame; zero where the identity is not present."""
        slots, present = self.slots()
        if not values.shape[1]:
            return np.zeros((*slots.shape, *values.shape[2:]))
        picked = values[np.arange(values.shape[0])[None], slots]
        return np.where(present.reshape(*present.shape, *(1,) * (values.ndim - 2)), picked, 0.0)


def assemble(
    path: Path | str,
    rows: Rows,
    *,
    rate: float,
    first: int = 0,
    num_frames: int | None = None,
    capacity: int | None = None,
    names: tuple[str, ...] = ("object",),
    poses: Float64[np.ndarray, "t 4 4"] | None = None,
) -> Detections:
    """Sorts rows of a file into frames; rows that are not usable, or exceed the capacity, are left out and counted.

    Args:
        path: the file, for errors.
        rows: of the file.
        rate: frames a second.
        first: number of the first frame.
        num_frames: how many frames there are; up to the last row where not given.
        capacity: slots of a frame; those of the fullest frame where not given. The highest scores are kept.
        names: of the types.
        poses: T_world_camera of each frame; the identity where not given.

    Returns:
        The detections.

    Raises:
        DataError: when there are more frames than there should be, or fewer poses than frames.
    """
    table = _table(path, rows, first, num_frames, capacity)
    valid = table >= 0
    count = len(table)
    types = np.zeros(len(rows.frames), np.int64) if rows.types is None else rows.types
    return Detections(
        first + np.arange(count),
        np.arange(count) / rate,
        valid,
        _scatter(rows.boxes, table),
        _scatter(rows.scores, table),
        np.where(valid, _scatter(types, table), -1),
        names,
        np.bincount(rows.frames - first, minlength=count) - valid.sum(axis=1),
        *(() if rows.objects is None else _world_objects(path, _scatter(rows.objects, table), valid, poses)),
    )


def assemble_tracks(
    path: Path | str,
    rows: Rows,
    *,
    rate: float,
    first: int = 0,
    num_frames: int | None = None,
    names: tuple[str, ...] = ("object",),
    poses: Float64[np.ndarray, "t 4 4"] | None = None,
) -> LabeledTracks:
    """Sorts rows with identities into frames; all rows must be usable.

    Args:
        path: the file, for errors.
        rows: of the file.
        rate: frames a second.
        first: number of the first frame.
        num_frames: how many frames there are; up to the last row where not given.
        names: of the types.
        poses: T_world_camera of each frame; the identity where not given.

    Returns:
        The tracks.

    Raises:
        DataError: as `assemble`, and when a row is not usable, or an identity occurs twice in a frame.
    """
    if rows.ids is None:
        raise ValueError("Tracks need rows with identities.")
    broken = np.flatnonzero(~rows.usable())
    if broken.size:
        raise DataError(path, f"line {rows.lines[broken[0]]} holds a number that is not finite, or a box without area")
    pairs = np.column_stack([rows.frames, rows.ids])
    again = np.setdiff1d(np.arange(len(pairs)), np.unique(pairs, axis=0, return_index=True)[1])
    if again.size:
        frame, identity = pairs[again[0]]
        raise DataError(path, f"line {rows.lines[again[0]]}: identity {identity} occurs twice in frame {frame}")
    found = assemble(path, rows, rate=rate, first=first, num_frames=num_frames, names=names, poses=poses)
    table = _table(path, rows, first, num_frames, None)
    count = len(np.unique(rows.ids))
    if count * len(table) > _MOST_PRESENCES:
        raise DataError(path, f"{count} identities in {len(table)} frames are too many")
    return LabeledTracks(found, np.where(found.valid, _scatter(rows.ids, table), -1))


def check_frame(path: Path | str, line: int, value: float, first: int) -> int:
    """Checks the number of a frame.

    Args:
        path: the file, for the error.
        line: of the file, for the error.
        value: the number in the file.
        first: number of the first frame.

    Returns:
        The number.

    Raises:
        DataError: it is not whole, too small or too large.
    """
    if not (first <= value < _MOST_FRAMES and value == int(value)):
        limits = f"whole, from {first}" if value < _MOST_FRAMES else f"whole, below {_MOST_FRAMES}"
        raise DataError(path, f"line {line}: {value:g} is no frame number ({limits})")
    return int(value)


def _table(
    path: Path | str, rows: Rows, first: int, num_frames: int | None, capacity: int | None
) -> Int64[np.ndarray, "t m"]:
    """Index of the row in each slot of each frame; -1 where there is none."""
    frames = rows.frames - first
    last = int(frames.max(initial=-1))
    count = last + 1 if num_frames is None else num_frames
    if last >= count:
        line = rows.lines[frames.argmax()]
        raise DataError(path, f"line {line}: frame {last + first} is beyond the last of {count} frames")
    used = np.flatnonzero(rows.usable())
    room = int(np.bincount(frames[used]).max(initial=0)) if capacity is None else capacity
    if count * room > max(_FREE_CELLS, _CELLS_PER_ROW * len(frames)):
        line = f"line {rows.lines[frames.argmax()]}: " if num_frames is None and len(frames) else ""
        raise DataError(path, f"{line}{count} frames of up to {room} rows are too many for {len(frames)} rows")
    used = used[np.lexsort((-rows.scores[used], frames[used]))]
    starts = np.searchsorted(frames[used], np.arange(count))
    slots = np.arange(len(used)) - starts[frames[used]]
    kept = slots < room
    table = np.full((count, room), -1, np.int64)
    table[frames[used[kept]], slots[kept]] = used[kept]
    return table


def _scatter(values: np.ndarray, table: Int64[np.ndarray, "t m"]) -> np.ndarray:
    """Values of rows in their slots; zero where there is none."""
    table_values = np.zeros((*table.shape, *values.shape[1:]), values.dtype)
    table_values[table >= 0] = values[table[table >= 0]]
    return table_values


def _world_objects(
    path: Path | str,
    objects: Float64[np.ndarray, "t m 7"],
    valid: Bool[np.ndarray, "t m"],
    poses: Float64[np.ndarray, "k 4 4"] | None,
) -> tuple[np.ndarray, ...]:
    """Positions in the camera's frame and in the world, sizes, and headings in the world."""
    count = len(objects)
    poses = np.tile(np.eye(4), (count, 1, 1)) if poses is None else poses
    if len(poses) < count:
        raise DataError(path, f"has {count} frames, but there are {len(poses)} poses")
    rotations, translations = poses[:count, :3, :3], poses[:count, :3, 3]
    camera, turn = objects[..., 3:6], objects[..., 6]
    world = np.einsum("tij,tmj->tmi", rotations, camera) + translations[:, None]
    along = np.stack([np.cos(turn), np.zeros_like(turn), -np.sin(turn)], axis=-1)
    ahead = np.einsum("tij,tmj->tmi", rotations, along)
    headings = np.where(valid, np.arctan2(-ahead[..., 2], ahead[..., 0]), 0.0)
    return camera, np.where(valid[..., None], world, 0.0), objects[..., :3], headings
