"""Finds the tracked volume of a setup: what its document states, or what its board suggests."""

from anser_ros.errors import FitError
from anser_ros.physics.volume import TrackedVolume
from anser_ros.refit.excitation import region_of
from anser_ros.sessions.drawing import NominalBoard
from anser_ros.wire.setup import Setup


def stated_volume(setup: Setup) -> TrackedVolume | None:
    """Return the volume that the setup document states; None where it leaves it to the board."""
    return None if setup.volume is None else TrackedVolume(*setup.volume)


def tracked_volume(setup: Setup) -> TrackedVolume:
    """Return the stated volume, or else the default over the setup's board.

    A board that can't be drawn from the setup gets the box of an Anser board.
    """
    stated, field = stated_volume(setup), NominalBoard.of(setup).field
    if stated is not None:
        return stated
    if field is None:
        return TrackedVolume()
    try:
        return region_of(field).volume
    except FitError:  # a drawing without any field
        return TrackedVolume()
