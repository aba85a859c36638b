"""How a network was trained, as its own file says."""

from __future__ import annotations

import json
from typing import Any

from buildloc_msgs_py.errors import BuildlocError
from buildloc_segmenter.network import Network

TRAINING_KEY = "buildloc_training"  # of the ONNX file's metadata: JSON with the places that trained it


class TrainingNotesError(BuildlocError):
    """A network's file does not say on which ground it was trained."""


def trained_on(network: Network) -> dict[str, Any] | None:
    """What trained a network; None when its file has no word of it. Raises TrainingNotesError."""
    text = network.metadata.get(TRAINING_KEY)
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
