"""GNSS-free position from building patterns: command line, offline localizer, replay, launch."""
