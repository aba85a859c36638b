"""What a segmentation network must reach, and whether a report of `eval segmentation` says it does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from buildloc_eval.bars import Judged, judged

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
DENSE = "banepa"  # a dense town
DENSE_SCENE = "banepa_ortho"  # its scene whose labels tell touching houses apart
MERGED_OVER_PLAIN = 1.0 / 3.0
FALL = 0.05  # of the IoU, of disturbed input
FRAME_MS, QUANTISED_FRAME_MS, MEMORY_MB = 80.0, 55.0, 500.0
EQUAL_MASK_SHARE = 0.999


def case_bars(report: Mapping[str, Any]) -> Judged:
    """The bars of a network on a place, by the case's part of the report."""
    place, trained, every = report["place"], report["trained on"], report["all scenes"]
    places = trained[-1]["places"] if trained else []
    limits = {
        "barnarp": UNSEEN,
        "barnarp_east": OTHER_HALF_SEEN if "barnarp_west" in places else UNSEEN,
    }.get(place, ())
    name = f"{place}, {report['model']}"
    bars = {f"{name}: {key}": judged(every["instances"][key], limit, least) for key, limit, least in limits}
    if place == DENSE:
        merged = report["scenes"][DENSE_SCENE]["merged over plain"]
        bars[f"{name}: merged over plain"] = judged(merged, MERGED_OVER_PLAIN)
    falls = [row["falls_by"] for row in report["disturbed input"].values() if "falls_by" in row]
    bars[f"{name}: IoU of disturbed input falls by"] = judged(max(falls), FALL)
    equal = report["torch against onnx"]
    if equal is not None:
        bars[f"{name}: PyTorch and ONNX agree"] = judged(equal["equal_mask_share"], EQUAL_MASK_SHARE, True)
    return bars


def speed_bars(speeds: Mapping[str, Any]) -> Judged:
    """The bars of the timed networks."""
    bars = {}
    for name, values in speeds.items():
        if isinstance(values, Mapping):
            limit = QUANTISED_FRAME_MS if values["quantised"] else FRAME_MS
            bars[f"{name}: ms a frame"] = judged(values["ms_total"], limit)
            bars[f"{name}: peak memory, MB"] = judged(values["peak_memory_mb"], MEMORY_MB)
    return bars
