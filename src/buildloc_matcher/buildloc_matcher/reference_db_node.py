"""Serves /buildloc/reference/load and tells the matcher which reference database to use."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

from buildloc_msgs_py import qos, topics
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ros_node import Diagnostics, declare_config, run_node
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.srv import LoadMap
from rclpy.node import Node
from std_msgs.msg import String

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.reference.database import DatabaseMissingError, open_database


def local_path(map_url: str) -> Path:
    """The path of a file:// URL or a plain path."""
    return Path(unquote(urlparse(map_url).path) if map_url.startswith("file://") else map_url)


class ReferenceDbNode(Node):  # type: ignore[misc]
    """Checks a database before announcing its path; a bad one leaves the current one in place."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("reference_db_node", **kwargs)
        self._config = declare_config(self, MatcherConfig)
        self.diagnostics = Diagnostics(self)
        self._publisher = self.create_publisher(String, topics.REFERENCE_DATABASE, qos.LATCHED)
        self.create_service(LoadMap, topics.REFERENCE_LOAD, self._on_load)
        database = str(self.declare_parameter("database", "").value)
        if database:
            self.load(database)
        else:
            hint = "no reference database: call /buildloc/reference/load"
            self.diagnostics.report(DiagnosticStatus.WARN, hint)

    def load(self, map_url: str) -> int:
        """Open, check and announce a database; the result code of nav_msgs/srv/LoadMap."""
        path = local_path(map_url)
        try:
            database = open_database(path, self._config)
        except (BuildlocError, OSError) as error:
            self.get_logger().error(str(error))
            self.diagnostics.report(DiagnosticStatus.ERROR, str(error))
            missing = isinstance(error, DatabaseMissingError)
            response = LoadMap.Response
            return int(response.RESULT_MAP_DOES_NOT_EXIST if missing else response.RESULT_INVALID_MAP_DATA)
        self._publisher.publish(String(data=str(path.resolve())))
        self.diagnostics.report(
            DiagnosticStatus.OK,
            "reference database loaded",
            database=str(path),
            buildings=len(database),
            stars=database.stars,
            epsg=database.epsg,
        )
        return int(LoadMap.Response.RESULT_SUCCESS)

    def _on_load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        response.result = self.load(request.map_url)
        return response


def main() -> int:
    """Entry point."""
    return int(run_node(ReferenceDbNode))


if __name__ == "__main__":
    sys.exit(main())
