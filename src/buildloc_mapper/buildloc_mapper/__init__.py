"""Keyframes stitched into a metric map of buildings: registration, pose graph, mask fusion, extraction."""
