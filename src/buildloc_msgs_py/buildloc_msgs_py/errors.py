"""One exception base for everything a user can put right."""


class BuildlocError(Exception):
    """An expected error: one line that names the problem and the remedy (exit status 2)."""
