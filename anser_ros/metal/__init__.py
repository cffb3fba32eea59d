"""Models how metal responds to the emitters: bodies and sheets as operators on shapes of field."""
