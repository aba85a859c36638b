"""Settings of every test run."""

import os

# A field of the wrong type becomes garbage silently; this makes it an error. Read as messages are imported.
os.environ.setdefault("ROS_PYTHON_CHECK_FIELDS", "1")
