"""Names what the judges may say of a pose that its own frame had found good."""

INCONSISTENT = 'inconsistent'
"""State of a coil whose pose contradicts the rest of its body."""
UNCONFIRMED = 'unconfirmed'
"""State of a pose that has yet to be confirmed by the frames after it."""
MODEL_DOUBTFUL = 'model_doubtful'
"""State of all poses while nearly everything that is measured contradicts the field model."""
