"""Holds the parts of the tracker node: the model of a frame's instant, and the poses' topics."""
