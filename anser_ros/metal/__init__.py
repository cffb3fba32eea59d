"""Models how metal answers to the emitters: bodies and sheets as operators on shapes of field."""
