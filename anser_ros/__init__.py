"""Real-time electromagnetic tracking with online compensation of metal distortion."""
