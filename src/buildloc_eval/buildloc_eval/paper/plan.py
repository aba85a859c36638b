"""What a run of the experiments is: its extent, its error models, and where its stages are kept."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from buildloc_mapper.config import MapperConfig
from buildloc_matcher.config import matcher_config

from buildloc_eval.observation import Digitiser
from buildloc_eval.paper.differences import AutomaticMapping
from buildloc_eval.paper.flights import Flight, PaperFlight
from buildloc_eval.paper.methods import METHODS
from buildloc_eval.paper.netvlad import NETVLAD
from buildloc_eval.paper.published import LARGE_RADII_KM, RADII_KM
from buildloc_eval.paper.store import Store
from buildloc_eval.sections import source_digest
from buildloc_eval.segmentation_errors import Outlines, SegmentationErrors, read_errors

PAPER = "buildloc_eval.paper"
GROUND_CODE = (f"{PAPER}.sources", f"{PAPER}.differences", f"{PAPER}.flights", "buildloc_eval.observation")
TRACK_CODE = (
    "buildloc_mapper", "buildloc_msgs_py", "buildloc_eval.flight", "buildloc_eval.camera",
    "buildloc_eval.orthos", "buildloc_eval.world",
    *(f"{PAPER}.{name}" for name in ("flights", "published", "texture", "flown")),
)  # fmt: skip
MAP_CODE = (*TRACK_CODE, *GROUND_CODE, f"{PAPER}.brm", "buildloc_eval.segmentation_errors")
PREDICTION_CODE = (
    *MAP_CODE, "buildloc_matcher", "buildloc_eval.generators", f"{PAPER}.methods"
)  # fmt: skip
NETVLAD_CODE = (*MAP_CODE, f"{PAPER}.methods", f"{PAPER}.netvlad", f"{PAPER}.retrieval")


@dataclass(frozen=True)
class Plan:
    """What is run of a part: flights by their names, seeds of each, radii; of which methods every prefix is
    located, at which radii, and for how many seeds at each; the methods."""

    flights: tuple[str, ...]
    seeds: int
    radii_km: tuple[int, ...]
    prefixes: dict[str, dict[int, int]]
    methods: tuple[str, ...] = METHODS


SEEDS = 10
# Prefixes are most of the work: those of several seeds where the bar is, at 6 km.
PREFIXES = {LARGE_RADII_KM[0]: 3} | dict.fromkeys(LARGE_RADII_KM[1:], 1)
FULL = Plan(
    tuple(f"flight{n}" for n in range(1, 8)), SEEDS, RADII_KM,
    {"default preset": PREFIXES, "paper preset": PREFIXES},
)  # fmt: skip
# Ground that the network which ships never saw. Those of the other places were trained a twelfth as long.
ERRORS_OF = "barnarp"
QUICK = Plan(("flight1", "flight2"), 2, (1, 6, 12), {"default preset": {6: 2}, "paper preset": {6: 2}})


@dataclass(frozen=True)
class Snow:
    """Residual snow of flight 7: patches on the ground that look like roofs, false buildings added per km2
    and their median area."""

    false_per_km2: float = 200.0
    area_m2: float = 80.0

    def on(self, errors: SegmentationErrors) -> SegmentationErrors:
        """The errors with the patches among the false buildings, whose area is the mean of both kinds."""
        total = errors.false_per_km2 + self.false_per_km2
        area = errors.false_per_km2 * errors.false_median_m2 + self.false_per_km2 * self.area_m2
        return replace(errors, false_per_km2=total, false_median_m2=area / total)


@dataclass(frozen=True)
class Models:
    """Every error that is simulated, and the mapper's parameters."""

    segmentation: SegmentationErrors
    digitiser: Digitiser = field(default_factory=Digitiser)
    automatic: AutomaticMapping = field(default_factory=AutomaticMapping)
    snow: Snow = field(default_factory=Snow)
    mapper: MapperConfig = field(default_factory=MapperConfig)

    def errors(self, flight: PaperFlight) -> SegmentationErrors:
        """Of the segmenter over a flight's ground."""
        return self.snow.on(self.segmentation) if flight.like.snow else self.segmentation


def measured_models() -> Models:
    """With the segmenter's errors as they were measured. Raises ErrorModelError without that file."""
    return Models(read_errors(ERRORS_OF))


class Stores:
    """One folder per stage. Each is refused when an earlier stage's configuration or code has changed.

    ``also`` and ``code``: what a part depends on besides, and its own modules. ``networks``: digest of
    NetVLAD's, whose predictions have a folder of their own.
    """

    def __init__(
        self, out: Path, seed: int, models: Models, also: Mapping[str, Any] = {}, code: Sequence[str] = (),
        networks: str | None = None,
    ) -> None:  # fmt: skip
        said = {name: value for name, value in asdict(models).items() if name != "mapper"}
        ground = {
            "seed": seed,
            "digitiser": said.pop("digitiser"),
            "automatic": said.pop("automatic"),
            **also,
        }
        track = {"seed": seed, "mapper": asdict(models.mapper), **also}
        matchers = {name: asdict(matcher_config({"preset": name})) for name in ("default", "paper")}
        self.ground = Store(out / "ground", _plain(ground | {"code": source_digest((*GROUND_CODE, *code))}))
        self.tracks = Store(out / "tracks", _plain(track | {"code": source_digest((*TRACK_CODE, *code))}))
        maps = ground | track | said
        self.maps = Store(out / "maps", _plain(maps | {"code": source_digest((*MAP_CODE, *code))}))
        predictions = maps | {"matchers": matchers, "code": source_digest((*PREDICTION_CODE, *code))}
        self.predictions = Store(out / "predictions", _plain(predictions))
        retrieval = maps | {"networks": networks, "code": source_digest((*NETVLAD_CODE, *code))}
        self._netvlad = None if networks is None else Store(out / "netvlad", _plain(retrieval))

    def of(self, method: str) -> Store:
        """Where a method's predictions are kept."""
        return self._netvlad if method == NETVLAD and self._netvlad is not None else self.predictions


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """As JSON gives it back: lists for tuples."""
    return dict(json.loads(json.dumps(values)))


def maps_name(flight: Flight, seed: int) -> str:
    """Of the maps of a flight and a seed."""
    return f"{flight.name}_seed{seed}"


def prediction_name(method: str, radius_km: float, flight: Flight, seed: int, prefixes: bool) -> str:
    """Of a prediction, or of those of all prefixes."""
    kind = "prefixes" if prefixes else "whole"
    return f"{kind}_{method.replace(' ', '_')}_{radius_km:g}km_{maps_name(flight, seed)}"


def whole_names(method: str, flight: Flight, seed: int, radii_km: Sequence[int]) -> dict[int, str]:
    """Of the predictions of a whole flight, by radius."""
    return {radius: prediction_name(method, radius, flight, seed, prefixes=False) for radius in radii_km}


def ragged(outlines: Outlines) -> tuple[Any, ...]:
    """Outlines as arrays, which are kept and read much faster than objects."""
    return tuple(shapely.to_ragged_array(outlines))


def outlines_of(kept: tuple[Any, ...]) -> Outlines:
    """Outlines kept by :func:`ragged`."""
    return np.asarray(shapely.from_ragged_array(*kept))
