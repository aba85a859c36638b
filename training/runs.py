"""A training run that can stop and go on."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import torch


class Stateful(Protocol):
    """A network or an optimiser."""

    def state_dict(self) -> dict[str, Any]:
        """What it has learnt."""

    def load_state_dict(self, state: dict[str, Any], /) -> Any:
        """Take that back."""


class Run:
    """How far a run of so many steps is, and the parts (by name) that learn in it."""

    def __init__(self, parts: dict[str, Stateful], steps: int, device: torch.device) -> None:
        self._parts, self.steps, self.device = parts, steps, device
        self.step, self.seconds = 0, 0.0

    def save(self, path: Path, settings: dict[str, object]) -> None:
        """Write a checkpoint; a run that is killed meanwhile keeps the earlier one."""
        state = {name: part.state_dict() for name, part in self._parts.items()}
        unfinished = path.with_suffix(".part")
        torch.save(state | {"step": self.step, "seconds": self.seconds, "settings": settings}, unfinished)
        unfinished.replace(path)

    def restore(self, path: Path, settings: dict[str, object]) -> None:
        """Go on from a checkpoint. Raises SystemExit when it was made with other settings."""
        state = torch.load(path, map_location=self.device, weights_only=True)
        if state["settings"] != settings:
            raise SystemExit(f"{path}: was made with {state['settings']}; choose another --out, or remove it")
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        self.step, self.seconds = state["step"], state["seconds"]
