"""Makes a session of four coils before an array: coils are emitters, magnetometers the references.

Frame `fg` is the array's. An emitter's centre is where the vendor's own fit has it. The fluxes are
the raw epoch's phasors in the stored unit, signs and noise as they were sampled. Gradiometers are
left out: one axis at one place can't stand for a difference of two coils.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from anser_ros.measured.hpi_channels import examine
from anser_ros.measured.hpi_coils import HpiData, load
from anser_ros.measured.hpi_demodulation import demodulate, find_tones
from anser_ros.measured.session_file import vector, write_frames
from anser_ros.stamps import SECOND_NS
from anser_ros.wire.setup import FIELD_GENERATOR, Coil, Emitter, SensorSpec, Setup

KIND = 'head_coil'


def phasors(data: HpiData) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Return tones (K,), Hz, and magnetometers' fluxes (S, K), T, coils in the stored order."""
    array = data.array
    tones = demodulate(
        data.epoch, data.rate_hz, find_tones(data.epoch, data.rate_hz), array.is_magnetometer
    )
    found = examine(array, tones, data.stored)
    flux = found.scale[0] * tones.phasors[found.tone_of][:, array.is_magnetometer]
    return tones.frequencies_hz[found.tone_of], np.asarray(flux.T, dtype=complex)


def setup_of(data: HpiData, frequencies_hz: NDArray[np.float64]) -> Setup:
    """Return four emitters where the vendor has them, and a reference for each magnetometer."""
    array = data.array
    chosen = np.flatnonzero(array.is_magnetometer)
    centres = array.centres_m
    normals = np.sum(array.normals * array.weights[:, :, None], axis=1)[chosen]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sensors = tuple(
        SensorSpec(
            int(row), array.names[row].lower().replace(' ', '/'), FIELD_GENERATOR,
            vector(centres[row]), vector(normal), 0.0,
        )
        for row, normal in zip(chosen.tolist(), normals, strict=True)
    )  # fmt: skip
    coils = tuple(
        Coil(f'hpi{k}', vector(place), 0.0, float(frequency))
        for k, (place, frequency) in enumerate(zip(data.vendor_m, frequencies_hz, strict=True))
    )
    rate = data.rate_hz / data.epoch.shape[1]
    return Setup('fg', rate, Emitter(KIND, {}, coils), sensors)


def write_session(data: HpiData, path: Path) -> None:
    """Write the epoch as one frame; raises `BagError` when the file exists."""
    frequencies_hz, flux = phasors(data)
    write_frames(path, setup_of(data, frequencies_hz), [SECOND_NS], flux[None])


def write_sessions(folder: Path, into: Path) -> list[Path]:
    """Write the data set as a session; return the file written."""
    into.mkdir(parents=True, exist_ok=True)
    path = into / 'hpi_coils.mcap'
    write_session(load(folder), path)
    return [path]
