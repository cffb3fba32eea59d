"""Names every document of a diagnosis, of fluxes and of poses alone."""

SCHEMA = 'anser_diagnosis/1'
"""Name of the document's layout (`docs/interfaces.md`), which stands in it."""
