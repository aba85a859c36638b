"""What is varied: one thing at a time from a base case, for both presets.

The base case: maps of 100 buildings with the errors of level 1, drawn and sought within 12 km of Lexington.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from buildloc_matcher.config import MatcherConfig, matcher_config

from buildloc_eval.observation import Level

PRESETS = ("default", "paper")
NO_SHAPES = "no shapes"  # their weight is no parameter: all buildings of both sides get the same ones


@dataclass(frozen=True)
class Reference:
    """What is searched: the footprints within ``radius_km`` of Lexington (None: all of greater Boston) but
    for the share ``missing``; every image of 500 m is shifted by ``image_shift_m`` and every building by
    ``shift_m``, each its own way. Without ``shapes`` all buildings have the same shape metrics."""

    radius_km: float | None = 12.0
    missing: float = 0.0
    image_shift_m: float = 0.0
    shift_m: float = 0.0
    shapes: bool = True


@dataclass(frozen=True)
class Case:
    """A preset, whole or without one of its parts (``ablation``), on maps of so many ``buildings`` with the
    errors of a ``level``, but ``drift`` times its heading walk, and an altitude that is off by a share; flown
    within ``flown_km`` of Lexington (None: anywhere)."""

    preset: str
    ablation: str = ""
    level: Level = 1
    buildings: int = 100
    drift: float = 1.0
    altitude_bias: float = 0.0
    flown_km: float | None = 12.0
    reference: Reference = Reference()

    @property
    def name(self) -> str:
        """Of its file: whatever is not as in the base case."""
        parts = [*_differences(self, Case(self.preset)), *_differences(self.reference, Reference())]
        return "-".join([self.preset, *parts]).replace(" ", "_")

    @property
    def cost(self) -> float:
        """Relative: a large reference takes long to make and to search."""
        return 3.0 if self.reference.radius_km is None else 1.0

    @property
    def config(self) -> MatcherConfig:
        """Of the matcher."""
        values = ABLATIONS[self.preset][self.ablation] if self.ablation else {}
        return matcher_config({"preset": self.preset, **values})


def _differences(one: Any, other: Any) -> Iterator[str]:
    for field in fields(one):
        value = getattr(one, field.name)
        if value != getattr(other, field.name) and not isinstance(value, Reference):
            yield f"{field.name}={value}"


# Parts of the descriptor and stages of the selection, taken out by parameters: where none takes a part out,
# one goes to the end of its range.
_DESCRIPTOR: Mapping[str, Mapping[str, Any]] = {
    "angles filter nothing": {"tau_angle_deg": 180.0},
    "angles hardly count": {"score_angle_deg": 180.0},
    "perimeters filter nothing": {"tau_perimeter": 0.95},
    "perimeters hardly count": {"score_perimeter": 5.0},
    NO_SHAPES: {},
}
ABLATIONS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "default": {
        **_DESCRIPTOR,
        "no areas in the score": {"area_weight": 0.0},
        "neighbours weigh as the centre": {"centre_weight": 1.0},
        "neighbours hardly count": {"centre_weight": 10.0},
        "votes by score": {"votes": "score"},
        "rigid selection": {"selection": "rigid"},
        "no second look": {"second_look": 0},
        "no pairs in the second look": {"second_look_places": 0},
        "no seeds laid anew": {"reseeded": 0},
        "no building is invented": {"false_per_km2": 0.0},
        "all stars at first": {"max_stars": 0},
        "half the matches per star": {"matches_per_star": 50, "second_look_matches": 250},
        "20 candidates": {"top_k": 20},
        "no evidence of areas": {"area_share": 0.0},
        "no evidence of scale": {"sigma_scale": 1.0},
        "what is not seen hardly counts": {"seen_share": 0.05},
        "scale gate open": {"scale_gate": 0.9},
    },
    "paper": {
        **_DESCRIPTOR,
        "areas in the score": {"area_weight": 3.0, "score_area": 0.45},
        "the centre weighs most": {"centre_weight": 3.0},
        "votes by evidence": {"votes": "evidence", "min_votes": 1},
        "grown selection": {"selection": "grow"},
        "evidence and growth": {"votes": "evidence", "min_votes": 1, "selection": "grow"},
        "100 candidates": {"top_k": 100},
        "second look": {"second_look": 8},
    },
}  # fmt: skip


@dataclass(frozen=True)
class Factor:
    """A thing that is varied: title and axis of its figure, and for every value (as the axis shows it) the
    case, of the first preset."""

    title: str
    axis: str
    cases: tuple[tuple[Any, Case], ...]

    def of(self, preset: str) -> list[tuple[Any, Case]]:
        """Values and cases of a preset."""
        return [(value, replace(case, preset=preset)) for value, case in self.cases]


_BASE = Case(PRESETS[0])


def _map(title: str, axis: str, field: str, values: Iterable[Any], base: Case = _BASE) -> Factor:
    return Factor(title, axis, tuple((value, replace(base, **{field: value})) for value in values))


def _reference(title: str, axis: str, field: str, values: Iterable[Any], base: Case = _BASE) -> Factor:
    cases = ((v, replace(base, reference=replace(base.reference, **{field: v}))) for v in values)
    return Factor(title, axis, tuple(cases))


ALL = "all"
EVERYWHERE = replace(_BASE, flown_km=None, reference=Reference(None))
_AREA = _reference(
    "Area of the search, for flights within 4.2 km of its middle", "radius, km (all: greater Boston)",
    "radius_km", (4.2, 6.0, 9.0, 12.0, 18.0, None), replace(_BASE, flown_km=4.2),
)  # fmt: skip
_SHIFTS_M = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
FACTORS = (
    replace(_AREA, cases=tuple((ALL if value is None else value, case) for value, case in _AREA.cases)),
    _map(
        "Segmentation quality in all of greater Boston, flights anywhere", "level", "level",
        (1, 2, 3, "measured"), EVERYWHERE,
    ),
    _map("Segmentation quality", "level", "level", (0.5, 1, 1.5, 2, 2.5, 3, "measured")),
    _map("Drift", "heading walk, multiples of 0.15 deg per 10 m", "drift", (0.0, 1.0, 2.0, 4.0, 8.0)),
    _reference("Footprints missing in the reference", "share", "missing", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)),
    _reference("Images of 500 m of the reference shifted", "m", "image_shift_m", _SHIFTS_M),
    _reference("Every footprint of the reference shifted", "m", "shift_m", _SHIFTS_M),
    _map("Altitude bias", "share", "altitude_bias", (-0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1)),
    _map("Buildings seen", "buildings of the map", "buildings", (15, 20, 30, 40, 60, 100, 150, 200)),
)  # fmt: skip
ABLATED_LEVELS: tuple[Level, ...] = (1, 2)


def ablated(preset: str, level: Level) -> list[tuple[str, Case]]:
    """A preset whole and without each part, at a level."""
    whole = Case(preset, level=level)
    without = {name: replace(whole, ablation=name) for name in ABLATIONS[preset]}
    without[NO_SHAPES] = replace(without[NO_SHAPES], reference=Reference(shapes=False))
    return [("whole", whole), *without.items()]
