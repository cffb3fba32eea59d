"""Recorded sessions: read, prepared, tracked, evaluated, diagnosed, and watched while they run."""
