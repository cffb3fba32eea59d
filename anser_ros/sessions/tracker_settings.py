"""Takes what a setup document says about tracking: noise, stamps, tools, volume."""

from dataclasses import replace

from anser_ros.sessions.session import stamp_sigma, tracking_noise
from anser_ros.sessions.volume import tracked_volume
from anser_ros.tracking.estimate import TrackerSettings
from anser_ros.wire.setup import Setup


def settings_for(setup: Setup, settings: TrackerSettings) -> TrackerSettings:
    """Return settings with what the setup states or measured, and its volume if they have none."""
    return replace(
        settings,
        flux_noise_t=tracking_noise(setup),
        stamp_sigma_s=stamp_sigma(setup),
        tools=setup.refit.tools,
        volume=settings.volume or tracked_volume(setup),
    )
