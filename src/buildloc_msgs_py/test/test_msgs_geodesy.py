"""UTM zones of places that everybody can look up."""

from __future__ import annotations

import pytest
from buildloc_msgs_py.geodesy import utm_epsg


@pytest.mark.parametrize(
    ("longitude_deg", "latitude_deg", "epsg"),
    [
        (-71.06, 42.36, 32619),
        (139.7, 35.6, 32654),
        (151.2, -33.9, 32756),
        (180.0, 0.0, 32660),
        (-180.0, 1.0, 32601),
    ],
)
def test_zone_of_a_place(longitude_deg: float, latitude_deg: float, epsg: int) -> None:
    assert utm_epsg(longitude_deg, latitude_deg) == epsg
