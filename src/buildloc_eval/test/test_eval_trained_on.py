"""What a network says of the ground that trained it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from buildloc_eval.trained_on import TRAINING_KEY, TrainingNotesError, trained_on


def network(**metadata: str) -> Any:
    return cast(Any, SimpleNamespace(metadata=metadata))


def test_a_network_tells_its_places_or_has_no_word_of_them() -> None:
    assert trained_on(network(**{TRAINING_KEY: '{"places": ["banepa"], "steps": 3}'})) == {
        "places": ["banepa"], "steps": 3,
    }  # fmt: skip
    assert trained_on(network(author="somebody")) is None


@pytest.mark.parametrize("text", ["trained by hand", "[]", "{}", '{"places": "banepa"}', ""])
def test_notes_of_another_program_end_in_words(text: str) -> None:
    with pytest.raises(TrainingNotesError, match="names no places; export the network again") as error:
        trained_on(network(**{TRAINING_KEY: text}))
    assert "\n" not in str(error.value)
