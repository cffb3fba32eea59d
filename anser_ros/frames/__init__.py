"""Takes flux frames in: what order, flags and values say about a frame is judged here, once."""
