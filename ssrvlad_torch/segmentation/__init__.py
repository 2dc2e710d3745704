"""Images -> label maps, by any network."""
