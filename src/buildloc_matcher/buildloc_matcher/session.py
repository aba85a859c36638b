"""What the matcher node keeps between messages, without ROS: pairs masks with telemetry and maps with
keyframes, and hands out complete jobs. Stamps in ns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import observe
from buildloc_msgs_py.pairing import Telemetry
from buildloc_msgs_py.types import Fix, FrameObservation, Keyframe, LocalMap, Mask, NoFix, Tracked

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.matcher import Answer, Matcher
from buildloc_matcher.reference.database import open_database
from buildloc_matcher.seeker import Seeker
from buildloc_matcher.window import frames_kept

PENDING = 10


@dataclass(frozen=True)
class Job:
    """One solve: a map with the keyframes it was made from and what the frames saw; which flight it is of."""

    local_map: LocalMap
    keyframes: tuple[Keyframe, ...]
    observations: tuple[FrameObservation, ...]
    flight: int


class Session:
    """The state of one matcher: its reference or why there is none, the telemetry and the frames seen."""

    def __init__(self, config: MatcherConfig) -> None:
        self.config = config
        self.telemetry = Telemetry()
        self.seeker: Seeker | None = None
        self.database_path = ""
        self.reason = "no reference database: call /buildloc/reference/load"
        self.frames_unusable = 0
        self.maps_skipped = 0
        self.flight = 0
        self._frames: dict[int, FrameObservation | None] = {}
        self._maps: dict[int, LocalMap] = {}
        self._keyframes: dict[int, tuple[Keyframe, ...]] = {}
        self.reset()

    def reset(self) -> None:
        """Forget the flight, keep the reference."""
        self.flight += 1
        self.latest_stamp_ns = 0
        self.telemetry_fault = ""
        self.telemetry.reset()
        for flown in (self._frames, self._maps, self._keyframes):
            flown.clear()
        if (seeker := self.seeker) is not None:
            seeker.reset()

    def load(self, path: str) -> bool:
        """Open a reference database; on failure there is none, and ``reason`` says why."""
        self.database_path, self.seeker = path, None
        try:
            matcher = Matcher(open_database(Path(path), self.config), self.config)
            matcher.warm_up()
        except (BuildlocError, OSError) as error:
            self.reason = str(error)
            return False
        self.seeker = Seeker(matcher)
        return True

    def add_mask(self, mask: Mask) -> Job | None:
        """What a keyframe saw; a mask without its telemetry counts as seen, with nothing in it."""
        self.latest_stamp_ns = max(self.latest_stamp_ns, mask.stamp_ns)
        seen: FrameObservation | None = None
        self.telemetry_fault = ""
        try:
            camera, altitude, attitude = self.telemetry.at(mask.stamp_ns)
            if mask.pixels.shape != (camera.height, camera.width):
                size = f"{mask.pixels.shape[1]}x{mask.pixels.shape[0]}"
                raise BuildlocError(f"mask is {size}, camera_info says {camera.width}x{camera.height}")
            seen = observe(mask.pixels, mask.stamp_ns, camera, altitude, attitude, self.config.min_area_m2)
        except BuildlocError as error:
            self.telemetry_fault = str(error)
        self.frames_unusable += seen is None
        self._frames[mask.stamp_ns] = seen
        while len(self._frames) > frames_kept(self.config):
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
        if (seeker := self.seeker) is not None:
            seeker.carry(keyframes)
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
        return Job(self._maps.pop(stamp_ns), self._keyframes.pop(stamp_ns), seen, self.flight)

    def solve(self, job: Job) -> Answer:
        """Answer a job."""
        if job.flight != self.flight:
            return Answer(NoFix(job.local_map.stamp_ns, "the flight was forgotten meanwhile"), (), {})
        if (seeker := self.seeker) is None:
            return Answer(NoFix(job.local_map.stamp_ns, self.reason), (), {})
        return seeker.solve(job.local_map, job.keyframes, job.observations)

    def locate(self, tracked: Tracked) -> Fix | NoFix:
        """The fix of a tracked frame, or why there is none."""
        self.latest_stamp_ns = max(self.latest_stamp_ns, tracked.stamp_ns)
        if (seeker := self.seeker) is None:
            return NoFix(tracked.stamp_ns, self.reason)
        return seeker.locate(tracked)

    def failed(self, reason: str) -> None:
        """A job had no answer at all, and why."""
        if (seeker := self.seeker) is not None:
            seeker.failed(reason)

    def figures(self) -> dict[str, object]:
        """For /diagnostics."""
        counts = {"frames_unusable": self.frames_unusable, "maps_skipped": self.maps_skipped}
        seeker = self.seeker
        return {"database": self.database_path} | counts | (seeker.figures() if seeker else {})

    def waiting(self) -> NoFix:
        """No position right now, at the capture time of the latest image."""
        missing, seeker = self.telemetry.missing(), self.seeker
        if seeker is None:
            reason = self.reason
        elif missing:
            reason = f"no {', '.join(missing)} received; check that it is published"
        else:
            reason = self.telemetry_fault or seeker.reason
        return NoFix(self.latest_stamp_ns, reason)
