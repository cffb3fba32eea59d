"""From measurements of a board to its field model: moments, dipole positions, and their choice."""
