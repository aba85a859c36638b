"""How a network was trained, as its own file says."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from buildloc_msgs_py.errors import BuildlocError

TRAINING_KEY = "buildloc_training"  # of the ONNX file's metadata: JSON with the places that trained it


class TrainingNotesError(BuildlocError):
    """A network's file does not say on which ground it was trained."""


def trained_on(metadata: Mapping[str, str]) -> dict[str, Any] | None:
    """What trained a network, by the metadata of its file; None when they have no word of it. Raises
    TrainingNotesError."""
    text = metadata.get(TRAINING_KEY)
    if text is None:
        return None
    try:
        training = json.loads(text)
    except ValueError:
        training = None
    if not isinstance(training, dict) or not isinstance(training.get("places"), list):
        raise TrainingNotesError(
            f"metadata {TRAINING_KEY}: {text!r} names no places; export the network again"
        )
    return training


def runs(training: dict[str, Any] | None) -> list[dict[str, Any]]:
    """The runs of a training since the pretrained encoder, each after the one before; [] where not known."""
    if training is None:
        return []
    before = training.get("start")
    own = {key: value for key, value in training.items() if key != "start"}
    return [*runs(before if isinstance(before, dict) else None), own]


def training_line(of_runs: Sequence[dict[str, Any]]) -> str:
    """For people: the steps of each run, and the ground of the last one, which is all of it."""
    if not of_runs:
        return "its file does not say what trained it"
    averaged = (" (averaged)" if "averaged_with_runs_before" in run else "" for run in of_runs)
    steps = " + ".join(f"{run.get('steps', '?')}{mean}" for run, mean in zip(of_runs, averaged, strict=True))
    times = Counter(of_runs[-1]["places"])
    ground = ", ".join(name if n == 1 else f"{name} ({n} times)" for name, n in times.items())
    return f"{steps} steps on {ground}"
