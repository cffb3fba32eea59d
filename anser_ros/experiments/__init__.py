"""The article's experiments, redone on recordings, with the report and the figures of them."""
