"""The answer of `buildloc locate`, and the settings that commands start from."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from buildloc.located import locate, table
from buildloc.settings import load, matcher_config_of
from buildloc_matcher.config import PRESETS, MatcherConfig, matcher_config
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference.database import assemble
from buildloc_matcher.reference.ingest import read_buildings
from buildloc_matcher.reference.region import Circle
from buildloc_msgs_py.types import LocalMap

SAMPLE = Path(__file__).parents[3] / "bags" / "sample_footprints.geojson"


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_means_its_own_parameters_in_every_command(preset: str) -> None:
    installed = load(None, [f"matcher_node.preset={preset}"])
    assert matcher_config_of(installed) == matcher_config({"preset": preset})


def test_the_default_is_the_default() -> None:
    assert matcher_config_of(load()) == MatcherConfig()


def test_an_answer_without_a_rival_is_json_that_everyone_reads() -> None:
    config = MatcherConfig()
    found = read_buildings([SAMPLE], config.min_area_m2, Circle(47.62, 8.15, 0.4))
    buildings = found.buildings
    centre = buildings.centroids_m.mean(axis=0)
    some = buildings.select(np.argsort(np.hypot(*(buildings.centroids_m - centre).T))[:60])
    ids = np.arange(60)
    local_map = LocalMap.whole(
        0, ids, some.centroids_m - centre, some.areas_m2.astype(float), some.shapes.astype(float), ids + 1
    )
    answer = locate(Matcher(assemble(found.epsg, buildings, config), config), local_map, (0.0, 0.0), 5)
    assert json.loads(json.dumps(answer, allow_nan=False))["funnel"]["lead"] is None
    assert answer["fix"] is not None and answer["fix"]["lat"] == pytest.approx(47.62, abs=1e-3)
    assert "fix: 47.6" in table(answer)
