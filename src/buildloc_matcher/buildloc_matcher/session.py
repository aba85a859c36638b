"""What the matcher node keeps between messages, without ROS: pairs masks with telemetry and maps with
keyframes, and hands out complete jobs. Stamps in ns."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import ByteArray, CameraModel, FrameObservation, Keyframe, LocalMap, Mask, NoFix

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.database import open_database
from buildloc_matcher.matcher import Answer, Matcher

T = TypeVar("T")
Attitude = tuple[float, float, float, float]
Observe = Callable[[ByteArray, int, CameraModel, float, Attitude, float], FrameObservation]

SLOP_NS = 50_000_000
MAX_AGE_NS = 2_000_000_000
HISTORY = 20_000
PENDING = 10


class Series(Generic[T]):
    """Stamped values; answers with the latest one no later than a stamp and not too old for it."""

    def __init__(self) -> None:
        self._values: deque[tuple[int, T]] = deque(maxlen=HISTORY)

    def add(self, stamp_ns: int, value: T) -> None:
        self._values.append((stamp_ns, value))

    def at(self, stamp_ns: int) -> T | None:
        """The value for a stamp, or None: nothing within MAX_AGE_NS before it (SLOP_NS after)."""
        usable = [v for v in self._values if stamp_ns - MAX_AGE_NS <= v[0] <= stamp_ns + SLOP_NS]
        return max(usable, key=lambda v: v[0])[1] if usable else None


@dataclass(frozen=True)
class Job:
    """One solve: a map with the keyframes it was made from and what the frames saw."""

    local_map: LocalMap
    keyframes: tuple[Keyframe, ...]
    observations: tuple[FrameObservation, ...]


class Session:
    """The state of one matcher: its reference, the telemetry, the frames seen and why there is no fix."""

    def __init__(self, config: MatcherConfig, observe: Observe) -> None:
        self.config = config
        self.altitudes: Series[float] = Series()
        self.attitudes: Series[Attitude] = Series()
        self.camera: CameraModel | None = None
        self.matcher: Matcher | None = None
        self.database_path = ""
        self.reason = "no reference database: set the parameter `database` or call /buildloc/reference/load"
        self.latest_stamp_ns = 0
        self.telemetry_fault = ""
        self.frames_unusable = 0
        self.maps_skipped = 0
        self._observe = observe
        self._frames: dict[int, FrameObservation | None] = {}
        self._maps: dict[int, LocalMap] = {}
        self._keyframes: dict[int, tuple[Keyframe, ...]] = {}

    def load(self, path: str) -> bool:
        """Open a reference database; on failure there is none, and ``reason`` says why."""
        self.database_path, self.matcher = path, None
        try:
            self.matcher = Matcher(open_database(Path(path), self.config), self.config)
        except (BuildlocError, OSError) as error:
            self.reason = str(error)
            return False
        self.reason = "waiting for a map"
        return True

    def add_mask(self, mask: Mask) -> Job | None:
        """What a keyframe saw; a mask without its telemetry counts as seen, with nothing in it."""
        self.latest_stamp_ns = mask.stamp_ns
        altitude, attitude = self.altitudes.at(mask.stamp_ns), self.attitudes.at(mask.stamp_ns)
        camera = self.camera
        seen: FrameObservation | None = None
        self.telemetry_fault = ""
        if camera is None or altitude is None or attitude is None:
            named = (("camera info", camera), ("altitude", altitude), ("gimbal attitude", attitude))
            missing = ", ".join(name for name, value in named if value is None)
            self.telemetry_fault = f"no {missing} for the image; check that it is published and its stamps"
        elif mask.pixels.shape != (camera.height, camera.width):
            size = f"{mask.pixels.shape[1]}x{mask.pixels.shape[0]}"
            self.telemetry_fault = f"mask is {size}, camera_info says {camera.width}x{camera.height}"
        else:
            seen = self._observe(
                mask.pixels, mask.stamp_ns, camera, altitude, attitude, self.config.min_area_m2
            )
        self.frames_unusable += seen is None
        self._frames[mask.stamp_ns] = seen
        while len(self._frames) > 4 * self.config.refine_frames:
            del self._frames[next(iter(self._frames))]
        return self._complete(mask.stamp_ns)

    def add_map(self, local_map: LocalMap) -> Job | None:
        """A map; its job is complete once its keyframes and the mask of its stamp are there."""
        self._maps[local_map.stamp_ns] = local_map
        return self._complete(local_map.stamp_ns)

    def add_keyframes(self, keyframes: tuple[Keyframe, ...]) -> Job | None:
        """The keyframe poses that belong to the map of the last keyframe's stamp."""
        if not keyframes:
            return None
        stamp_ns = max(k.stamp_ns for k in keyframes)
        self._keyframes[stamp_ns] = keyframes
        return self._complete(stamp_ns)

    def _complete(self, stamp_ns: int) -> Job | None:
        waiting: tuple[dict[int, Any], ...] = (self._maps, self._keyframes)
        for pending in waiting:
            while len(pending) > PENDING:
                pending.pop(next(iter(pending)))
                self.maps_skipped += 1
        if stamp_ns not in self._maps or stamp_ns not in self._keyframes or stamp_ns not in self._frames:
            return None
        seen = tuple(f for f in self._frames.values() if f is not None)
        return Job(self._maps.pop(stamp_ns), self._keyframes.pop(stamp_ns), seen)

    def solve(self, job: Job) -> Answer:
        """Answer a job; keeps the reason when there is no fix."""
        if self.matcher is None:
            return Answer(NoFix(job.local_map.stamp_ns, self.reason), (), {})
        answer = self.matcher.fix(job.local_map, job.keyframes, job.observations)
        self.reason = answer.result.reason if isinstance(answer.result, NoFix) else "waiting for the next map"
        return answer

    def waiting(self) -> NoFix:
        """No position right now, at the capture time of the latest image."""
        fault = self.telemetry_fault if self.matcher is not None else ""
        return NoFix(self.latest_stamp_ns, fault or self.reason)
