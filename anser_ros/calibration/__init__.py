"""Makes a field model of measurements of a board: moments, dipole positions, and their choice."""
