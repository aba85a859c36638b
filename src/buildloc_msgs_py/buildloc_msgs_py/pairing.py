"""Images paired with the telemetry that belongs to them; one rule, live and recorded. No ROS."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from buildloc_msgs_py import topics, wire
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import validate_frame
from buildloc_msgs_py.types import ByteArray, CameraModel, Frame

T = TypeVar("T")
Attitude = tuple[float, float, float, float]

MAX_AGE_NS = 1_000_000_000
PATIENCE_NS = 3_000_000_000
HISTORY = 2_000


class Series(Generic[T]):
    """Stamped values of one topic, and the faults of messages that had none; answers with the nearest."""

    def __init__(self, topic: str, max_age_ns: int | None = MAX_AGE_NS) -> None:
        self.topic = topic
        self._max_age_ns = max_age_ns
        self._stamps: list[int] = []
        self._values: dict[int, T | BuildlocError] = {}

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, stamp_ns: int, value: T | BuildlocError) -> None:
        """Keep a value, or the fault of a message whose value cannot be used."""
        if stamp_ns not in self._values:
            insort(self._stamps, stamp_ns)
        self._values[stamp_ns] = value
        if len(self._stamps) > HISTORY:
            del self._values[self._stamps.pop(0)]

    def clear(self) -> None:
        """Forget all values."""
        self._stamps.clear()
        self._values.clear()

    def settled(self, stamp_ns: int) -> bool:
        """Whether no later message of an ordered topic can be nearer to ``stamp_ns``."""
        if self._max_age_ns is None:
            return bool(self._stamps)
        return bool(self._stamps) and self._stamps[-1] >= stamp_ns

    def at(self, stamp_ns: int) -> T:
        """The value nearest in time; raises WireError when there is none near enough or it was a fault."""
        if not self._stamps:
            raise wire.WireError(f"no {self.topic} received; check that it is published or recorded")
        at = bisect_left(self._stamps, stamp_ns)
        nearest = min(self._stamps[max(0, at - 1) : at + 1], key=lambda s: abs(s - stamp_ns))
        if self._max_age_ns is not None and abs(nearest - stamp_ns) > self._max_age_ns:
            age_s = abs(nearest - stamp_ns) * 1e-9
            raise wire.WireError(
                f"{self.topic} nearest to the image is {age_s:.1f} s away; check its rate and its clock"
            )
        value = self._values[nearest]
        if isinstance(value, BuildlocError):
            raise value
        return value


class Telemetry:
    """Intrinsics, height above ground and camera attitude, by stamp."""

    def __init__(self) -> None:
        self.camera: Series[CameraModel] = Series(topics.CAMERA_INFO, max_age_ns=None)
        self.altitude: Series[float] = Series(topics.ALTITUDE)
        self.attitude: Series[Attitude] = Series(topics.GIMBAL_ATTITUDE)
        self._decoders: dict[str, tuple[Series[Any], Callable[[Any], Any]]] = {
            topics.CAMERA_INFO: (self.camera, wire.decode_camera_info),
            topics.ALTITUDE: (self.altitude, wire.decode_altitude),
            topics.GIMBAL_ATTITUDE: (self.attitude, wire.decode_attitude),
        }

    def add(self, topic: str, message: Any) -> None:
        """Take a telemetry message of one of the three topics."""
        series, decode = self._decoders[topic]
        try:
            value = decode(message)
        except BuildlocError as error:
            value = error
        series.add(wire.stamp_ns(message), value)

    def unsettled(self, stamp_ns: int) -> tuple[str, ...]:
        """Topics of which a message still to come can change :meth:`at` of this stamp."""
        return tuple(t for t, (series, _) in self._decoders.items() if not series.settled(stamp_ns))

    def at(self, stamp_ns: int) -> tuple[CameraModel, float, Attitude]:
        """Camera, altitude (m) and attitude (x, y, z, w) of an image; WireError says what is missing."""
        return self.camera.at(stamp_ns), self.altitude.at(stamp_ns), self.attitude.at(stamp_ns)

    def reset(self) -> None:
        """Forget the flight. The intrinsics stay: they are the camera's, which may publish them only once."""
        self.altitude.clear()
        self.attitude.clear()

    def missing(self) -> tuple[str, ...]:
        """Topics of which nothing was received."""
        return tuple(topic for topic, (series, _) in self._decoders.items() if len(series) == 0)


@dataclass(frozen=True)
class FrameFault:
    """An image that cannot be used, and why."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True)
class _Waiting:
    stamp_ns: int
    frame_id: str
    decode: Callable[[], ByteArray]


class FramePairing:
    """Turns messages in the order they come into frames, in the order of the images.

    An image waits until telemetry at or after its stamp is there, so that live and recorded flights pair
    the same values however their topics interleave. It goes out with what there is once images of
    PATIENCE_NS came without a message of a topic that it waits for, or at :meth:`flush`. A topic that only
    lags is waited for: a busy node takes one message of each in turn, and telemetry comes ten to an image.
    """

    def __init__(self) -> None:
        self.telemetry = Telemetry()
        self._waiting: deque[_Waiting] = deque()
        self._last_stamp_ns = -1
        self._heard_at_ns: dict[str, int] = {}  # the newest image when a topic last spoke

    def add(self, topic: str, message: Any) -> list[Frame | FrameFault]:
        """Take a message of any input topic; the frames, or faults, that it completes."""
        if topic in (topics.IMAGE, topics.IMAGE_COMPRESSED):
            stamp = wire.stamp_ns(message)
            if stamp != self._last_stamp_ns:  # otherwise the same picture, raw and compressed
                decode = wire.decode_image if topic == topics.IMAGE else wire.decode_compressed_image
                self._waiting.append(_Waiting(stamp, str(message.header.frame_id), lambda: decode(message)))
                self._last_stamp_ns = stamp
        else:
            self.telemetry.add(topic, message)
            self._heard_at_ns[topic] = self._last_stamp_ns
        done: list[Frame | FrameFault] = []
        while self._waiting and self._due(self._waiting[0].stamp_ns):
            done.append(self._complete(self._waiting.popleft()))
        return done

    def _due(self, stamp_ns: int) -> bool:
        unsettled = self.telemetry.unsettled(stamp_ns)
        heard = [max(stamp_ns, self._heard_at_ns.get(topic, stamp_ns)) for topic in unsettled]
        return not heard or any(abs(self._last_stamp_ns - at_ns) > PATIENCE_NS for at_ns in heard)

    @property
    def waiting(self) -> int:
        """Number of images that wait for their telemetry."""
        return len(self._waiting)

    def flush(self) -> list[Frame | FrameFault]:
        """The waiting images with the telemetry there is: nothing more will come."""
        done = [self._complete(waiting) for waiting in self._waiting]
        self._waiting.clear()
        return done

    def reset(self) -> None:
        """Forget the flight: waiting images and telemetry, whose stamps the next flight may have too."""
        self.telemetry.reset()
        self._waiting.clear()
        self._heard_at_ns.clear()
        self._last_stamp_ns = -1

    def _complete(self, waiting: _Waiting) -> Frame | FrameFault:
        try:
            camera, altitude, attitude = self.telemetry.at(waiting.stamp_ns)
            frame = Frame(waiting.stamp_ns, waiting.frame_id, waiting.decode(), camera, altitude, attitude)
            validate_frame(frame)
        except BuildlocError as error:
            return FrameFault(waiting.stamp_ns, str(error))
        return frame
