"""The simulated control unit: bytes in, bytes out, and fluxes that come back as they went in."""

from dataclasses import replace

import numpy as np
import pytest

from anser_ros.errors import ParameterError, SetupError
from anser_ros.nodes.acquisition_stream import FluxStream
from anser_ros.physics.dipole import field_basis
from anser_ros.simulation import effects
from anser_ros.simulation.control_unit import ControlUnit, FrontEnd
from anser_ros.simulation.effects import CATALOGUE, draw
from anser_ros.simulation.world import World, steel_disc
from anser_ros.wire import frames
from anser_ros.wire.channel_calibration import parse_channels
from anser_ros.wire.protocols import FrameReader
from anser_ros.wire.setup import parse_setup
from anser_ros.wire.text_files import config_path, read_config

SETUP = parse_setup(read_config('demo_setup.yaml'))
CHANNELS = parse_channels(read_config('demo_channels.yaml'))
TONES = np.array(SETUP.frequencies_hz)
WINDOW_S = 0.02


def dipoles(points):
    """One vertical dipole an emitter, as strong as 25 turns of 62 mm at 0.25 A."""
    centres = np.array([coil.centre_m for coil in SETUP.emitter.coils])
    up = np.broadcast_to([0.0, 0.0, 1.0], centres.shape)
    return 0.024 * field_basis(points, centres, up).transpose(0, 2, 1).astype(complex)


def world(**options):
    return World(SETUP, dipoles, **options)


def decode(pieces):
    return [record.payload for record in FrameReader().feed(b''.join(p.data for p in pieces))]


def streamed(unit, samples):
    """Start a unit; return its bytes over so many samples."""
    unit.receive(frames.encode(frames.Start()))
    return b''.join(piece.data for piece in unit.advance(samples))


def codes_of(unit, samples):
    """Start a unit; return the codes of so many samples, shape (samples, columns)."""
    payloads = [record.payload for record in FrameReader().feed(streamed(unit, samples))]
    return np.concatenate([p.codes for p in payloads if isinstance(p, frames.SampleBlock)])


def stream_of(unit, rate_hz=1 / WINDOW_S):
    """Return a stream for a unit."""
    said = decode(unit.receive(frames.encode(frames.Identify())))
    (hello,) = [p for p in said if isinstance(p, frames.Hello)]
    return FluxStream(hello, SETUP, CHANNELS, WINDOW_S, rate_hz)


def fluxes(unit, seconds=0.1):
    """Fluxes (windows, S, K), their sigmas and the mid times, as acquisition makes them."""
    unit.receive(frames.encode(frames.Start()))
    begin, arrival_ns, found = unit.samples / unit.sample_rate_hz, 10**12, []
    stream = stream_of(unit)
    stream.restart(arrival_ns)
    for _ in range(round(seconds / 0.005)):
        for block in decode(unit.advance(200)):
            if isinstance(block, frames.SampleBlock):
                arrival_ns += 10**6
                found += stream.push([block], [arrival_ns])
    flux = [np.concatenate([frame.tool.flux, frame.reference.flux]) for frame in found]
    times = begin + (np.arange(len(found)) + 0.5) * WINDOW_S
    return np.array(flux), np.array([frame.window.sigma for frame in found]), times


@pytest.mark.parametrize('rate_hz', [25, 50, 100])
def test_blocks_in_runs_lost_and_twice_give_the_fluxes_of_single_blocks(rate_hz):
    unit = ControlUnit(world(), CHANNELS)
    payloads = [r.payload for r in FrameReader().feed(streamed(unit, 12_000))]
    blocks = [p for p in payloads if isinstance(p, frames.SampleBlock)]
    kept = [b for b in blocks if b.sequence not in {50, 97, 98, *range(150, 175)}]
    kept.insert(60, kept[55])
    rng, found = np.random.default_rng(rate_hz), []
    for runs in (False, True):
        stream, done, times = stream_of(unit, rate_hz), 0, []
        stream.restart(10**12)
        while done < len(kept):
            count = stream.run_length(kept[done : done + rng.integers(1, 9)]) if runs else 1
            arrivals = [10**12 + (b.sequence + 1) * 10**6 for b in kept[done : done + count]]
            times += stream.push(kept[done : done + count], arrivals)
            done += count
        found.append(times)
    single, grouped = ([(f.window.flux, f.flags) for f in times] for times in found)
    assert len(single) > 0.8 * 0.3 * rate_hz
    for (flux, flags), (same, same_flags) in zip(single, grouped, strict=True):
        np.testing.assert_allclose(same, flux, rtol=1e-9, atol=1e-15)
        assert np.array_equal(same_flags, flags)


class TestProtocol:
    def test_says_hello_and_status_once_a_second_even_when_idle(self):
        unit = ControlUnit(world(), CHANNELS)
        payloads = [p for _ in range(300) for p in decode(unit.advance(400))]
        assert [type(p) for p in payloads] == [frames.Hello, frames.DeviceStatus] * 3
        assert payloads[1].state is frames.DeviceState.IDLE

    def test_streams_between_start_and_stop(self):
        unit = ControlUnit(world(), CHANNELS)
        unit.advance(400)
        (reply,) = decode(unit.receive(frames.encode(frames.Start(), 7)))
        assert reply == frames.Reply(0x82, frames.ReplyCode.OK)
        blocks = [p for _ in range(4) for p in decode(unit.advance(100))]
        assert [b.sequence for b in blocks] == list(range(10))
        assert [b.timestamp_ticks for b in blocks] == [10_000 + 1000 * k for k in range(10)]
        assert blocks[0].codes.shape == (40, 42)
        unit.receive(frames.encode(frames.Stop()))
        assert decode(unit.advance(100)) == []

    def test_time_that_was_skipped_is_missing_from_the_sequence(self):
        unit = ControlUnit(world(), CHANNELS)
        unit.receive(frames.encode(frames.Start()))
        unit.advance(90)
        unit.skip(100)
        blocks = [p for p in decode(unit.advance(50)) if isinstance(p, frames.SampleBlock)]
        assert [(b.sequence, b.timestamp_ticks, b.flags) for b in blocks] == [
            (4, 4000, frames.SamplesFlag.LOST_BEFORE),
            (5, 5000, 0),
        ]

    def test_sets_tones_and_refuses_wrong_ones(self):
        unit = ControlUnit(world(), CHANNELS)
        reply, hello = decode(
            unit.receive(frames.encode(frames.SetFrequencies(tuple(TONES + 1000))))
        )
        assert reply.code is frames.ReplyCode.OK
        assert hello.frequencies_hz == tuple(TONES + 1000)
        for wrong in ((6000.0,), (30000.0,) * 8):
            (reply,) = decode(unit.receive(frames.encode(frames.SetFrequencies(wrong))))
            assert reply.code is frames.ReplyCode.BAD_ARGUMENT and reply.text

    def test_counts_what_it_refused_and_what_it_dropped(self):
        unit = ControlUnit(world(), CHANNELS)
        damaged = bytearray(frames.encode(frames.Start()))
        damaged[-1] ^= 1
        assert unit.receive(bytes(damaged)) == []
        assert unit.receive(frames.encode(frames.Reply(1, frames.ReplyCode.OK))) == []
        unit.receive(frames.encode(frames.Start()))
        unit.drop()
        payloads = decode(unit.advance(40))
        assert payloads[1].refused_records == 1 and payloads[1].dropped_blocks == 1
        assert payloads[2].flags == frames.SamplesFlag.LOST_BEFORE


class TestSignals:
    def errors(self, *front_end):
        """Fluxes less the true ones in units of their sigma, and the sigmas."""
        got, sigma, times = fluxes(ControlUnit(world(), CHANNELS, *front_end), 0.2)
        return np.abs(got - [world().flux(t) for t in times]) / sigma, sigma

    def test_flux_comes_back_as_it_went_in_whatever_the_currents_do(self):
        ratio, sigma = self.errors()
        assert len(ratio) == 10
        assert np.sqrt((ratio**2).mean() / 2) == pytest.approx(1.0, abs=0.1)
        assert 20e-12 < np.median(sigma) < 200e-12
        ratio, _ = self.errors(FrontEnd(current_drift=0.3, warm_up_s=0.5))
        assert ratio.max() < 7

    def test_converter_clips(self):
        codes = codes_of(ControlUnit(world(), CHANNELS, FrontEnd(full_scale_v=0.02)), 400)
        assert codes.min() == -32768 and codes.max() == 32767

    def test_same_seed_same_bytes(self):
        units = [ControlUnit(world(metal=[steel_disc()]), CHANNELS, seed=3) for _ in range(2)]
        first, second = (streamed(unit, 200) for unit in units)
        assert first == second


class TestEffects:
    def codes(self, *effects):
        unit = ControlUnit(world(), CHANNELS, FrontEnd(noise_codes=0.0), effects=effects)
        return codes_of(unit, 4000).astype(float)

    def test_effects_on_samples_do_what_they_say(self):
        clean = self.codes()
        leaky = self.codes(effects.channel_crosstalk([3, 5], np.array([[1.0, 0.1], [0.0, 1.0]])))
        assert np.abs(leaky[:, 3] - clean[:, 3] - 0.1 * clean[:, 5]).max() <= 1
        assert np.array_equal(np.delete(leaky, 3, 1), np.delete(clean, 3, 1))
        limit = 5.0 * np.abs(clean[:, 20]).max() / 32768
        bent = self.codes(effects.compressing(20, limit))
        ratio = np.abs(bent[:, 20]).max() / np.abs(clean[:, 20]).max()
        assert ratio == pytest.approx(np.tanh(1.0), abs=1e-3)
        loose = self.codes(effects.loose(20, share=0.5, period_s=0.02, rest=0.0))
        assert np.abs(loose[:400, 20]).max() == 0
        assert np.array_equal(loose[400:800], clean[400:800])
        swung = self.codes(effects.gain_ripple(0.1, 0.4))
        assert np.abs(swung[-1, 20] - 1.1 * clean[-1, 20]) <= 1
        scaled = self.codes(effects.with_gain(20, 0.5))
        assert np.abs(scaled[:, 20] - 0.5 * clean[:, 20]).max() <= 1
        crossed = self.codes(effects.crossing_over(20, 0.02))
        volts = clean[:, 20] * 5.0 / 32768
        expected = clean[:, 20] - 0.02 * np.tanh(volts / 0.02) * 32768 / 5.0
        assert np.abs(crossed[:, 20] - expected).max() <= 2

    def test_tilted_sensor_is_tilted_in_the_world_only(self):
        real = effects.tilted(2, (0.0, 0.6, 0.8)).setup(SETUP)
        assert real.sensors[2].axis == (0.0, 0.6, 0.8)
        assert real.sensors[3:] == SETUP.sensors[3:]

    def test_drift_begins_with_the_first_start(self):
        drift = effects.weakening(2, -0.5, 0.05)

        def current_share(unit, seconds):
            unit.advance(int(seconds * unit.sample_rate_hz))
            unit.receive(frames.encode(frames.Start()))
            got, _, times = fluxes(unit, 0.1)
            return got[:, 20, 2].real / [world().flux(t)[20, 2].real for t in times]

        share = current_share(ControlUnit(world(), CHANNELS, effects=[drift]), 0.0)
        assert share[0] > 0.85 and share[-1] < 0.65
        unit = ControlUnit(world(), CHANNELS, effects=[drift])
        idle = current_share(unit, 1.0)
        assert idle[0] > 0.85, 'an idle unit does not drift'
        again = current_share(unit, 1.0)
        assert again[0] < 0.52, 'a second start does not cool the coils'

    def test_optical_clock(self):
        clock = effects.optical_clock(early_s=0.03, fast_ppm=1000.0)
        assert clock.optical_time(0.0) == -0.03
        assert clock.optical_time(10.0) == pytest.approx(9.98)


class TestDraw:
    @pytest.mark.parametrize('name', sorted(CATALOGUE))
    def test_every_effect_of_the_catalogue_changes_the_signals(self, name):
        drawn = draw(name, SETUP, CHANNELS, np.random.default_rng(1))
        assert drawn.name == name and drawn.parameters
        real = SETUP
        for effect in drawn.effects:
            real = effect.setup(real)
        changed = World(real, dipoles, metal=drawn.metal)
        quiet = FrontEnd(noise_codes=0.0, current_noise_codes=0.0)
        streams = []
        for unit in (
            ControlUnit(changed, CHANNELS, quiet, effects=drawn.effects),
            ControlUnit(world(), CHANNELS, quiet),
        ):
            unit.advance(40_000)
            streams.append(streamed(unit, 4000))
        optical = [effect.optical_time(10.0) for effect in drawn.effects]
        assert (streams[0] != streams[1]) or optical != [10.0] * len(optical)

    def test_random_is_reproducible_and_none_is_nothing(self):
        first, second = (
            draw('random', SETUP, CHANNELS, np.random.default_rng(5)) for _ in range(2)
        )
        assert first.document() == second.document()
        assert draw('none', SETUP, CHANNELS, np.random.default_rng(0)).effects == ()
        with pytest.raises(ParameterError, match='no effect'):
            draw('gremlin', SETUP, CHANNELS, np.random.default_rng(0))


class TestMetal:
    def test_metal_comes_and_goes(self):
        bare, with_metal = world(), world(metal=[steel_disc()])
        change = [np.abs(with_metal.flux(t) - bare.flux(t)).max() for t in (0.0, 14.0, 30.0)]
        assert change[1] > 5e-9 and change[1] > 50 * max(change[0], change[2])


@pytest.mark.parametrize('kept', ['tool_sensors', 'reference_sensors'])
def test_a_world_of_only_tools_or_only_references(kept):
    setup = replace(SETUP, sensors=getattr(SETUP, kept))
    rows = [SETUP.sensors.index(sensor) for sensor in setup.sensors]
    for metal in ((), (steel_disc(),)):
        part, whole = World(setup, dipoles, metal=metal), world(metal=metal)
        assert part.flux(14.0) == pytest.approx(whole.flux(14.0)[rows])


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('[', 'not YAML'),
        ('schema: other', 'schema must be'),
        ('schema: anser_channels/1', 'default must be a mapping'),
        ('schema: anser_channels/1\ndefault: {}', 'area_m2 must be a finite'),
        ('schema: anser_channels/1\ndefault: {area_m2: 0}', 'not be zero'),
        ('schema: anser_channels/1\ndefault: {area_m2: 1, delay_s: 1}', '10 ms'),
        ('schema: anser_channels/1\ndefault: {area_m2: 1, gain: 1}', 'unknown key gain'),
        ('schema: anser_channels/1\ndefault: {area_m2: 1}\nchannels: 3', 'must be a list'),
        ('schema: anser_channels/1\ndefault: {area_m2: 1}\nchannels: [{}]', 'channel number'),
        (
            'schema: anser_channels/1\ndefault: {area_m2: 1}\n'
            'channels: [{channel: 1}, {channel: 1}]',
            'appears twice',
        ),
    ],
)
def test_channel_documents_that_are_refused(text, message):
    with pytest.raises(SetupError, match=message):
        parse_channels(text)


def test_config_files_are_found_or_named(tmp_path):
    assert config_path('demo_setup.yaml').is_file()
    with pytest.raises(SetupError, match='no file nothing'):
        config_path('nothing.yaml')
    binary = tmp_path / 'binary.yaml'
    binary.write_bytes(b'\xff\x00\x80')
    with pytest.raises(SetupError, match='not a text'):
        read_config(str(binary))
