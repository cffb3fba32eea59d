"""Metal that is known from another recording: learnt once, followed by tools alone."""
