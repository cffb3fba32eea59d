"""Follows reference coils on patches that move: poses from a topic, fluxes among the tools'.

A patch is a body of the setup whose pose another tracker measures. Its coils join the fixed
references for as long as pose and flux are fresh; where one is missing, they are left out, and
reported.
"""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from geometry_msgs.msg import PoseStamped
from numpy.typing import NDArray

from anser_ros.nodes.field_model_parts.pose_messages import pose_in
from anser_ros.physics.sensor import SensorTable
from anser_ros.refit.live_refit import LiveRefit
from anser_ros.refit.patches import PatchCoils
from anser_ros.settings import RefitSettings
from anser_ros.stamps import stamp_of

ComplexArray = NDArray[np.complex128]

WORKER = 'patches'
"""Name of the thread that works a refit out; there is none while nothing is worked out."""


class Patches(PatchCoils):
    """Follows the patches that messages tell of; a refit for new places is computed in
    parallel with the callbacks.

    Parameters
    ----------
    coils : SensorTable
        Places and axes in their bodies' frames.
    fixed : ndarray, shape (R, K), complex
        Baseline of the fixed references, T.
    frame_id : str
        The poses' frame must be this one.
    settings : RefitSettings, optional
        Of the refit that the coils take part in.
    """

    def __init__(
        self,
        coils: SensorTable,
        fixed: ComplexArray,
        frame_id: str,
        settings: RefitSettings | None = None,
    ) -> None:
        super().__init__(coils, fixed, settings)
        self._frame_id = frame_id
        self._pending: tuple[Future[LiveRefit], SensorTable] | None = None

    def take_pose(self, body: str, message: PoseStamped) -> None:
        """Keep a body's pose.

        Raises
        ------
        FrameError
            When it is given in another frame, or is no pose.
        """
        position, rotation = pose_in(message, self._frame_id, body)
        self.put(body, stamp_of(message), position, rotation)

    def moved_refit(self, refit: LiveRefit, stamp_ns: int) -> LiveRefit | None:
        """Return a refit for where the patches are now, when it is needed and has been worked out.

        Parameters
        ----------
        refit : LiveRefit
            The one in force; its last coils are the patches'.
        stamp_ns : int
        """
        if self._pending is not None:
            work, at = self._pending
            if not work.done():
                return None
            self._pending = None
            self.settle(at)
            return work.result()
        now, known = self.where(stamp_ns)
        if known.any() and self.must_rebuild(now):
            worker = ThreadPoolExecutor(1, thread_name_prefix=WORKER)
            self._pending = (worker.submit(self.rebuilt, refit, now), now)
            worker.shutdown(wait=False)  # its thread ends with the work, whoever still asks for it
        return None
