"""Recorded flights: frames out of a rosbag2 (MCAP or SQLite), without ROS."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from buildloc_msgs_py import topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.pairing import FrameFault, FramePairing
from buildloc_msgs_py.types import Frame
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

TELEMETRY = (topics.CAMERA_INFO, topics.ALTITUDE, topics.GIMBAL_ATTITUDE)
IMAGES = (topics.IMAGE, topics.IMAGE_COMPRESSED)


class BagError(BuildlocError):
    """A bag cannot be used."""


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """A reader, open within the context. Raises BagError for a missing, damaged or empty bag."""
    if not path.exists():
        raise BagError(f"{path}: no such bag; give the folder of a rosbag2 recording")
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        raise BagError(f"{path}: is a folder without metadata.yaml; give a rosbag2, or `ros2 bag reindex` it")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY))
        reader.open()
    except Exception as error:  # rosbags and the storage libraries raise many kinds on damaged files
        raise BagError(
            f"{path}: bag is truncated or damaged ({_line(error)}); record or copy it again"
        ) from error
    try:
        if reader.message_count == 0:
            raise BagError(f"{path}: bag holds no messages; record the flight again")
        yield reader
    finally:
        reader.close()


def _line(error: Exception) -> str:
    text = str(error).strip()
    return text.splitlines()[0] if text else type(error).__name__


def require_topics(reader: AnyReader, path: Path) -> None:
    """Raise BagError when an input topic is absent or empty."""
    present = {c.topic.lstrip("/") for c in reader.connections if c.msgcount > 0}
    missing = [topic for topic in TELEMETRY if topic not in present]
    if not present.intersection(IMAGES):
        missing.insert(0, " or ".join(IMAGES))
    if missing:
        raise BagError(
            f"{path}: bag has no messages on {', '.join(missing)}; it has {', '.join(sorted(present))}; "
            "record the missing topics or remap them"
        )


def raw_messages(
    reader: AnyReader, path: Path, names: set[str] | None = None
) -> Iterator[tuple[Any, int, bytes]]:
    """(connection, time in ns, CDR bytes) in order of recording, of the topics named (without slash) or all.

    Raises BagError where the recording is damaged.
    """
    wanted = [c for c in reader.connections if names is None or c.topic.lstrip("/") in names]
    try:
        yield from reader.messages(wanted)
    except Exception as error:
        raise BagError(
            f"{path}: bag is truncated or damaged ({_line(error)}); record or copy it again"
        ) from error


def read_frames(path: Path) -> Iterator[Frame | FrameFault]:
    """Frames in order, paired with their telemetry; FrameFault for an image that cannot be used.

    Raises BagError when the bag is missing, damaged, empty or lacks a needed topic.
    """
    with open_bag(path) as reader:
        require_topics(reader, path)
        pairing = FramePairing()
        for connection, _, data in raw_messages(reader, path, {*TELEMETRY, *IMAGES}):
            message = reader.deserialize(data, connection.msgtype)
            yield from pairing.add(connection.topic.lstrip("/"), message)
        yield from pairing.flush()
