"""Matching of a local building map against a reference database of building footprints."""
