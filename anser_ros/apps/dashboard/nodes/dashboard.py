"""Shows a live view in the browser: scene, states, curves, diagnosis and correction.

On behalf of the page it asks the running nodes for services and model files (`ChainClient`).
"""

import asyncio
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from anser_ros.apps.dashboard.extension import LIVE_VIEW
from anser_ros.apps.dashboard.nodes.view_source import ViewSource, polling_node
from anser_ros.errors import AnserError
from anser_ros.nodes.runtime import qos
from anser_ros.nodes.runtime.node import AnserNode, Level, Status
from anser_ros.nodes.runtime.parameters import optical_parameter, parameter
from anser_ros.nodes.runtime.process import main

TRIGGERS = ('recorder/start', 'recorder/stop', 'field_model/set_baseline')
MODEL_FILE, BASELINE_FILE = 'model_file', 'baseline_file'
HOLDERS = ('field_model', 'tracker', 'watcher')
"""Nodes with a model file, in the order in which they are given another one."""
ANSWER_S = 10.0
"""Time that an answer is waited for, s: nodes of a busy machine answer late."""
LOADING_S = 60.0
"""Time for a node to load a model and to begin its refit with it, s."""


class ChainError(AnserError):
    """A node that is asked is not there, does not answer, or refuses."""


class ChainClient:
    """Reaches the nodes of a namespace; they refuse by `ChainError`.

    The node's executor must be spinning in another thread than that of the page.
    """

    def __init__(self, node: Node) -> None:
        self._triggers = {name: node.create_client(Trigger, name) for name in TRIGGERS}
        self._getters = {
            name: node.create_client(GetParameters, f'{name}/get_parameters') for name in HOLDERS
        }
        self._setters = {
            name: node.create_client(SetParameters, f'{name}/set_parameters') for name in HOLDERS
        }

    def is_there(self, service: str) -> bool:
        return bool(self._triggers[service].service_is_ready())

    async def trigger(self, service: str) -> str:
        """Call a service without arguments and return its answer.

        Raises `ChainError` when no node offers it, answers in time, or when it refuses.
        """
        answer = await _ask(self._triggers[service], Trigger.Request(), ANSWER_S)
        if not answer.success:
            raise ChainError(answer.message or f'{service} is refused')
        return str(answer.message)

    async def model_files(self) -> dict[str, str]:
        """Return the model file of each node that is there."""
        found = {}
        for name, getter in self._getters.items():
            if getter.service_is_ready():
                found[name] = await _text_parameter(getter, MODEL_FILE)
        return found

    async def load_model(self, files: Mapping[str, str]) -> None:
        """Give nodes other model files.

        Raises `ChainError` when one refuses; those before it have theirs already.
        """
        for name, path in files.items():
            wanted = Parameter(MODEL_FILE, value=path).to_parameter_msg()
            request = SetParameters.Request(parameters=[wanted])
            (result,) = (await _ask(self._setters[name], request, LOADING_S)).results
            if not result.successful:
                raise ChainError(f'{name}: {result.reason}')

    async def baseline_file(self) -> str:
        """Return the recording without metal that ``field_model`` was started with."""
        getter = self._getters['field_model']
        return await _text_parameter(getter, BASELINE_FILE) if getter.service_is_ready() else ''


async def _text_parameter(getter: Any, name: str) -> str:
    answer = await _ask(getter, GetParameters.Request(names=[name]), ANSWER_S)
    return str(answer.values[0].string_value) if answer.values else ''


async def _ask(client: Any, request: Any, longest_s: float) -> Any:
    """Wait for an answer, which comes in the executor's thread."""
    if not client.service_is_ready():
        raise ChainError(f'no node offers {client.srv_name}')
    loop = asyncio.get_running_loop()
    answered = asyncio.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _future: loop.call_soon_threadsafe(answered.set))
    try:
        await asyncio.wait_for(answered.wait(), longest_s)
    except TimeoutError:
        client.remove_pending_request(future)
        raise ChainError(f'{client.srv_name} does not answer') from None
    return future.result()


@dataclass(frozen=True)
class DashboardParameters:
    host: str = parameter(
        '127.0.0.1',
        "address that the page is served on; any other than this machine's own needs a token",
    )
    port: int = parameter(
        LIVE_VIEW, 'TCP port of the page; 0 for any that is free', within=(0, 65535)
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
        from anser_ros.apps.dashboard.loop import CorrectionLoop, RecordingFolder
        from anser_ros.apps.dashboard.page import Pages
        from anser_ros.apps.dashboard.server import PageServer, token_for

        table = self.parameters
        self.streams = polling_node(self)
        self._client = ChainClient(self)
        refuse = partial(self.warn, 'messages_refused')
        self._source = ViewSource(self.streams, table.optical, refuse, self._client.is_there)
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
        job = self._loop.job
        values = {
            'pages': self._server.guard.pages,
            'command': '' if job is None else job.kind,
            'last_trouble': self._loop.message if self._loop.is_trouble else '',
        }
        return Status('', Level.OK, f'{self._pages.count} pages open', values)

    def close(self) -> None:
        self._loop.cancel()
        self._server.end()
        self.streams.destroy_node()


if __name__ == '__main__':
    sys.exit(main(Dashboard))
