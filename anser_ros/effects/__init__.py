"""Lists what may be wrong with a session, one file for each effect, and how it is undone."""
