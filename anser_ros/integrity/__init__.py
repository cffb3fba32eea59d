"""May a pose be trusted: judges of what poses are made from, and the states that they say."""
