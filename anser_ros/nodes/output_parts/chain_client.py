"""Asks the running nodes on behalf of the page: services, and which model file they have."""

import asyncio
from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.node import Node
from std_srvs.srv import Trigger

from anser_ros.errors import AnserError

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
    """Reaches the nodes of a namespace, as `anser_ros.web.loop.Chain` has them.

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
        """Return whether somebody offers a service."""
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
            value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=path)
            wanted = ParameterMessage(name=MODEL_FILE, value=value)
            request = SetParameters.Request(parameters=[wanted])
            answer = await _ask(self._setters[name], request, LOADING_S)
            if not answer.results or not answer.results[0].successful:
                reason = answer.results[0].reason if answer.results else 'refused'
                raise ChainError(f'{name}: {reason}')

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
