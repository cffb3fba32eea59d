"""Redoes the article's experiments on recordings, with the report and the figures of them."""
