"""One intake of flux frames: what order, flags and values say about a frame is judged here."""
