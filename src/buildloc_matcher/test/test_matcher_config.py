"""Presets by name, and every wrong parameter in one line."""

from __future__ import annotations

import dataclasses

import pytest
from buildloc_matcher.config import PRESETS, MatcherConfig, check_matcher, matcher_config, preset_values
from buildloc_msgs_py.config import ConfigError


def test_the_default_preset_is_the_defaults() -> None:
    assert matcher_config() == matcher_config({"preset": "default"}) == MatcherConfig()
    assert set(PRESETS) == {"default", "paper"}


def test_the_paper_preset_has_the_figures_of_the_paper() -> None:
    paper = matcher_config({"preset": "paper"})
    # Eq. 1: 15 degrees, 0.3, 0.3. Eq. 2: the angle against its tolerance, the perimeter as a ratio, no areas,
    # all four triangles alike. Bins of 100 m, the top 20 rescored, 20 frames within 50 m.
    assert (paper.tau_angle_deg, paper.tau_perimeter, paper.tau_shape) == (15.0, 0.3, 0.3)
    assert (paper.score_angle_deg, paper.score_perimeter) == (15.0, 1.0)
    assert (paper.area_weight, paper.centre_weight) == (0.0, 1.0)
    assert (paper.votes, paper.selection, paper.second_look) == ("score", "rigid", 0)
    assert (paper.bin_size_m, paper.top_k) == (100.0, 20)
    assert (paper.refine_frames, paper.refine_distance_m) == (20, 50.0)


def test_parameters_go_over_their_preset() -> None:
    config = matcher_config({"preset": "paper", "top_k": 7, "sigma_m": 3})
    assert (config.top_k, config.sigma_m, config.votes) == (7, 3.0, "score")
    assert dataclasses.replace(config, top_k=20, sigma_m=2.0) == matcher_config({"preset": "paper"})


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"preset": "papper"}, "preset papper is unknown; there are default, paper"),
        ({"preset": None}, "preset None is unknown"),
        ({"votes": "loud"}, "parameter votes = loud is not one of score, evidence"),
        ({"selection": "best"}, "parameter selection = best is not one of rigid, grow"),
        ({"tau_shape": 1.5}, "parameter tau_shape = 1.5 is out of range"),
        ({"match_share": 1.0}, "parameter match_share = 1.0 is out of range"),
        ({"matches_per_star": 0}, "parameter matches_per_star = 0 is out of range"),
        ({"top_k": "many"}, "parameter top_k = 'many' is not a int"),
        ({"tau": 1.0}, "parameter tau is unknown"),
        ({"sigma_m": float("nan")}, "parameter sigma_m = nan is out of range"),
    ],
)
def test_what_is_wrong_is_one_line(values: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError) as error:
        matcher_config(values)
    assert text in str(error.value) and "\n" not in str(error.value)


def test_every_preset_is_valid_and_names_parameters() -> None:
    names = {field.name for field in dataclasses.fields(MatcherConfig)}
    for name, values in PRESETS.items():
        assert set(values) <= names and preset_values(name).keys() == names
        check_matcher(MatcherConfig(**preset_values(name)))
