"""The live refit: the field model follows reference sensors while metal moves."""
