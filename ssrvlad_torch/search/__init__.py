"""Search: the frames of a source in a map, exactly or by an index on disk."""
