"""How metal answers to the emitters: bodies and sheets as operators between shapes of field."""
