"""Shows a live view in the browser: scene, states, curves, diagnosis and correction."""

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from std_msgs.msg import String

from anser_ros.nodes.output_parts.chain_client import ChainClient
from anser_ros.nodes.output_parts.polled import polling_node
from anser_ros.nodes.output_parts.view_source import ViewSource
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import parameter
from anser_ros.nodes.runtime.process import main
from anser_ros.nodes.runtime.shared_names import optical_parameter
from anser_ros.wire.tcp_ports import LIVE_VIEW


@dataclass(frozen=True)
class DashboardParameters:
    """Holds the parameters of the live view."""

    host: str = parameter(
        '127.0.0.1',
        "address that the page is served on; any other than this machine's own needs a token",
    )
    port: int = parameter(
        LIVE_VIEW, 'TCP port of the page; 0 for any that is free', minimum=0, maximum=65535
    )
    token_file: str = parameter(
        '', 'file with the token that browsers have to know; empty: a new one, printed at the '
        'start, where other machines can reach the page',
    )  # fmt: skip
    directory: str = parameter(
        'recordings', "the recorder's folder; all that the page reads and writes lies in it"
    )
    optical: str = optical_parameter()


class Dashboard(AnserNode):
    """Serves the live view to browsers.

    It only subscribes; its buttons call services and run commands.
    """

    NAME = 'dashboard'
    EXAMPLE = f'--ros-args -p directory:=recordings -p port:={LIVE_VIEW}'
    PARAMETERS = DashboardParameters

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # Loaded here, for the help of the node must not need what may be missing.
        from anser_ros.web.folder import RecordingFolder
        from anser_ros.web.loop import CorrectionLoop
        from anser_ros.web.page import Pages
        from anser_ros.web.server import PageServer, token_for

        table = self.parameters
        self._streams = polling_node(self.get_name(), self.get_namespace())
        self._client = ChainClient(self)
        refuse = partial(self.warn, 'messages_refused')
        self._source = ViewSource(self._streams, table.optical, refuse, self._client.is_there)
        self.create_subscription(String, 'setup', self._on_setup, qos.LATCHED)
        folder = RecordingFolder(Path(table.directory))
        if words := folder.trouble():
            self.get_logger().warning(f'directory {folder.path}: {words}: no result can be kept')
        self._loop = CorrectionLoop(self._client, self._source, folder)
        self._pages = Pages(self._source, self._loop, self._guard)
        self._pages.register()
        token = token_for(table.host, table.token_file)
        self._server = PageServer(table.host, table.port, token, folder)
        self._server.start()
        # Not in the log, which goes out on the graph: the address has the token in it.
        print(f'live view: {self._server.url}', flush=True)

    def _on_setup(self, message: String) -> None:
        self._source.setup_text = message.data

    def status(self) -> Status:
        """Return how many pages look on."""
        job = self._loop.job
        values = {
            'pages': self._server.guard.pages,
            'command': '' if job is None else job.kind,
            'last_trouble': self._loop.message if self._loop.is_trouble else '',
        }
        return Status('', Level.OK, f'{self._pages.count} pages open', values)

    def close(self) -> None:
        """End the page, and a command that runs."""
        self._loop.cancel()
        self._server.end()
        self._streams.destroy_node()


if __name__ == '__main__':
    sys.exit(main(Dashboard))
