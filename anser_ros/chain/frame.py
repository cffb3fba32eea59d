"""Holds what the halves of the chain give each other."""

from dataclasses import dataclass, replace

from anser_ros.arrays import ComplexArray, Integers
from anser_ros.field.model import FieldModel
from anser_ros.pose_states import Withheld


@dataclass(frozen=True)
class FrameReadings:
    """Holds what S sensors read in one frame: channels, fluxes (S, K), T, and flag bits."""

    channels: Integers
    flux: ComplexArray
    flags: Integers


@dataclass(frozen=True)
class ChainFrame:
    """Holds all that tools or references, or both, measured under one stamp."""

    stamp_ns: int
    tools: FrameReadings | None
    reference: FrameReadings | None

    def in_phase(self) -> 'ChainFrame':
        """Return the frame without the quadrature parts of the tools' fluxes."""
        tools = self.tools
        if tools is None:
            return self
        return replace(self, tools=replace(tools, flux=tools.flux.real.astype(complex)))


@dataclass(frozen=True)
class Answer:
    """Holds the model that is to be used from a stamp on, and why no pose may be given, if so.

    The model is None while there is none but the tracker's own. If it ``follows`` references,
    their frames are answered one by one, and it ages until the next answer. Poses state its
    ``name``, or what distinguishes its arrays where that is None.
    """

    stamp_ns: int
    model: FieldModel | None
    follows: bool = False
    withheld: Withheld | None = None
    name: str | None = None
