"""Holds the parts of recorder and replay: message definitions, what was recorded, who listens."""
