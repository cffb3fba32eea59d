"""Lists what may be wrong with a session, by what it acts on, and how it is undone."""
