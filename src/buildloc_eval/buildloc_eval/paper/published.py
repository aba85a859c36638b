"""What the paper reports: its tables and the figures of its text, to stand beside ours.

Seven real flights over Denver, reference of Microsoft Building Footprints. None: the paper has no figure.
"""

from __future__ import annotations

from dataclasses import dataclass

RADII_KM = (1, 3, 6, 9, 12)
LARGE_RADII_KM = (6, 9, 12)
CORRECT_M = 100.0

Triple = tuple[float | None, float | None, float | None]


@dataclass(frozen=True)
class PublishedFlight:
    """A row of Tables "flight summary" and "reference-map building count"; triples at 6, 9, 12 km.

    ``environment``: C commercial, S suburban (single-family), R residential (multi-family).
    """

    number: int
    length_km: float
    altitude_m: float
    keyframes: int
    detected: int
    environment: str
    reference: tuple[int, int, int]
    coarse_m: Triple
    final_m: Triple
    snow: bool = False


FLIGHTS = (
    PublishedFlight(
        1, 0.39, 108, 20, 30, "C", (18_711, 51_452, 99_484), (22.9, 22.9, 22.8), (7.3, 7.3, 7.6)
    ),
    PublishedFlight(
        2, 1.68, 116, 67, 78, "C+S", (49_962, 120_434, 201_628), (45.0, 47.4, 47.4), (25.4, 32.9, 31.3)
    ),
    PublishedFlight(
        3, 2.19, 105, 101, 133, "S", (17_987, 52_290, 101_521), (99.9, 102.5, 105.3), (40.0, 38.2, 40.7)
    ),
    PublishedFlight(
        4, 3.18, 115, 256, 104, "R", (84_318, 178_164, 272_878), (27.6, 27.4, 27.3), (20.5, 17.7, 17.7)
    ),
    PublishedFlight(
        5, 2.26, 98, 76, 87, "C+S", (78_849, 159_946, 260_750), (153.7, 156.1, None), (22.1, 30.3, None)
    ),
    PublishedFlight(
        6, 2.85, 106, 181, 121, "C+S", (90_617, 167_685, 277_091), (52.8, 44.2, None), (4.7, 4.3, None)
    ),
    PublishedFlight(
        7, 2.02, 97, 186, 104, "C+S+R", (64_662, 103_742, 173_956), (38.9, 36.2, 37.8), (30.5, 25.2, 26.8),
        snow=True,
    ),
)  # fmt: skip

# Flights of seven with a correct hypothesis among the first 1, 5 and 10, at RADII_KM.
RECALL: dict[str, dict[int, tuple[int, int, int, int, int]]] = {
    "NetVLAD": {1: (5, 2, 0, 0, 0), 5: (7, 3, 0, 0, 0), 10: (7, 3, 0, 0, 0)},
    "BRM": {1: (6, 1, 1, 0, 0), 5: (6, 2, 1, 0, 0), 10: (6, 3, 1, 0, 0)},
    "ours without shape": {1: (5, 5, 4, 3, 3), 5: (6, 6, 5, 3, 3), 10: (6, 6, 6, 3, 3)},
    "ours": {1: (7, 7, 7, 7, 5), 5: (7, 7, 7, 7, 5), 10: (7, 7, 7, 7, 5)},
}
# Mean keyframes to the first and to the stable success, at LARGE_RADII_KM (12 km: five successful flights).
FIRST_SUCCESS = (38.6, 42.7, 64.2)
STABLE_SUCCESS = (48.6, 51.6, 75.4)
# Seconds per query on an RTX 5070, segmentation among them, at LARGE_RADII_KM.
SECONDS_PER_QUERY = ((0.4, 1.2), (0.6, 1.3), (0.7, 1.5))
