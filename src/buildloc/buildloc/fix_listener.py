"""A subscriber as an integrator would write it: prints every message of /buildloc/fix and when it came, one
JSON line each.

python -m buildloc.fix_listener [--out FIXES.jsonl]
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any, TextIO

from buildloc_msgs_py import qos, topics, wire
from buildloc_msgs_py.ros_node import run_node
from buildloc_msgs_py.types import Fix, NoFix
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node
from sensor_msgs.msg import NavSatFix

from buildloc.records import record

POSES_KEPT = 50


class FixListener(Node):  # type: ignore[misc]
    """Writes fixes with the metric pose of the same stamp."""

    def __init__(self, out: TextIO) -> None:
        super().__init__("fix_listener")
        self._out = out
        self._fixes: OrderedDict[int, Fix] = OrderedDict()
        self._poses: OrderedDict[int, tuple[float, float, float]] = OrderedDict()
        self.create_subscription(NavSatFix, topics.FIX, self._on_fix, qos.SENSOR)
        self.create_subscription(PoseWithCovarianceStamped, topics.POSE, self._on_pose, qos.SENSOR)

    def _on_fix(self, message: NavSatFix) -> None:
        fix = wire.decode_fix(message)
        if isinstance(fix, NoFix):
            self._write(fix, (math.nan, math.nan, math.nan))
        else:
            self._fixes[fix.stamp_ns] = fix
            self._pair(fix.stamp_ns)

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        stamp = wire.stamp_ns(message)
        self._poses[stamp] = wire.decode_pose(message)
        self._pair(stamp)
        while len(self._poses) > POSES_KEPT:
            self._poses.popitem(last=False)

    def _pair(self, stamp_ns: int) -> None:
        if stamp_ns in self._fixes and stamp_ns in self._poses:
            self._write(self._fixes.pop(stamp_ns), self._poses.pop(stamp_ns))

    def _write(self, fix: Fix | NoFix, pose: tuple[float, float, float]) -> None:
        arrived = {"received_ns": time.time_ns()}
        self._out.write(json.dumps(record(fix, pose) | arrived) + "\n")
        self._out.flush()


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(description="print /buildloc/fix as JSON lines until SIGINT")
    parser.add_argument("--out", type=Path, help="file to write instead of standard output")
    args: Any = parser.parse_args()
    out = args.out.open("w") if args.out else sys.stdout
    try:
        return run_node(lambda: FixListener(out))
    finally:
        if args.out:
            out.close()


if __name__ == "__main__":
    sys.exit(main())
