"""Settings of every test run."""

import os

import pytest

# A field of the wrong type becomes garbage silently; this makes it an error. Read as messages are imported.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first: otherwise one worker flies them alone while the other has nothing left."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
