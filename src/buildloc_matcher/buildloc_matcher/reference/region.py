"""Which part of the world a database covers, and the UTM zone that its metres are of."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.types import FloatArray
from numpy.typing import NDArray
from pyproj import CRS, Transformer

WGS84 = 4326
KM_PER_DEGREE = 110.0  # a little less than anywhere on Earth, so that bounds in degrees are a little wide

Bounds = tuple[float, float, float, float]


class RegionError(BuildlocError):
    """A region that is none."""


@dataclass(frozen=True)
class Circle:
    """What lies within ``radius_km`` (of the UTM plane) of a position in degrees."""

    latitude_deg: float
    longitude_deg: float
    radius_km: float

    def __post_init__(self) -> None:
        if not 0.0 < self.radius_km < math.inf:
            raise RegionError(f"radius of {self.radius_km:g} km is not positive; give the radius in km")

    @property
    def center_deg(self) -> tuple[float, float]:
        """Latitude, longitude."""
        return self.latitude_deg, self.longitude_deg

    @property
    def bounds_deg(self) -> Bounds:
        """West, south, east, north of a box that holds the circle."""
        high = self.radius_km / KM_PER_DEGREE
        wide = high / max(math.cos(math.radians(abs(self.latitude_deg) + high)), 1e-3)
        west, east = self.longitude_deg - wide, self.longitude_deg + wide
        if west < -180.0 or east > 180.0:
            west, east = -180.0, 180.0  # the other side of the date line is near as well
        return west, max(self.latitude_deg - high, -90.0), east, min(self.latitude_deg + high, 90.0)

    def holds(self, centroids_m: FloatArray, epsg: int) -> NDArray[np.bool_]:
        """Which of the points (N, 2) of a UTM zone lie inside."""
        x, y = transformer(CRS(WGS84), CRS(epsg)).transform(self.longitude_deg, self.latitude_deg)
        distance = np.hypot(centroids_m[:, 0] - x, centroids_m[:, 1] - y)
        return np.asarray(distance <= self.radius_km * 1000.0)

    def __str__(self) -> str:
        return f"within {self.radius_km:g} km of {self.latitude_deg:.5f}, {self.longitude_deg:.5f}"


@dataclass(frozen=True)
class Box:
    """What lies between two meridians and two parallels, in degrees."""

    west_deg: float
    south_deg: float
    east_deg: float
    north_deg: float

    def __post_init__(self) -> None:
        west, south, east, north = self.bounds_deg
        if not (-180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0):
            raise RegionError(f"the box {self.bounds_deg} is not WEST,SOUTH,EAST,NORTH in degrees")

    @property
    def center_deg(self) -> tuple[float, float]:
        """Latitude, longitude."""
        return (self.south_deg + self.north_deg) / 2.0, (self.west_deg + self.east_deg) / 2.0

    @property
    def bounds_deg(self) -> Bounds:
        """West, south, east, north."""
        return self.west_deg, self.south_deg, self.east_deg, self.north_deg

    def holds(self, centroids_m: FloatArray, epsg: int) -> NDArray[np.bool_]:
        """Which of the points (N, 2) of a UTM zone lie inside."""
        longitude, latitude = transformer(CRS(epsg), CRS(WGS84)).transform(*centroids_m.T)
        return np.asarray(
            (longitude >= self.west_deg) & (longitude < self.east_deg)
            & (latitude >= self.south_deg) & (latitude < self.north_deg)
        )  # fmt: skip

    def __str__(self) -> str:
        return "in the box {:g}, {:g}, {:g}, {:g}".format(*self.bounds_deg)


Region = Circle | Box


def transformer(source: CRS, target: CRS) -> Transformer:
    """From one reference system to another, x east and y north or longitude and latitude."""
    return Transformer.from_crs(source, target, always_xy=True)
