"""The node field_model over DDS: the model that it serves, and its services."""

from dataclasses import replace

import numpy as np
import pytest
from graph_bench import FIRST_NS, Bench, reference_specs
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool, Trigger
from tracking_world import certain_model

from anser_ros.nodes.field_model import FieldModelNode
from anser_ros.nodes.streams.clouds import read_dipoles, read_error
from anser_ros.sessions.session import sensor_table
from anser_ros.sessions.starting_model import load_model, save_model
from anser_ros.stamps import stamp_of


@pytest.fixture
def server(ros, tmp_path):
    """A field_model node that saves into the test's folder."""
    node = FieldModelNode(
        parameter_overrides=[
            Parameter('save_file', value=str(tmp_path / 'kept.yaml')),
            Parameter('baseline_s', value=0.2),
        ]
    )
    bench = Bench(ros, node)
    bench.connect(bench.setup, bench.reference)
    yield bench
    bench.close()


def call(bench, kind, name, **request):
    client = bench.peer.create_client(kind, f'field_model/{name}')
    bench.spin_until(client.service_is_ready)
    future = client.call_async(kind.Request(**request))
    bench.spin_until(future.done)
    bench.peer.destroy_client(client)
    return future.result()


def test_the_nominal_model_is_served_latched_with_its_uncertainty(server):
    server.say_setup()
    server.spin_until(lambda: server.models and server.errors)
    points = read_dipoles(server.models[0])
    assert points.moments.shape == (144, 8)
    assert server.models[0].point_step == 8 * (6 + 16)
    assert stamp_of(server.models[0]) == stamp_of(server.errors[0]) > 0
    error = read_error(server.errors[0], 144, 8)
    assert error.modes.shape == (48, 144, 8)
    server.say_setup('schema: anser_setup/1\nsensors: []\n')
    server.spin_until(lambda: server.node.counters['setups_refused'] == 1)
    server.node.publish_diagnostics()
    server.spin_until(lambda: 'at least one' in server.state('anser/field_model'))


def test_services_of_the_field_model(server, tmp_path):
    assert not call(server, Trigger, 'reset').success, 'there is no model yet'
    assert not call(server, Trigger, 'save').success
    assert not call(server, Trigger, 'set_baseline').success
    server.say_setup()
    server.spin_until(lambda: len(server.models) == 1)
    reply = call(server, Trigger, 'set_baseline')
    assert not reply.success
    assert 'frames' in reply.message
    references = sensor_table(reference_specs())
    clean = certain_model().flux(references.position, references.axis)
    for i in range(8):
        points = server.points(clean, channels=references.channel)
        server.reference.publish(server.cloud.message(points, FIRST_NS + i * 40_000_000))
    server.spin_until(lambda: server.node.counters['frames'] == 8)
    reply = call(server, Trigger, 'set_baseline')
    assert reply.success, reply.message
    assert reply.message.startswith('baseline of 8 references')
    assert call(server, SetBool, 'freeze', data=True).message == 'the model stays as it is'
    assert call(server, SetBool, 'freeze', data=False).message == 'the model may change'
    reply = call(server, Trigger, 'save')
    assert reply.message == str(tmp_path / 'kept.yaml')
    kept = load_model(reply.message)
    assert kept.moments.shape == (144, 8)
    before = stamp_of(server.models[-1])
    assert call(server, Trigger, 'reset').success
    server.spin_until(lambda: stamp_of(server.models[-1]) > before)
    assert server.node.counters['callback_faults'] == 0


def test_another_model_while_it_runs(server, tmp_path):
    """It is served, and followed with the baseline of before; one that does not fit is refused."""

    def give(name):
        return server.node.set_parameters([Parameter('model_file', value=str(tmp_path / name))])[0]

    model = certain_model()
    save_model(tmp_path / 'better.yaml', replace(model, moments=1.01 * model.moments))
    save_model(tmp_path / 'other.yaml', replace(model, emitters=tuple('abcdefgh')))
    server.say_setup()
    server.spin_until(lambda: len(server.models) == 1)
    references = sensor_table(reference_specs())
    clean = model.flux(references.position, references.axis)
    for i in range(8):
        points = server.points(clean, channels=references.channel)
        server.reference.publish(server.cloud.message(points, FIRST_NS + i * 40_000_000))
    server.spin_until(lambda: server.node.counters['frames'] == 8)
    assert call(server, Trigger, 'set_baseline').success
    server.spin_until(lambda: server.node.counters['refit_starts'] == 1)
    before = len(server.models)
    for name, why in (('other.yaml', 'emitters'), ('nowhere.yaml', 'nowhere.yaml')):
        refused = give(name)
        assert not refused.successful
        assert why in refused.reason
        assert server.node.parameters.model_file != str(tmp_path / name)
    assert give('better.yaml').successful
    server.spin_until(lambda: len(server.models) > before)
    served = read_dipoles(server.models[-1])
    np.testing.assert_allclose(served.moments, 1.01 * model.moments)
    server.spin_until(lambda: server.node.counters['refit_starts'] == 2)
    points = server.points(clean, channels=references.channel)
    server.reference.publish(server.cloud.message(points, FIRST_NS + 400_000_000))
    server.spin_until(lambda: server.node.counters['refits'] == 1)
    assert server.node.counters['callback_faults'] == 0


def test_a_model_file_is_served_at_once_and_must_fit_the_setup(ros, tmp_path):
    model = certain_model()
    other = type(model)(
        model.positions, model.directions, model.moments,
        ('a', 'b', 'c', 'd', 'e', 'f', 'g', 'h'), model.frequencies_hz,
    )  # fmt: skip
    save_model(tmp_path / 'other.yaml', other)
    node = FieldModelNode(
        parameter_overrides=[Parameter('model_file', value=str(tmp_path / 'other.yaml'))]
    )
    bench = Bench(ros, node)
    try:
        bench.connect(bench.setup)
        bench.spin_until(lambda: bool(bench.models))
        bench.say_setup()
        bench.spin_until(lambda: node.counters['setups_refused'] == 1)
        node.publish_diagnostics()
        bench.spin_until(lambda: 'emitters' in bench.state('anser/field_model'))
    finally:
        bench.close()
