"""Offers scripts and notebooks sessions, models, tracking and diagnosis without ROS.

Everything public here is a name of the package itself: ``from anser_ros import load_session``.
Quantities are in SI units and in the frame ``fg`` of the field generator's board, unless the name
of an argument says otherwise. The commands ``anser calibrate``, ``anser evaluate`` and
``anser diagnose`` work on the same files and give the same figures.

The examples run in the folder of the repository, on the simulated sessions of ``bags/``.
"""
