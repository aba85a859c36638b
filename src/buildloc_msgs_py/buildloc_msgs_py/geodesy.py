"""Which plane coordinates belong to a place on Earth."""

from __future__ import annotations


def utm_epsg(longitude_deg: float, latitude_deg: float) -> int:
    """EPSG code of the WGS84 UTM zone of a position."""
    zone = min(60, int((longitude_deg + 180.0) // 6.0) + 1)
    return (32600 if latitude_deg >= 0.0 else 32700) + zone
