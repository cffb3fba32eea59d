"""The one order of a frame, and what each half of it does with what the other one says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tracking_world import certain_model, triaxial_tool

from anser_ros.chain.chain import Chain
from anser_ros.chain.frame import Answer, ChainFrame, FrameReadings
from anser_ros.chain.model_half import ModelHalf
from anser_ros.chain.tracking_half import TrackingHalf
from anser_ros.pose_states import Withheld
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.tracking.tracker import Tracker

MODEL, TOOL = certain_model(), triaxial_tool()
NOISE_T = TrackerSettings.flux_noise_t
NOW_NS, SECOND_NS, STEP_NS = 10**12, 10**9, 20_000_000
READINGS = FrameReadings(np.arange(2), np.ones((2, 8), complex), np.zeros(2, int))


class Log:
    """Both halves, which note what is asked of them; the model is changed in some frames only."""

    def __init__(self):
        self.said = []
        self.refits = SimpleNamespace(step=self.refit, witnessed=self.witnessed)
        self.tracks = SimpleNamespace(use=self.use, step=self.track)

    def refit(self, frame):
        self.said.append(f'refit {frame.stamp_ns}')
        return frame.stamp_ns // 2 if frame.reference is not None else None

    def use(self, answer, ahead):
        self.said.append(f'use {answer}{" ahead" * ahead}')

    def track(self, stamp_ns, _tools):
        self.said.append(f'track {stamp_ns}')
        return [stamp_ns]

    def witnessed(self, frame, found):
        assert found == [frame.stamp_ns]
        self.said.append(f'witnessed {frame.stamp_ns}')


@pytest.mark.parametrize(
    ('lags', 'order'),
    [
        (False, ['refit 2', 'use 1', 'track 2', 'witnessed 2', 'refit 4', 'use 2', 'track 4',
                 'witnessed 4', 'refit 6', 'refit 8', 'track 8', 'witnessed 8']),
        (True, ['track 2', 'refit 2', 'use 1 ahead', 'witnessed 2', 'track 4', 'refit 4',
                'use 2 ahead', 'witnessed 4', 'refit 6', 'track 8', 'refit 8', 'witnessed 8']),
    ],
)  # fmt: skip
def test_a_frame_is_tracked_by_its_own_model_or_by_the_one_before(lags, order):
    log = Log()
    chain = Chain(log.refits, log.tracks, lags)
    frames = [(2, READINGS, READINGS), (4, READINGS, READINGS), (6, None, None),
              (8, READINGS, None)]  # fmt: skip
    assert [chain.step(ChainFrame(*frame)) for frame in frames] == [[2], [4], [], [8]]
    assert log.said == order


def test_without_references_there_is_nothing_to_refit_and_one_phase_may_do():
    log = Log()
    assert Chain(None, log.tracks).step(ChainFrame(2, READINGS, READINGS)) == [2]
    assert log.said == ['track 2']
    turned = replace(READINGS, flux=READINGS.flux * (1 + 1j))
    assert np.array_equal(ChainFrame(2, turned, turned).in_phase().tools.flux, READINGS.flux)


class Refit:
    """A refit whose state in each frame is given; its model is a new one each time."""

    def __init__(self, states):
        self.states, self.followed = iter(states), []
        self.references = SimpleNamespace(channel=READINGS.channels)

    def follow(self, frame):
        state = next(self.states)
        self.followed.append(frame.stamp_ns)
        model = replace(MODEL, flux_error_t=1e-12 * len(self.followed))
        return SimpleNamespace(
            stamp_ns=frame.stamp_ns, is_answer=not state, withheld=state, reason='why', model=model
        )

    def reset(self):
        self.followed.clear()


def test_every_frame_of_references_is_answered_by_the_last_model_that_they_gave():
    half = ModelHalf(SimpleNamespace(is_due=lambda stamp_ns: stamp_ns % STEP_NS == 0))
    assert half.step(ChainFrame(NOW_NS, READINGS, READINGS)) is None, 'there is no refit'
    half.follow_by(refit := Refit(['', 'references_doubtful', '']))
    assert half.step(ChainFrame(NOW_NS, READINGS, None)) is None
    first, between, doubtful, again = (
        half.step(ChainFrame(NOW_NS + lag, None, READINGS))
        for lag in (0, STEP_NS // 4, 2 * STEP_NS, 4 * STEP_NS)
    )
    assert len(refit.followed) == 3, 'one came before the pace allows'
    assert first.follows and first.withheld is None and between.model is first.model
    assert between.stamp_ns == NOW_NS + STEP_NS // 4
    assert doubtful.model is first.model
    assert doubtful.withheld == Withheld('references_doubtful', 'why')
    assert again.withheld is None and again.model.flux_error_t == 3e-12
    half.reset()
    assert half.result is None and half.answered is None and not refit.followed


@pytest.fixture
def half():
    return TrackingHalf(Tracker(MODEL, TOOL), 0.6)


def tool_at(stamp_ns):
    rng = np.random.default_rng(stamp_ns)
    flux = MODEL.flux(TOOL.position + [0.0, 0.0, 0.2], TOOL.axis, TOOL.length)
    noise = NOISE_T * (rng.normal(size=flux.shape) + 1j * rng.normal(size=flux.shape))
    return FrameReadings(TOOL.channel, flux + noise, np.zeros(len(flux), int))


def states(half, stamp_ns):
    return {one.state for one in half.step(stamp_ns, tool_at(stamp_ns))}


def follows(stamp_ns, model=MODEL, withheld=None):
    return Answer(stamp_ns, model, True, withheld)


class TestTracking:
    def test_a_model_ages_by_the_clock_of_the_frames(self, half):
        now = NOW_NS
        assert states(half, now) == {'ok'}
        half.use(Answer(now, MODEL))
        assert states(half, now + 100 * SECOND_NS) == {'ok'}, 'it follows nothing'
        now += 101 * SECOND_NS
        half.use(follows(now))
        assert states(half, now + SECOND_NS // 4) == {'ok'}
        assert states(half, now + SECOND_NS) == {'references_lost'}
        half.use(follows(now + SECOND_NS, withheld=Withheld('references_lost', 'too few')))
        assert states(half, now + SECOND_NS + 1) == {'references_lost'}
        assert 'too few' in half.withheld.reason
        now += 2 * SECOND_NS
        half.use(follows(now))
        assert states(half, now) == {'ok'}
        half.use(follows(now + 1, withheld=Withheld('references_doubtful', '')))
        assert states(half, now + 1) == {'references_doubtful'}
        # The server's own stamp while a recording of another day is played.
        half.use(follows(10**18))
        assert states(half, now + SECOND_NS // 4) == {'ok'}
        assert states(half, now + SECOND_NS) == {'references_lost'}

    @pytest.mark.parametrize('late_s', [1, 6, 60])
    def test_an_answer_to_an_old_frame_is_late_however_old_the_frame(self, half, late_s):
        """Beyond some age it was once taken for one by another clock, and trusted anew."""
        states(half, NOW_NS)
        half.use(follows(NOW_NS - late_s * SECOND_NS))
        assert states(half, NOW_NS + 1) == {'references_lost'}

    @pytest.mark.parametrize('ahead', [False, True])
    def test_the_model_of_the_next_frame_is_made_ready_before_it_comes(self, half, ahead):
        for n in range(2):
            model = replace(MODEL, moments=(1.0 + 0.01 * n) * MODEL.moments)
            half.use(follows(NOW_NS + n * STEP_NS, model), ahead)
        ready = half.tracker.model
        assert (ready is model) != ahead, 'one that is for the frame after its own has aged'
        half.step(NOW_NS + (1 + ahead) * STEP_NS, tool_at(NOW_NS))
        assert half.tracker.model is ready and (ready.modes is not None) == ahead

    def test_a_frame_of_doubtful_origin_says_nothing_of_ages(self, half):
        half.use(follows(NOW_NS))
        doubt = Withheld('two_sources', '2 publishers')
        found = half.step(NOW_NS + 60 * SECOND_NS, tool_at(NOW_NS), doubt)
        assert {one.state for one in found} == {'two_sources'} and half.withheld is doubt
        assert states(half, NOW_NS + 61 * SECOND_NS) == {'references_lost'}
