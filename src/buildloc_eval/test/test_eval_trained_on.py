"""What a network says of the ground that trained it."""

from __future__ import annotations

from typing import Any

import pytest
from buildloc_eval.trained_on import (
    TRAINING_KEY,
    TrainingNotesError,
    runs,
    trained_on,
    training_line,
)


def test_a_network_tells_its_places_or_has_no_word_of_them() -> None:
    assert trained_on({TRAINING_KEY: '{"places": ["banepa"], "steps": 3}'}) == {
        "places": ["banepa"], "steps": 3,
    }  # fmt: skip
    assert trained_on({"author": "somebody"}) is None


def test_runs_come_in_order_and_their_line_names_the_ground_once() -> None:
    first: dict[str, Any] = {"places": ["banepa"], "steps": 3}
    second = {"places": ["banepa", "zanzibar", "banepa"], "steps": 5}
    assert runs(second | {"start": first}) == [first, second]
    assert training_line([first, second]) == "3 + 5 steps on banepa (2 times), zanzibar"
    mean = second | {"averaged_with_runs_before": [1]}
    assert training_line([first, mean]).startswith("3 + 5 (averaged) steps on")
    assert runs(None) == [] and training_line([]) == "its file does not say what trained it"


@pytest.mark.parametrize("text", ["trained by hand", "[]", "{}", '{"places": "banepa"}', ""])
def test_notes_of_another_program_end_in_words(text: str) -> None:
    with pytest.raises(TrainingNotesError, match="names no places; export the network again") as error:
        trained_on({TRAINING_KEY: text})
    assert "\n" not in str(error.value)
