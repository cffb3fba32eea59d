"""Imports other people's measurements, with recipes of commands that find what is in them.

A data set has a ``RECIPE`` (`recipe.Recipe`): its sessions, the commands that are run on them, and
the figures that these give. `apps/lab/cli/measured.py` lists the data sets.
"""
