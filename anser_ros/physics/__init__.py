"""Physics of current paths, magnetic dipoles and pick-up coils; it imports no other room."""
