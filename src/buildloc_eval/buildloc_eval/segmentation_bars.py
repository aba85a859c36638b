"""What a segmentation network must reach, and whether a report of `eval segmentation` says it does."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Limit = tuple[str, float, bool]  # a figure of instance_metrics, its limit, whether it must be at least that

UNSEEN: tuple[Limit, ...] = (
    ("pixel_iou", 0.70, True),
    ("recall_0.3", 0.88, True),
    ("precision_0.3", 0.80, True),
    ("centroid_median_m", 0.8, False),
)
OTHER_HALF_SEEN: tuple[Limit, ...] = (
    ("pixel_iou", 0.83, True),
    ("recall_0.3", 0.97, True),
    ("precision_0.3", 0.90, True),
    ("centroid_median_m", 0.35, False),
    ("centroid_p90_m", 1.5, False),
)
DENSE, DENSE_SCENE = (
    "banepa",
    "banepa_ortho",
)  # a dense town; its scene whose labels tell touching houses apart
MERGED_OVER_PLAIN = 1.0 / 3.0
FALL = 0.05  # of the IoU, of disturbed input
FRAME_MS, QUANTISED_FRAME_MS, MEMORY_MB = 80.0, 55.0, 500.0
EQUAL_MASK_SHARE = 0.999


@dataclass(frozen=True)
class Bar:
    """What was measured (None: nothing to measure it on) and its limit: the least or the most it may be."""

    what: str
    measured: float | None
    limit: float
    at_least: bool

    @property
    def met(self) -> bool:
        """Whether it is; not when nothing was measured."""
        if self.measured is None:
            return False
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit


def case_bars(report: Mapping[str, Any]) -> list[Bar]:
    """The bars of a network on a place, by the case's part of the report."""
    place, trained, every = report["place"], report["trained on"], report["all scenes"]
    places = trained["places"] if isinstance(trained, Mapping) else []
    limits = {
        "barnarp": UNSEEN,
        "barnarp_east": OTHER_HALF_SEEN if "barnarp_west" in places else UNSEEN,
    }.get(place, ())
    name = f"{place}, {report['model']}"
    bars = [Bar(f"{name}: {key}", every["instances"][key], limit, least) for key, limit, least in limits]
    if place == DENSE:
        merged = report["scenes"][DENSE_SCENE]["merged over plain"]
        bars.append(Bar(f"{name}: merged over plain", merged, MERGED_OVER_PLAIN, False))
    falls = [row["falls_by"] for row in report["disturbed input"].values() if "falls_by" in row]
    bars.append(Bar(f"{name}: IoU of disturbed input falls by", max(falls), FALL, False))
    equal = report["torch against onnx"]
    if equal is not None:
        bars.append(Bar(f"{name}: PyTorch and ONNX agree", equal["equal_mask_share"], EQUAL_MASK_SHARE, True))
    return bars


def speed_bars(speeds: Mapping[str, Any]) -> list[Bar]:
    """The bars of the timed networks."""
    bars = []
    for name, values in speeds.items():
        if isinstance(values, Mapping):
            limit = QUANTISED_FRAME_MS if values["quantised"] else FRAME_MS
            bars.append(Bar(f"{name}: ms a frame", values["ms_total"], limit, False))
            bars.append(Bar(f"{name}: peak memory, MB", values["peak_memory_mb"], MEMORY_MB, False))
    return bars


def bars_table(bars: Sequence[Bar]) -> list[str]:
    """For people."""
    return [
        f"{'met    ' if bar.met else 'NOT MET'} {bar.what} "
        + ("not measured" if bar.measured is None else f"{bar.measured:.4g}")
        + f" (bar: {'at least' if bar.at_least else 'at most'} {bar.limit:.4g})"
        for bar in bars
    ]
